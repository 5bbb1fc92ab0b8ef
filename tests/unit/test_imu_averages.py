"""Averaged IMU samples: the means of the simulated motion over a tick, against fine integration."""

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from scipy.integrate import solve_ivp
from scipy.spatial.transform import Rotation

import quad_gym
from quad_gym.batch.flight_batch import FlightBatch
from quad_gym.records import Source
from quad_gym.sensors import Imu
from quad_gym.vehicle import state_derivative
from tests.body_states import random_state, state_of
from tests.unit.test_imu import QUIET

LAB = quad_gym.sensor_suite("lab")
AVERAGE = LAB.replace(
    imu=LAB.imu.replace(samples="average"), estimator=LAB.estimator.replace(integration="midpoint")
)
# hardly any drag: its kink, where the flow through the rotors reverses, disturbs quadrature
VEHICLE = quad_gym.VehicleParams(disc_area=1e-9)
LEVER = (0.05, -0.03, 0.02)
SHAPES = {"position": 3, "velocity": 3, "R_BI": (3, 3), "body_rates": 3, "rotor_speeds": 4}


def packed(state):
    return np.concatenate([np.ravel(state[name]) for name in SHAPES])


def unpacked(x):
    cuts = np.split(x, np.cumsum([np.prod(shape) for shape in SHAPES.values()])[:-1])
    return {
        name: part.reshape(shape) for part, (name, shape) in zip(cuts, SHAPES.items(), strict=True)
    }


def fly_finely(state, voltages, force, dt):
    """States at the Gauss points of a tick, their weights, and the state at its end, by SciPy."""
    nodes, weights = np.polynomial.legendre.leggauss(8)
    instants = np.append(0.5 * dt * (nodes + 1.0), dt)
    solution = solve_ivp(
        lambda t, x: packed(state_derivative(unpacked(x), voltages, force, VEHICLE)),
        (0.0, dt),
        packed(state),
        method="DOP853",
        t_eval=instants,
        rtol=1e-11,
        atol=1e-12,
    )
    states = [unpacked(x) for x in solution.y.T]
    return states[:-1], weights / 2.0, states[-1]


def orthonormal(R):
    u, _, v = np.linalg.svd(R)
    return u @ v


def average_sample(start, end, lever, dt):
    params = QUIET.replace(samples="average", lever_arm_B=lever, rate=1.0 / dt)
    end = end | {"R_BI": orthonormal(end["R_BI"])}
    return Imu(params, np.random.default_rng(1), VEHICLE).measure(end, since=start)


def instant_force(state, force, lever):
    state = state | {"R_BI": orthonormal(state["R_BI"])}
    imu = Imu(QUIET.replace(lever_arm_B=lever), np.random.default_rng(1), VEHICLE)
    return imu.measure(state, force)[1]


@settings(max_examples=30)  # SciPy's integration is slow
@given(st.integers(0, 2**32 - 1))
@example(500)  # the quaternions of its start and end have opposite signs
def test_averaged_sample_is_the_mean_rate_and_force_over_the_tick(seed):
    """The axes are at the attitude halfway. SciPy integrates states; instant samples give force."""
    start, rng, dt = random_state(seed), np.random.default_rng(seed), 0.005
    voltages, force = rng.uniform(3.0, 9.0, 4), rng.normal(size=3)
    states, weights, end = fly_finely(start, voltages, force, dt)
    gyro, accel = average_sample(start, end, LEVER, dt)
    turn = Rotation.from_matrix(orthonormal(end["R_BI"]) @ start["R_BI"].T)
    np.testing.assert_allclose(gyro * dt, -turn.as_rotvec(), rtol=0.0, atol=1e-11)
    half = Rotation.from_rotvec(turn.as_rotvec() / 2.0).as_matrix() @ start["R_BI"]
    mean = sum(
        w * (half @ s["R_BI"].T @ instant_force(s, force, LEVER))
        for w, s in zip(weights, states, strict=True)
    )
    np.testing.assert_allclose(accel, mean, rtol=0.0, atol=1e-7)


def test_averaged_samples_of_batch_and_imu_class_are_equal():
    """The samples equal the ones of `Imu` between the batch's states, without noise and bias."""
    quiet = AVERAGE.replace(imu=QUIET.replace(samples="average", lever_arm_B=LEVER))
    batch = FlightBatch(8, sensors=quiet, source=Source.TRUTH, run_filter=True)
    batch.reset(seeds=range(8))
    imu = Imu(quiet.imu, np.random.default_rng(1))
    for _ in range(40):
        before = [state_of(batch.record, lane) for lane in range(8)]
        batch.step()
        for lane in range(8):
            gyro, accel = imu.measure(state_of(batch.record, lane), since=before[lane])
            np.testing.assert_allclose(batch.record("gyro")[lane], gyro, rtol=0.0, atol=1e-10)
            np.testing.assert_allclose(batch.record("accel")[lane], accel, rtol=0.0, atol=1e-10)
        np.testing.assert_allclose(batch.record("w_meas"), batch.record("w"), rtol=0.0, atol=1e-12)


def test_inner_loops_read_the_instant_rate_and_the_filter_the_mean_rate():
    batch = FlightBatch(8, sensors=AVERAGE)
    batch.reset(seeds=range(8))
    for _ in range(50):
        start = batch.record("w")
        batch.step()
        bias = batch.record("b_g")
        noise = batch.record("w_meas") - batch.record("w") - bias
        seen = batch.record("w_meas") - batch.record("b_g_hat")
        np.testing.assert_array_equal(batch.record("w_seen"), seen)
        # both have equal noise; the mean rate is near the middle of the rates at both ends
        middle = 0.5 * (start + batch.record("w"))
        spread = abs(batch.record("w") - start).max()
        assert abs(batch.record("gyro") - bias - noise - middle).max() < 0.3 * spread + 1e-6


@pytest.mark.parametrize("turn", [0.0, 1e-12, 1e-3, 1.0, 3.1])
def test_averaged_gyro_is_exact_for_small_and_large_turns(turn):
    rng = np.random.default_rng(4)
    axis = rng.normal(size=3)
    axis /= np.linalg.norm(axis)
    start = random_state(3) | {"velocity": np.zeros(3)}
    end = start | {"R_BI": Rotation.from_rotvec(-turn * axis).as_matrix() @ start["R_BI"]}
    gyro, _ = average_sample(start, end, (0.0, 0.0, 0.0), 0.005)
    np.testing.assert_allclose(gyro * 0.005, turn * axis, rtol=0.0, atol=1e-13)


def test_inconsistent_kinds_of_imu_samples_are_refused():
    with pytest.raises(ValueError, match=r"^ImuParams.samples must be one of instant, average"):
        LAB.imu.replace(samples="mean")
    with pytest.raises(ValueError, match=r"^true_sensors must have the IMU samples of sensors"):
        FlightBatch(1, sensors=LAB, true_sensors=AVERAGE)
    state = random_state(1)
    with pytest.raises(ValueError, match=r"^since must be the state one tick ago"):
        Imu(AVERAGE.imu, np.random.default_rng(1)).measure(state)
    with pytest.raises(ValueError, match=r"^since must be the state one tick ago"):
        Imu(LAB.imu, np.random.default_rng(1)).measure(state, since=state)
    bad = state | {"velocity": np.zeros(2)}
    with pytest.raises(ValueError, match=r"^since\['velocity'\] must"):
        Imu(AVERAGE.imu, np.random.default_rng(1)).measure(state, since=bad)

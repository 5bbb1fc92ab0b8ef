"""The IMU: lever arm, white noise and Gauss-Markov biases."""

import functools

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import quad_gym
from quad_gym.kernels.entries import integrate_flight
from quad_gym.packing import params_record
from quad_gym.records import FLIGHT
from quad_gym.rotations import quaternion_to_dcm
from quad_gym.sensors import Imu
from tests.body_states import put_state, random_state
from tests.unit.alarms import alarm_score, assert_normal

LAB = quad_gym.ImuParams()
VEHICLE = quad_gym.VehicleParams(disc_area=0.2)
GRAVITY_UP = np.array([0.0, 0.0, 9.8])


QUIET = LAB.replace(
    **dict.fromkeys(("accel_noise_density", "gyro_noise_density"), 1e-15),
    **dict.fromkeys(("accel_bias_sigma", "gyro_bias_sigma"), 1e-15),
)


def resting():
    speed = VEHICLE.hover_voltage * VEHICLE.motor_speed_per_volt
    still = dict.fromkeys(("position", "velocity", "body_rates"), np.zeros(3))
    return still | {"R_BI": np.eye(3), "rotor_speeds": np.full(4, speed)}


def position_of_body_point(state, disturbance_I, l_B, t):
    """Position of a body-fixed point after a flight of time t with constant rotor speeds."""
    flight, params = np.zeros(1, FLIGHT), params_record(VEHICLE, quad_gym.SensorSuite())
    put_state(flight, state)
    flight["voltages"] = state["rotor_speeds"] / VEHICLE.motor_speed_per_volt
    flight["disturbance"] = disturbance_I
    params["dt"] = t
    if t != 0.0:
        integrate_flight(flight, params, 1)
    return flight["r"][0] + quaternion_to_dcm(flight["q"][0]).T @ l_B


@given(st.integers(0, 2**32 - 1))
def test_specific_force_matches_acceleration_at_the_lever_arm(seed):
    state, rng = random_state(seed), np.random.default_rng(seed)
    l_B, force = rng.normal(0.0, 0.3, 3), rng.normal(size=3)
    h = 1e-3
    ahead, now, behind, far_ahead, far_behind = (
        position_of_body_point(state, force, l_B, k * h) for k in (1, 0, -1, 2, -2)
    )
    acceleration = (16 * (ahead + behind) - 30 * now - far_ahead - far_behind) / (12 * h**2)
    imu = Imu(QUIET.replace(lever_arm_B=l_B), rng, VEHICLE)
    gyro, accel = imu.measure(state, force)
    expected = state["R_BI"] @ (acceleration + GRAVITY_UP)
    limit = 3e-6 * (1.0 + np.abs(expected).max())
    np.testing.assert_allclose(accel, expected, rtol=0.0, atol=limit)
    np.testing.assert_allclose(gyro, state["body_rates"], rtol=0.0, atol=1e-12)


@functools.cache
def sampled(params, count, seed=1):
    """Samples of a hovering vehicle minus the truth, and the biases before each sample."""
    imu, state = Imu(params, np.random.default_rng(seed), VEHICLE), resting()
    since = {"since": state} if params.samples == "average" else {}
    rows = [(imu.gyro_bias, imu.accel_bias, *imu.measure(state, **since)) for _ in range(count)]
    gyro_bias, accel_bias, gyro, accel = (np.array(column) for column in zip(*rows, strict=True))
    return gyro, accel - GRAVITY_UP, gyro_bias, accel_bias


@pytest.mark.parametrize("samples", ["instant", "average"])
def test_white_noise_has_the_density_of_the_laboratory(samples):
    gyro, accel, gyro_bias, accel_bias = sampled(LAB.replace(samples=samples), 4_000)
    dt = 1.0 / 200.0
    noise = np.concatenate([gyro - gyro_bias, accel - accel_bias], axis=1)
    gyro_variance = (np.pi / 180.0 * 0.05) ** 2 / dt
    accel_variance = (9.8e-3 * 0.1) ** 2 / dt
    assert_normal(noise, np.zeros(6), np.diag([gyro_variance] * 3 + [accel_variance] * 3))


def test_biases_are_first_order_gauss_markov_processes():
    params = LAB.replace(accel_bias_tau=0.05, gyro_bias_tau=0.02)
    _, _, gyro_bias, accel_bias = sampled(params, 4_000)
    for bias, tau, sigma in (
        (accel_bias, 0.05, params.accel_bias_sigma),
        (gyro_bias, 0.02, params.gyro_bias_sigma),
    ):
        alpha = np.exp(-params.dt / tau)
        driving = bias[1:] - alpha * bias[:-1]
        assert_normal(driving, np.zeros(3), sigma**2 * (1.0 - alpha**2) * np.eye(3))
        # the driving noise is drawn each time, independent of the bias
        correlation = (driving * bias[:-1]).mean(axis=0) / (driving.std(axis=0) * sigma)
        assert np.abs(correlation).max() < alarm_score(3) / np.sqrt(len(driving))


def test_a_bias_begins_at_its_stationary_distribution():
    rng = np.random.default_rng(3)
    imus = [Imu(LAB, rng) for _ in range(1_000)]
    biases = np.array([np.append(imu.accel_bias, imu.gyro_bias) for imu in imus])
    variances = [LAB.accel_bias_sigma**2] * 3 + [LAB.gyro_bias_sigma**2] * 3
    assert_normal(biases, np.zeros(6), np.diag(variances))


def test_a_bad_state_is_refused_by_name():
    imu = Imu(LAB, np.random.default_rng(1))
    with pytest.raises(ValueError, match=r"^state\['velocity'\] must"):
        imu.measure(resting() | {"velocity": np.zeros(2)})
    with pytest.raises(ValueError, match=r"^state must have the keys"):
        imu.measure({"position": np.zeros(3)})
    with pytest.raises(ValueError, match=r"^disturbance_I must"):
        imu.measure(resting(), disturbance_I=1.0)

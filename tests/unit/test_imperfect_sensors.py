"""Errors of scale and alignment, vibration, constant heading errors, and limits of the camera.
Flights on the true state do not depend on the sensors, so samples with and without an effect,
drawn with equal seeds, differ only by the effect."""

import itertools
import math

import numpy as np
import pytest
from scipy import stats

import quad_gym
from quad_gym.estimation import ExtendedKalmanFilter, UnscentedKalmanFilter
from quad_gym.params.task import TaskParams
from quad_gym.params.vehicle import VehicleParams
from quad_gym.params.world import WorldParams
from quad_gym.records import FEATURE_SLICE, Autoreset, Control, Source
from quad_gym.rotations import euler_to_dcm, quaternion_to_dcm
from quad_gym.sensors import Camera, GnssReceiver, Imu
from quad_gym.vehicle import state_derivative
from tests.body_states import random_state
from tests.builders import batch as flights_of
from tests.field_flights import fly, nees, steps
from tests.filter_states import set_at_rest

LAB, STANDARD = quad_gym.sensor_suite("lab"), quad_gym.sensor_suite("standard")
HOVER = TaskParams(kind="hover", start="hover", duration=0.0, out_of_bounds=1e6, max_tilt=math.pi)
ERRORS = {
    "accel_scale_sigma": 0.004,
    "accel_misalignment_sigma": 0.002,
    "gyro_scale_sigma": 0.01,
    "gyro_misalignment_sigma": 0.005,
}


CALM_IMU = dict.fromkeys(("accel_noise_density", "gyro_noise_density"), 1e-12)
CALM_IMU |= dict.fromkeys(("accel_bias_sigma", "gyro_bias_sigma"), 1e-12)


def batch(suite, count=64, **keywords):
    made = {"sensors": suite, "task": HOVER, "source": Source.TRUTH, "control": Control.MOTOR}
    made |= {"run_filter": True, "autoreset": Autoreset.DISABLED, "threads": 1}
    return flights_of(count, **made, **keywords)


def with_imu(suite, **changes):
    return suite.replace(imu=suite.imu.replace(**changes))


def with_camera(**changes):
    places = itertools.product((-4.0, 0.0, 4.0), (-3.0, 3.0), (0.0, 1.0))
    return LAB.replace(camera=LAB.camera.replace(features_I=tuple(places), **changes))


def flown(flights, actions, fields):
    """(steps, flights, ...) of each field."""
    found = [[] for _ in fields]
    for action in actions:
        flights.step(np.broadcast_to(action, (flights.count, 4)))
        for values, name in zip(found, fields, strict=True):
            values.append(flights.record(name))
    return [np.array(values) for values in found]


def shaking(count, steps=40, seed=5):
    return np.random.default_rng(seed).uniform(-0.6, 0.6, (steps, count, 4))


def specific_force(state, vehicle, lever):
    """Specific force at `lever`, by the public model of the vehicle."""
    rate = state_derivative(state, np.zeros(4), np.zeros(3), vehicle)
    w, dw = state["body_rates"], rate["body_rates"]
    f = state["R_BI"] @ (rate["velocity"] + [0.0, 0.0, vehicle.gravity])
    return f + np.cross(dw, lever) + np.cross(w, np.cross(w, lever))


@pytest.mark.parametrize(
    "lever", [(0.0, 0.0, 0.0), (0.05, -0.03, 0.02)], ids=["center", "lever arm"]
)
def test_regression_recovers_errors_of_scale_and_alignment(lever):
    """Sensors are exact otherwise. The errors have the standard deviations of the parameters."""
    count, vehicle = 24, VehicleParams()
    suite = with_imu(LAB, **CALM_IMU, **ERRORS, lever_arm_B=lever)
    fast = {"start_velocity_I": quad_gym.Uniform(-5.0, 5.0)}  # so that there is drag
    flights = batch(suite, count, randomization=fast)
    names = ("r", "v", "q", "w", "rotor_speeds", "accel", "gyro")
    r, v, q, w, speeds, accel, gyro = flown(flights, shaking(count), names)
    accel_errors, gyro_errors = np.empty((2, count, 3, 3))
    for k in range(count):
        R_BI, force = quaternion_to_dcm(q[:, k]), np.empty((len(r), 3))
        for t in range(len(r)):
            state = {"position": r[t, k], "velocity": v[t, k], "R_BI": R_BI[t]}
            state |= {"body_rates": w[t, k], "rotor_speeds": speeds[t, k]}
            force[t] = specific_force(state, vehicle, np.array(lever))
        excess = force - [0.0, 0.0, vehicle.gravity]
        accel_errors[k] = np.linalg.lstsq(excess, accel[:, k] - force, rcond=None)[0].T
        gyro_errors[k] = np.linalg.lstsq(w[:, k], gyro[:, k] - w[:, k], rcond=None)[0].T
    np.testing.assert_allclose(accel_errors, flights.record("accel_error"), atol=2e-6)
    np.testing.assert_allclose(gyro_errors, flights.record("gyro_error"), atol=2e-6)
    diagonal = np.eye(3, dtype=bool)
    for errors, name in ((accel_errors, "accel"), (gyro_errors, "gyro")):
        parts = {"scale": errors[:, diagonal], "misalignment": errors[:, ~diagonal]}
        for kind, entries in parts.items():
            total = np.sum(np.square(entries / ERRORS[f"{name}_{kind}_sigma"]))
            low, high = stats.chi2.ppf([5e-6, 1 - 5e-6], entries.size)
            assert low < total < high, (name, kind)


def test_error_of_averaged_samples_is_linear_in_deviation_from_rest():
    """The mean over a tick with errors is (I + D) times the one without, relative to (0, 0, g)."""
    plain, erring = batch(STANDARD), batch(with_imu(STANDARD, **ERRORS))
    names = ("accel", "gyro", "w_meas", "r", "q")
    without, found = (flown(b, shaking(64, 20), names) for b in (plain, erring))
    D_a, D_g = erring.record("accel_error"), erring.record("gyro_error")
    excess = without[0] - [0.0, 0.0, VehicleParams().gravity]
    np.testing.assert_allclose(
        found[0] - without[0], np.einsum("kij,tkj->tki", D_a, excess), atol=1e-12
    )
    for k in (1, 2):
        np.testing.assert_allclose(
            found[k] - without[k], np.einsum("kij,tkj->tki", D_g, without[k]), atol=1e-12
        )
    for k in (3, 4):
        np.testing.assert_array_equal(found[k], without[k])


def test_scale_and_alignment_errors_change_only_between_episodes():
    flights = batch(with_imu(STANDARD, **ERRORS), 8)
    first = flights.record("accel_error")
    flights.step(np.zeros((8, 4)))
    np.testing.assert_array_equal(flights.record("accel_error"), first)
    flights.reset()
    assert not np.isclose(flights.record("accel_error"), first).any()


@pytest.mark.parametrize("suite", [LAB, STANDARD], ids=["instant", "average"])
def test_vibration_grows_with_the_square_of_the_rotor_speeds(suite):
    """The variance is the variance in hover times the mean of (speed / hover speed)^4."""
    vehicle, count = VehicleParams(), 64
    hover = vehicle.motor_speed_per_volt * vehicle.hover_voltage
    shaken = with_imu(suite, accel_vibration=0.3, gyro_vibration=0.02)
    for level in ((0.0, 0.0, 0.0, 0.0), (-0.3, 0.4, -0.3, 0.4)):
        # rotors settle in ten time constants; means under wild attitudes do not matter
        actions = np.broadcast_to(np.array(level), (130, count, 4))
        names = ("accel", "gyro", "w_meas", "rotor_speeds")
        without, found = (flown(batch(s, count), actions, names) for s in (suite, shaken))
        speeds = found[3][100:]
        expected = np.mean(speeds**4, axis=-1) / hover**4
        if not any(level):
            np.testing.assert_allclose(expected, 1.0, rtol=1e-6)
        for k, sigma in ((0, 0.3), (1, 0.02), (2, 0.02)):
            scaled = (found[k] - without[k])[100:] / (sigma * np.sqrt(expected))[..., np.newaxis]
            low, high = stats.chi2.ppf([5e-6, 1 - 5e-6], scaled.size)
            assert low < np.sum(scaled**2) < high, (level, k)
            assert abs(np.mean(scaled[1:] * scaled[:-1])) < 5.0 / math.sqrt(scaled.size)


@pytest.mark.parametrize("lift", [0.0, 1.0, 2.5])
def test_filter_scales_vibration_noise_with_measured_thrust(lift):
    """The variance of a tick is white noise plus vibration times the square of force over g."""
    imu = STANDARD.imu.replace(accel_vibration=0.3, gyro_vibration=0.02)
    kalman = quad_gym.UnscentedKalmanFilter(STANDARD.replace(imu=imu))
    set_at_rest(kalman, 1e-16 * np.eye(15))
    kalman.predict(np.zeros(3), (0.0, 0.0, lift * VehicleParams().gravity))
    added = np.diag(kalman.covariance) / imu.dt**2
    accel = imu.accel_noise_density**2 * imu.rate + (0.3 * lift) ** 2
    gyro = imu.gyro_noise_density**2 * imu.rate + (0.02 * lift) ** 2
    np.testing.assert_allclose(added[5], accel, rtol=1e-6)  # upward: gyro noise has no effect on it
    np.testing.assert_allclose(added[6:9], gyro, rtol=1e-6)


def test_heading_error_turns_all_baselines_of_an_episode_about_body_z():
    sigma, count = 0.1, 400
    erring = LAB.replace(gnss=LAB.gnss.replace(heading_error_sigma=sigma))
    plain, turned = batch(LAB, count), batch(erring, count)
    actions = shaking(count, 10)
    (without, q), (found, _) = (flown(b, actions, ("gnss_baseline", "q")) for b in (plain, turned))
    R_IG = quad_gym.frames.ecef_to_enu(LAB.gnss.reference_antenna_G)
    error = turned.record("heading_error")
    for t in range(10):
        R_BI = quaternion_to_dcm(q[t])
        before = np.einsum("kij,jl,kl->ki", R_BI, R_IG, without[t])
        after = np.einsum("kij,jl,kl->ki", R_BI, R_IG, found[t])
        angle = np.arctan2(after[:, 1], after[:, 0]) - np.arctan2(before[:, 1], before[:, 0])
        np.testing.assert_allclose(np.sin(angle), np.sin(error), atol=1e-9)
        np.testing.assert_allclose(after[:, 2], before[:, 2], atol=1e-9)
    low, high = stats.chi2.ppf([5e-6, 1 - 5e-6], count)
    assert low < np.sum(np.square(error / sigma)) < high


def seen_by_projection(flights, camera, ground=None):
    """Visibility of each feature, by NumPy."""
    R_CB = euler_to_dcm(camera.attitude)
    features, expected = np.array(camera.features_I), []
    for r, q in zip(flights.record("r"), flights.record("q"), strict=True):
        R_BI = quaternion_to_dcm(q)
        center = r + R_BI.T @ camera.position_B
        v_C = (R_CB @ R_BI @ (features - center).T).T
        front = v_C[:, 2] > 0.0
        pixels = camera.focal_length * v_C[:, :2] / np.where(front, v_C[:, 2], 1.0)[:, np.newaxis]
        inside = np.all(np.abs(pixels) <= np.array(camera.image_size) / 2.0, axis=1)
        near = np.linalg.norm(features - center, axis=1) <= camera.max_range
        seen = front & inside & near
        if ground is not None:
            seen &= (center[2] >= ground) & (features[:, 2] >= ground)
        expected.append(seen)
    return np.array(expected)


def test_features_beyond_the_range_are_not_seen():
    suite = with_camera(max_range=5.5)
    flights = batch(suite, 200, randomization={"start_yaw": quad_gym.Uniform(-3.0, 3.0)})
    found = flights.record("block_valid")[:, FEATURE_SLICE][:, :12] > 0.0
    np.testing.assert_array_equal(found, seen_by_projection(flights, suite.camera))
    unlimited = seen_by_projection(flights, suite.camera.replace(max_range=math.inf))
    assert 0.1 < found.sum() / unlimited.sum() < 0.9


@pytest.mark.parametrize("ground", [-0.1, 0.0, 0.5, 1.05])
def test_ground_hides_features_below_it_and_all_from_below(ground):
    """Features are at 0 and 1 m, cameras about 1 m high."""
    suite = with_camera(ground_hides=True)
    flights = batch(suite, 200, world=WorldParams(ground_height=ground))
    found = flights.record("block_valid")[:, FEATURE_SLICE][:, :12] > 0.0
    np.testing.assert_array_equal(found, seen_by_projection(flights, suite.camera, ground))
    above = seen_by_projection(flights, suite.camera)
    assert found.any() == (ground < 1.0)
    assert (found.sum() < above.sum()) == (ground > 0.0)


@pytest.mark.parametrize("rate", [0.0, 2.0])
def test_blur_grows_with_the_body_rate(rate):
    """Shifts are uniform within a smear of focal_length |w| exposure pixels."""
    spin = {"start_body_rates": [None, None, quad_gym.Uniform(rate, rate)]}
    sharp, blurred = with_camera(), with_camera(exposure=0.004)
    plain, found = (batch(s, 400, randomization=spin) for s in (sharp, blurred))
    seen = found.record("block_valid")[:, FEATURE_SLICE] > 0.0
    np.testing.assert_array_equal(seen, plain.record("block_valid")[:, FEATURE_SLICE] > 0.0)
    shift = (found.record("pixels") - plain.record("pixels"))[seen].ravel()
    smear = sharp.camera.focal_length * rate * 0.004
    if rate == 0.0:
        assert not shift.any()
        return
    assert np.abs(shift).max() <= smear / 2.0 * (1.0 + 1e-9)
    assert stats.kstest(shift, stats.uniform(-smear / 2.0, smear).cdf).pvalue > 1e-5


@pytest.mark.parametrize("kind", [quad_gym.UnscentedKalmanFilter, quad_gym.ExtendedKalmanFilter])
def test_errors_of_scale_and_alignment_add_noise_in_a_maneuver(kind):
    """The errors count as white noise, with the effect of half a second of constant force. An axis
    has one error of scale and two of alignment; the variance is the mean over the axes."""
    accel, error = np.array([1.5, -0.7, 11.0]), 0.004
    plain, dt = with_imu(STANDARD, accel_misalignment_sigma=0.0), STANDARD.imu.dt
    excess = np.linalg.norm(accel - [0.0, 0.0, 9.8])
    white = plain.imu.accel_noise_density**2 + (error * excess) ** 2 / 3.0  # 0.5 s times 2 / 3
    suites = (
        with_imu(STANDARD, accel_misalignment_sigma=error),
        with_imu(
            STANDARD, accel_scale_sigma=math.sqrt(1.5) * error, accel_misalignment_sigma=0.5 * error
        ),
        with_imu(STANDARD, accel_noise_density=math.sqrt(white)),
        plain,
    )
    covariances = []
    for suite in suites:
        ukf = kind(suite)
        set_at_rest(ukf, np.diag(np.full(15, 1e-6)))
        ukf.predict(np.array([0.1, 0.2, -0.3]), accel)
        covariances.append(ukf.covariance)
    aligned, scaled, noisy, exact = covariances
    np.testing.assert_allclose(aligned, noisy, rtol=1e-12, atol=1e-18)
    np.testing.assert_allclose(scaled, noisy, rtol=1e-12, atol=1e-18)
    grown = np.diag(aligned - exact)[3:6]
    np.testing.assert_allclose(grown, dt * (error * excess) ** 2 / 3.0, rtol=1e-6)


def test_classes_of_one_vehicle_have_every_effect():
    """Two sensors with equal seeds differ only by the effect, whose size is tested above."""

    def pair(kind, plain, **changes):
        both = plain, plain.replace(**changes)
        return [kind(params, np.random.default_rng(1)) for params in both]

    place, R_BI = np.array([0.0, 0.0, 6.0]), np.eye(3)
    true, turned = pair(GnssReceiver, LAB.gnss, heading_error_sigma=0.05)
    (fix, baseline), (same, other) = (gnss.measure(place, R_BI) for gnss in (true, turned))
    np.testing.assert_array_equal(fix, same)
    assert (baseline != other).any()
    camera, state = quad_gym.sensor_suite("rtk").camera, random_state(1)
    free, near = pair(Camera, camera.replace(max_range=math.inf), max_range=7.7)
    seen = np.isfinite(free.measure(place, R_BI)).sum()
    assert 0 < np.isfinite(near.measure(place, R_BI)).sum() < seen
    below, upward = np.array([0.0, 0.0, -6.0]), np.diag([1.0, -1.0, -1.0])
    free, hidden = pair(Camera, camera.replace(ground_hides=False), ground_hides=True)
    assert np.isfinite(free.measure(below, upward)).any()
    assert np.isnan(hidden.measure(below, upward)).all()
    sharp, blurred = pair(Camera, camera.replace(exposure=0.0), exposure=0.01)
    rates = np.array([0.0, 2.0, 1.0])
    gap = blurred.measure(place, R_BI, rates) - sharp.measure(place, R_BI)
    assert 0.0 < np.nanmax(abs(gap)) <= 0.005 * camera.focal_length * np.linalg.norm(rates)
    with pytest.raises(ValueError, match="body_rates must have shape"):
        blurred.measure(place, R_BI, np.zeros(2))
    for samples, since in (("instant", {}), ("average", {"since": state})):
        imu = LAB.imu.replace(samples=samples)
        for name, size in {**ERRORS, "accel_vibration": 0.2, "gyro_vibration": 0.01}.items():
            exact, erring = (one.measure(state, **since) for one in pair(Imu, imu, **{name: size}))
            concerned = name.startswith("accel")
            assert (exact[concerned] != erring[concerned]).all()
            np.testing.assert_array_equal(exact[not concerned], erring[not concerned])


FLIGHTS = 400
BAND = 5 * np.sqrt(2 * 15 / FLIGHTS)
"""Five standard deviations of the mean of FLIGHTS NEES of 15 degrees of freedom."""


def mounted(name, lever_arm, **choices):
    suite = quad_gym.sensor_suite(name)
    estimator = suite.estimator.replace(**choices)
    return suite.replace(imu=suite.imu.replace(lever_arm_B=lever_arm), estimator=estimator)


def late_arm(**latencies):
    suite = mounted("rtk", (0.05, 0.05, -0.05))
    changes = {name: getattr(suite, name).replace(latency=t) for name, t in latencies.items()}
    return suite.replace(**changes)


CENTER = {"center_of_mass_B": quad_gym.Uniform(-0.03, 0.03)}
MOUNTED = {
    **{
        f"{name}, {kind}": (mounted(name, (0.05, -0.05, 0.05), kind=kind), {})
        for name in ("rtk", "indoor")
        for kind in ("ukf", "ekf")
    },
    "late": (late_arm(gnss=0.1), {"filter_start": "warm"}),
    "latest": (late_arm(gnss=0.2, camera=0.08), {"filter_start": "warm"}),
    "known drawn center of mass": (
        quad_gym.sensor_suite("rtk").simplified(),
        {"randomization": quad_gym.Randomization(CENTER, known=True)},
    ),
}


@pytest.mark.parametrize("name", MOUNTED)
def test_a_known_lever_arm_leaves_the_filter_consistent(name):
    suite, options = MOUNTED[name]
    batch = fly(suite, FLIGHTS, start="hover", **options)
    for _ in range(3):
        steps(batch, 1.0)
        assert abs(nees(batch).mean() - 15.0) < BAND


@pytest.mark.parametrize(
    ("kind", "tolerance"), [(ExtendedKalmanFilter, 1e-9), (UnscentedKalmanFilter, 1e-5)]
)
def test_filter_with_lever_arm_stays_at_rest_while_vehicle_spins_up(kind, tolerance):
    """The force is f = dw x l + w x (w x l) + g e3, with w = (0, 0, a t) about the vertical.
    The UKF's mean has a second-order term: gyro noise slightly reduces the vertical force."""
    arm, rate = np.array([0.3, -0.2, 0.1]), 4.0
    suite = mounted("lab", tuple(arm))
    kalman = kind(sensors=suite)
    set_at_rest(kalman, 1e-14 * np.eye(15))
    w_before = None
    for tick in range(200):
        w = np.array([0.0, 0.0, rate * tick * suite.imu.dt])
        dw = np.array([0.0, 0.0, rate if tick else 0.0])
        force = np.cross(dw, arm) + np.cross(w, np.cross(w, arm)) + [0.0, 0.0, 9.8]
        kalman.predict(w, force)
        w_before = w
    assert w_before[2] > 3.9
    np.testing.assert_allclose(kalman.velocity, 0.0, atol=tolerance)
    np.testing.assert_allclose(kalman.position, 0.0, atol=tolerance)

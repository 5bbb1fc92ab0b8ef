"""The filter class for users: refused input, failures, and starts."""

import warnings

import numpy as np
import pytest

import quad_gym
from quad_gym.estimation import UnscentedKalmanFilter
from quad_gym.records import FilterStatus
from tests.circle_flight import record_circle
from tests.reference_ukf import east_north_up, rotation_312

LAB = quad_gym.sensor_suite("lab")
R_IG = east_north_up(LAB.gnss.reference_antenna_G)
RECORDING = record_circle(LAB, 50, seed=1)
PROPERTIES = ("position", "velocity", "R_BI", "accel_bias", "gyro_bias", "covariance")


def running_filter(cycles=5):
    ukf = UnscentedKalmanFilter(sensors=LAB)
    ukf.initialize(RECORDING.gnss_position[0], RECORDING.gnss_baseline[0])
    for k in range(cycles):
        ukf.update(RECORDING.gnss_position[k], RECORDING.gnss_baseline[k], RECORDING.pixels[k])
        ukf.predict(RECORDING.gyro[k], RECORDING.accel[k])
    return ukf


def estimate(ukf):
    return [getattr(ukf, name) for name in PROPERTIES]


def assert_same(before, after):
    for name, was, now in zip(PROPERTIES, before, after, strict=True):
        np.testing.assert_array_equal(was, now, err_msg=name)


@pytest.mark.parametrize("partly", [(np.nan, np.nan), (np.nan, 3.0), (3.0, np.nan)])
def test_a_nan_pixel_is_a_feature_not_seen(partly):
    first, second = running_filter(), running_filter()
    first.update(pixels=[(100.0, -50.0), partly])
    second.update(pixels=[(100.0, -50.0), (np.nan, np.nan)])
    assert_same(estimate(first), estimate(second))
    assert first.nis[1] == 2  # degrees of freedom of a direction
    before = estimate(first)
    first.update(pixels=[partly, partly])
    assert_same(before, estimate(first))


def test_an_update_without_measurements_changes_nothing():
    ukf = running_filter()
    before, nis = estimate(ukf), ukf.nis
    ukf.update()
    ukf.update(None, None, None)
    ukf.update(pixels=np.full((2, 2), np.nan))
    assert_same(before, estimate(ukf))
    assert ukf.nis == nis
    assert ukf.status == FilterStatus(0)


def test_pixels_without_camera_raise_and_properties_return_copies():
    ukf = UnscentedKalmanFilter(LAB.replace(camera=None))
    ukf.initialize(RECORDING.gnss_position[0], RECORDING.gnss_baseline[0])
    ukf.update(pixels=np.zeros((0, 2)))
    with pytest.raises(ValueError, match="pixels"):
        ukf.update(pixels=np.zeros((2, 2)))
    for name in PROPERTIES:  # each returns a copy
        before = getattr(ukf, name).copy()
        getattr(ukf, name)[...] = 7.0
        np.testing.assert_array_equal(getattr(ukf, name), before)


def test_calls_before_the_start_raise():
    with pytest.raises(ValueError, match="sensors"):
        UnscentedKalmanFilter(sensors="lab")
    ukf = UnscentedKalmanFilter(LAB)
    with pytest.raises(ValueError, match="gnss_baseline_G"):
        ukf.initialize((0.0, 0.0, 0.0), (0.0, 0.0, 0.0))
    with pytest.raises(RuntimeError, match="initialize"):
        ukf.update(RECORDING.gnss_position[0])
    with pytest.raises(RuntimeError, match="initialize"):
        ukf.predict((0, 0, 0), (0, 0, 9.8))
    for name in PROPERTIES:
        with pytest.raises(RuntimeError, match="initialize"):
            getattr(ukf, name)


@pytest.mark.parametrize("yaw", np.linspace(-3.0, 3.0, 7))
def test_exact_fix_gives_position_and_attitude(yaw):
    gnss, ukf = LAB.gnss, UnscentedKalmanFilter(LAB)
    r, R_BI = np.array([1.0, -2.0, 3.0]), rotation_312(np.array([0.0, 0.0, yaw]))
    antenna = r + R_BI.T @ gnss.primary_antenna_B
    ukf.initialize(R_IG.T @ antenna, R_IG.T @ R_BI.T @ gnss.baseline_B)
    np.testing.assert_allclose(ukf.R_BI, R_BI, atol=1e-14)
    np.testing.assert_allclose(ukf.position, r, atol=1e-14)
    for name in ("velocity", "accel_bias", "gyro_bias"):
        np.testing.assert_array_equal(getattr(ukf, name), 0.0)


def test_initial_covariance_equals_laboratory_values():
    ukf = running_filter(cycles=0)
    milli_g, degree_per_hour = 9.8e-3, np.radians(1.0) / 3600.0
    variances = np.repeat(
        [2 * 0.006**2, 0.001, 2 * 0.05**2, (100 * milli_g) ** 2, (100 * degree_per_hour) ** 2], 3
    )
    variances[2] = 2 * 0.012**2
    np.testing.assert_allclose(ukf.covariance, np.diag(variances), rtol=1e-14, atol=0.0)


def test_tilt_is_split_between_baseline_and_vertical():
    """Two directions with equal weight that disagree by 2d are each turned by d."""
    ukf, tilt = UnscentedKalmanFilter(LAB), 0.3
    baseline_I = 0.19 * np.array([-np.cos(tilt), 0.0, np.sin(tilt)])
    ukf.initialize((0.0, 0.0, 0.0), R_IG.T @ baseline_I)
    expected = rotation_312(np.array([0.0, tilt / 2, 0.0]))
    np.testing.assert_allclose(ukf.R_BI, expected, atol=1e-13)


@pytest.mark.parametrize("name", ["lab", "rtk"])
@pytest.mark.parametrize("heading", np.linspace(-3.0, 3.0, 5))
def test_heading_with_vertical_baseline_is_taken_from_argument(name, heading):
    suite = quad_gym.sensor_suite(name)
    up = {"primary_antenna_B": (0.01, 0.02, 0.05), "secondary_antenna_B": (0.01, 0.02, 0.24)}
    suite = suite.replace(
        gnss=suite.gnss.replace(**up), initial_pose=quad_gym.InitialPoseParams(heading_sigma=0.1)
    )
    fix = R_IG.T @ np.ones(3), R_IG.T @ (0.0, 0.0, 0.19)
    R_BI = rotation_312(np.array([0.0, 0.0, heading]))
    ukf = UnscentedKalmanFilter(suite)
    ukf.initialize(*fix, heading=heading)
    np.testing.assert_allclose(ukf.R_BI, R_BI, atol=1e-13)
    np.testing.assert_allclose(ukf.position, 1.0 - R_BI.T @ (0.01, 0.02, 0.05), atol=1e-13)
    variance = suite.estimator.initial_covariance_scale * 0.1**2
    np.testing.assert_allclose(ukf.covariance[8, 8], variance, rtol=1e-12)
    ukf.initialize(*fix)
    np.testing.assert_allclose(ukf.covariance[8, 8], np.pi**2 / 3, rtol=1e-12)  # any heading


@pytest.mark.parametrize("sigma", [0.05, 1.0])
def test_level_baseline_overrides_given_heading_even_if_noisy(sigma):
    fix = RECORDING.gnss_position[0], RECORDING.gnss_baseline[0]
    suite = LAB.replace(gnss=LAB.gnss.replace(baseline_sigma=sigma))
    told, not_told = UnscentedKalmanFilter(suite), UnscentedKalmanFilter(suite)
    told.initialize(*fix, heading=2.0)
    not_told.initialize(*fix)
    assert_same(estimate(not_told), estimate(told))


def test_initialize_resets_state_and_failure_status():
    ukf = running_filter()
    with pytest.warns(RuntimeWarning, match="last good state"):
        ukf.predict((0.0, 0.0, 0.0), (1e300, 0.0, 0.0))
    ukf.initialize(RECORDING.gnss_position[0], RECORDING.gnss_baseline[0])
    assert ukf.status == FilterStatus(0)
    assert_same(estimate(running_filter(cycles=0)), estimate(ukf))


def given_state(**changes):
    factor = np.tril(np.random.default_rng(2).normal(size=(15, 15))) + 5.0 * np.eye(15)
    state = {
        "position": (1.0, 2.0, 3.0),
        "velocity": (-1.0, 0.5, 0.1),
        "R_BI": rotation_312(np.array([0.1, -0.2, 2.0])),
        "accel_bias": (0.3, 0.2, 0.1),
        "gyro_bias": (1e-4, 2e-4, -3e-4),
        "covariance": factor @ factor.T,
    }
    return {**state, **changes}


def test_properties_return_values_given_to_set_state():
    ukf, state = UnscentedKalmanFilter(LAB), given_state()
    ukf.set_state(**state)
    for name in PROPERTIES:
        np.testing.assert_allclose(getattr(ukf, name), state[name], rtol=1e-13, err_msg=name)


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("position", (1.0, 2.0)),
        ("velocity", (1.0, np.nan, 0.0)),
        ("accel_bias", (np.inf, 0.0, 0.0)),
        ("gyro_bias", np.zeros((3, 1))),
        ("R_BI", np.diag([1.0, 1.0, -1.0])),
        ("R_BI", 1.001 * np.eye(3)),
        ("R_BI", np.eye(4)),
        ("covariance", np.eye(14)),
        ("covariance", -np.eye(15)),
        ("covariance", np.zeros((15, 15))),
        ("covariance", np.eye(15) + np.eye(15, k=1)),
        ("covariance", np.full((15, 15), np.nan)),
    ],
    ids=str,
)
def test_set_state_with_invalid_value_raises_and_changes_nothing(name, value):
    ukf = running_filter()
    before = estimate(ukf)
    with pytest.raises(ValueError, match=name):
        ukf.set_state(**given_state(**{name: value}))
    assert_same(before, estimate(ukf))


EXTREMES = [1e300, -1e300, 1e160, 1e100, -1e30, 1e17]


@pytest.mark.parametrize("value", EXTREMES)
@pytest.mark.parametrize("name", ["gyro", "accel", "gnss_position_G", "pixels"])
def test_enormous_values_keep_estimate_finite_with_or_without_warning(name, value):
    ukf, shape = running_filter(), (2, 2) if name == "pixels" else (3,)
    before, of_imu = estimate(ukf), name in ("gyro", "accel")
    given = {"gyro": (0.0, 0.0, 0.1), "accel": (0.0, 0.0, 9.8)} if of_imu else {}
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        (ukf.predict if of_imu else ukf.update)(**{**given, name: np.full(shape, value)})
    failed = FilterStatus.PREDICTION_FAILED if of_imu else FilterStatus.UPDATE_FAILED
    assert (ukf.status == failed) == bool(caught)
    if caught:
        assert failed.name in str(caught[0].message)
        assert_same(before, estimate(ukf))
    assert all(np.isfinite(part).all() for part in estimate(ukf))
    np.testing.assert_allclose(ukf.R_BI @ ukf.R_BI.T, np.eye(3), atol=1e-12)
    assert caught or abs(value) < 1e160 or not of_imu


@pytest.mark.parametrize("length", [1e300, 1e160, 1e100, 1e-8])
def test_baseline_of_extreme_length_updates_by_its_direction_or_raises(length):
    wild, tame = running_filter(), running_filter()
    before, direction = estimate(wild), RECORDING.gnss_baseline[5] / 0.19
    try:
        wild.update(gnss_baseline_G=length * direction)
    except ValueError:
        assert_same(before, estimate(wild))
    else:
        tame.update(gnss_baseline_G=direction)
        np.testing.assert_allclose(wild.R_BI, tame.R_BI, atol=1e-12)


def test_the_filter_goes_on_after_a_failure():
    calm, upset = running_filter(), running_filter()
    with pytest.warns(RuntimeWarning, match="PREDICTION_FAILED"):
        upset.predict((0.0, 0.0, 0.0), (1e300, 0.0, 0.0))
    for ukf in (calm, upset):
        ukf.update(RECORDING.gnss_position[5])
        ukf.predict(RECORDING.gyro[5], RECORDING.accel[5])
    assert_same(estimate(calm), estimate(upset))
    assert upset.status == FilterStatus.PREDICTION_FAILED

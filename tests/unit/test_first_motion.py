"""A replay that begins in motion starts with a larger uncertainty."""

import numpy as np
import pytest

import quad_gym
from quad_gym.estimation import UnscentedKalmanFilter
from quad_gym.frames import ecef_to_enu
from quad_gym.logs.formats import read_log
from quad_gym.logs.replaying.log_start import wide_start

ORIGIN = quad_gym.sensor_suite("rtk").gnss.reference_antenna_G
RTK = quad_gym.sensor_suite("rtk")


def log(speed=0.0, turning=0.0, noise=0.0):
    """Return two seconds of a flight to the east: IMU at 100 Hz, positions at 10 Hz."""
    time = 0.01 * np.arange(200)
    east = np.where(np.arange(200) % 10 == 0, speed * time, np.nan)
    position = np.column_stack([east, 0.0 * east, 0.0 * east])
    position += np.random.default_rng(0).normal(0.0, noise + 1e-9, position.shape)
    gyro = np.tile([turning, 0.0, 0.0], (200, 1))
    accel = np.tile([0.0, 0.0, 9.8], (200, 1))
    return read_log({"time": time, "gyro": gyro, "accel": accel, "gnss_enu": position})


@pytest.mark.parametrize(("speed", "turning"), [(3.0, 0.0), (0.0, 0.8)])
def test_start_in_motion_is_uncertain(speed, turning):
    assert wide_start(RTK, log(speed, turning)) == {"tilt_sigma": 0.3, "rest_sigma": 1.0 + speed}


@pytest.mark.parametrize(
    ("name", "motion"), [("rtk", {}), ("consumer", {"noise": 0.2}), ("lab", {"speed": 3.0})]
)
def test_start_at_rest_or_noisy_or_by_wahbas_problem_is_unchanged(name, motion):
    assert wide_start(quad_gym.sensor_suite(name), log(**motion)) == {}


@pytest.mark.parametrize("baseline", [True, False])
def test_wide_start_holds_for_the_start_alone(baseline):
    """The first standard deviations are the given ones; later resets have the suite's."""
    ukf = UnscentedKalmanFilter(RTK)
    heading = {"gnss_baseline_G": ecef_to_enu(ORIGIN).T[:, 0]} if baseline else {"heading": 0.0}
    ukf.initialize(np.zeros(3), **heading, tilt_sigma=0.3, rest_sigma=4.0)
    sigma = np.sqrt(np.diag(ukf.covariance))
    np.testing.assert_allclose(sigma[3:6], 4.0, rtol=1e-9)
    np.testing.assert_allclose(sigma[6:8], 0.3, rtol=1e-9)
    params = ukf._engine.params
    assert params["initial_tilt_sigma"][0, 0] == RTK.estimator.initial_tilt_sigma
    assert params["initial_velocity_variance"][0, 0] == RTK.estimator.initial_velocity_variance


def test_uncertainties_of_a_start_without_effect_are_refused():
    fix = {"gnss_position_G": np.zeros(3), "heading": 0.0}
    with pytest.raises(ValueError, match="rest_sigma must not be given with gnss_velocity_G"):
        UnscentedKalmanFilter(RTK).initialize(**fix, gnss_velocity_G=np.ones(3), rest_sigma=1.0)
    lab = UnscentedKalmanFilter(quad_gym.sensor_suite("lab"))
    with pytest.raises(ValueError, match="tilt_sigma must not be given with gnss_baseline_G"):
        lab.initialize(np.zeros(3), gnss_baseline_G=np.ones(3), tilt_sigma=0.1)

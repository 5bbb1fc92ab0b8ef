"""A replay that begins in motion starts with a larger uncertainty."""

import numpy as np
import pytest

import quad_gym
from quad_gym.estimation.logs import read_log
from quad_gym.estimation.replaying.first_motion import with_wide_start

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
    form = with_wide_start(RTK, log(speed, turning)).estimator
    assert form.initial_tilt_sigma == 0.3
    assert form.initial_velocity_variance == pytest.approx((1.0 + speed) ** 2)


@pytest.mark.parametrize(
    ("name", "motion"), [("rtk", {}), ("consumer", {"noise": 0.2}), ("lab", {"speed": 3.0})]
)
def test_start_at_rest_or_noisy_or_by_wahbas_problem_is_unchanged(name, motion):
    suite = quad_gym.sensor_suite(name)
    assert with_wide_start(suite, log(**motion)) is suite

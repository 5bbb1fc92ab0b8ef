"""Warm and cold starts at any yaw, and late measurements, over many flights."""

import numpy as np
import pytest

import quad_gym
from quad_gym import Uniform
from tests.field_flights import attitudes, fly, nees, small_euler_angles, state_errors, steps

ANY_YAW = {"start_yaw": Uniform(-np.pi, np.pi)}
RTK = quad_gym.sensor_suite("rtk").simplified()
BASELINE_UP = RTK.replace(
    gnss=RTK.gnss.replace(primary_antenna_B=(0.0, 0.0, 0.05), secondary_antenna_B=(0.0, 0.0, 0.24))
)


def delayed(suite, kind="ukf"):
    """Return a suite with latencies of a typical receiver and of a camera with image processing."""
    changes = {"estimator": suite.estimator.replace(kind=kind)}
    for name, latency in (("gnss", 0.11), ("camera", 0.06)):
        if getattr(suite, name) is not None:
            changes[name] = getattr(suite, name).replace(latency=latency)
    return suite.replace(**changes)


def yaw_errors(batch):
    """Return the absolute yaw errors (n,) [deg]."""
    R_error = attitudes(batch.record("q")) @ batch.record("R_hat").transpose(0, 2, 1)
    return np.degrees(np.abs(small_euler_angles(R_error)[:, 2]))


@pytest.mark.slow
@pytest.mark.parametrize("camera", [True, False], ids=["camera", "no camera"])
@pytest.mark.parametrize("name", ["lab", "rtk", "late rtk"])
def test_yaw_error_falls_below_one_degree_within_ten_seconds(name, camera):
    """The bound holds for 99.9 % of hovering flights with a baseline without constant errors."""
    suite = delayed(RTK) if name == "late rtk" else RTK
    if name == "lab":  # its default form is overconfident with a camera
        suite = quad_gym.sensor_suite("lab")
        suite = suite.replace(estimator=suite.estimator.replace(bearing_noise_at="predicted"))
    if not camera:
        suite = suite.replace(camera=None)
    batch = fly(suite, 2000, task="hover", randomization=ANY_YAW)
    assert yaw_errors(batch).max() > 3.0
    steps(batch, 10.0)
    assert (yaw_errors(batch) > 1.0).sum() <= 2
    assert not batch.record("filter_status").any()


@pytest.mark.slow
@pytest.mark.parametrize("start", ["cold", "warm"])
@pytest.mark.parametrize("camera", [True, False], ids=["camera", "no camera"])
def test_filter_with_vertical_baseline_stays_consistent(camera, start):
    """The initial pose gives any yaw; the filter stays consistent and accurate. After hovering, the
    balance of tilt and accelerometer bias has a standard deviation of 0.4 mrad. Half the square of
    a heading error of 50 mrad is larger: without a camera the error angles are too nonlinear at
    first, and NEES is 22. It is 15 with a heading standard deviation of 20 mrad."""
    suite = BASELINE_UP if camera else BASELINE_UP.replace(camera=None)
    if start == "warm" and not camera:
        suite = suite.replace(initial_pose=quad_gym.InitialPoseParams(heading_sigma=0.02))
    batch = fly(suite, 1000, filter_start=start, randomization=ANY_YAW)
    means = [nees(batch).mean()]
    for _ in range(60):
        steps(batch, 0.5)
        means.append(nees(batch).mean())
    bound = 5 * np.sqrt(2 * 15 / 1000)
    assert np.abs(np.array(means) - 15.0).max() < bound, means
    assert not batch.record("filter_status").any()
    assert np.abs(state_errors(batch)[:, :3]).max() < 0.05

"""Repeated inflation of a covariance stops at the largest standard deviations."""

import math

import numpy as np
import pytest

import quad_gym
import quad_gym.frames
from quad_gym.records import FEATURE_BLOCKS, POSITION_BLOCK
from tests.field_flights import fly, steps
from tests.filter_states import set_at_rest

MOST = np.repeat([100.0, 20.0, math.nan, 2.0, 0.1], 3)  # attitude: tilt 0.2, heading pi/sqrt 3


def axis_turn(angle, axis):
    """exp(-[angle axis x]), Rodrigues' formula."""
    x, y, z = np.array(axis) / np.linalg.norm(axis)
    K = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    return np.eye(3) - math.sin(angle) * K + (1.0 - math.cos(angle)) * K @ K


R_BI = axis_turn(0.5, (1.0, -2.0, 0.5))
SUITE = quad_gym.sensor_suite("rtk").simplified().replace(camera=None)
R_IG = quad_gym.frames.ecef_to_enu(SUITE.gnss.reference_antenna_G)


def started(deviations, seed=0):
    """A filter whose states are correlated, with given standard deviations."""
    ukf = quad_gym.UnscentedKalmanFilter(SUITE)
    rng = np.random.default_rng(seed)
    mixed = np.eye(15) + 0.3 * rng.standard_normal((15, 15))
    P = mixed @ mixed.T
    scaled = np.array(deviations) / np.sqrt(np.diag(P))
    set_at_rest(ukf, P * np.outer(scaled, scaled), R_BI=R_BI)
    return ukf


def fix(ukf):
    """The velocity that the filter predicts: it passes the gate and corrects nothing."""
    lever = np.cross(ukf._engine.read("w_meas")[0] - ukf.gyro_bias, SUITE.gnss.primary_antenna_B)
    return {"gnss_velocity_G": R_IG.T @ (ukf.velocity + ukf.R_BI.T @ lever)}


def alarm(ukf):
    """Cause an alarm, as if the last 50 velocity innovations were 0.9 standard deviations off."""
    ukf._engine.blocks["innovation_drift"][:, 2] = 0.9
    ukf.update(**fix(ukf))


def inflated(P):
    """P after an alarm, by NumPy: a congruence, plus the variances added to the biases."""
    M, var = np.zeros((15, 15)), np.diag(P)
    k = R_BI[:, 2]
    P_ee = P[6:9, 6:9]
    heading = k @ P_ee @ k
    tilt = (np.trace(P_ee) - heading) / 2.0

    def root(most, variance):
        return math.sqrt(min(16.0, max(1.0, most**2 / variance)))

    for i in range(15):
        if not 6 <= i < 9:
            M[i, i] = root(MOST[i], var[i])
    to_heading = np.outer(k, k)
    M[6:9, 6:9] = root(0.2, tilt) * (np.eye(3) - to_heading)
    M[6:9, 6:9] += root(math.pi / math.sqrt(3.0), heading) * to_heading
    found = M @ P @ M
    for first in (9, 12):
        more = min(240.0 * var[first : first + 3].mean(), MOST[first] ** 2)
        for i in range(first, first + 3):
            found[i, i] += min(more, max(MOST[i] ** 2 - found[i, i], 0.0))
    return found


@pytest.mark.parametrize(
    "deviations",
    [(0.1, 0.05, 0.01, 0.02, 1e-3), (50.0, 3.0, 0.1, 0.3, 0.02), (300.0, 30.0, 0.5, 3.0, 0.2)],
    ids=["small", "some beyond", "all beyond"],
)
def test_alarm_inflates_each_standard_deviation_up_to_its_bound(deviations):
    quiet, alarmed = started(np.repeat(deviations, 3)), started(np.repeat(deviations, 3))
    quiet.update(**fix(quiet))
    alarm(alarmed)
    scale = np.sqrt(np.diag(alarmed.covariance))
    np.testing.assert_allclose(
        alarmed.covariance / np.outer(scale, scale),
        inflated(quiet.covariance) / np.outer(scale, scale),
        atol=1e-6,
    )


def test_repeated_alarms_leave_unmeasured_states_bounded():
    """Only velocities are measured: position and heading are unobserved for 25 alarms."""
    ukf = started(np.repeat([0.1, 0.05, 0.05, 0.05, 0.005], 3))
    for _ in range(25):
        alarm(ukf)
        sigma = np.sqrt(np.diag(ukf.covariance))
        assert (np.linalg.eigvalsh(ukf.covariance / np.outer(sigma, sigma)) > 0.0).all()
        for _ in range(20):
            ukf.predict(np.zeros(3), R_BI @ (0.0, 0.0, 9.8))
    assert ukf._engine.read("update_failures").max() == 0
    assert ukf._engine.read("prediction_failures").max() == 0
    others = np.r_[0:6, 9:15]
    assert (sigma[others] <= 1.01 * MOST[others]).all()  # 1 %: noise of the samples in between
    assert sigma[:3].max() > 50.0
    k = R_BI[:, 2]
    assert math.sqrt(k @ ukf.covariance[6:9, 6:9] @ k) < 2.0


def test_a_sensor_that_no_longer_measures_raises_no_more_alarms():
    """Without a gate the mean of the innovations is not restarted; the camera still measures. The
    filter stays diverged for as long as biases may be wrong, counted from the last fix."""
    batch = fly("standard", 8, task="hover", filter_start="warm")
    steps(batch, 1.0)
    assert not batch.record("diverged").any()
    flights = batch.snapshot()
    flights["innovation_drift"][:, POSITION_BLOCK] = 0.8
    batch.restore(flights)
    batch.switch_sensors(gnss=False)
    steps(batch, 0.5)
    assert batch.record("diverged").all()
    steps(batch, 0.8)
    doubted = batch.record("alarm_tick")
    steps(batch, 1.0)
    assert (batch.record("innovation_drift")[:, POSITION_BLOCK] == 0.8).all()
    assert (batch.record("accepted_tick")[:, FEATURE_BLOCKS] > 0.0).all()
    np.testing.assert_array_equal(batch.record("alarm_tick"), doubted)

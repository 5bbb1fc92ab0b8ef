"""The drift of GNSS positions as a state of the filter."""

import numpy as np
import pytest

import quad_gym
from quad_gym.faults import GnssJump, GnssOutliers
from quad_gym.records import POSITION_BLOCK
from tests.field_flights import fly, nees, state_errors, steps

CONSUMER = quad_gym.sensor_suite("consumer").simplified()


def with_filter(suite, **choices):
    return suite.replace(estimator=suite.estimator.replace(**choices))


def test_drift_in_one_axis_leaves_other_axes_without_drift():
    suite = CONSUMER.replace(gnss=CONSUMER.gnss.replace(drift_sigma_I=(0.6, 0.0, 0.0)))
    batch = fly(suite, 50, task="hover")
    steps(batch, 5.0)
    assert not batch.record("filter_status").any()
    drift = batch.record("drift_hat")
    assert (abs(drift[:, 1:]) < 1e-5).all()
    assert abs(drift[:, 0]).max() > 0.1


@pytest.mark.parametrize("kind", ["ukf", "ekf"])
@pytest.mark.parametrize("start", ["cold", "warm"])
@pytest.mark.parametrize("latency", [0.0, pytest.param(0.1, marks=pytest.mark.slow), 0.2])
def test_filter_with_gnss_drift_is_consistent(kind, start, latency):
    """The mean NEES of 300 flights has a standard deviation of 0.32; five of them are allowed."""
    suite = with_filter(CONSUMER, kind=kind)
    suite = suite.replace(gnss=suite.gnss.replace(latency=latency))
    batch = fly(suite, 300, filter_start=start)
    for _ in range(3):
        steps(batch, 1.5)
        assert nees(batch).mean() == pytest.approx(15.0, abs=1.6)
    assert not batch.record("filter_status").any()


def test_warm_start_draws_the_drift_of_a_running_receiver():
    """The drift has its variance after 10 s, and the joint errors match the filter's covariance."""
    batch = fly(CONSUMER, 4000, task="hover", filter_start="warm")
    true = batch.record("drift")
    error = true - batch.record("drift_hat")
    expected = np.array(CONSUMER.gnss.drift_sigma_I) * np.sqrt(1 - np.exp(-20.0 / 60.0))
    np.testing.assert_allclose(true.std(axis=0), expected, rtol=0.06)
    L = np.zeros((4000, 18, 18))
    L[:, :15, :15], L[:, 15:] = batch.record("L"), batch.record("L_drift")
    joint = np.concatenate([state_errors(batch), error], axis=1)
    white = np.linalg.solve(L, joint[..., np.newaxis])[..., 0]
    np.testing.assert_allclose(np.cov(white.T), np.eye(18), atol=0.1)
    # an estimate is independent of its error
    correlation = (batch.record("drift_hat") * error).mean(axis=0) / error.std(axis=0)
    assert (abs(correlation / batch.record("drift_hat").std(axis=0)) < 0.08).all()


def test_a_gross_outlier_is_rejected():
    """About 30 % of the fixes are off by at least 5 m; the RMS error grows by less than 20 %."""
    outliers = GnssOutliers(share=0.3, size=(10.0, 30.0))
    batch, sound = fly(CONSUMER, 100, faults=outliers), fly(CONSUMER, 100)
    struck = rejected = 0
    for _ in range(1000):
        batch.step()
        measured = batch.record("block_valid")[:, POSITION_BLOCK] > 0.0
        hit = measured & (batch.record("outlier") > 0.0)
        struck += hit.sum()
        rejected += (hit & (batch.record("gate")[:, 0] == 2.0)).sum()
    assert struck > 1000
    assert rejected > 0.98 * struck
    steps(sound, 5.0)
    rms = [np.sqrt(np.square(state_errors(b)[:, :3]).sum(axis=1).mean()) for b in (batch, sound)]
    assert rms[0] < 1.2 * rms[1]


def test_lasting_jump_of_the_fixes_is_followed_after_the_time_limit():
    batch = fly(CONSUMER, 100, task="hover", faults=GnssJump(start=3.0, size=5.0, duration=1e3))
    steps(batch, 3.2)
    assert (batch.record("block_nis")[:, 0] > 100.0).mean() > 0.9
    assert (batch.record("gate")[:, 0] == 2.0).all()
    steps(batch, 8.0)
    assert (batch.record("diverged") > 0.0).all()
    assert nees(batch, slice(0, 3)).mean() < 6.0  # by velocities and barometer
    steps(batch, CONSUMER.estimator.glitch_timeout - 7.0)
    assert (batch.record("alarm_tick") > 3.0 * CONSUMER.imu.rate).all()
    assert (batch.record("gate")[:, 0] == 1.0).mean() >= 0.95


@pytest.mark.parametrize("phase", [0.25, 0.5])
def test_drift_grows_over_the_time_from_the_start_to_the_first_measurement(phase):
    """It starts at zero, and has the variance s^2 (1 - exp(-2 t / tau)) at the first measurement,
    after a share of the period, and at the second. Standard deviations of 4,000 flights have a
    sigma of 1.1 %."""
    gnss = CONSUMER.gnss.replace(
        rate=2.0, phase=phase, drift_sigma_I=(1.0, 2.0, 3.0), drift_tau=0.5, latency=0.0
    )
    batch, measured = fly(CONSUMER.replace(gnss=gnss), 4000, task="hover"), 0.5 * phase
    np.testing.assert_array_equal(batch.record("drift"), 0.0)
    for wait in (measured + 0.02, 0.5):
        steps(batch, round(50.0 * wait) / 50.0)
        expected = np.array([1.0, 2.0, 3.0]) * np.sqrt(1.0 - np.exp(-2.0 * measured / 0.5))
        np.testing.assert_allclose(batch.record("drift").std(axis=0), expected, rtol=0.06)
        measured += 0.5

"""The slow error of GNSS positions among the filter's states."""

import numpy as np
import pytest

import quad_gym
from quad_gym.faults import GnssJump, GnssOutliers
from quad_gym.records import POSITION_BLOCK
from tests.field_flights import fly, nees, state_errors, steps
from tests.reference_late import Rewinding
from tests.reference_ukf import PlainUKF

CONSUMER, LAB = quad_gym.sensor_suite("consumer").simplified(), quad_gym.sensor_suite("lab")


def with_filter(suite, **choices):
    return suite.replace(estimator=suite.estimator.replace(**choices))


def test_a_slow_error_in_one_axis_leaves_the_others_without():
    suite = CONSUMER.replace(gnss=CONSUMER.gnss.replace(drift_sigma_I=(0.6, 0.0, 0.0)))
    batch = fly(suite, 50, task="hover")
    steps(batch, 5.0)
    assert not batch.record("filter_status").any()
    drift = batch.record("gnss_drift_hat")
    assert (abs(drift[:, 1:]) < 1e-5).all()
    assert abs(drift[:, 0]).max() > 0.1


def riccati(gnss, axis, seconds, speed_sigma=0.03):
    """Variance of the position of a vehicle on a line, by a Kalman filter of (r, v, b, d).

    Attitude and lever arms are known, so that no filter of the vehicle can do better.
    """
    dt, imu = 1.0 / gnss.rate, CONSUMER.imu
    decay, kept = np.exp(-dt / imu.accel_bias_tau), np.exp(-dt / gnss.drift_tau)
    F = np.array([[1, dt, -(dt**2) / 2, 0], [0, 1, -dt, 0], [0, 0, decay, 0], [0, 0, 0, kept]])
    white, slow = gnss.position_sigma_I[axis], gnss.drift_sigma_I[axis]
    Q = np.diag([0, 0, imu.accel_bias_sigma**2 * (1 - decay**2), slow**2 * (1 - kept**2)])
    Q[:2, :2] = imu.accel_noise_density**2 * np.array([[dt**3 / 3, dt**2 / 2], [dt**2 / 2, dt]])
    P = np.diag([white**2, speed_sigma**2, imu.accel_bias_sigma**2, 0.0])
    H, R = np.array([[1.0, 0, 0, 1], [0, 1.0, 0, 0]]), np.diag([white**2, gnss.velocity_sigma**2])
    for _ in range(round(seconds / dt)):
        P = F @ P @ F.T + Q
        K = np.linalg.solve(H @ P @ H.T + R, H @ P).T
        P = P - K @ H @ P
    return P[0, 0]


def test_the_position_is_about_as_good_as_theory_allows():
    """Within 15 % after 10 s; the mean square of 300 flights is off by 4 % or so by chance."""
    batch = fly(CONSUMER, 300)
    steps(batch, 10.0)
    square = np.square(state_errors(batch)[:, :3]).mean(axis=0)
    best = np.array([riccati(CONSUMER.gnss, axis, 10.0) for axis in range(3)])
    assert (square > 0.75 * best).all()
    assert square.sum() < 1.32 * best.sum()


def test_the_slow_error_is_estimated_as_well_as_claimed():
    batch = fly(CONSUMER, 300)
    steps(batch, 10.0)
    error, L = batch.record("gnss_drift") - batch.record("gnss_drift_hat"), batch.record("L_drift")
    P = L @ L.transpose(0, 2, 1)
    square = np.einsum("ni,ni->n", error, np.linalg.solve(P, error[..., np.newaxis])[..., 0])
    assert square.mean() == pytest.approx(3.0, abs=5 * np.sqrt(6 / 300))
    squares = (np.square(x).mean(axis=0) for x in (error, 0.5 * batch.record("gnss_drift")))
    assert np.less(*squares).all()


@pytest.mark.parametrize("kind", ["ukf", "ekf"])
@pytest.mark.parametrize("start", ["cold", "warm"])
@pytest.mark.parametrize("latency", [0.0, pytest.param(0.1, marks=pytest.mark.slow), 0.2])
def test_the_filter_is_consistent(kind, start, latency):
    """A mean over 300 flights has a deviation of 0.32; here are five of them."""
    suite = with_filter(CONSUMER, kind=kind)
    suite = suite.replace(gnss=suite.gnss.replace(latency=latency))
    batch = fly(suite, 300, filter_start=start)
    for _ in range(3):
        steps(batch, 1.5)
        assert nees(batch).mean() == pytest.approx(15.0, abs=1.6)
    assert not batch.record("filter_status").any()


def test_warm_start_draws_the_drift_of_a_running_receiver():
    """It has its variance after ten seconds, and goes with the errors as the filter claims."""
    batch = fly(CONSUMER, 4000, task="hover", filter_start="warm")
    true = batch.record("gnss_drift")
    error = true - batch.record("gnss_drift_hat")
    expected = np.array(CONSUMER.gnss.drift_sigma_I) * np.sqrt(1 - np.exp(-20.0 / 60.0))
    np.testing.assert_allclose(true.std(axis=0), expected, rtol=0.06)
    L = np.zeros((4000, 18, 18))
    L[:, :15, :15], L[:, 15:] = batch.record("L"), batch.record("L_drift")
    joint = np.concatenate([state_errors(batch), error], axis=1)
    white = np.linalg.solve(L, joint[..., np.newaxis])[..., 0]
    np.testing.assert_allclose(np.cov(white.T), np.eye(18), atol=0.1)
    # an estimate is independent of its error
    correlation = (batch.record("gnss_drift_hat") * error).mean(axis=0) / error.std(axis=0)
    assert (abs(correlation / batch.record("gnss_drift_hat").std(axis=0)) < 0.08).all()


def test_late_fixes_leave_what_filtering_all_over_again_does():
    """Fixes of 10 Hz that arrive after 0.1 s, and a filter that goes back to every one of them."""
    lab = LAB.replace(camera=None).with_rates(gnss=10.0)
    gnss = lab.gnss.replace(
        drift_sigma_I=(0.6, 0.6, 1.0), position_sigma_I=(0.2, 0.2, 0.4), latency=0.1, phase=0.5
    )
    suite = with_filter(
        lab.replace(imu=lab.imu.replace(samples="average"), gnss=gnss),
        integration="midpoint",
        attitude_reset=True,
        reuse_first_fix=False,
    )
    batch = fly(suite, 1, task="hover")
    plain = PlainUKF(suite.replace(gnss=suite.gnss.replace(latency=0.0)))
    reference = start_like(batch, plain)
    for tick in range(1, 601):
        batch.step()
        reference.predict(batch.record("gyro")[0], batch.record("accel")[0])
        if batch.record("block_valid")[:, POSITION_BLOCK][0]:
            reference.update(
                tick - 20,
                gnss_position_G=batch.record("gnss_position")[0],
                gnss_baseline_G=batch.record("gnss_baseline")[0],
            )
    sigma = np.sqrt(np.diag(plain.P))
    assert (abs(batch.record("r_hat")[0] - plain.r) < 0.1 * sigma[:3]).all()
    assert (abs(batch.record("gnss_drift_hat")[0] - plain.d) < 0.1 * sigma[15:]).all()
    ours = np.sqrt(np.diag(batch.record("L_drift")[0] @ batch.record("L_drift")[0].T))
    np.testing.assert_allclose(ours, sigma[15:], rtol=0.05)


def start_like(batch, plain):
    """A plain filter with a memory that begins as the filter of a batch's only flight."""
    for name in ("r", "v", "R", "b_a", "b_g"):
        setattr(plain, name, batch.record(f"{name}_hat")[0])
    plain.d = batch.record("gnss_drift_hat")[0]
    plain.P = np.zeros((18, 18))
    plain.P[:15, :15] = batch.covariance()[0]
    plain.P[15:, 15:] = 1e-20 * np.eye(3)
    return Rewinding(plain)


def test_a_gross_outlier_is_rejected():
    """A third of the fixes are off by 5 m and more, and the estimate hardly feels it."""
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


def test_jump_of_the_fixes_moves_the_estimated_drift():
    batch = fly(CONSUMER, 100, task="hover", faults=GnssJump(start=3.0, size=5.0, duration=1e3))
    steps(batch, 3.2)
    assert (batch.record("block_nis")[:, 0] > 100.0).mean() > 0.9
    assert (batch.record("gate")[:, 0] == 2.0).all()
    steps(batch, 3.0)  # the filter doubts its position meanwhile
    assert (batch.record("alarm_tick") > 3.0 * CONSUMER.imu.rate).all()
    assert (batch.record("gate")[:, 0] == 1.0).all()
    assert nees(batch, slice(0, 3)).mean() < 30.0

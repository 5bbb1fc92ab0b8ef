"""Outages, outliers and jumps over 1,000 flights: the filter knows how lost it is, and comes back.
"Inside 3 sigma" of an error of d numbers means that its normalized square is below the chi-square
quantile that holds 99.73 % of a consistent filter's errors, as 3 sigma do of a single number. Of
1,000 flights of such a filter nearly three lie outside at any given instant, so that no filter can
have all of them inside at one instant; it must have each of them inside at some instant of the time
allowed, and all of them within the quantile of 1e-6 in 1,000 at its end."""

import numpy as np
import pytest
from scipy import linalg, stats

import quad_gym
from quad_gym.estimation import ExtendedKalmanFilter, UnscentedKalmanFilter
from quad_gym.faults import CameraOcclusion, GnssOutage, GnssOutliers, PositionJump
from quad_gym.records import POSITION_BLOCK, GateDecision, Source
from tests.field_flights import fly, nees, state_errors, steps
from tests.filter_states import set_at_rest
from tests.unit.alarms import ALARM, alarm_score

LAB, RTK = quad_gym.sensor_suite("lab"), quad_gym.sensor_suite("rtk").simplified()
COUNT = 1000
BEFORE, OUTAGE, RETURN = 15.0, 60.0, 3.0
MOTION = slice(0, 6)
"""Position and velocity."""
THREE_SIGMA = 0.9973
R, V, E, BA, BG = (slice(k, k + 3) for k in range(0, 15, 3))


def of_kind(suite, kind):
    return suite.replace(estimator=suite.estimator.replace(kind=kind))


@pytest.mark.parametrize("suite", [LAB, RTK], ids=["euler", "midpoint"])
@pytest.mark.parametrize("kind", [UnscentedKalmanFilter, ExtendedKalmanFilter])
def test_uncertainty_at_rest_grows_in_closed_form(kind, suite):
    """Double and triple integrals of white noise and of constants, at rest and level. Gravity
    couples tilt into horizontal acceleration; constant biases, for their time constant is a million
    years here."""
    forever = {"accel_bias_tau": 3e13, "gyro_bias_tau": 3e13}
    suite = suite.replace(imu=suite.imu.replace(**forever))
    g, dt = suite.estimator.gravity, suite.imu.dt
    sigma_a, sigma_g = suite.imu.accel_noise_density, suite.imu.gyro_noise_density
    r, v, e, b_a, b_g = 0.01, 0.02, 1e-3, 2e-3, 1e-5
    filter_ = kind(suite)
    set_at_rest(filter_, np.diag(np.repeat([r, v, e, b_a, b_g], 3)) ** 2)
    t = 0.0
    for seconds in (10.0, 60.0):
        while t < seconds - dt / 2:
            filter_.predict(np.zeros(3), np.array([0.0, 0.0, g]))
            t += dt
        up = r**2 + (v * t) ** 2 + (b_a * t**2 / 2) ** 2 + sigma_a**2 * t**3 / 3
        tilt = (g * e * t**2 / 2) ** 2 + (g * b_g * t**3 / 6) ** 2 + (g * sigma_g) ** 2 * t**5 / 20
        angle = e**2 + (b_g * t) ** 2 + sigma_g**2 * t
        variances = np.diag(filter_.covariance)
        np.testing.assert_allclose(variances[R], [up + tilt, up + tilt, up], rtol=0.01)
        np.testing.assert_allclose(variances[E], [angle] * 3, rtol=0.01)


def hovering_theory(P, attitudes, sensors, step):
    """(15, 15) covariance after some steps [s] without fixes, of a vehicle that hovers level. The
    continuous error model, dr' = dv, dv' = R^T (de x f - db_a) + noise, de' = -db_g + noise, db' =
    -db / tau + noise, with f = g e3 and the attitude R that the filter believes in, (n, 3, 3) for n
    steps, integrated by Van Loan's matrix exponential."""
    imu, g = sensors.imu, sensors.estimator.gravity
    F, Q = np.zeros((15, 15)), np.zeros((15, 15))
    F[R, V], F[E, BG] = np.eye(3), -np.eye(3)
    F[BA, BA], F[BG, BG] = -np.eye(3) / imu.accel_bias_tau, -np.eye(3) / imu.gyro_bias_tau
    Q[V, V], Q[E, E] = np.eye(3) * imu.accel_noise_density**2, np.eye(3) * imu.gyro_noise_density**2
    Q[BA, BA] = np.eye(3) * 2 * imu.accel_bias_sigma**2 / imu.accel_bias_tau
    Q[BG, BG] = np.eye(3) * 2 * imu.gyro_bias_sigma**2 / imu.gyro_bias_tau
    for R_BI in attitudes:
        F[V, E], F[V, BA] = R_BI.T @ [[0.0, g, 0.0], [-g, 0.0, 0.0], [0.0] * 3], -R_BI.T
        exponential = linalg.expm(np.block([[-F, Q], [np.zeros((15, 15)), F.T]]) * step)
        Phi = exponential[15:, 15:].T
        P = Phi @ P @ Phi.T + Phi @ exponential[:15, 15:]
    return P


def lost_for_a_minute(suite, task, dark=OUTAGE):
    """Flights on the true state just when an outage of a minute begins, the camera dark, too."""
    faults = [GnssOutage(start=BEFORE, duration=OUTAGE)]
    if suite.camera is not None:
        faults.append(CameraOcclusion(start=BEFORE, duration=dark))
    options = {"source": Source.TRUTH, "run_filter": True, "threads": 1}
    batch = fly(suite, COUNT, task=task, faults=faults, **options)
    steps(batch, BEFORE)
    assert batch.active_faults()["gnss_outage"].all()
    return batch


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["ukf", "ekf"])
def test_in_an_outage_of_a_minute_uncertainty_grows_as_theory_says(kind):
    """The covariance is that of the linear error model, and the errors are as large as it says."""
    batch = lost_for_a_minute(of_kind(RTK, kind), "hover")
    some = np.arange(0, COUNT, 50)
    P, R_hat = batch.covariance()[some], []
    for k in range(120):
        steps(batch, 0.25)
        R_hat.append(batch.record("R_hat")[some])
        steps(batch, 0.25 if k < 119 else 0.25 - RTK.imu.dt)
    assert batch.active_faults()["gnss_outage"].all()
    R_hat = np.array(R_hat)
    expected = np.array([hovering_theory(P[k], R_hat[:, k], RTK, 0.5) for k in range(len(some))])
    found = batch.covariance()
    sigma = np.sqrt(np.einsum("nii->ni", expected))
    ratio = np.sqrt(np.einsum("nii->ni", found[some])) / sigma
    np.testing.assert_allclose(ratio, 1.0, atol=0.005)
    gap = (found[some] - expected) / (sigma[:, :, np.newaxis] * sigma[:, np.newaxis])
    assert abs(gap).max() < 0.03
    assert sigma[:, :2].min() > 5.0  # meters: nothing was clipped on the way

    for part in (slice(0, 15), R, V, E, BA, BG):  # chi-square, so mean d and variance 2 d
        d = part.stop - part.start
        score = (nees(batch, part).mean() - d) / np.sqrt(2 * d / COUNT)
        assert abs(score) < alarm_score(6), (part, score)
    assert not batch.record("filter_status").any()


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "kind", "task", "dark"),
    [
        ("rtk", "ukf", "hover", OUTAGE),
        ("rtk", "ukf", "random_trajectory", OUTAGE),
        ("rtk", "ekf", "random_trajectory", OUTAGE),
        ("rtk", "ukf", "random_trajectory", OUTAGE - 5.0),
        ("consumer", "ukf", "random_trajectory", OUTAGE),
    ],
)
def test_error_after_an_outage_is_soon_inside_three_sigma(name, kind, task, dark):
    """Also where the camera is back before, and sees features that the filter has long lost."""
    batch = lost_for_a_minute(of_kind(quad_gym.sensor_suite(name), kind), task, dark)
    steps(batch, OUTAGE - batch.sensors.imu.dt)
    assert batch.active_faults()["gnss_outage"].all()
    lost = np.linalg.norm(state_errors(batch)[:, R], axis=1)
    assert np.median(lost) > 3.0
    bound = stats.chi2.ppf(THREE_SIGMA, 6)
    inside = np.zeros(COUNT, bool)
    for _ in range(round(RETURN / 0.1)):
        steps(batch, 0.1)
        fixed = batch.record("gate")[:, POSITION_BLOCK] == GateDecision.ACCEPTED
        inside |= fixed & (nees(batch, MOTION) < bound)
    assert inside.all(), np.flatnonzero(~inside)
    at_last = nees(batch, MOTION)
    assert at_last.max() < stats.chi2.isf(ALARM / COUNT, 6), np.flatnonzero(at_last > 40)
    outside = int((at_last > bound).sum())
    assert stats.binomtest(outside, COUNT, 1.0 - THREE_SIGMA, "greater").pvalue > ALARM
    found = np.linalg.norm(state_errors(batch)[:, R], axis=1)
    assert found.max() < 0.1 * np.median(lost) + 3.0 * np.linalg.norm(
        batch.sensors.gnss.position_sigma_I
    ) + 3.0 * np.linalg.norm(batch.sensors.gnss.drift_sigma_I)
    assert not batch.record("filter_status").any()


def rms_error(suite, faults):
    """Of the estimated position, over flights on the estimate, from two to twelve seconds [m]."""
    batch = fly(suite, COUNT, faults=faults, threads=1)
    steps(batch, 2.0)
    squares = []
    for _ in range(100):
        steps(batch, 0.1)
        squares.append((state_errors(batch)[:, R] ** 2).sum(axis=1).mean())
    assert not batch.record("filter_status").any()
    return float(np.sqrt(np.mean(squares)))


GATED_LAB = LAB.replace(
    estimator=LAB.estimator.replace(false_alarm_probability=1e-4, bearing_noise_at="predicted")
)
SUITES = {
    "lab": GATED_LAB,
    "rtk": RTK,
    "rtk, no camera": RTK.replace(camera=None),
    "consumer": quad_gym.sensor_suite("consumer").simplified(),
}


@pytest.mark.slow
@pytest.mark.parametrize("name", SUITES)
@pytest.mark.parametrize("kind", ["ukf", "ekf"])
def test_with_five_percent_outliers_the_error_is_hardly_larger(kind, name):
    suite = of_kind(SUITES[name], kind)
    clean = rms_error(suite, None)
    corrupt = rms_error(suite, GnssOutliers(share=0.05, size=(10.0, 100.0)))
    print(f"{name}, {kind}: {clean:.4f} m, with outliers {corrupt:.4f} m, {corrupt / clean:.3f}")
    assert corrupt < 1.2 * clean


@pytest.mark.slow
def test_without_the_gate_outliers_do_harm():
    suite = SUITES["rtk, no camera"]
    open_ = suite.replace(estimator=suite.estimator.replace(false_alarm_probability=0.0))
    clean = rms_error(open_, None)
    corrupt = rms_error(open_, GnssOutliers(share=0.05, size=(10.0, 100.0)))
    assert corrupt > 3.0 * clean


@pytest.mark.slow
@pytest.mark.parametrize("name", ["lab", "rtk", "rtk, no camera"])
@pytest.mark.parametrize("kind", ["ukf", "ekf"])
def test_a_true_jump_does_not_lock_the_filter_out(kind, name):
    """The gate refuses the truth at first; after `max_rejections` refusals it opens again."""
    suite = of_kind(SUITES[name], kind)
    jump = PositionJump(start=5.0, size=(2.0, 4.0))
    options = {"source": Source.TRUTH, "run_filter": True, "threads": 1}
    batch = fly(suite, COUNT, task="hover", faults=jump, **options)
    steps(batch, 5.0)
    first = np.linalg.norm(state_errors(batch)[:, R], axis=1)
    assert (first > 1.9).all()
    steps(batch, 5.0)
    errors = np.linalg.norm(state_errors(batch)[:, R], axis=1)
    print(f"{name}, {kind}: {np.median(errors):.4f} m, at most {errors.max():.4f} m")
    assert errors.max() < 0.2
    assert (batch.record("reopened").sum(axis=1) >= 1.0).all()
    assert not batch.record("filter_status").any()

"""Outages and outliers over 1,000 flights: errors match the covariance, and decrease afterwards.
An error of d numbers is "inside 3 sigma" if its normalized square is below the 99.73 % quantile of
chi-square, as for 3 sigma of a single number. Of 1,000 flights of a consistent filter, nearly three
are outside at any given instant. So each flight must be inside at some instant of the allowed time,
and all of them within the quantile of 1e-6 in 1,000 at its end."""

import numpy as np
import pytest
from scipy import stats

import quad_gym
from quad_gym.estimation import ExtendedKalmanFilter, UnscentedKalmanFilter
from quad_gym.faults import CameraOcclusion, GnssOutage, GnssOutliers
from quad_gym.records import POSITION_BLOCK, GateDecision, Source
from tests.field_flights import fly, nees, state_errors, steps
from tests.filter_states import set_at_rest
from tests.unit.alarms import ALARM

LAB, RTK = quad_gym.sensor_suite("lab"), quad_gym.sensor_suite("rtk").simplified()
COUNT = 1000
BEFORE, OUTAGE, RETURN = 15.0, 60.0, 3.0
MOTION = slice(0, 6)
"""Position and velocity."""
THREE_SIGMA = 0.9973
R, E = slice(0, 3), slice(6, 9)


def of_kind(suite, kind):
    return suite.replace(estimator=suite.estimator.replace(kind=kind))


@pytest.mark.parametrize("suite", [LAB, RTK], ids=["euler", "midpoint"])
@pytest.mark.parametrize("kind", [UnscentedKalmanFilter, ExtendedKalmanFilter])
def test_covariance_growth_at_rest_matches_closed_form(kind, suite):
    """The closed form has double and triple integrals of white noise and of constants, at rest and
    level. Gravity couples tilt into horizontal acceleration. Biases are constant, as their time
    constant is a million years."""
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


def lost_for_a_minute(suite, task, dark=OUTAGE):
    """Return flights on the true state when a GNSS outage of a minute and a dark image begin."""
    faults = [GnssOutage(start=BEFORE, duration=OUTAGE)]
    if suite.camera is not None:
        faults.append(CameraOcclusion(start=BEFORE, duration=dark))
    options = {"source": Source.TRUTH, "run_filter": True, "threads": 1}
    batch = fly(suite, COUNT, task=task, faults=faults, **options)
    steps(batch, BEFORE)
    assert batch.active_faults()["gnss_outage"].all()
    return batch


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
def test_error_returns_within_three_sigma_after_outage(name, kind, task, dark):
    """In one case the camera returns before GNSS, with features far from their predictions."""
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
    """Return the RMS position error of flights on the estimate, from 2 s to 12 s [m]."""
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
def test_five_percent_outliers_raise_rms_error_by_less_than_20_percent(kind, name):
    suite = of_kind(SUITES[name], kind)
    clean = rms_error(suite, None)
    corrupt = rms_error(suite, GnssOutliers(share=0.05, size=(10.0, 100.0)))
    print(f"{name}, {kind}: {clean:.4f} m, with outliers {corrupt:.4f} m, {corrupt / clean:.3f}")
    assert corrupt < 1.2 * clean

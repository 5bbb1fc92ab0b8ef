"""Filters with barometer and magnetometer equal plain filters with sensor errors as states."""

import decimal
from decimal import Decimal

import numpy as np
import pytest

import quad_gym
from quad_gym import BarometerParams, MagnetometerParams
from quad_gym.estimation import ExtendedKalmanFilter, UnscentedKalmanFilter
from quad_gym.records import GateDecision
from tests.circle_flight import record_circle
from tests.reference_aids import AidedEKF, AidedUKF
from tests.reference_ukf import TOLERANCES, PlainUKF, array_of, rotation_312

LAB = quad_gym.sensor_suite("lab")
BOTH = {"barometer": BarometerParams(bias_tau=20.0), "magnetometer": MagnetometerParams()}
DRIFTING = LAB.gnss.replace(drift_sigma_I=(0.6, 0.3, 1.0), drift_tau=20.0)
FIELD = LAB.estimator.replace(integration="midpoint", attitude_reset=True, alpha=0.7)
SUITES = {
    "both": LAB.replace(**BOTH),
    "barometer alone": LAB.replace(barometer=BOTH["barometer"], camera=None),
    "magnetometer alone": LAB.replace(magnetometer=BOTH["magnetometer"], camera=None),
    "GNSS that drifts, camera": LAB.replace(gnss=DRIFTING),
    "GNSS that drifts, attitude reset": LAB.replace(
        gnss=DRIFTING, estimator=LAB.estimator.replace(attitude_reset=True)
    ),
    "GNSS that drifts, both": LAB.replace(gnss=DRIFTING, camera=None, **BOTH),
    "field filter": LAB.replace(gnss=DRIFTING, camera=None, estimator=FIELD, **BOTH),
}


def measured_by_aids(suite, recording, ticks, seed):
    """Return altitudes and fields with constant errors and noise; None where not measured."""
    rng = np.random.default_rng(seed)
    altitudes, fields = [None] * ticks, [None] * ticks
    hard_iron = rng.normal(0.0, 1e-6, 3)
    for k in range(ticks):
        if suite.barometer is not None and rng.random() < 0.6:
            altitudes[k] = recording.r[k, 2] + 0.4 + rng.normal(0.0, suite.barometer.noise_sigma)
        if suite.magnetometer is not None and rng.random() < 0.6:
            field = recording.R_BI[k] @ suite.magnetometer.field_I + hard_iron
            fields[k] = field + rng.normal(0.0, suite.magnetometer.noise_sigma, 3)
    return altitudes, fields


@pytest.mark.parametrize(
    "kinds", [(UnscentedKalmanFilter, AidedUKF), (ExtendedKalmanFilter, AidedEKF)]
)
@pytest.mark.parametrize("name", SUITES)
def test_filter_with_slow_errors_equals_plain_filter_with_augmented_state(name, kinds):
    """The plain filter computes with 45 digits; a random part of the measurements is missing."""
    suite, ticks, seed = SUITES[name], 18, 5
    ours_class, plain_class = kinds
    recording = record_circle(suite, ticks, seed)
    recording.gnss_position += suite.drifts * np.linspace(0.0, 0.3, ticks)[:, np.newaxis]
    altitudes, fields = measured_by_aids(suite, recording, ticks, seed)
    has = np.random.default_rng(seed).random((ticks, 2)) < 0.5
    with decimal.localcontext() as context:
        context.prec = 45
        ours, plain = ours_class(suite), plain_class(suite, Decimal)
        for one in (ours, plain):
            one.initialize(recording.gnss_position[0], recording.gnss_baseline[0])
        for k in range(ticks):
            for one in (ours, plain):
                one.update(
                    gnss_position_G=recording.gnss_position[k] if has[k, 0] else None,
                    gnss_baseline_G=recording.gnss_baseline[k] if has[k, 1] else None,
                    pixels=recording.pixels[k] if suite.camera is not None else None,
                    barometer=altitudes[k],
                    magnetometer=fields[k],
                )
                one.predict(recording.gyro[k], recording.accel[k])
        for field, tolerance in TOLERANCES.items():
            gap = abs(array_of(Decimal, getattr(ours, field)) - getattr(plain, field)).max()
            assert float(gap) < tolerance, field
        P, d = plain.P.astype(float), plain._state().astype(float)
    sigma = np.sqrt(np.diag(P))
    relative = np.outer(sigma, sigma)
    assert abs((ours.covariance - P[:15, :15]) / relative[:15, :15]).max() < 1e-7
    drift = slice(15, 18)
    if suite.drifts:
        np.testing.assert_allclose(ours.gnss_drift, d[drift], rtol=0.0, atol=1e-9)
        gap = (ours.gnss_drift_covariance - P[drift, drift]) / relative[drift, drift]
        assert abs(gap).max() < 1e-7
        assert abs(ours.gnss_drift).max() > 0.01  # the drift is not trivially zero
    if suite.barometer is not None:
        assert ours.aid_errors["barometer"][0] == pytest.approx(d[plain.altitude_bias], abs=1e-9)
        assert abs(ours.aid_errors["barometer"][0]) > 0.05
    if suite.magnetometer is not None:
        found = ours.aid_errors["magnetometer"]
        np.testing.assert_allclose(found[:3], d[plain.hard_iron], rtol=0, atol=1e-15)
        assert found[3] == pytest.approx(d[plain.declination], abs=1e-10)
        assert abs(found[:3]).max() > 1e-8
    assert ours.status == 0


@pytest.mark.parametrize("kind", [UnscentedKalmanFilter, ExtendedKalmanFilter])
def test_velocity_of_a_turning_vehicle_observes_its_heading(kind):
    """The update equals a linear one with a numerical Jacobian of v + R_BI^T (w_B x l_B)."""
    one_antenna = LAB.gnss.replace(secondary_antenna_B=None, velocity_sigma=0.02)
    suite = LAB.replace(gnss=one_antenna, camera=None, barometer=BOTH["barometer"])
    ours = kind(suite)
    ours.initialize(np.zeros(3), heading=0.7, heading_sigma=0.05)
    w_B, lever_B = np.array([1.0, -2.0, 6.0]), np.array(one_antenna.primary_antenna_B)
    ours.predict(w_B, ours.R_BI @ (0.0, 0.0, 9.81))
    P, v, R_BI = ours.covariance, ours.velocity, ours.R_BI

    def antenna(x):
        return v + x[3:6] + (rotation_312(x[np.newaxis, 6:9])[0] @ R_BI).T @ np.cross(w_B, lever_B)

    H = np.array([(antenna(1e-6 * e) - antenna(-1e-6 * e)) / 2e-6 for e in np.eye(15)]).T
    S = H @ P @ H.T + 0.02**2 * np.eye(3)
    expected = P - P @ H.T @ np.linalg.solve(S, H @ P)
    R_IG = PlainUKF(LAB).R_IG
    ours.update(gnss_velocity_G=R_IG.T @ antenna(np.zeros(15)))
    sigma = np.sqrt(np.diag(P))
    tolerance = 1e-5 if kind is ExtendedKalmanFilter else 0.02  # second-order terms of the UKF
    gap = (ours.covariance - expected) / np.outer(sigma, sigma)
    assert abs(gap).max() < tolerance
    assert ours.covariance[8, 8] < 0.8 * P[8, 8]


def test_gate_accepts_measurements_again_after_its_time_limit():
    gated = LAB.estimator.replace(false_alarm_probability=1e-4)
    suite = LAB.replace(camera=None, estimator=gated, **BOTH)
    recording = record_circle(suite, 1, 1)
    ours = UnscentedKalmanFilter(suite)
    ours.initialize(recording.gnss_position[0], recording.gnss_baseline[0])
    altitude, before = recording.r[0, 2] + 10.0, ours.aid_errors["barometer"][0]
    ours.update(barometer=altitude)
    assert ours.gate_decisions[-2] == GateDecision.REJECTED
    assert ours.aid_errors["barometer"][0] == before
    seconds = 0.0
    while ours.gate_decisions[-2] != GateDecision.ACCEPTED:
        ours.predict(np.zeros(3), np.array([0.0, 0.0, 9.8]))
        ours.update(barometer=altitude)
        seconds += suite.imu.dt
        assert seconds < gated.glitch_timeout + 1.0
    assert seconds >= gated.reset_timeout
    assert ours.gate_decisions.shape == (3 + 2,)

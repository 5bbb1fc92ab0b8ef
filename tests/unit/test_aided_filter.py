"""Filters with a barometer and a magnetometer equal plain ones that have their errors as states."""

import decimal
from decimal import Decimal

import numpy as np
import pytest

import quad_gym
from quad_gym import BarometerParams, MagnetometerParams
from quad_gym.estimation import ExtendedKalmanFilter, UnscentedKalmanFilter
from quad_gym.packing.aids import slow_states
from quad_gym.records import Aid, GateDecision
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
    "with GNSS that drifts": LAB.replace(gnss=DRIFTING, camera=None, **BOTH),
    "field filter": LAB.replace(gnss=DRIFTING, camera=None, estimator=FIELD, **BOTH),
}


def measured_by_aids(suite, recording, ticks, seed):
    """Altitudes and fields of a recording, with constant errors and noise; None: not measured."""
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
def test_the_filter_equals_a_plain_one(name, kinds):
    """The plain one computes in 45 digits; measurements come and go."""
    suite, ticks, seed = SUITES[name], 18, 5
    ours_class, plain_class = kinds
    recording = record_circle(suite, ticks, seed)
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
    scale = np.outer(sigma, sigma)[:15, :15]
    assert abs((ours.covariance - P[:15, :15]) / scale).max() < 1e-7
    if suite.barometer is not None:
        assert ours.aid_errors["barometer"][0] == pytest.approx(d[plain.altitude_bias], abs=1e-9)
        assert abs(ours.aid_errors["barometer"][0]) > 0.05  # there was something to find
    if suite.magnetometer is not None:
        np.testing.assert_allclose(
            ours.aid_errors["magnetometer"][:3], d[plain.hard_iron], rtol=0, atol=1e-15
        )
        assert ours.aid_errors["magnetometer"][3] == pytest.approx(d[plain.declination], abs=1e-10)
        assert abs(ours.aid_errors["magnetometer"][:3]).max() > 1e-8
    assert ours.status == 0


@pytest.mark.parametrize("kind", [UnscentedKalmanFilter, ExtendedKalmanFilter])
def test_normalized_innovations_are_those_of_the_plain_filter(kind):
    suite, k = SUITES["both"].replace(camera=None), 0
    plain_class = AidedUKF if kind is UnscentedKalmanFilter else AidedEKF
    recording = record_circle(suite, 1, 7)
    altitude = float(recording.r[0, 2]) + 1.0
    field = recording.R_BI[0] @ suite.magnetometer.field_I + 2e-6
    ours, plain = kind(suite), plain_class(suite)
    for one in (ours, plain):
        one.initialize(recording.gnss_position[k], recording.gnss_baseline[k])
    z, H = np.append(altitude, field), []
    ours.update(barometer=altitude, magnetometer=field)
    assert ours.nis[1] == 4
    # by hand: a vehicle of known covariance whose measurement is linear enough
    x = plain._state()
    for i in range(plain.states):
        step = np.zeros(plain.states)
        step[i] = 1e-6
        ahead, behind = ((x + s * step)[np.newaxis] for s in (1, -1))
        both = [np.append(plain._altitude(p), plain._field_B(p)) for p in (ahead, behind)]
        H.append((both[0] - both[1]) / 2e-6)
    H = np.array(H).T
    R = np.diag([suite.barometer.noise_sigma**2, *[suite.magnetometer.noise_sigma**2] * 3])
    S = H @ plain.P @ H.T + R
    nu = z - np.append(plain._altitude(x[np.newaxis]), plain._field_B(x[np.newaxis]))
    expected = [nu[0] ** 2 / S[0, 0], nu[1:] @ np.linalg.solve(S[1:, 1:], nu[1:])]
    tolerance = 1e-6 if kind is ExtendedKalmanFilter else 0.02  # the sigma points' second order
    np.testing.assert_allclose(ours.block_nis[-2:], expected, rtol=tolerance)


@pytest.mark.parametrize("kind", [UnscentedKalmanFilter, ExtendedKalmanFilter])
def test_velocity_of_a_turning_vehicle_observes_its_heading(kind):
    """The antenna goes by w x l, seen from I: by the linear update, with numerical derivatives."""
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
    tolerance = 1e-5 if kind is ExtendedKalmanFilter else 0.02  # the sigma points' second order
    gap = (ours.covariance - expected) / np.outer(sigma, sigma)
    assert abs(gap).max() < tolerance
    assert ours.covariance[8, 8] < 0.8 * P[8, 8]


def field_derivatives(ours, suite, delta):
    """The derivatives of the expected field by attitude error and hard iron, numerically."""
    g = np.cross(suite.magnetometer.field_I, (0.0, 0.0, 1.0))
    field_I = suite.magnetometer.field_I + ours._engine.read("slow_hat")[0, delta] * g
    R_BI = ours.R_BI

    def field_B(x):
        return rotation_312(x[np.newaxis, :3])[0] @ R_BI @ field_I + x[3:]

    return np.array([(field_B(1e-5 * e) - field_B(-1e-5 * e)) / 2e-5 for e in np.eye(6)]).T


def covariance_of_field(ours, H, first):
    """H P H^T, P the joint covariance of attitude error and hard iron."""
    rows = [ours._engine.read("L")[0, 6:9], ours._engine.read("L_slow")[0, first : first + 3]]
    L = np.zeros((6, rows[1].shape[1]))
    L[:3, :15], L[3:] = rows
    return H @ L @ L.T @ H.T


@pytest.mark.parametrize("kind", [UnscentedKalmanFilter, ExtendedKalmanFilter])
def test_rotated_attitude_keeps_the_covariance_of_the_field(kind):
    """Before and after an update that corrects the heading by eight degrees.

    A filter whose covariance does not turn has the covariance of the errors as they are before the
    rotation, and finds another covariance of the field after it.
    """
    magnetometer = MagnetometerParams(declination_sigma=1e-9)
    plain = quad_gym.sensor_suite("consumer").simplified().replace(magnetometer=magnetometer)
    places = slow_states(plain)
    first, delta = places.vectors[Aid.MAGNETOMETER], places.scalars[Aid.MAGNETOMETER]
    field_B = rotation_312(np.array([[0.0, 0.0, 0.15]]))[0] @ plain.magnetometer.field_I
    found = {}
    for reset in (True, False):
        estimator = plain.estimator.replace(attitude_reset=reset, false_alarm_probability=0.0)
        suite = plain.replace(estimator=estimator)
        ours = kind(suite)
        ours.initialize(np.zeros(3), heading=0.0, heading_sigma=0.1)
        before = field_derivatives(ours, suite, delta)
        ours.update(magnetometer=field_B)
        after = field_derivatives(ours, suite, delta)
        found[reset] = [covariance_of_field(ours, H, first) for H in (before, after)]
    kept, scale = found[False][0], abs(found[False][0]).max()
    assert abs(found[True][1] - kept).max() < 1e-6 * scale
    assert abs(found[False][1] - kept).max() > 0.05 * scale


def test_measurements_beyond_the_gate_are_accepted_at_last():
    gated = LAB.estimator.replace(false_alarm_probability=1e-4, max_rejections=5)
    suite = LAB.replace(camera=None, estimator=gated, **BOTH)
    recording = record_circle(suite, 1, 1)
    ours = UnscentedKalmanFilter(suite)
    ours.initialize(recording.gnss_position[0], recording.gnss_baseline[0])
    altitude, before = recording.r[0, 2] + 10.0, ours.aid_errors["barometer"][0]
    for _ in range(5):
        ours.update(barometer=altitude)
        assert ours.gate_decisions[-2] == GateDecision.REJECTED
        assert ours.aid_errors["barometer"][0] == before
    ours.update(barometer=altitude)  # the filter has doubted itself
    assert ours.gate_decisions[-2] == GateDecision.ACCEPTED
    assert ours.aid_errors["barometer"][0] > 3.0
    field = recording.R_BI[0] @ suite.magnetometer.field_I + 3e-5
    for _ in range(5):
        ours.update(magnetometer=field)
        assert ours.gate_decisions[-1] == GateDecision.REJECTED
    ours.update(magnetometer=field)
    assert ours.gate_decisions[-1] == GateDecision.ACCEPTED
    assert ours.gate_decisions.shape == (3 + 2,)


@pytest.mark.parametrize(
    ("suite", "measurement"),
    [
        *((LAB, {"barometer": 1.0}), (LAB, {"magnetometer": np.ones(3)})),
        (SUITES["both"], {"barometer": np.nan}),
        (SUITES["both"], {"magnetometer": np.ones(2)}),
    ],
)
def test_invalid_measurements_change_nothing(suite, measurement):
    ours = UnscentedKalmanFilter(suite)
    ours.initialize(np.ones(3), np.array([0.1, 0.0, 0.0]))
    before = ours.covariance
    with pytest.raises(ValueError, match=next(iter(measurement))):
        ours.update(**measurement)
    np.testing.assert_array_equal(ours.covariance, before)

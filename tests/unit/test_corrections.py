"""Sums of corrections in `kernels/filter/measurements.py`, and a flag without a gate."""

import math

import numpy as np
import pytest

from quad_gym.kernels.stages import Stage
from quad_gym.records import POSITION_BLOCK
from tests.lane_filter import EIGHT
from tests.lane_rules import NEVER, LaneRules
from tests.level_flights import MAGNETIC, R_IG

GNSS = MAGNETIC.gnss.replace(secondary_antenna_B=None, primary_antenna_B=(0.0, 0.0, 0.0))
DRIFTING = MAGNETIC.replace(
    gnss=GNSS.replace(drift_sigma_I=(0.5, 0.6, 0.7), drift_tau=50.0), barometer=None
)
OPEN = MAGNETIC.replace(
    gnss=GNSS, estimator=MAGNETIC.estimator.replace(false_alarm_probability=0.0)
)
NOW, SECOND = LaneRules.tick, MAGNETIC.imu.rate


def test_corrections_of_biases_and_drift_add_up_and_fade():
    """Linearly over 6 s and 1.5 s, with the variance that each update removes; in closed form."""
    rules, rng = LaneRules(DRIFTING), np.random.default_rng(0)
    P = rules.covariance()[0]
    states = [*range(9, 18)]
    for row in states:  # each is correlated with the position along some axis
        P[row, row % 3] = P[row % 3, row] = 0.3 * math.sqrt(P[row, row] * P[row % 3, row % 3])
    P[0, 1] = P[1, 0] = P[0, 2] = P[2, 0] = P[1, 2] = P[2, 1] = 0.0
    rules.set_covariance(P)
    ago = np.array([0.0, 0.5, 1.4, 1.6, 3.0, 5.9, 6.1, 20.0])
    sums = 1e-3 * rng.standard_normal((EIGHT, 9))
    squares = 1e-7 * rng.random((EIGHT, 9))
    rules.set(corrected=sums, corrected_variance=squares, corrected_tick=NOW - ago * SECOND)
    off = np.tile([0.03, -0.02, 0.01], (EIGHT, 1))
    rules.measured(POSITION_BLOCK, off @ R_IG)
    H = np.zeros((3, len(P)))
    H[:, :3] = H[:, 15:18] = np.eye(3)  # an antenna and its drift
    S = H @ P @ H.T + np.diag(np.square(GNSS.position_sigma_I))
    gain = P @ H.T @ np.linalg.inv(S)
    removed = np.diag(gain @ S @ gain.T)[states]
    rules.run(Stage.UPDATE)
    kept = np.maximum(1.0 - ago[:, np.newaxis] / np.array([6.0] * 6 + [1.5] * 3), 0.0)
    expected = kept * sums + (gain @ off[0])[states]
    np.testing.assert_allclose(rules.get("corrected"), expected, rtol=1e-5, atol=1e-9)
    expected = kept**2 * squares + removed
    np.testing.assert_allclose(rules.get("corrected_variance"), expected, rtol=1e-5, atol=1e-12)
    np.testing.assert_array_equal(rules.get("corrected_tick"), NOW)


@pytest.mark.parametrize("first", [0, 3])
def test_filter_without_a_gate_is_flagged_while_its_biases_drift(first):
    """The sums are beyond 24, chi-square of three axes. No state changes, and the sums stay.

    The flag stays for the time in which corrections reduce the error of a bias to a third: its
    variance over the rate at which updates have reduced it in the last 3 s, or the rate of its
    driving noise, if that is larger; at least 1 s and at most 60 s.
    """
    rules, imu = LaneRules(OPEN, innovations=True), OPEN.imu
    sigma, kind = (0.02, "accel") if first == 0 else (0.002, "gyro")
    drive = float(rules.params[f"{kind}_bias_drive"][0, 0])
    removed = sigma**2 * np.array([10.0, 1.0, 0.3, 0.1, 0.06, 0.04, 0.1, 0.1])
    variances = np.full((EIGHT, 9), 1e9)
    variances[:, first : first + 3] = removed[:, np.newaxis]
    corrected = np.zeros((EIGHT, 9))
    share = np.array([1.01] * 7 + [0.99])
    corrected[:, first + 1] = share * np.sqrt(24.0 * (removed + sigma**2 / 24.0))
    alarm = np.array([NEVER] * 6 + [NOW + 1e6, NEVER])
    rules.set(corrected=corrected, corrected_variance=variances, alarm_tick=alarm)
    rules.measured(POSITION_BLOCK, np.zeros(3))
    before = rules.covariance()
    rules.run(Stage.UPDATE)
    # the update itself changes neither sums nor biases, as nothing is correlated
    rate = np.maximum(removed / 3.0, drive**2 * imu.rate)
    memory = np.clip(sigma**2 / rate, 1.0, 60.0)  # other biases are corrected at once
    held = NOW + (memory - 1.0) * SECOND
    held[6:] = alarm[6:]
    np.testing.assert_allclose(rules.get("alarm_tick"), held, rtol=1e-9)
    np.testing.assert_allclose(rules.get("corrected"), corrected, rtol=1e-9, atol=1e-15)
    np.testing.assert_allclose(rules.covariance()[:, 9:, 9:], before[:, 9:, 9:], rtol=1e-9)
    assert (memory > 1.0).any()
    assert (memory == 60.0).any()


@pytest.mark.parametrize("ratio", [2.0, 2.3])
def test_filter_without_a_gate_is_flagged_while_its_nis_is_too_large(ratio):
    rules = LaneRules(OPEN, innovations=True)
    rules.set(nis_ratio=ratio)
    rules.measured(POSITION_BLOCK, np.zeros(3))
    rules.run(Stage.UPDATE)
    assert (rules.get("nis_ratio") == 0.95 * ratio).all()
    assert (rules.get("alarm_tick") >= NOW).all() == (0.95 * ratio > 2.1)
    np.testing.assert_array_equal(rules.get("diverged"), float(0.95 * ratio > 2.1))

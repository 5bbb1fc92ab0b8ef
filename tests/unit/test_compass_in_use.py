"""A compass that is left out and used again, and an unknown heading, in `kernels/filter/motion.py`.

docs/filter-heading.md has the rules. Each flight of a run is near another limit.
"""

import math

import numpy as np
import pytest
from scipy import stats

from quad_gym.kernels.stages import Stage
from quad_gym.records import (
    AID_BLOCK,
    AID_GROUPS,
    BASELINE_BLOCK,
    POSITION_BLOCK,
    Aid,
    GateDecision,
)
from quad_gym.rotations import euler_to_dcm
from tests.lane_filter import EIGHT
from tests.lane_rules import LaneRules
from tests.level_flights import MAGNETIC, R_IG

SUITE = MAGNETIC.replace(gnss=MAGNETIC.gnss.replace(secondary_antenna_B=None))
COMPASS, FIELD = AID_GROUPS + Aid.MAGNETOMETER, AID_BLOCK[Aid.MAGNETOMETER]
FIELD_I = np.array(SUITE.magnetometer.field_I)
GATE = stats.chi2.isf(SUITE.estimator.false_alarm_probability, 3)
NOW, UNKNOWN = LaneRules.tick, math.pi / math.sqrt(3.0)
SECOND = SUITE.imu.rate


def certain(heading=0.4, **fields):
    """Flights with a certain estimate, so that fields have the covariance of their noise."""
    rules = LaneRules(SUITE, np.full(5, 1e-7))
    for row in range(15, 15 + rules.slow):
        rules.set_sigma(row, 1e-9)
    rules.set(R_hat=euler_to_dcm([0.0, 0.0, heading]), level_tick=NOW - 0.5 * SECOND)
    rules.set(**fields)
    return rules


def see_field(rules, nis=0.0):
    """Update with a field whose normalized innovation squared is this, or one for each."""
    field_B = rules.get("R_hat") @ FIELD_I
    off = SUITE.magnetometer.noise_sigma * np.sqrt(np.broadcast_to(nis, EIGHT))
    field_B[:, 2] += off
    rules.measured(FIELD, field_B)
    rules.run(Stage.UPDATE)
    return rules


OUT = {"compass_out": 1.0, "compass_agrees": 1.0, "compass_from": [math.cos(0.4), math.sin(0.4)]}


@pytest.mark.parametrize(("least", "time"), [(0.86, 10.0), (0.88, 60.0)])
def test_compass_is_used_again_after_it_has_agreed_for_long(least, time):
    """For 10 s while the heading changed by 30 degrees, or for 60 s. It is used at once."""
    ago = time + np.repeat([-0.01, 0.01], 4)
    rules = certain(compass_tick=NOW - ago * SECOND, compass_least=least, **OUT)
    see_field(rules)
    back = ago > time
    np.testing.assert_array_equal(rules.get("compass_out"), ~back)
    decision = np.where(back, GateDecision.ACCEPTED, rules.get("gate")[0, FIELD])
    np.testing.assert_array_equal(rules.get("gate")[:, FIELD], decision)
    assert rules.get("gate")[0, FIELD] != GateDecision.ACCEPTED
    np.testing.assert_array_equal(rules.get("compass_least"), least)


@pytest.mark.parametrize("turned", [0.3, -0.3])
def test_compass_is_used_again_when_the_heading_has_changed_enough(turned):
    """The cosine of the change falls below 0.87, by this field or by an earlier one."""
    change = math.acos(0.87) + np.resize([-0.01, 0.01], EIGHT)
    rules = certain(compass_tick=NOW - 11.0 * SECOND, compass_least=0.9, **OUT)
    sign = math.copysign(1.0, turned)
    rules.set(R_hat=[euler_to_dcm([0.2, 0.0, 0.4 + sign * x]) for x in change])
    # the nose of a vehicle that leans aside points as before
    see_field(rules)
    np.testing.assert_array_equal(rules.get("compass_out"), np.resize([1.0, 0.0], EIGHT))
    np.testing.assert_allclose(rules.get("compass_least"), np.cos(change), rtol=1e-6)


@pytest.mark.parametrize(
    ("changes", "nis", "agrees"),
    [
        ({}, 0.99 * GATE, True),
        ({}, 1.01 * GATE, False),
        ({"level_tick": NOW - 0.99 * SECOND}, 0.0, True),
        ({"level_tick": NOW - 1.01 * SECOND}, 0.0, False),
    ],
    ids=["within the gate", "beyond it", "confirmed", "no longer confirmed"],
)
@pytest.mark.parametrize("before", [0.0, 1.0])
def test_compass_agrees_within_the_gate_with_a_confirmed_heading(changes, nis, agrees, before):
    """The time begins when it first agrees, with the heading of then."""
    fields = OUT | {"compass_agrees": before, "compass_tick": 5.0, "compass_least": 0.5} | changes
    fields["compass_from"] = [1.0, 0.0]
    rules = see_field(certain(1.1, **fields), nis)
    begins = agrees and not before
    np.testing.assert_array_equal(rules.get("compass_agrees"), float(agrees))
    np.testing.assert_array_equal(rules.get("compass_tick"), NOW if begins else 5.0)
    start = [math.cos(1.1), math.sin(1.1)] if begins else [1.0, 0.0]
    np.testing.assert_allclose(rules.get("compass_from"), np.tile(start, (EIGHT, 1)), rtol=1e-9)
    least = 1.0 if begins else min(math.cos(1.1), 0.5) if agrees else 0.5
    np.testing.assert_allclose(rules.get("compass_least"), least, rtol=1e-9)
    # a flight that just begins is no longer out of use by the time of an earlier one
    expected = 0.0 if agrees and before else 1.0
    np.testing.assert_array_equal(rules.get("compass_out"), expected)


def test_compass_in_use_is_not_followed():
    rules = see_field(certain(compass_agrees=0.3, compass_tick=5.0, compass_least=0.4))
    np.testing.assert_array_equal(rules.get("compass_agrees"), 0.3)
    np.testing.assert_array_equal(rules.get("compass_tick"), 5.0)
    np.testing.assert_array_equal(rules.get("compass_least"), 0.4)
    np.testing.assert_array_equal(rules.get("gate")[:, FIELD], GateDecision.ACCEPTED)


@pytest.mark.parametrize(("row", "first"), [(0.0, True), (1.0, False)])
def test_first_of_a_series_of_fields_has_leapt_if_it_is_far_beyond_the_gate(row, first):
    """The NIS of twice the largest innovation within the gate is four times as large."""
    rules = certain(compass_leapt=np.resize([0.0, 1.0], EIGHT))
    rules.change("rejected_in_row", COMPASS, row)
    see_field(rules, GATE * np.repeat([3.98, 4.02], 4))
    leapt = np.repeat([0.0, 1.0], 4) if first else np.resize([0.0, 1.0], EIGHT)
    np.testing.assert_array_equal(rules.get("compass_leapt"), leapt)


# --------------------------------------------------------------------------------------------------
# An unknown heading.
# --------------------------------------------------------------------------------------------------


def mixed_covariance(size, scale):
    mixed = np.eye(size) + 0.3 * np.random.default_rng(0).standard_normal((size, size))
    return scale * mixed @ mixed.T


def rows_of_attitude(rules):
    """Rows that an unknown heading ties to the attitude: also biases, hard iron, declination."""
    iron, delta = (
        15 + int(rules.settings[name][0, Aid.MAGNETOMETER]) for name in ("aid_vector", "aid_scalar")
    )
    return [*range(6, 15), iron, iron + 1, iron + 2, delta]


@pytest.mark.parametrize("kind", ["ukf", "ekf"])
@pytest.mark.parametrize("first", [0.0, 0.02])
def test_unknown_heading_is_tied_to_no_position_or_velocity(kind, first):
    """Without a sensor of the heading it has no information, and N has the tilt.

    Derivatives lack the second order of a force with any heading, so the velocity has its square.
    """
    rules = LaneRules(SUITE.replace(estimator=SUITE.estimator.replace(kind=kind)))
    R_BI = euler_to_dcm([0.2, -0.3, 0.5])
    P = mixed_covariance(15 + rules.slow, 1e-4)
    rules.set_covariance(P)
    lost = np.resize([1.0, 0.0], EIGHT)
    rules.set(R_hat=R_BI, heading_lost=lost, level_first=first, level_last=[0.1, 0.2, 3.0],
              level_sum=[1.1, 2.2, 3.1])  # fmt: skip
    rules.measured(POSITION_BLOCK, np.zeros(3))
    rules.run(Stage.MOTION)
    tied, k, expected = rows_of_attitude(rules), R_BI[:, 2], P.copy()
    free = [i for i in range(len(P)) if i not in tied]
    expected[np.ix_(tied, free)], expected[np.ix_(free, tied)] = 0.0, 0.0
    expected[6:9], expected[:, 6:9] = 0.0, 0.0
    tilt = 0.05**2 + first
    expected[6:9, 6:9] = tilt * np.eye(3) + (UNKNOWN**2 - tilt) * np.outer(k, k)
    if kind == "ekf":
        expected[[3, 4], [3, 4]] += 1.0**2 + 2.0**2
    found = rules.covariance()
    np.testing.assert_allclose(found[0], expected, rtol=1e-7, atol=1e-12)
    np.testing.assert_allclose(found[1], P, rtol=1e-12)
    np.testing.assert_array_equal(rules.get("heading_lost"), lost)


@pytest.mark.parametrize(
    ("sigma", "suite", "lost"),
    [(0.69, SUITE, 0.0), (0.71, SUITE, 1.0), (0.71, MAGNETIC, 0.0)],
    ids=["known", "unknown", "with a baseline"],
)
def test_heading_is_unknown_beyond_40_degrees_unless_a_baseline_measures_it(sigma, suite, lost):
    rules = LaneRules(suite)
    rules.set_sigma(8, sigma)
    rules.measured(POSITION_BLOCK, np.zeros(3))
    rules.change("block_valid", POSITION_BLOCK, np.resize([1.0, 0.0], EIGHT))
    rules.run(Stage.MOTION)
    expected = np.resize([lost, 0.0], EIGHT)
    np.testing.assert_array_equal(rules.get("heading_lost"), expected)
    sigma = np.where(expected, UNKNOWN, sigma)
    np.testing.assert_allclose(np.sqrt(rules.covariance()[:, 8, 8]), sigma, rtol=1e-9)


def test_position_corrects_no_attitude_whose_heading_is_unknown():
    """The lever arm moves the position with the heading, by as much as its length."""
    arm = np.array([0.3, -0.2, 0.1])
    suite = SUITE.replace(gnss=SUITE.gnss.replace(primary_antenna_B=tuple(arm)))
    rules, R_BI = LaneRules(suite), euler_to_dcm([0.1, 0.05, 0.5])
    rules.set(R_hat=R_BI, heading_lost=1.0)
    rules.measured(POSITION_BLOCK, np.array([0.3, -0.4, 0.2]) @ R_IG)
    rules.run(Stage.MOTION)
    before = rules.covariance()[0, :2, :2]
    rules.run(Stage.MOTION, 1)
    P, k = rules.covariance()[0], R_BI[:, 2]
    np.testing.assert_allclose(P[:2, :2], before + arm @ arm * np.eye(2), rtol=1e-9)
    expected = 0.05**2 * np.eye(3) + (UNKNOWN**2 - 0.05**2) * np.outer(k, k)
    np.testing.assert_allclose(P[6:9, 6:9], expected, rtol=1e-9, atol=1e-12)
    rules.run(Stage.UPDATE)
    np.testing.assert_array_equal(rules.get("R_hat"), np.tile(R_BI, (EIGHT, 1, 1)))
    assert abs(rules.get("r_hat")[0, :2]).min() > 0.1


@pytest.mark.parametrize(
    ("first", "out", "sigma"),
    [
        (0.0, 0.0, 0.35),
        (0.01, 0.0, None),
        (0.2, 0.0, 0.6),
        (0.0, 1.0, UNKNOWN),
    ],
    ids=["usual tilt", "large tilt", "larger tilt", "compass out"],
)
def test_field_shows_an_unknown_heading(first, out, sigma):
    """With 20 degrees, and more for a tilt beyond the usual one, which turns a steep field."""
    rules = LaneRules(SUITE)
    R_BI, turn = euler_to_dcm([0.1, -0.2, 0.0]), euler_to_dcm([0.0, 0.0, 0.9])
    rules.set(R_hat=R_BI, heading_lost=1.0, level_first=first, compass_out=out)
    rules.measured(FIELD, R_BI @ turn @ FIELD_I)
    rules.run(Stage.MOTION)
    steep = FIELD_I[2] ** 2 / (FIELD_I[0] ** 2 + FIELD_I[1] ** 2)
    sigma = math.sqrt(0.35**2 + steep * first) if sigma is None else sigma
    expected = R_BI if out else R_BI @ turn
    np.testing.assert_allclose(rules.get("R_hat")[0], expected, atol=1e-9)
    np.testing.assert_array_equal(rules.get("heading_lost"), out)
    k, tilt = R_BI[:, 2], 0.05**2 + first
    P = tilt * np.eye(3) + (sigma**2 - tilt) * np.outer(k, k)
    np.testing.assert_allclose(rules.covariance()[0, 6:9, 6:9], P, rtol=1e-9, atol=1e-12)
    if not out:  # the update corrects the attitude then
        rules.run(Stage.MOTION, 1)
        np.testing.assert_allclose(rules.covariance()[0, 6:9, 6:9], P, rtol=1e-9, atol=1e-12)


def test_baseline_shows_an_unknown_heading_where_it_is_measured():
    rules, R_BI = LaneRules(MAGNETIC), euler_to_dcm([0.1, -0.2, 0.0])
    turn = euler_to_dcm([0.0, 0.0, -2.0])
    rules.set(R_hat=R_BI, heading_lost=1.0)
    rules.measured(BASELINE_BLOCK, R_IG.T @ (R_BI @ turn).T @ MAGNETIC.gnss.baseline_B)
    rules.change("block_valid", BASELINE_BLOCK, np.resize([1.0, 0.0], EIGHT))
    rules.measured(POSITION_BLOCK, np.zeros(3))
    rules.run(Stage.MOTION)
    shown = np.resize([True, False], EIGHT)
    np.testing.assert_array_equal(rules.get("heading_lost"), ~shown)
    np.testing.assert_allclose(rules.get("R_hat")[0], R_BI @ turn, atol=1e-9)
    np.testing.assert_allclose(rules.get("R_hat")[1], R_BI, atol=1e-12)
    k, P = R_BI[:, 2], rules.covariance()[:, 6:9, 6:9]
    sigma = np.sqrt(np.einsum("i,nij,j->n", k, P, k))
    np.testing.assert_allclose(sigma, np.where(shown, 0.35, UNKNOWN), rtol=1e-9)

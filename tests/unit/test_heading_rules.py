"""The rules of `quad_gym.kernels.filter.motion` at their limits, just below and just above.

docs/filter-heading.md has the limits. Each flight of a run is near another one. Angles between
headings count as chords, whose squares are 2 - 2 cos.
"""

import math

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from quad_gym.kernels.stages import Stage
from quad_gym.records import AID_GROUPS, SENSOR_GROUPS, Aid
from quad_gym.rotations import euler_to_dcm
from tests.lane_filter import EIGHT
from tests.lane_rules import NEVER, LaneRules
from tests.level_flights import GRAVITY, MAGNETIC

SUITE = MAGNETIC.replace(gnss=MAGNETIC.gnss.replace(secondary_antenna_B=None))
RATE = SUITE.imu.rate
COMPASS = AID_GROUPS + Aid.MAGNETOMETER
UNKNOWN = math.pi / math.sqrt(3.0)
NOW = LaneRules.tick


def angle(square):
    """The angle whose chord has this square."""
    return 2.0 * math.asin(0.5 * math.sqrt(square))


def compared(off, sigma=0.12, own=0.02, length=1.0, suite=SUITE, heading=0.8, **fields):
    """Flights whose heading by motion is `off` from the filter's; both have standard deviations.

    N began with the heading zero, so that u has the angle of the true heading.
    """
    rules = LaneRules(suite)
    off, sigma, own, length = (np.broadcast_to(x, EIGHT) for x in (off, sigma, own, length))
    u = length * np.exp(1j * (heading + off))
    rules.set(
        R_hat=euler_to_dcm([0.0, 0.0, heading]),
        level_fresh=1.0,
        level_phase=2.0,
        level_force=[0.0, 0.0, 20.0],
    )
    rules.change("level_state", 2, u.real)
    rules.change("level_state", 3, u.imag)
    rules.change("level_P", 1, 2.0 * sigma**2 * length**2)
    rules.change("level_P", 2, 1e-6)
    rules.set_sigma(8, own)
    rules.set(**fields)
    return rules


def judged(*args, flag=0, **fields):
    rules = compared(*args, **fields)
    rules.run(Stage.HEADING, flag)
    return rules


AROUND = np.array([0.99, 1.01, -0.99, -1.01])
"""Just below and just above a limit, in both directions."""


@pytest.mark.parametrize(("field", "deviations"), [("level_against", 4.0), ("level_doubts", 3.2)])
@pytest.mark.parametrize(("sigma", "own"), [(0.12, 0.02), (0.02, 0.14), (0.1, 0.9), (0.005, 0.003)])
def test_headings_contradict_beyond_a_number_of_standard_deviations(field, deviations, sigma, own):
    """At most 0.03 of the filter's variance counts, and the square of a chord is at least that."""
    square = max(deviations**2 * (sigma**2 + min(own**2, 0.03)), 0.03)
    rules = judged(np.repeat(angle(square) * AROUND, 2), sigma, own)
    np.testing.assert_array_equal(rules.get(field), np.repeat([0, 1, 0, 1], 2))


@pytest.mark.parametrize(("sigma", "own"), [(0.12, 0.02), (0.1, 0.9), (0.005, 0.003)])
def test_headings_agree_up_to_two_standard_deviations(sigma, own):
    square = max(4.0 * (sigma**2 + min(own**2, 0.03)), 0.03)
    rules = judged(np.repeat(angle(square) * AROUND, 2), sigma, own)
    expected = np.repeat([NOW, NEVER, NOW, NEVER], 2)
    np.testing.assert_array_equal(rules.get("level_tick"), expected)


@pytest.mark.parametrize(
    ("limits", "deviations", "counts"),
    [
        ({"length": [0.59, 0.61, 1.49, 1.51]}, 0.12, [0, 1, 1, 0]),
        ({"level_force": [[0, 0, 0.49], [0, 0, 0.51], [9, 9, 0.49], [9, 9, 0.51]]}, 0.12,
         [0, 1, 0, 1]),
        ({"level_fresh": [0, 1, 0, 1]}, 0.12, [0, 1, 0, 1]),
        ({}, [0.345, 0.355, 0.345, 0.355], [1, 0, 1, 0]),
        ({"heading_lost": [0, 1, 0, 1]}, 0.3, [1, 0, 1, 0]),
    ],
    ids=["length of u", "time since the start", "fix", "standard deviation", "unknown heading"],
)  # fmt: skip
def test_contradiction_counts_where_the_model_holds(limits, deviations, counts):
    """The opposite heading contradicts in any case."""
    limits = {name: np.array(2 * values, dtype=float) for name, values in limits.items()}
    rules = judged(math.pi, np.resize(deviations, EIGHT), **limits)
    for field in ("level_against", "level_doubts"):
        np.testing.assert_array_equal(rules.get(field), 2 * counts)


@pytest.mark.parametrize(
    ("limits", "deviations", "confirmed"),
    [
        ({"length": [0.59, 0.61, 1.49, 1.51]}, 0.12, [0, 1, 1, 0]),
        ({"level_fresh": [0, 1, 0, 1]}, 0.12, [0, 1, 0, 1]),
        ({}, [0.255, 0.265, 0.255, 0.265], [1, 0, 1, 0]),
        ({"heading_lost": [0, 1, 0, 1]}, 0.2, [1, 0, 1, 0]),
    ],
    ids=["length of u", "fix", "standard deviation", "unknown heading"],
)
def test_heading_is_confirmed_where_it_is_known(limits, deviations, confirmed):
    limits = {name: np.array(2 * values, dtype=float) for name, values in limits.items()}
    rules = judged(0.01, np.resize(deviations, EIGHT), **limits)
    np.testing.assert_array_equal(rules.get("level_tick") == NOW, 2 * confirmed)


def test_baseline_measures_the_heading_so_that_motion_neither_confirms_nor_contradicts():
    rules = judged(np.resize([0.0, 3.0], EIGHT), suite=MAGNETIC)
    assert rules.settings["by_motion"] == 2
    np.testing.assert_array_equal(rules.get("level_tick"), NEVER)
    np.testing.assert_array_equal(rules.get("level_against"), 0.0)
    np.testing.assert_array_equal(rules.get("compass_out"), 0.0)


def test_difference_and_uncertainty_of_the_heading_by_motion_are_recorded_after_a_fix():
    off = np.array([0.3, -0.3, 2.0, -2.0, 0.1, 0.1, 0.1, 0.1])
    sigma = np.array([0.1, 0.2, 0.255, 0.265, 0.1, 0.1, 0.1, 0.1])
    length = np.array([1.0, 0.7, 1.2, 1.0, 0.59, 1.51, 1.0, 1.0])
    fresh = np.array([1, 1, 1, 1, 1, 1, 0, 1.0])
    rules = judged(off, sigma, length=length, level_fresh=fresh, level_apart=7.0, level_sigma=9.0)
    apart = np.where(fresh, 2.0 * np.sin(0.5 * off), 7.0)
    np.testing.assert_allclose(rules.get("level_apart"), apart, rtol=1e-9)
    known = [0.1, 0.2, 0.255, UNKNOWN, UNKNOWN, UNKNOWN, 9.0, 0.1]
    np.testing.assert_allclose(rules.get("level_sigma"), known, rtol=1e-9)
    np.testing.assert_array_equal(rules.get("level_fresh"), 0.0)


@pytest.mark.parametrize(
    ("field", "off", "before", "reset"),
    [
        ("level_against", math.pi, [0, 1, 2, 3], [0, 0, 1, 1]),
        ("level_doubts", angle(12.0 * (0.12**2 + 0.02**2)), [0, 8, 9, 10], [0, 0, 1, 1]),
    ],
)
def test_attitude_is_reset_after_contradictions_in_a_row(field, off, before, reset):
    """After three, or ten smaller ones; a fix that agrees ends the row, and others leave it."""
    before = np.array(2 * before, dtype=float)
    rules = judged(off, **{field: before})
    np.testing.assert_array_equal(rules.get("compass_out"), 2 * reset)
    np.testing.assert_array_equal(rules.get(field), np.where(2 * reset, 0.0, before + 1.0))
    np.testing.assert_array_equal(judged(0.0, **{field: before}).get(field), 0.0)
    kept = judged(off, level_fresh=0.0, **{field: before})
    np.testing.assert_array_equal(kept.get(field), before)
    np.testing.assert_array_equal(kept.get("compass_out"), 0.0)


@pytest.mark.parametrize("sigma", [0.155, 0.165])
def test_contradicted_heading_is_reset_by_the_motion_if_this_is_sharp_else_unknown(sigma):
    """The limit is 0.16 rad. Only the former confirms the heading."""
    rules = compared(math.pi, sigma, level_against=2.0, heading=0.3, compass_agrees=1.0)
    rules.change("level_state", 0, 1.5)
    rules.run(Stage.HEADING)
    sharp = sigma < 0.16
    np.testing.assert_allclose(rules.get("v_hat")[:, 0], 1.5 if sharp else 0.0)
    heading = 0.3 + math.pi if sharp else 0.3
    np.testing.assert_allclose(rules.get("R_hat")[0], euler_to_dcm([0, 0, heading]), atol=1e-9)
    np.testing.assert_array_equal(rules.get("heading_lost"), 0.0 if sharp else 1.0)
    np.testing.assert_array_equal(rules.get("level_tick"), NOW if sharp else NEVER)
    np.testing.assert_array_equal(rules.get("compass_out"), 1.0)
    np.testing.assert_array_equal(rules.get("compass_agrees"), 0.0)
    variance = sigma**2 if sharp else UNKNOWN**2
    np.testing.assert_allclose(rules.covariance()[:, 8, 8], variance, rtol=1e-9)


@pytest.mark.parametrize("first", [0.0, 0.02])
def test_reset_by_the_motion_gives_tilt_velocity_and_biases_the_variances_of_a_start(first):
    """The vehicle leans, with all states correlated, and a first tilt beyond the usual.

    N has its tilt. The velocity comes from the motion, at this tick, without the antenna's about
    the center.
    """
    rules = compared(math.pi, 0.1, level_against=2.0, level_P=np.zeros(9))
    lean, u = euler_to_dcm([0.1, -0.2, 0.0]), 0.9 * np.exp(2.0j)
    rng, states = np.random.default_rng(0), 15 + rules.slow
    mixed = np.eye(states) + 0.3 * rng.standard_normal((states, states))
    P = 1e-9 * mixed @ mixed.T
    iron = int(rules.settings["aid_vector"][0, Aid.MAGNETOMETER])
    others = np.delete(np.arange(15, states), np.arange(iron, iron + 3))
    last, sums, force = [0.5, -0.3, 19.0], [1.5, 0.9, 19.2], [1.4, 1.0, 19.2]
    rules.set(
        level_turn=lean, R_hat=lean, level_first=first,
        level_last=last, level_sum=sums, level_force=force,
        level_state=[1.0, 2.0, u.real, u.imag, 0.04, -0.03],
        b_a_hat=0.01, b_g_hat=[1.0, -1.0, 0.001], slow_hat=0.5,
        rejected_in_row=5.0, stepped=1.0, corrected=3.0, corrected_tick=7.0,
    )  # fmt: skip
    rules.change("level_P", 1, 2.0 * 0.1**2 * 0.81)
    rules.set_covariance(P)
    # the motion shows d, and so the tilt: N is corrected by it
    rules.run(Stage.HEADING)
    d = (0.04 - 0.03j) / u / GRAVITY
    tilt = Rotation.from_rotvec([-d.imag, d.real, 0.0]).as_matrix()
    upright = lean @ (tilt.T if first else np.eye(3))
    expected = upright @ euler_to_dcm([0.0, 0.0, 2.0])
    found, imu = rules.get("R_hat")[0], SUITE.imu
    np.testing.assert_allclose(found, expected, atol=1e-9)
    moved = u * ((1.5 - 0.5 - 0.1) + 1j * (0.9 + 0.3 + 0.1)) + 0.2 * (0.04 - 0.03j)
    velocity = [1.0 + moved.real, 2.0 + moved.imag, 0.0]
    np.testing.assert_allclose(rules.get("v_hat")[0], velocity, rtol=1e-9)
    np.testing.assert_array_equal(rules.get("b_a_hat"), 0.0)
    most = 3.0 * imu.gyro_bias_sigma
    np.testing.assert_allclose(rules.get("b_g_hat")[0], [most, -most, 0.001], rtol=1e-12)
    expected = np.zeros((states, states))
    expected[:3, :3] = expected[3:6, 3:6] = np.eye(3)
    k = found[:, 2]
    expected[6:9, 6:9] = 0.05**2 * (np.eye(3) - np.outer(k, k)) + 0.1**2 * np.outer(k, k)
    expected[9:12, 9:12] = imu.accel_bias_sigma**2 * np.eye(3)
    expected[12:15, 12:15] = imu.gyro_bias_sigma**2 * np.eye(3)
    own = np.arange(15 + iron, 18 + iron)
    expected[own, own] = SUITE.magnetometer.hard_iron_sigma**2
    expected[np.ix_(others, others)] = P[np.ix_(others, others)]
    scale = np.sqrt(np.outer(np.diag(expected), np.diag(expected)))
    np.testing.assert_allclose(rules.covariance()[0] / scale, expected / scale, atol=1e-9)
    hat = rules.get("slow_hat")[0, : states - 15]
    np.testing.assert_array_equal(hat, np.where(np.isin(np.arange(15, states), own), 0.0, 0.5))
    for field in ("rejected_in_row", "stepped", "corrected"):
        np.testing.assert_array_equal(rules.get(field), 0.0)
    for field in ("alarm_tick", "corrected_tick", "level_tick"):
        np.testing.assert_array_equal(rules.get(field), NOW)


def test_reset_by_the_motion_leaves_flights_that_agree_as_they_were():
    rules = compared([math.pi, 0.0] * 4, level_against=2.0)
    before = {name: rules.get(name)[1::2] for name in ("P", "P_slow", "R_hat", "v_hat", "b_g_hat")}
    rules.run(Stage.HEADING)
    for name, values in before.items():
        np.testing.assert_array_equal(rules.get(name)[1::2], values, err_msg=name)
    np.testing.assert_array_equal(rules.get("rejected_in_row"), 0.0)
    assert (rules.get("alarm_tick")[1::2] == NEVER).all()


def leaning(lean, confirmed, sigma_tilt, first=0.0, **fields):
    """Flights whose vertical leaves the axis of N by some angles, about any level axis."""
    rules = compared(0.0, 0.3, level_lean=1.0)
    turns = [Rotation.from_rotvec(x * np.array([0.6, -0.8, 0.0])).as_matrix() for x in lean]
    rules.set(
        R_hat=np.array(turns),
        level_tick=NOW if confirmed else NOW - 1.01 * RATE,
        level_first=first,
        **fields,
    )
    rules.change("level_P", 2, 2.0 * (GRAVITY * sigma_tilt) ** 2)
    rules.run(Stage.HEADING)
    return rules


@pytest.mark.parametrize(
    ("confirmed", "sigma_tilt", "limit"),
    [
        (False, 0.001, 0.087),
        (False, 0.03, math.sqrt(12.0) * 0.03),
        (False, 0.1, 0.12),
        (True, 0.001, 0.14),
        (True, 0.1, 0.14),
    ],
)
def test_vertical_that_leaves_the_level_frame_is_wrong_in_two_fixes_in_a_row(
    confirmed, sigma_tilt, limit
):
    """Beyond 5 to 7 degrees by the tilt's variance, or 8 degrees with a confirmed heading."""
    lean = [2.0 * math.asin(0.5 * limit * share) for share in np.repeat([0.99, 1.01], 4)]
    rules = leaning(lean, confirmed, sigma_tilt)
    np.testing.assert_array_equal(rules.get("compass_out"), np.repeat([0.0, 1.0], 4))
    np.testing.assert_array_equal(rules.get("heading_lost"), np.repeat([0.0, 1.0], 4))
    np.testing.assert_array_equal(rules.get("level_lean"), 0.0)
    # the tilt is that of N then, and the heading is as before
    np.testing.assert_allclose(rules.get("R_hat")[4:], np.tile(np.eye(3), (4, 1, 1)), atol=1e-2)
    np.testing.assert_allclose(rules.get("R_hat")[4:, :, 2], [[0, 0, 1.0]] * 4, atol=1e-12)
    once = leaning(lean, confirmed, sigma_tilt, level_lean=0.0)
    far = 2.0 * np.sin(0.5 * np.array(lean)) > 0.14  # at once, without a row
    np.testing.assert_array_equal(once.get("compass_out"), far)
    np.testing.assert_array_equal(once.get("level_lean"), [*[0.0] * 4, *(1.0 - far[4:])])


def squared_by_variances(sigma_tilt, lean):
    """Sixteen variances of the tilts of N and of the filter, 0.05 rad but 0.02 about its own z."""
    about_z = 0.02**2 * math.cos(lean) ** 2 + 0.05**2 * math.sin(lean) ** 2
    return 16.0 * (sigma_tilt**2 + 0.5 * (2.0 * 0.05**2 + 0.02**2 - about_z))


@pytest.mark.parametrize("confirmed", [False, True])
def test_large_first_tilt_may_lean_by_four_standard_deviations(confirmed):
    first, sigma = 0.001, 0.07
    for share, found in ((0.99, 0.0), (1.01, 1.0)):
        lean = 0.3
        for _ in range(20):  # the limit depends on the lean
            lean = share * angle(squared_by_variances(sigma, lean) + 12.0 * first)
        rules = leaning([lean] * EIGHT, confirmed, sigma, first, level_force=[0.0, 0.0, 0.6])
        np.testing.assert_array_equal(rules.get("compass_out"), found)


@pytest.mark.parametrize(
    ("lean", "changes"),
    [
        (0.13, {"level_fresh": 0.0}),
        (0.3, {"heading_lost": 1.0}),
        (0.3, {"level_phase": 1.0}),
    ],
)
def test_vertical_is_not_compared_without_a_fix_or_a_known_heading(lean, changes):
    rules = leaning([lean] * EIGHT, False, 0.001, **changes)
    np.testing.assert_array_equal(rules.get("compass_out"), 0.0)
    np.testing.assert_array_equal(rules.get("level_lean"), float("level_fresh" in changes))


def test_vertical_that_is_far_off_is_wrong_at_once_also_between_two_fixes():
    lean = [2.0 * math.asin(0.5 * 0.14 * share) for share in np.repeat([0.99, 1.01], 4)]
    rules = leaning(lean, True, 0.001, level_fresh=0.0, level_against=2.0, level_doubts=9.0)
    np.testing.assert_array_equal(rules.get("compass_out"), np.repeat([0.0, 1.0], 4))
    # what only a fix can show has not been counted
    np.testing.assert_array_equal(rules.get("level_against"), 2.0)
    np.testing.assert_array_equal(rules.get("level_doubts"), 9.0)


@pytest.mark.parametrize("changes", [{}, {"compass_out": 1.0}, {"sigma": 0.27}])
@pytest.mark.parametrize("left", [0.1, 0.9])
def test_hard_iron_beyond_five_standard_deviations_contradicts_the_compass(left, changes):
    """The limit has 1.1 times the suite's variance, minus the filter's.

    Where the motion shows the heading, it replaces the filter's heading, although both agree.
    """
    own, generator = SUITE.magnetometer.hard_iron_sigma, np.random.default_rng(4)
    rules = compared(0.0, **({"sigma": 0.2} | changes))
    iron = int(rules.settings["aid_vector"][0, Aid.MAGNETOMETER])
    M = generator.normal(size=(3, 3))
    rest = M @ M.T
    rest *= left * own**2 / np.linalg.eigvalsh(rest)[-1]
    covariance = rules.covariance()
    here = np.arange(15 + iron, 18 + iron)
    covariance[np.ix_(range(EIGHT), here, here)] = rest
    rules.set_covariance(covariance)
    for number, share in enumerate(np.repeat([0.99, 1.01], 4)):
        b = generator.normal(size=3)
        b *= 5.0 * share / math.sqrt(b @ np.linalg.solve(1.1 * own**2 * np.eye(3) - rest, b))
        slow = rules.get("slow_hat")[number]
        slow[iron : iron + 3] = b
        rules.put(number, slow_hat=slow)
    rules.set(level_against=2.0)
    rules.run(Stage.HEADING)
    found = np.repeat([0.0, 1.0], 4) if not changes else changes.get("compass_out", 0.0)
    np.testing.assert_array_equal(rules.get("compass_out"), found)
    np.testing.assert_array_equal(rules.get("heading_lost"), 0.0)
    if not changes:
        sigma = np.sqrt(rules.covariance()[:, 8, 8])
        np.testing.assert_allclose(sigma, np.repeat([0.02, 0.2], 4), rtol=1e-9)


@pytest.mark.parametrize("time", [0.0, 10.0])
def test_first_tilt_beyond_the_usual_one_allows_a_larger_lean(time):
    """The first variance counts twelve times, and falls as N is leveled at 0.06 per second."""
    first, lean = 0.01, 0.3
    for _ in range(20):
        square = squared_by_variances(0.001, lean) + 12.0 * first * math.exp(-2.0 * 0.06 * time)
        lean = angle(square)
    lean = lean * np.repeat([0.99, 1.01], 4)
    rules = leaning(lean, False, 0.001, first, level_force=[0.0, 0.0, time])
    np.testing.assert_array_equal(rules.get("compass_out"), np.repeat([0.0, 1.0], 4))
    tilt = 0.05**2 + first * math.exp(-2.0 * 0.06 * time)
    np.testing.assert_allclose(rules.covariance()[4:, 6, 6], tilt, rtol=1e-9)


def test_unknown_heading_is_found_when_the_motion_shows_it_sharply():
    """Below 0.16 rad; until then N has the vertical."""
    lean = euler_to_dcm([0.1, 0.05, 0.0])
    rules = compared(1.0, [0.15, 0.17] * 4, heading_lost=1.0, level_turn=lean)
    rules.change("level_fresh", (), [1, 1, 1, 1, 0, 0, 1, 1])
    rules.run(Stage.HEADING)
    found = np.array([1, 0, 1, 0, 0, 0, 1, 0], dtype=bool)
    np.testing.assert_array_equal(rules.get("heading_lost"), ~found)
    np.testing.assert_array_equal(rules.get("level_tick"), np.where(found, NOW, NEVER))
    R, fresh = rules.get("R_hat"), np.array([1, 1, 1, 1, 0, 0, 1, 1], dtype=bool)
    np.testing.assert_allclose(
        R[found], [lean @ euler_to_dcm([0, 0, 1.8])] * found.sum(), atol=1e-9
    )
    np.testing.assert_allclose(R[fresh][:, :, 2], [lean[:, 2]] * fresh.sum(), atol=1e-12)
    np.testing.assert_array_equal(R[~fresh], [euler_to_dcm([0, 0, 0.8])] * 2)
    np.testing.assert_array_equal(rules.get("compass_out"), 0.0)


@pytest.mark.parametrize(
    ("changes", "older"),
    [
        ({}, True),
        ({"rejected_in_row": 1.0}, False),
        ({"compass_out": 1.0}, False),
        ({"compass_leapt": 1.0}, False),
        ({"level_fresh": 0.0}, False),
        ({"heading_lost": 1.0}, False),
        ({"sigma": 0.2}, False),
    ],
)
def test_rejected_compass_ends_a_confirmation_that_the_motion_no_longer_repeats(changes, older):
    """Unless the compass has stepped: the gyro's bias may have changed. Older ones stay."""
    fields = {"rejected_in_row": np.zeros(SENSOR_GROUPS), "sigma": 0.3} | changes
    row = fields["rejected_in_row"] + 0.0
    row = np.broadcast_to(row, SENSOR_GROUPS).copy()
    row[COMPASS] = changes.get("rejected_in_row", 2.0)
    ticks = np.resize([NOW - 0.5 * RATE, NOW - 3.0 * RATE], EIGHT)
    rules = judged(0.3, **fields | {"rejected_in_row": row, "level_tick": ticks})
    if "sigma" in changes:  # confirmed again
        expected = np.full(EIGHT, NOW)
    else:
        expected = np.minimum(ticks, NOW - RATE) if older else ticks
    np.testing.assert_array_equal(rules.get("level_tick"), expected)

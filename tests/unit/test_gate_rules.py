"""The rules of the gate, `quad_gym.kernels.filter.gate`, at their limits.

The estimate is so certain, or so uncertain, that innovations have a covariance in closed form.
"""

import math

import numpy as np
import pytest
from scipy import stats

import quad_gym
from quad_gym.kernels.stages import Stage
from quad_gym.params.sensor_table import READINGS
from quad_gym.records import (
    AID_BLOCK,
    AID_GROUPS,
    BASELINE_BLOCK,
    FEATURE_BLOCKS,
    POSITION_BLOCK,
    VELOCITY_BLOCK,
    Aid,
    GateDecision,
)
from quad_gym.rotations import euler_to_dcm
from tests.lane_filter import EIGHT
from tests.lane_rules import NEVER, LaneRules
from tests.level_flights import MAGNETIC, R_IG

GNSS = MAGNETIC.gnss.replace(secondary_antenna_B=None, primary_antenna_B=(0.0, 0.0, 0.0))
SUITE = MAGNETIC.replace(gnss=GNSS)
ALARM = SUITE.estimator.false_alarm_probability
GATE, GATE_OF_RANGES = stats.chi2.isf(ALARM, 3), stats.chi2.isf(ALARM, 1)
NOW, SECOND = LaneRules.tick, SUITE.imu.rate
ANCHORS = ((10.0, 0.0, 0.0), (0.0, 10.0, 0.0), (-10.0, 0.0, 0.0), (0.0, -10.0, 0.0),
           (0.0, 0.0, 10.0), (0.0, 0.0, -10.0))  # fmt: skip
NOISE_OF_RANGES = quad_gym.UwbRangeParams().noise_sigma
RANGES, GROUP = AID_BLOCK[Aid.UWB_RANGE], AID_GROUPS + Aid.UWB_RANGE
FEATURE_GROUP = AID_GROUPS - 1
ACCEPTED, REJECTED, WEAKENED = (
    int(GateDecision[name]) for name in ("ACCEPTED", "REJECTED", "WEAKENED")
)


def located(nis, sigma=0.1, axis=0, **fields):
    """Update with positions off along an axis, by a normalized innovation squared each."""
    rules = LaneRules(SUITE, (sigma, 0.1, 0.05, 0.02, 0.002))
    rules.set(**fields)
    S = sigma**2 + GNSS.position_sigma_I[axis] ** 2
    off = np.zeros((EIGHT, 3))
    off[:, axis] = np.sqrt(S * np.broadcast_to(nis, EIGHT))
    rules.measured(POSITION_BLOCK, off @ R_IG)
    rules.run(Stage.UPDATE)
    return rules, off[:, axis]


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_position_beyond_the_gate_is_weakened_so_that_its_innovation_is_at_the_gate(axis):
    """A gain of P / (S NIS / gate). Its NIS remains, with the noise of the suite."""
    share = np.array([0.5, 0.99, 1.01, 1.2, 2.0, 3.0, 3.9, 3.99])
    rules, off = located(GATE * share, axis=axis)
    S = 0.1**2 + GNSS.position_sigma_I[axis] ** 2
    used = S * np.maximum(share, 1.0)
    np.testing.assert_allclose(rules.get("r_hat")[:, axis], 0.1**2 / used * off, rtol=1e-9)
    variance = 0.1**2 - 0.1**4 / used
    np.testing.assert_allclose(rules.covariance()[:, axis, axis], variance, rtol=1e-9)
    np.testing.assert_allclose(rules.get("nis"), GATE * share, rtol=1e-9)
    np.testing.assert_allclose(rules.get("block_nis")[:, POSITION_BLOCK], GATE * share, rtol=1e-9)
    decision = np.where(share < 1.0, ACCEPTED, WEAKENED)
    np.testing.assert_array_equal(rules.get("gate")[:, POSITION_BLOCK], decision)
    np.testing.assert_array_equal(rules.get("rejected_in_row")[:, POSITION_BLOCK], share > 1.0)
    np.testing.assert_array_equal(rules.get("rejections")[:, POSITION_BLOCK], 0.0)
    np.testing.assert_allclose(
        rules.get("innovation_sigma")[:, POSITION_BLOCK, axis], math.sqrt(S), rtol=1e-9
    )


def test_noise_that_is_adapted_weakens_a_position_and_raises_its_gate():
    """By a factor on its noise. The NIS that users read has the noise of the suite."""
    factor, noise = 9.0, GNSS.position_sigma_I[0] ** 2
    share = np.array([0.5, 0.99, 1.01, 1.2, 2.0, 3.0, 3.5, 3.9])
    more = (0.1**2 + factor * noise) / (0.1**2 + noise)
    rules, off = located(GATE * share * more, noise_factor=factor)
    used = (0.1**2 + factor * noise) * np.maximum(share, 1.0)
    np.testing.assert_allclose(rules.get("r_hat")[:, 0], 0.1**2 / used * off, rtol=1e-9)
    decision = np.where(share < 1.0, ACCEPTED, WEAKENED)
    np.testing.assert_array_equal(rules.get("gate")[:, POSITION_BLOCK], decision)
    np.testing.assert_allclose(rules.get("nis"), GATE * share * more, rtol=1e-9)
    np.testing.assert_allclose(rules.get("block_nis")[:, 0], GATE * share * more, rtol=1e-9)


@pytest.mark.parametrize("ratio", [0.5, 2.0])
def test_first_position_far_beyond_the_gate_is_a_step_of_the_sensor(ratio):
    """Four times the gate, times the mean NIS if this is above one, soon after an accepted one."""
    share = 4.0 * max(ratio, 1.0) * np.resize([0.99, 1.01], EIGHT)
    ago = np.repeat([0.99, 0.99, 1.01, 1.01], 2)
    row = np.repeat([0.0, 1.0, 0.0, 1.0], 2)
    rules = LaneRules(SUITE)
    accepted = np.tile(NEVER, (EIGHT, len(rules.get("accepted_tick")[0])))
    accepted[:, POSITION_BLOCK] = NOW - ago * SECOND
    rows = np.zeros(accepted.shape)
    rows[:, POSITION_BLOCK] = row
    rules, _ = located(
        GATE * share, accepted_tick=accepted, rejected_in_row=rows, nis_ratio=ratio,
        refused_tick=7.0,
    )  # fmt: skip
    step = (share > 4.0 * max(ratio, 1.0)) & (ago < 1.0) & (row == 0.0)
    decision = np.where(step, REJECTED, WEAKENED)
    np.testing.assert_array_equal(rules.get("gate")[:, POSITION_BLOCK], decision)
    np.testing.assert_array_equal(rules.get("stepped")[:, POSITION_BLOCK], step)
    np.testing.assert_array_equal(rules.get("rejections")[:, POSITION_BLOCK], step)
    np.testing.assert_array_equal(rules.get("rejected_in_row")[:, POSITION_BLOCK], row + 1.0)
    since = np.where(row == 0.0, NOW, 7.0)
    np.testing.assert_array_equal(rules.get("refused_tick")[:, POSITION_BLOCK], since)
    np.testing.assert_array_equal(
        rules.get("accepted_tick")[:, POSITION_BLOCK], accepted[:, POSITION_BLOCK]
    )
    assert (rules.get("r_hat")[step] == 0.0).all()
    assert (rules.get("r_hat")[~step, 0] > 0.0).all()


def test_positions_after_a_step_are_rejected_until_one_is_within_the_gate():
    share = np.resize([0.99, 1.01], EIGHT)
    rows, stepped = (np.zeros((EIGHT, len(READINGS))) for _ in range(2))
    rows[:, POSITION_BLOCK], stepped[:, POSITION_BLOCK] = 3.0, np.repeat([0.0, 1.0], 4)
    rules, _ = located(GATE * share, rejected_in_row=rows, stepped=stepped)
    beyond = share > 1.0
    decision = np.where(beyond, np.where(stepped[:, 0] > 0.0, REJECTED, WEAKENED), ACCEPTED)
    np.testing.assert_array_equal(rules.get("gate")[:, 0], decision)
    np.testing.assert_array_equal(rules.get("rejected_in_row")[:, 0], np.where(beyond, 4.0, 0.0))
    accepted = np.where(beyond, NEVER, NOW)
    np.testing.assert_array_equal(rules.get("accepted_tick")[:, 0], accepted)


@pytest.mark.parametrize("position_nis", [np.nan, 6.0])
def test_receiver_with_wrong_velocities_is_used_again_with_its_position(position_nis):
    """No position counts until then. The sum of both NIS is below the gate of a velocity then."""
    noise = GNSS.velocity_sigma
    rest = GATE - (0.0 if math.isnan(position_nis) else position_nis)
    nis = rest * np.resize([0.98, 1.02], EIGHT)
    rules = LaneRules(SUITE, (0.1, 1e-6, 1e-6, 1e-6, 1e-6))
    rows, stepped = (np.zeros((EIGHT, len(READINGS))) for _ in range(2))
    stepped[:, VELOCITY_BLOCK] = np.repeat([1.0, 1.0, 0.0, 0.0], 2)
    rows[:, VELOCITY_BLOCK] = np.repeat([2.0, 2.0, 2.0, 0.0], 2)
    wrong = (stepped > 0.0).any(axis=1) & (rows > 0.0).any(axis=1)
    rules.set(rejected_in_row=rows, stepped=stepped)
    off = np.zeros((EIGHT, 3))
    off[:, 0] = (
        0.0
        if math.isnan(position_nis)
        else math.sqrt(position_nis * (0.1**2 + GNSS.position_sigma_I[0] ** 2))
    )
    if not math.isnan(position_nis):
        rules.measured(POSITION_BLOCK, off @ R_IG)
    off[:, 0] = noise * np.sqrt(nis)
    rules.measured(VELOCITY_BLOCK, off @ R_IG)
    rules.run(Stage.UPDATE)
    beyond = nis > np.where(wrong, rest, GATE)
    gate = rules.get("gate")
    decision = np.where(beyond, np.where(wrong, REJECTED, WEAKENED), ACCEPTED)
    np.testing.assert_array_equal(gate[:, VELOCITY_BLOCK], decision)
    np.testing.assert_array_equal(
        rules.get("rejected_in_row")[:, VELOCITY_BLOCK],
        np.where(beyond, rows[:, VELOCITY_BLOCK] + 1.0, 0.0),
    )
    if not math.isnan(position_nis):
        np.testing.assert_array_equal(gate[:, POSITION_BLOCK], np.where(wrong, REJECTED, ACCEPTED))


# --------------------------------------------------------------------------------------------------
# Several measurements of a group: ranges, each with one number.
# --------------------------------------------------------------------------------------------------


def ranged(nis, anchors=6, before=None, sensors=None, **fields):
    """Update certain estimates with ranges to some anchors, (anchors,) NIS, or one for each."""
    suite = SUITE.replace(uwb_range=quad_gym.UwbRangeParams(anchors_I=ANCHORS[:anchors]))
    rules = LaneRules(suite if sensors is None else sensors(suite), np.full(5, 1e-7))
    rules.set(**fields)
    sigma, nis = suite.uwb_range.noise_sigma, np.broadcast_to(nis, (EIGHT, anchors))
    for i in range(anchors):
        value = np.zeros((EIGHT, 3))
        value[:, 0] = 10.0 + sigma * np.sqrt(nis[:, i])
        rules.measured(RANGES + i, value)
        if before is not None:
            rules.change("gate", RANGES + i, before[i])
    rules.run(Stage.UPDATE)
    return rules


def test_ranges_beyond_the_gate_are_rejected_while_most_agree():
    """And are weakened after most were refused; half of them are most."""
    far = 2.0 * GATE_OF_RANGES
    nis = np.array([[far] * n + [1.0] * (6 - n) for n in (0, 1, 2, 3, 4, 5, 6, 2)])
    for row in (0.0, 1.0):
        rows = np.zeros((EIGHT, len(READINGS)))
        rows[:, GROUP] = row
        rules = ranged(nis, rejected_in_row=rows)
        beyond = nis > GATE_OF_RANGES
        expected = np.where(beyond, WEAKENED if row else REJECTED, ACCEPTED)
        np.testing.assert_array_equal(rules.get("gate")[:, RANGES : RANGES + 6], expected)
        refused = beyond.sum(axis=1) >= 3
        found = rules.get("rejected_in_row")[:, GROUP]
        np.testing.assert_array_equal(found, np.where(refused, row + 1.0, 0.0))
        accepted = rules.get("accepted_tick")[:, GROUP]
        np.testing.assert_array_equal(accepted, np.where(refused, NEVER, NOW))
        np.testing.assert_array_equal(rules.get("stepped")[:, GROUP], 0.0)
        found = rules.get("innovation")[:, RANGES : RANGES + 6]
        np.testing.assert_allclose(found[:, :, 0], np.sqrt(nis) * NOISE_OF_RANGES, rtol=1e-6)
        found = np.stack([found, rules.get("innovation_sigma")[:, RANGES : RANGES + 6]])
        np.testing.assert_array_equal(np.isnan(found), np.broadcast_to([0, 1, 1], found.shape))


def ratio_of(nis_per_freedom):
    """The running mean of NIS over its degrees of freedom, from one on, with a share of 0.05."""
    return 1.0 + 0.05 * (np.minimum(nis_per_freedom, 10.0) - 1.0)


@pytest.mark.parametrize("anchors", [4, 5])
@pytest.mark.parametrize("before", [REJECTED, ACCEPTED])
def test_range_that_is_rejected_again_counts_if_three_others_agree(anchors, before):
    """Three determine the position, so that they agree with any; four do not.

    Otherwise the mean NIS of the accepted ones counts, or of all if most are refused.
    """
    far = np.array([2.0, 3.0, 4.0, 2.0, 2.5, 3.0, 3.5, 4.0])[:, np.newaxis] * GATE_OF_RANGES
    nis = np.hstack([far, np.tile([0.5, 0.7, 0.9, 1.1], (EIGHT, 1))[:, : anchors - 1]])
    nis[3, 1:] = 3.0 * GATE_OF_RANGES  # most are refused
    rules = ranged(nis, anchors, before=[before, *[ACCEPTED] * (anchors - 1)])
    kept = np.where(nis > GATE_OF_RANGES, 0.0, nis).sum(axis=1) / (anchors - 1)
    expected = nis.mean(axis=1) if anchors == 4 and before == REJECTED else kept
    expected[3] = nis[3].mean()
    np.testing.assert_allclose(rules.get("nis_ratio"), ratio_of(expected), rtol=1e-6)


def test_range_that_is_rejected_again_does_not_count_if_gnss_confirms_the_position():
    nis = np.array([3.0 * GATE_OF_RANGES, 0.5, 0.7, 0.9])
    accepted = np.tile(NEVER, (EIGHT, len(READINGS)))
    accepted[:, [POSITION_BLOCK, VELOCITY_BLOCK]] = NOW - 0.5 * SECOND
    accepted[4:, POSITION_BLOCK] = NOW - 1.5 * SECOND
    rules = ranged(nis, 4, before=[REJECTED, 1, 1, 1], accepted_tick=accepted)
    expected = np.repeat([nis[1:].mean(), nis.mean()], 4)
    np.testing.assert_allclose(rules.get("nis_ratio"), ratio_of(expected), rtol=1e-6)


# --------------------------------------------------------------------------------------------------
# Adapted noise, and the mean NIS.
# --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("factor", [1.0, 4.0, 24.9])
def test_noise_follows_the_scatter_of_successive_innovations(factor):
    """Half the NIS of a difference, up to the gate, over the degrees of freedom, minus 1.3.

    Changes are 5 % of this; the factor is between 1 and 25. Differences beyond four gates, and
    measurements that follow three rejected ones, do not count.
    """
    scatter = GATE * np.array([0.0, 0.1, 0.5, 0.9, 1.5, 3.9, 4.1, 0.5])
    rows = np.zeros((EIGHT, len(READINGS)))
    rows[:, POSITION_BLOCK] = [0, 0, 2, 2, 2, 2, 2, 3]
    rules = LaneRules(SUITE, np.full(5, 1e-7))
    last, now = np.zeros((EIGHT, 3)), np.zeros((EIGHT, 3))
    size = math.sqrt(2.0 * factor) * np.array(GNSS.position_sigma_I)[0] * np.sqrt(scatter)
    last[:, 0], now[:, 0] = -0.5 * size, 0.5 * size
    rules.set(noise_factor=factor, rejected_in_row=rows)
    rules.change("innovation", POSITION_BLOCK, last)
    rules.measured(POSITION_BLOCK, now @ R_IG)
    rules.run(Stage.UPDATE)
    growth = 1.0 + 0.05 * (np.minimum(scatter, GATE) / 3.0 - 1.3)
    expected = np.clip(factor * growth, 1.0, 25.0)
    expected[6:] = factor
    np.testing.assert_allclose(rules.get("noise_factor")[:, POSITION_BLOCK], expected, rtol=1e-6)
    np.testing.assert_array_equal(rules.get("noise_factor")[:, BASELINE_BLOCK], factor)


def test_noise_of_ranges_follows_their_mean_scatter():
    rng = np.random.default_rng(0)
    nis = rng.uniform(0.0, 0.9, (EIGHT, 6)) * GATE_OF_RANGES
    rules = ranged(nis, innovation=0.0)
    growth = 1.0 + 0.05 * (0.5 * nis.mean(axis=1) - 1.3)
    expected = np.maximum(growth, 1.0)
    np.testing.assert_allclose(rules.get("noise_factor")[:, GROUP], expected, rtol=1e-6)
    assert (expected > 1.0).any()


def test_mean_nis_flags_a_filter_as_diverged_beyond_2_1_and_until_1_5():
    """A new NIS per degree of freedom counts 5 %, and at most 10."""
    ratio = np.array([1.0, 2.09, 2.2, 1.4, 1.49, 1.51, 2.0, 2.0])
    diverged = np.array([0, 0, 0, 1, 1, 1, 0, 0.0])
    alarm = np.array([NEVER] * 6 + [NOW - 0.99 * SECOND, NOW - 1.01 * SECOND])
    per_freedom = np.array([0.0, 2.0, 2.0, 1.4, 1.4, 1.6, 2.0, 2.0])
    rules = LaneRules(SUITE, np.full(5, 1e-7))
    off = np.zeros((EIGHT, 3))
    off[:, 0] = GNSS.position_sigma_I[0] * np.sqrt(3.0 * per_freedom)
    rules.set(nis_ratio=ratio, diverged=diverged, alarm_tick=alarm)
    rules.measured(POSITION_BLOCK, off @ R_IG)
    rules.run(Stage.UPDATE)
    mean = ratio + 0.05 * (per_freedom - ratio)
    np.testing.assert_allclose(rules.get("nis_ratio"), mean, rtol=1e-6)
    np.testing.assert_array_equal(rules.get("diverged"), [0, 0, 1, 0, 0, 1, 1, 0])


def test_largest_nis_counts_as_ten_times_its_freedoms():
    rules, _ = located(GATE * np.array([0.2, 0.9, 1.2, 1.4, 1.5, 2.0, 3.0, 3.9]))
    expected = GATE * np.array([0.2, 0.9, 1.2, 1.4, 1.5, 2.0, 3.0, 3.9]) / 3.0
    np.testing.assert_allclose(rules.get("nis_ratio"), ratio_of(expected), rtol=1e-6)


# --------------------------------------------------------------------------------------------------
# Support by a camera, and features whose prediction is too uncertain.
# --------------------------------------------------------------------------------------------------

CAMERA = quad_gym.CameraParams(
    position_B=(0.0, 0.0, 0.0), attitude=(math.pi / 2.0, 0.0, math.pi / 2.0),
    features_I=((4.0, 0.0, 0.0), (4.0, 1.0, 0.5)),
)  # fmt: skip


def looking(sigma, **estimator):
    """Flights whose attitude has a standard deviation, with features in view."""
    suite = SUITE.replace(camera=CAMERA, estimator=SUITE.estimator.replace(**estimator))
    rules = LaneRules(suite, (1e-6, 1e-6, 1e-6, 1e-6, 1e-6))
    P = rules.covariance()
    P[:, [6, 7, 8], [6, 7, 8]] = np.square(np.broadcast_to(sigma, EIGHT))[:, np.newaxis]
    rules.set_covariance(P)
    return rules


def test_position_that_a_camera_refutes_is_rejected_and_is_no_evidence_of_divergence():
    """The features were accepted within the last second."""
    rules = looking(1e-6)
    off = np.zeros((EIGHT, 3))
    off[:, 0] = GNSS.position_sigma_I[0] * math.sqrt(2.0 * GATE)
    rules.measured(POSITION_BLOCK, off @ R_IG)
    ago = np.repeat([0.99, 1.01], 4)
    rules.change("accepted_tick", FEATURE_GROUP, NOW - ago * SECOND)
    rules.run(Stage.UPDATE)
    refuted = ago < 1.0
    decision = np.where(refuted, REJECTED, WEAKENED)
    np.testing.assert_array_equal(rules.get("gate")[:, POSITION_BLOCK], decision)
    ratio = np.where(refuted, 1.0, ratio_of(2.0 * GATE / 3.0))
    np.testing.assert_allclose(rules.get("nis_ratio"), ratio, rtol=1e-6)
    np.testing.assert_array_equal(rules.get("r_hat")[:, 0] == 0.0, refuted)


def test_feature_whose_direction_is_too_uncertain_is_left_out_and_counts_as_nothing():
    """The sum of its two predicted variances is beyond the square of a limit."""
    rules = looking(np.linspace(0.05, 0.7, EIGHT), max_direction_sigma=0.5)
    for i, feature in enumerate(np.array(CAMERA.features_I)):
        x, y, z = euler_to_dcm(CAMERA.attitude) @ feature
        pixel = CAMERA.focal_length / z * np.array([x, y, 0.0])
        assert z > 0.0
        rules.measured(FEATURE_BLOCKS + i, pixel)
    before = rules.covariance()
    rules.run(Stage.UPDATE)
    for i in range(2):
        sigma = rules.get("innovation_sigma")[:, FEATURE_BLOCKS + i, :2]
        unsure = (sigma**2).sum(axis=1) > 0.5**2
        assert 2 <= unsure.sum() <= 6
        expected = np.where(unsure, int(GateDecision.UNSURE), ACCEPTED)
        np.testing.assert_array_equal(rules.get("gate")[:, FEATURE_BLOCKS + i], expected)
        np.testing.assert_array_equal(rules.get("rejections")[:, FEATURE_BLOCKS + i], 0.0)
    np.testing.assert_array_equal(rules.covariance()[unsure], before[unsure])
    assert (rules.covariance()[~unsure, 7, 7] < before[~unsure, 7, 7]).all()
    accepted = rules.get("accepted_tick")[:, FEATURE_GROUP]
    np.testing.assert_array_equal(accepted, np.where(unsure, NEVER, NOW))
    np.testing.assert_array_equal(rules.get("nis_ratio") == 1.0, unsure)


def seen_turned(rules, turns, count):
    """Measure the first features, at pixels turned about an axis of the picture, (EIGHT,) [rad].

    They have been rejected before, so that they are weakened. Returns the pixels of the first one.
    """
    for i, feature in reversed(list(enumerate(np.array(CAMERA.features_I)[:count]))):
        along = euler_to_dcm(CAMERA.attitude) @ feature
        along /= np.linalg.norm(along)
        side = np.cross(along, (0.0, 1.0, 0.0))
        seen = np.outer(np.cos(turns), along) + np.outer(np.sin(turns), side / np.linalg.norm(side))
        pixels = CAMERA.focal_length * seen / seen[:, 2:]
        rules.measured(FEATURE_BLOCKS + i, pixels * (1.0, 1.0, 0.0))
    rules.change("rejected_in_row", FEATURE_GROUP, 2.0)
    rules.run(Stage.UPDATE)
    return pixels[:, :2]


@pytest.mark.parametrize("sigma", [0.001, 0.005, 0.02])
@pytest.mark.parametrize("count", [1, 2])
def test_nis_of_features_far_off_is_not_below_the_mean_of_its_parts(sigma, count):
    """The joint NIS of Gaussian numbers is not below that of some of them, nor below their mean.

    Of the first feature, on the camera's axis, it is the square of the sine over the variance of
    the attitude and of a pixel.
    """
    rules, turns = looking(sigma), np.linspace(0.1, 0.8, EIGHT)
    pixels = seen_turned(rules, turns, count)
    blocks = slice(FEATURE_BLOCKS, FEATURE_BLOCKS + count)
    assert (rules.get("gate")[1:, blocks] == WEAKENED).all()
    S = sigma**2 + CAMERA.pixel_sigma**2 / ((pixels**2).sum(axis=1) + CAMERA.focal_length**2)
    nis, single = rules.get("nis"), rules.get("block_nis")[:, blocks]
    np.testing.assert_allclose(single[:, 0], np.sin(turns) ** 2 / S, rtol=0.01)
    assert (nis > 0.9 * single.sum(axis=1) / (2.0 * count)).all()
    assert (nis < 1.01 * single.sum(axis=1)).all()
    if count == 1:
        np.testing.assert_allclose(nis, single[:, 0], rtol=0.01)


# --------------------------------------------------------------------------------------------------
# A new episode.
# --------------------------------------------------------------------------------------------------


def test_start_forgets_all_that_gate_and_rules_of_the_heading_have_seen():
    rules = LaneRules(SUITE)
    zero = [
        "accepted_tick", "refused_tick", "stepped", "diverged", "rejections", "rejected_in_row",
        "resets", "gate", "corrected", "corrected_variance", "level_phase", "level_force",
        "level_sum", "level_last", "level_misses", "level_fresh", "level_against", "level_doubts",
        "level_lean", "compass_out", "compass_agrees", "heading_lost", "level_apart",
        "level_sigma", "level_first", "level_loose", "compass_leapt", "prediction_failures",
        "update_failures", "nis", "nis_dimension", "v_corrected", "arc",
    ]  # fmt: skip
    expected = {
        **dict.fromkeys(zero, 0.0),
        **dict.fromkeys(("block_nis", "innovation", "innovation_sigma"), np.nan),
        **dict.fromkeys(("noise_factor", "nis_ratio"), 1.0),
        **dict.fromkeys(("alarm_tick", "level_tick"), NEVER),
        "corrected_tick": NOW,
        "filter_status": 0,
    }
    rules.set(**dict.fromkeys(set(expected) - {"filter_status"}, 7.0))
    rules.blocks["filter_status"] = 3
    rules.set(r_hat=0.0, tick=NOW)
    rules.measured(POSITION_BLOCK, np.zeros(3))
    first = np.arange(EIGHT) < 4
    rules.initialize(first)
    for name, value in expected.items():
        found = rules.get(name)
        np.testing.assert_array_equal(found[first], np.full_like(found[first], value), name)
        kept = 3 if name == "filter_status" else 7.0
        assert (found[~first] == kept).all(), name

"""The rules of `quad_gym.kernels.filter.recovery` at their limits: support, times, and resets.

Flights are given their rejections; innovations have simple sizes.
"""

import math

import numpy as np
import pytest

import quad_gym
from quad_gym.kernels.stages import Stage
from quad_gym.params.sensor_table import AID_PARAMS, READINGS
from quad_gym.params.world import GROUND_HEIGHT
from quad_gym.records import (
    AID_GROUPS,
    GROUP_BLOCK,
    POSITION_BLOCK,
    VELOCITY_BLOCK,
    Aid,
)
from quad_gym.rotations import euler_to_dcm
from tests.lane_filter import EIGHT
from tests.lane_rules import NEVER, LaneRules
from tests.level_flights import GRAVITY, MAGNETIC

RTK = quad_gym.sensor_suite("rtk").simplified()
ALL = RTK.replace(
    camera=RTK.camera.replace(features_I=RTK.camera.features_I[:2]),  # an instant has room for 20
    **{name: kind() for name, kind in AID_PARAMS.items()},
)
DRIFTING = MAGNETIC.replace(
    gnss=MAGNETIC.gnss.replace(
        secondary_antenna_B=None, drift_sigma_I=(0.5, 0.6, 0.7), drift_tau=50.0
    )
)
GROUPS = list(READINGS)
PIXELS, COMPASS = GROUPS.index("pixels"), AID_GROUPS + int(Aid["MAGNETOMETER"])
BAROMETER = AID_GROUPS + int(Aid["BAROMETER"])
NOW, SECOND = LaneRules.tick, ALL.imu.rate
LONG_AGO = NOW - 1000.0 * SECOND
WAIT, GLITCH = ALL.estimator.reset_timeout, ALL.estimator.glitch_timeout
MOST = ALL.estimator.max_rejections
SEVERAL = {name for name, reading in READINGS.items() if reading.most_blocks > 1}


def groups_of(values, default=0.0):
    """Values of some groups by name, in all flights, or one for each."""
    array = np.full((EIGHT, len(GROUPS)), float(default))
    for name, value in values.items():
        array[:, GROUPS.index(name)] = value
    return array


def refused(rules, *names, row=20.0, waited=None, stepped=1.0, ago=30.0, nu=(0.0, 0.0, 0.0)):
    """Let flights have refused some groups for a time [s], last accepted some time `ago`."""
    waited = 2.0 * GLITCH if waited is None else waited
    rules.set(
        rejected_in_row=groups_of(dict.fromkeys(names, row)),
        refused_tick=groups_of(dict.fromkeys(names, NOW - np.multiply(waited, SECOND)), NEVER),
        stepped=groups_of(dict.fromkeys(names, stepped)),
        accepted_tick=groups_of(dict.fromkeys(names, NOW - ago * SECOND), LONG_AGO),
    )
    for name in names:
        block = GROUP_BLOCK[GROUPS.index(name)]
        rules.change("innovation", block, nu)
        rules.change("block_valid", block, 1.0)
    return rules


def reset_counts(rules, name):
    return rules.get("resets")[:, GROUPS.index(name)]


@pytest.mark.parametrize("name", GROUPS)
def test_group_is_alone_unless_others_observe_all_that_it_measures(name):
    """Within the last second; several blocks support themselves. An alarm shows it, without reset.

    The motion of the last second shows the heading, too.
    """
    rng = np.random.default_rng(GROUPS.index(name))
    for _ in range(6):
        rules = refused(LaneRules(ALL), name, row=2.0)
        recent = rng.random((EIGHT, len(GROUPS))) < 0.4
        recent[:, GROUPS.index(name)] = rng.random(EIGHT) < 0.5
        motion = rng.random(EIGHT) < 0.5
        ages = np.where(recent, 0.99, 1.01)
        rules.set(
            accepted_tick=NOW - ages * SECOND,
            level_tick=NOW - np.where(motion, 0.99, 1.01) * SECOND,
        )
        expected = []
        for flight, by_motion in zip(recent, motion, strict=True):
            seen = {"heading"} if by_motion else set()
            for other, accepted in zip(GROUPS, flight, strict=True):
                seen |= set(READINGS[other].observes) if accepted and other != name else set()
            supported = set(READINGS[name].observes) <= seen and name not in SEVERAL
            expected.append(NEVER if supported else NOW)
        rules.run(Stage.RECOVER)
        np.testing.assert_array_equal(rules.get("alarm_tick"), expected)
        np.testing.assert_array_equal(rules.get("resets"), 0.0)


@pytest.mark.parametrize("estimated", [False, True])
def test_position_whose_drift_is_estimated_confirms_a_velocity_alone(estimated):
    suite = DRIFTING if estimated else ALL
    for name, confirmed in {"gnss_velocity": True, "barometer": not estimated}.items():
        rules = refused(LaneRules(suite), name, row=2.0)
        rules.change("accepted_tick", POSITION_BLOCK, NOW)
        rules.run(Stage.RECOVER)
        np.testing.assert_array_equal(rules.get("alarm_tick"), NEVER if confirmed else NOW)


def test_group_that_the_suite_lacks_confirms_nothing():
    suite = ALL.replace(camera=None, uwb_range=None)
    rules = refused(LaneRules(suite), "gnss_position", row=2.0)
    rules.set(accepted_tick=groups_of({"pixels": NOW, "uwb_range": NOW}, LONG_AGO))
    rules.run(Stage.RECOVER)
    np.testing.assert_array_equal(rules.get("alarm_tick"), NOW)


CASES = [
    # rejections, times since the first one, step, alarm, reset
    (2.0, 0.99, 0.0, False, False),
    (2.0, 1.01, 0.0, True, False),
    (1.0, 1.01, 0.0, False, False),
    (MOST - 1.0, 1.01, 0.0, True, False),
    (MOST, 1.01, 0.0, True, True),
    (MOST, 0.99, 0.0, False, False),
    (MOST, 0.99 * GLITCH / WAIT, 1.0, True, False),
    (MOST, 1.01 * GLITCH / WAIT, 1.0, True, True),
]


def test_filter_is_reset_to_a_refused_sensor_after_a_time_and_a_number_of_rejections():
    """And is flagged before; after a step of the sensor it waits longer."""
    row, waited, stepped, alarm, reset = map(np.array, zip(*CASES, strict=True))
    rules = LaneRules(ALL)
    refused(rules, "gnss_velocity", row=row, waited=waited * WAIT, stepped=stepped, nu=(1, 2, 3))
    rules.run(Stage.RECOVER)
    np.testing.assert_array_equal(reset_counts(rules, "gnss_velocity"), reset)
    np.testing.assert_array_equal(rules.get("alarm_tick"), np.where(alarm, NOW, NEVER))
    row = np.where(reset, 0.0, row)
    np.testing.assert_array_equal(rules.get("rejected_in_row")[:, VELOCITY_BLOCK], row)


def test_lanes_without_a_measurement_are_not_reset():
    rules = refused(LaneRules(ALL), "gnss_velocity", nu=(1.0, 2.0, 3.0))
    taken = np.arange(EIGHT) % 2 == 0
    rules.run(Stage.RECOVER, lanes=taken)
    np.testing.assert_array_equal(reset_counts(rules, "gnss_velocity"), taken)
    np.testing.assert_allclose(rules.covariance()[:, 3, 3], np.where(taken, 1.0, 0.01))


@pytest.mark.parametrize("second_row", [1.0, 2.0])
def test_two_sensors_that_are_refused_at_the_same_time_do_not_wait_for_the_end_of_a_step(
    second_row,
):
    """The estimate is wrong then, and is reset to both."""
    rules = refused(LaneRules(ALL), "gnss_velocity", "optical_flow", waited=1.01 * WAIT)
    rows = rules.get("rejected_in_row")
    rows[:, GROUPS.index("optical_flow")] = second_row
    rules.set(rejected_in_row=rows)
    rules.run(Stage.RECOVER)
    expected = float(second_row >= 2.0)
    for name in ("gnss_velocity", "optical_flow"):
        np.testing.assert_array_equal(reset_counts(rules, name), expected)


def test_supported_sensor_is_never_reset_to_except_for_its_own_error():
    rules = refused(LaneRules(ALL), "gnss_velocity", "barometer", nu=(1.0, 2.0, 3.0))
    rules.change("accepted_tick", PIXELS, NOW)
    before = rules.covariance()
    rules.run(Stage.RECOVER)
    np.testing.assert_array_equal(reset_counts(rules, "gnss_velocity"), 0.0)
    np.testing.assert_array_equal(reset_counts(rules, "barometer"), 1.0)
    after = rules.covariance()
    np.testing.assert_array_equal(after[:, :15, :15], before[:, :15, :15])


@pytest.mark.parametrize("known", [True, False])
def test_refused_compass_is_left_out_if_the_motion_confirms_the_heading(known):
    """Otherwise the filter is reset to it, and the heading by motion is less certain."""
    suite = DRIFTING
    rules = refused(LaneRules(suite), "magnetometer", stepped=0.0, nu=(1e-5, 0.0, 0.0))
    rules.set(level_tick=NOW - (0.99 if known else 1.01) * SECOND, compass_agrees=1.0,
              level_loose=0.5)  # fmt: skip
    rules.change("level_P", 1, [0.1, 0.7] * 4)
    rules.run(Stage.RECOVER)
    np.testing.assert_array_equal(rules.get("compass_out"), float(known))
    np.testing.assert_array_equal(rules.get("compass_agrees"), float(not known))
    np.testing.assert_array_equal(reset_counts(rules, "magnetometer"), float(not known))
    loose = [0.1, 0.7] if known else [0.5, 0.7]
    np.testing.assert_array_equal(rules.get("level_P")[:, 1], loose * 4)


@pytest.mark.parametrize(
    "changes",
    [{"level_doubts": 1.0}, {"level_against": 1.0}, {"compass_out": 1.0}, {}],
    ids=["doubts", "against", "out", "none"],
)
def test_contradicted_heading_keeps_the_variance_by_motion(changes):
    rules = refused(LaneRules(DRIFTING), "magnetometer", stepped=0.0, nu=(1e-5, 0.0, 0.0))
    rules.set(level_loose=0.5, **changes)
    rules.change("level_P", 1, 0.1)
    rules.run(Stage.RECOVER)
    np.testing.assert_array_equal(rules.get("level_P")[:, 1], 0.1 if changes else 0.5)
    reset = "level_against" not in changes and "compass_out" not in changes
    np.testing.assert_array_equal(reset_counts(rules, "magnetometer"), float(reset))


# --------------------------------------------------------------------------------------------------
# Variances after a reset.
# --------------------------------------------------------------------------------------------------

H = 3.0  #: height of flights [m]


def variances(rules, lane=0):
    return np.diag(rules.covariance()[lane]).copy()


@pytest.mark.parametrize(
    ("name", "nu", "rows", "expected"),
    [
        ("gnss_position", (3.0, -4.0, 12.0), (0, 1, 2), 169.0),
        ("gnss_velocity", (3.0, -4.0, 12.0), (3, 4, 5), (9.0, 16.0, 144.0)),
        ("gnss_baseline", (0.3, -0.4, 0.0), (8,), 0.25),
        ("optical_flow", (0.6, -0.8, 0.0), (3, 4, 5), (H - GROUND_HEIGHT) ** 2),
        ("range_finder", (-2.0, 0.0, 0.0), (2,), 4.0),
        ("uwb_range", (-2.0, 0.0, 0.0), (0, 1, 2), 4.0),
    ],
)
def test_reset_to_a_sensor_sets_the_variances_of_the_measured_states(name, nu, rows, expected):
    """To the square of the innovation, and leaves others. A flow is an angular rate."""
    rules = refused(LaneRules(ALL), name, nu=nu)
    rules.set(r_hat=[0.0, 0.0, H])
    before = variances(rules)
    rules.run(Stage.RECOVER)
    before[list(rows)] = expected
    np.testing.assert_allclose(variances(rules), before, rtol=1e-9)


def test_reset_to_a_barometer_and_a_compass_alone_adds_their_own_errors():
    for name, row, nu in (("barometer", 2, (5.0, 0.0, 0.0)), ("magnetometer", 8, (6e-6, 8e-6, 0))):
        rules = refused(LaneRules(ALL), name, nu=nu)
        rules.run(Stage.RECOVER)
        if name == "barometer":
            expected = 25.0 + ALL.barometer.bias_sigma**2
        else:
            compass = ALL.magnetometer
            level = np.hypot(*compass.field_I[:2])
            expected = (1e-10 + compass.hard_iron_sigma**2) / level**2
        np.testing.assert_allclose(rules.covariance()[:, row, row], expected, rtol=1e-9)


@pytest.mark.parametrize("size", [1e-7, 3e-5])
@pytest.mark.parametrize("confirmed", [True, False])
def test_reset_to_a_compass_explains_its_fields_by_hard_iron_where_others_show_the_heading(
    confirmed, size
):
    """The iron is as large as the innovation, or as usual.

    Alone, it is as large as the part of the innovation that no heading explains.
    """
    rules = LaneRules(ALL)
    iron = 15 + int(rules.settings["aid_vector"][0, Aid.MAGNETOMETER])
    for row in range(iron, iron + 3):
        rules.set_sigma(row, 1e-9)
    nu = np.array([0.0, 0.6 * size, -0.8 * size])
    refused(rules, "magnetometer", nu=nu)
    if confirmed:
        rules.change("accepted_tick", PIXELS, NOW)
    rules.run(Stage.RECOVER)
    np.testing.assert_array_equal(reset_counts(rules, "magnetometer"), 1.0)
    own, field = ALL.magnetometer.hard_iron_sigma, np.array(ALL.magnetometer.field_I)
    other = math.hypot(math.hypot(*(field + nu)[:2]) - math.hypot(*field[:2]), nu[2])
    found = np.sqrt(variances(rules))
    np.testing.assert_allclose(found[iron : iron + 3], max(own, size if confirmed else other))
    heading = math.hypot(size, own) / math.hypot(*ALL.magnetometer.field_I[:2])
    assert found[8] == pytest.approx(0.05 if confirmed else max(heading, 0.05))


def test_reset_to_a_position_whose_drift_is_estimated_adds_the_drift():
    """The drift gets its variance in the long run, which is part of the position's, too."""
    nu = np.array([0.3, -0.4, 1.2])
    rules = refused(LaneRules(DRIFTING), "gnss_position", nu=nu)
    for row in range(15, 15 + rules.slow):
        rules.set_sigma(row, 1e-3)
    before = variances(rules)
    rules.run(Stage.RECOVER)
    np.testing.assert_array_equal(reset_counts(rules, "gnss_position"), 1.0)
    drift = np.square(DRIFTING.gnss.drift_sigma_I)
    expected = before.copy()
    expected[:3], expected[15:18] = nu @ nu + drift, drift
    np.testing.assert_allclose(variances(rules), expected, rtol=1e-9)


def test_reset_to_ranges_takes_the_largest_valid_one():
    rules = refused(LaneRules(ALL), "uwb_range", nu=(-2.0, 0.0, 0.0))
    first = GROUP_BLOCK[GROUPS.index("uwb_range")]
    for k, (size, valid) in enumerate([(1.0, 1.0), (-3.0, 1.0), (7.0, 0.0)], first + 1):
        rules.change("innovation", k, (size, 0.0, 0.0))
        rules.change("block_valid", k, valid)
    rules.run(Stage.RECOVER)
    np.testing.assert_allclose(variances(rules)[:3], 9.0, rtol=1e-9)


def test_reset_to_features_has_the_largest_angle_and_offset():
    """One feature is near by and one is far; another one that was not seen does not count."""
    features = ((2.0, 0.0, H), (0.0, 8.0, H), (0.0, 0.0, H - 1.0))
    camera = ALL.camera.replace(features_I=features, max_range=100.0)
    rules = refused(LaneRules(ALL.replace(camera=camera)), "pixels", nu=(0.3, 0.4, 0.0))
    first = GROUP_BLOCK[PIXELS]
    rules.set(r_hat=[0.0, 0.0, H])
    for k, (size, valid) in enumerate([(0.2, 1.0), (0.9, 0.0)], first + 1):
        rules.change("innovation", k, (0.6 * size, -0.8 * size, 0.0))
        rules.change("block_valid", k, valid)
    rules.run(Stage.RECOVER)
    found = variances(rules)
    np.testing.assert_allclose(found[:3], (0.2 * 8.0) ** 2, rtol=1e-9)
    np.testing.assert_allclose(found[6:9], 0.5**2, rtol=1e-9)


@pytest.mark.parametrize("ago", [2.0, 10.0])
@pytest.mark.parametrize("name", ["gnss_position", "pixels"])
def test_estimate_that_has_drifted_off_has_the_velocity_that_explains_it(name, ago):
    """Twice the distance over the time since the last accepted one; a camera has an angle."""
    distance, nu = 50.0, (50.0, 0.0, 0.0)
    suite = ALL
    if name == "pixels":
        features = ((100.0, 0.0, 0.0), (0.0, 0.1, 0.0))
        suite = ALL.replace(camera=ALL.camera.replace(features_I=features, max_range=1e3))
        nu = (0.5, 0.0, 0.0)
    rules = refused(LaneRules(suite), name, stepped=0.0, nu=nu, ago=ago)
    rules.run(Stage.RECOVER)
    found, estimator = variances(rules), suite.estimator
    tilt, T = estimator.initial_tilt_sigma, estimator.reset_timeout
    if tilt == 0.0:
        tilt = suite.gnss.baseline_sigma
    start = ((GRAVITY * tilt) ** 2 + suite.imu.accel_bias_sigma**2) * T**2
    speed = max((2.0 * distance / ago) ** 2, start)
    np.testing.assert_allclose(found[3:6], speed, rtol=1e-6)
    np.testing.assert_allclose(found[:3], distance**2, rtol=1e-6)
    # another sensor that measures the velocity confirms it
    rules = refused(LaneRules(suite), name, stepped=0.0, nu=nu, ago=ago)
    rules.change("accepted_tick", GROUPS.index("optical_flow"), NOW)
    rules.run(Stage.RECOVER)
    np.testing.assert_allclose(variances(rules)[3:6], start, rtol=1e-6)


@pytest.mark.parametrize("name", ["gnss_baseline", "magnetometer"])
@pytest.mark.parametrize(("ago", "rate"), [(10.0, 0.05), (100.0, None), (1.0, 0.09)])
def test_heading_that_has_drifted_off_makes_the_gyro_uncertain_about_the_vertical(name, ago, rate):
    """By the angle over the time since the last accepted one; cheap gyros have up to 0.09 rad/s."""
    R_BI = euler_to_dcm([0.3, -0.2, 1.0])
    turned, level = 0.5, np.hypot(*ALL.magnetometer.field_I[:2])
    nu = (0.3, 0.4, 0.0)
    if name == "magnetometer":
        size = math.sqrt((turned * level) ** 2 - ALL.magnetometer.hard_iron_sigma**2)
        nu = (0.6 * size, 0.0, 0.8 * size)
    rules = refused(LaneRules(ALL), name, stepped=0.0, nu=nu, ago=ago)
    rules.set(R_hat=R_BI)
    rules.run(Stage.RECOVER)
    k, P = R_BI[:, 2], rules.covariance()[0, 12:15, 12:15]
    start = max(ALL.imu.gyro_bias_sigma, 0.002)  # at least the present one of these flights
    expected = max(start, turned / ago if rate is None else rate) ** 2
    expected = start**2 * np.eye(3) + (expected - start**2) * np.outer(k, k)
    np.testing.assert_allclose(P, expected, rtol=1e-6, atol=1e-12)


# --------------------------------------------------------------------------------------------------
# Jumps that sums of corrections show.
# --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("first", "row"), [(0, 9), (3, 12)], ids=["accelerometer", "gyro"])
def test_bias_has_jumped_when_its_corrections_are_beyond_their_limit(first, row):
    """Chi-square of three axes above 24, with the variance of the state over 24 added."""
    rules = LaneRules(ALL)
    sigma, removed = 0.01, 2e-5
    for axis in range(3):
        rules.set_sigma(row + axis, sigma)
    whole = removed + sigma**2 / 24.0
    share = np.array([[1.0, 0, 0], [0, 1, 0], [0, 0, 1], [0.6, 0.0, -0.8]])
    share = np.vstack([math.sqrt(24.0 * whole) * s * share for s in (0.99, 1.01)])
    corrected = np.zeros((EIGHT, len(rules.get("corrected")[0])))
    corrected[:, first : first + 3] = share
    rules.set(corrected=corrected, corrected_variance=removed, corrected_tick=7.0)
    rules.run(Stage.RECOVER)
    jumped = np.repeat([False, True], 4)
    np.testing.assert_array_equal(rules.get("alarm_tick"), np.where(jumped, NOW, NEVER))
    np.testing.assert_array_equal((rules.get("corrected") == 0.0).all(axis=1), jumped)
    np.testing.assert_array_equal(rules.get("corrected_variance")[:, 0] == 0.0, jumped)
    np.testing.assert_array_equal(rules.get("corrected_tick"), np.where(jumped, NOW, 7.0))
    # variances may be three times the largest sum
    largest = 3.0 * abs(share).max(axis=1)
    expected = np.where(jumped, np.maximum(largest, sigma), sigma)
    np.testing.assert_allclose(np.sqrt(rules.covariance()[:, row, row]), expected, rtol=1e-9)


@pytest.mark.parametrize("corrected", [0.002, 0.01, 0.05])
def test_gyro_whose_bias_has_jumped_has_turned_attitude_velocity_and_position(corrected):
    """For half of 6 s, by three times the sum, up to 0.09 rad/s; the tilt up to a start's."""
    rules, imu, pose = LaneRules(ALL, np.full(5, 1e-6)), ALL.imu, ALL.initial_pose
    rules.set(R_hat=euler_to_dcm([0.3, -0.2, 1.0]))
    sums = np.zeros(len(rules.get("corrected")[0]))
    sums[4] = corrected
    rules.set(corrected=sums)
    rules.run(Stage.RECOVER)
    rate, T = min(3.0 * corrected, 0.09), 3.0
    start = ALL.estimator.initial_tilt_sigma or ALL.gnss.baseline_sigma
    tilt = min(start, T * rate)
    heading = max(tilt, min(pose.heading_sigma, T * rate))
    speed = GRAVITY * tilt * T
    expected = np.repeat([0.5 * T * speed, speed, tilt, 1e-6, rate], 3)
    P = rules.covariance()[0]
    found = np.sqrt(np.diag(P))
    others = np.delete(np.arange(15), [6, 7, 8])
    np.testing.assert_allclose(found[others], expected[others], rtol=1e-6)
    k = rules.get("R_hat")[0, :, 2]
    attitude = tilt**2 * np.eye(3) + (heading**2 - tilt**2) * np.outer(k, k)
    np.testing.assert_allclose(P[6:9, 6:9], attitude, rtol=1e-6, atol=1e-14)
    assert imu.gyro_bias_sigma < 0.09


@pytest.mark.parametrize("doubts", [0.0, 1.0])
def test_heading_by_motion_begins_again_when_the_bias_of_the_gyro_has_jumped(doubts):
    rules = LaneRules(DRIFTING, np.full(5, 1e-6))
    corrected = np.zeros((EIGHT, len(rules.get("corrected")[0])))
    corrected[:4, 0], corrected[4:, 5] = 0.1, 0.1  # accelerometer, gyro
    rules.set(corrected=corrected, level_doubts=doubts, level_misses=1.0)
    rules.run(Stage.RECOVER)
    expected = np.where((corrected[:, 5] > 0.0) & (doubts == 0.0), 3.0, 1.0)
    np.testing.assert_array_equal(rules.get("level_misses"), expected)


@pytest.mark.parametrize(("diverged", "limit"), [(0.0, 24.0), (1.0, 12.0)])
def test_drift_that_has_jumped_resets_position_and_drift(diverged, limit):
    """By three times the sum of its corrections, the drift up to its standard deviation.

    A filter that is flagged as diverged has a lower limit. Another sensor prevents it.
    """
    rules = LaneRules(DRIFTING)
    sigma, removed = 0.1, 0.01
    whole = removed + sigma**2 / limit
    corrected = np.zeros((EIGHT, len(rules.get("corrected")[0])))
    corrected[:, 7] = np.sqrt(limit * whole) * np.repeat([0.99, 1.01], 4)
    rules.set(corrected=corrected, corrected_variance=removed, diverged=diverged)
    before = rules.covariance()
    rules.run(Stage.RECOVER)
    moved = np.repeat([False, True], 4)
    np.testing.assert_array_equal(rules.get("alarm_tick"), np.where(moved, NOW, NEVER))
    place = 9.0 * corrected[4, 7] ** 2
    expected = before[4].copy()
    expected[[0, 1, 2], [0, 1, 2]] = place
    drift = np.array(DRIFTING.gnss.drift_sigma_I)
    first = np.sqrt(np.diag(before[4])[15:18])
    assert (first <= drift + 1e-12).all()
    own = np.maximum(first**2, np.minimum(place, drift**2))
    expected[[15, 16, 17], [15, 16, 17]] = own
    np.testing.assert_allclose(rules.covariance()[4], expected, rtol=1e-9)
    np.testing.assert_array_equal(rules.covariance()[0], before[0])


def test_barometer_that_is_reset_alone_moves_the_position():
    """The height is wrong, so that the drift may be, by three times the sum of its corrections."""
    rules = refused(LaneRules(DRIFTING), "barometer", nu=(5.0, 0.0, 0.0))
    rules.set(corrected=0.4, corrected_variance=1e6)
    rules.change("accepted_tick", POSITION_BLOCK, [NOW, LONG_AGO] * 4)
    rules.run(Stage.RECOVER)
    found = rules.covariance()[:, 0, 0]
    np.testing.assert_allclose(found, 9.0 * 0.4**2, rtol=1e-9)


@pytest.mark.parametrize("kind", ["accelerometer", "drifted"])
def test_reset_of_the_motion_resets_hard_iron_and_drift_with_it(kind):
    """To the start: they were estimated with the attitude and the position."""
    rules = LaneRules(DRIFTING, np.full(5, 1e-6))
    for row in range(15, 15 + rules.slow):
        rules.set_sigma(row, 1e-9)
    if kind == "drifted":
        refused(rules, "gnss_velocity", stepped=0.0, nu=(1.0, 1.0, 1.0))
    else:
        rules.change("corrected", 1, 0.001)
    rules.run(Stage.RECOVER)
    P, estimator, imu = rules.covariance()[0], DRIFTING.estimator, DRIFTING.imu
    iron = 15 + int(rules.settings["aid_vector"][0, Aid.MAGNETOMETER])
    own = DRIFTING.magnetometer.hard_iron_sigma
    np.testing.assert_allclose(np.sqrt(np.diag(P))[iron : iron + 3], own, rtol=1e-6)
    tilt, T, accel = estimator.initial_tilt_sigma, estimator.reset_timeout, imu.accel_bias_sigma
    if kind == "accelerometer":
        accel, T = 0.003, 3.0
        tilt = accel / GRAVITY
    place = 0.25 * T**4 * ((GRAVITY * tilt) ** 2 + accel**2)
    np.testing.assert_allclose(np.diag(P)[:3], place, rtol=1e-6)
    drift = np.minimum(place, np.square(DRIFTING.gnss.drift_sigma_I))
    np.testing.assert_allclose(np.diag(P)[15:18], drift, rtol=1e-6)

"""Eight filters in lanes: each equals a single filter and is independent of its neighbors."""

import numpy as np
import pytest

import quad_gym
from quad_gym.estimation import UnscentedKalmanFilter
from quad_gym.records import FEATURE_BLOCKS, MAX_BLOCKS, covariance_of
from tests.circle_flight import record_circle
from tests.lane_filter import EIGHT, STATE, LaneFilter

LAB = quad_gym.sensor_suite("lab")
TICKS = 200
RECORDINGS = [record_circle(LAB, TICKS, seed=100 + lane) for lane in range(EIGHT)]
ALL_VALID = (np.arange(MAX_BLOCKS) < FEATURE_BLOCKS + len(LAB.camera.features_I)).astype(float)
PRESENT = np.random.default_rng(0).random((TICKS, EIGHT, 3)) < 0.7


def measure_all(filters, k, present=PRESENT):
    for lane in range(EIGHT):
        position, baseline, camera = present[k, lane]
        filters.measure(
            lane, RECORDINGS[lane], k, position=position, baseline=baseline, camera=camera
        )


def fly(filters, ticks=50, upset=None):
    """Fly all lanes, return their states after each cycle; `upset(filters, k)` runs before each."""
    measure_all(filters, 0, np.ones((1, EIGHT, 3), bool))
    filters.initialize()
    states = []
    for k in range(ticks):
        measure_all(filters, k)
        if upset is not None:
            upset(filters, k)
        filters.update()
        filters.predict()
        states.append({name: filters.get(name) for name in STATE})
    return states


def assert_lane_is_unmoved(calm, upset, lane):
    for before, after in zip(calm, upset, strict=True):
        for name in STATE:
            np.testing.assert_array_equal(before[name][lane], after[name][lane])


@pytest.fixture(scope="module")
def calm():
    return fly(LaneFilter(LAB))


def alone(lane):
    """Return a single filter that starts from the first measurement of a lane."""
    recording, ukf = RECORDINGS[lane], UnscentedKalmanFilter(LAB)
    ukf.initialize(recording.gnss_position[0], recording.gnss_baseline[0])
    return ukf


def measure_alone(ukf, lane, k, position, baseline, camera):
    recording = RECORDINGS[lane]
    ukf.update(
        recording.gnss_position[k] if position else None,
        recording.gnss_baseline[k] if baseline else None,
        recording.pixels[k] if camera else None,
    )


def assert_equal(filters, lane, ukf):
    values = (ukf.position, ukf.velocity, ukf.R_BI, ukf.accel_bias, ukf.gyro_bias)
    for name, value in zip(STATE, values, strict=False):
        np.testing.assert_array_equal(filters.get(name)[lane], value, err_msg=name)
    P = covariance_of(filters.get("P")[lane], filters.get("arc")[lane])
    np.testing.assert_array_equal(P, ukf.covariance)
    assert filters.get("filter_status")[lane] == ukf.status == 0


def test_eight_lanes_equal_eight_single_filters():
    """States are bitwise equal for any set of measurements."""
    filters, alones = LaneFilter(LAB), [alone(lane) for lane in range(EIGHT)]
    measure_all(filters, 0, np.ones((1, EIGHT, 3), bool))
    filters.initialize()
    for k in range(TICKS):
        measure_all(filters, k)
        filters.update()
        for lane, ukf in enumerate(alones):
            measure_alone(ukf, lane, k, *PRESENT[k, lane])
            assert_equal(filters, lane, ukf)
        filters.predict()
        for lane, ukf in enumerate(alones):
            ukf.predict(RECORDINGS[lane].gyro[k], RECORDINGS[lane].accel[k])
            assert_equal(filters, lane, ukf)


MEASURED = ("gnss_position", "gnss_baseline", "pixels", "gyro", "accel")
WILD = [(name, value) for name in MEASURED for value in (np.nan, np.inf, -np.inf, 1e300, -1e300)]
STATES = ("P", "r_hat", "R_hat", "b_a_hat")
RUINED = [(name, value) for name in STATES for value in (np.nan, np.inf, 0.0, -1.0, 1e200)]


@pytest.mark.parametrize(("name", "value"), [*WILD, *RUINED])
def test_invalid_measurements_or_states_of_one_lane_leave_others_unchanged(calm, name, value):
    def upset(filters, k):
        if k == 7:
            valid = {"block_valid": ALL_VALID} if name in MEASURED else {}
            filters.put(5, **{name: value}, **valid)

    moved = fly(LaneFilter(LAB), upset=upset)
    for lane in (0, 1, 2, 3, 4, 6, 7):
        assert_lane_is_unmoved(calm, moved, lane)
    if name in MEASURED:
        assert all(np.isfinite(moved[-1][state][5]).all() for state in STATE)


def started():
    filters = LaneFilter(LAB)
    measure_all(filters, 0, np.ones((1, EIGHT, 3), bool))
    filters.initialize()
    filters.update()
    filters.predict()
    for lane in range(EIGHT):
        filters.measure(lane, RECORDINGS[lane], 1)
    return filters


def test_masked_update_and_initialization_touch_chosen_lanes():
    filters = started()
    chosen = np.array([True, False] * 4)
    before = {field: filters.get(field) for field in STATE}
    filters.update(mask=chosen)
    filters.initialize(mask=chosen)
    for field, values in before.items():
        np.testing.assert_array_equal(filters.get(field)[~chosen], values[~chosen])
    fresh = LaneFilter(LAB)
    for lane in range(EIGHT):
        fresh.measure(lane, RECORDINGS[lane], 1)
    fresh.initialize()
    for field in STATE:
        np.testing.assert_array_equal(filters.get(field)[chosen], fresh.get(field)[chosen])

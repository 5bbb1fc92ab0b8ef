"""Eight filters in lanes: each does what the scalar instance does, whatever its neighbors do."""

import numpy as np
import pytest

import quad_gym
from quad_gym.kernels import single
from quad_gym.packing.flight import params_record
from quad_gym.params.vehicle import VehicleParams
from quad_gym.records import FLIGHT, WORK, FilterStatus
from tests.circle_flight import record_circle
from tests.lane_filter import EIGHT, STATE, LaneFilter

LAB = quad_gym.sensor_suite("lab")
TICKS = 200
RECORDINGS = [record_circle(LAB, TICKS, seed=100 + lane) for lane in range(EIGHT)]
PRESENT = np.random.default_rng(0).random((TICKS, EIGHT, 3)) < 0.7


def measure_all(filters, k, present=PRESENT):
    for lane in range(EIGHT):
        position, baseline, camera = present[k, lane]
        filters.measure(
            lane, RECORDINGS[lane], k, position=position, baseline=baseline, camera=camera
        )


def fly(filters, ticks=50, upset=None):
    """Fly all lanes and return their states on the way; `upset(filters, k)` acts before a cycle."""
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


def test_eight_different_flights_equal_the_scalar_filter_to_the_last_bits():
    lanes, params = LaneFilter(LAB), params_record(VehicleParams(), LAB)
    work, features = np.zeros(1, WORK), lanes.features
    measure_all(lanes, 0, np.ones((1, EIGHT, 3), bool))
    scalars = [lanes.flight(lane) for lane in range(EIGHT)]
    lanes.initialize()
    for lane, flight in enumerate(scalars):
        single.ukf_initialize(flight, params, np.zeros(3))
        assert_close(lanes, lane, flight)

    for k in range(TICKS):
        measure_all(lanes, k)
        scalars = [lanes.flight(lane) for lane in range(EIGHT)]  # both start each half-cycle alike
        lanes.update()
        for lane, flight in enumerate(scalars):
            single.ukf_update(flight, params, work, features, 0)
            assert_close(lanes, lane, flight)
        scalars = [lanes.flight(lane) for lane in range(EIGHT)]
        lanes.predict()
        for lane, flight in enumerate(scalars):
            single.ukf_predict(flight, params, work, 0)
            assert_close(lanes, lane, flight)
    assert (lanes.get("filter_status") == 0).all()


def assert_close(lanes, lane, flight):
    """Equal to some units in the last place of the largest entry of each row."""
    scales = {"r_hat": 4.0, "v_hat": 2.0, "R_hat": 1.0, "b_a_hat": 1.0, "b_g_hat": 1e-3}
    for name, scale in scales.items():
        gap = abs(lanes.get(name)[lane] - flight[name][0]).max()
        largest = abs(flight[name][0]).max()  # at first biases of some m/s^2 are taken for possible
        assert gap <= 1e-12 * max(scale, largest), (name, gap)
    L, truth = lanes.get("L")[lane], flight["L"][0]
    rows = np.linalg.norm(truth, axis=1, keepdims=True)
    assert (abs(L - truth) / rows).max() < 1e-11


def test_a_lane_that_misses_a_measurement_has_exactly_the_update_without_it():
    params, work = params_record(VehicleParams(), LAB), np.zeros(1, WORK)
    for position in (True, False):
        for baseline in (True, False):
            lanes = LaneFilter(LAB)
            measure_all(lanes, 0, np.ones((1, EIGHT, 3), bool))
            lanes.initialize()
            for lane in range(EIGHT):
                lanes.measure(lane, RECORDINGS[lane], 1)
            lanes.measure(3, RECORDINGS[3], 1, position=position, baseline=baseline, camera=False)
            flight = lanes.flight(3)
            lanes.update()
            single.ukf_update(flight, params, work, lanes.features, 0)
            assert_close(lanes, 3, flight)
            assert lanes.get("filter_status")[3] == 0
            if not (position or baseline):
                before = lanes.flight(3)
                np.testing.assert_array_equal(before["r_hat"], flight["r_hat"])
                np.testing.assert_array_equal(before["L"], flight["L"])


def test_missing_measurements_of_neighbors_do_not_move_a_lane(calm):
    def without_neighbors(filters, k):
        for lane in range(1, EIGHT):
            filters.measure(lane, RECORDINGS[lane], k, position=False, camera=lane > 4)

    assert_lane_is_unmoved(calm, fly(LaneFilter(LAB), upset=without_neighbors), 0)


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf, 1e300, -1e300])
@pytest.mark.parametrize("name", ["gnss_position", "gnss_baseline", "pixels", "gyro", "accel"])
def test_wild_measurements_of_a_neighbor_do_not_move_a_lane(calm, name, value):
    def wild(filters, k):
        if k == 7:
            filters.put(5, **{name: value}, position_valid=1, baseline_valid=1, feature_valid=1)

    moved = fly(LaneFilter(LAB), upset=wild)
    for lane in (0, 1, 2, 3, 4, 6, 7):
        assert_lane_is_unmoved(calm, moved, lane)
    assert all(np.isfinite(moved[-1][state][5]).all() for state in STATE)


@pytest.mark.parametrize("value", [np.nan, np.inf, 0.0, -1.0, 1e200])
@pytest.mark.parametrize("name", ["L", "r_hat", "R_hat", "b_a_hat"])
def test_a_ruined_state_of_a_neighbor_does_not_move_a_lane(calm, name, value):
    def ruin(filters, k):
        if k == 7:
            filters.put(2, **{name: value})

    moved = fly(LaneFilter(LAB), upset=ruin)
    for lane in (0, 1, 3, 4, 5, 6, 7):
        assert_lane_is_unmoved(calm, moved, lane)


def started():
    filters = LaneFilter(LAB)
    measure_all(filters, 0, np.ones((1, EIGHT, 3), bool))
    filters.initialize()
    filters.update()
    filters.predict()
    for lane in range(EIGHT):
        filters.measure(lane, RECORDINGS[lane], 1)
    return filters


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
@pytest.mark.parametrize("name", ["gnss_position", "gnss_baseline", "pixels"])
def test_a_measurement_that_is_not_finite_fails_the_update_of_its_lane_alone(name, value):
    filters = started()
    filters.put(4, **{name: value}, feature_valid=1.0)
    before = {field: filters.get(field) for field in (*STATE, "nis", "nis_dimension")}
    filters.update()
    for field, values in before.items():
        np.testing.assert_array_equal(filters.get(field)[4], values[4])
        if field in STATE:
            assert all((filters.get(field)[lane] != values[lane]).any() for lane in (0, 3, 5, 7))
    expected = np.zeros(EIGHT)
    expected[4] = FilterStatus.UPDATE_FAILED
    np.testing.assert_array_equal(filters.get("filter_status"), expected)


@pytest.mark.parametrize("value", [np.nan, np.inf, 1e300])
@pytest.mark.parametrize("name", ["gyro", "accel"])
def test_a_prediction_that_fails_keeps_the_state_of_its_lane_alone(name, value):
    filters = started()
    filters.put(6, **{name: value})
    before = {field: filters.get(field) for field in STATE}
    filters.predict()
    for field, values in before.items():
        np.testing.assert_array_equal(filters.get(field)[6], values[6])
        if field in ("r_hat", "v_hat", "R_hat", "L"):
            assert all((filters.get(field)[lane] != values[lane]).any() for lane in (0, 5, 7))
    expected = np.zeros(EIGHT)
    expected[6] = FilterStatus.PREDICTION_FAILED
    np.testing.assert_array_equal(filters.get("filter_status"), expected)


def test_a_lost_covariance_fails_the_prediction_and_stays_for_the_record():
    filters = started()
    filters.put(1, L=np.nan)
    filters.predict()
    status = filters.get("filter_status")
    assert status[1] == FilterStatus.PREDICTION_FAILED
    filters.measure(1, RECORDINGS[1], 2)
    filters.update()
    assert filters.get("filter_status")[1] == 3
    assert (np.delete(filters.get("filter_status"), 1) == 0).all()


def test_a_masked_update_and_initialisation_touch_the_chosen_lanes_alone():
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


def test_results_do_not_depend_on_the_lane():
    filters = LaneFilter(LAB)
    for lane in range(EIGHT):
        filters.measure(lane, RECORDINGS[0], 0)
    filters.initialize()
    for k in range(100):
        for lane in range(EIGHT):
            filters.measure(lane, RECORDINGS[0], k)
        filters.update()
        filters.predict()
    for name in FLIGHT.names:
        values = filters.get(name)
        for lane in range(1, EIGHT):
            np.testing.assert_array_equal(values[lane], values[0], err_msg=name)

"""Batches of flights: motor actions, resets, fields, memory, and switched sensors and faults."""

import tracemalloc

import numpy as np
import pytest

from quad_gym.batch.flight_batch import FlightBatch
from quad_gym.faults import AccelBiasStep, GnssOutage
from quad_gym.params.task import TaskParams
from quad_gym.records import (
    FEATURE_SLICE,
    FLIGHT,
    POSITION_BLOCK,
    RESULTS,
    Control,
    Source,
)
from tests.builders import flown_batch

ENDLESS = TaskParams(duration=0)
SEEDS = np.random.default_rng(5).permutation(1000)[:100].tolist()


def new_batch(count, **options):
    return FlightBatch(count, **{"task": ENDLESS, "threads": 1, **options})


def fly(seeds, steps=60, **options):
    return flown_batch(seeds, steps, **{"task": ENDLESS, **options})


@pytest.fixture(scope="module")
def hundred():
    return fly(SEEDS)


def test_motor_actions_set_voltages_of_each_flight():
    task = TaskParams(duration=0, pad=False)
    batch = new_batch(2, control=Control.MOTOR, source=Source.TRUTH, task=task)
    batch.reset(seeds=[1, 1])
    for _ in range(20):
        batch.step(np.array([[-1.0] * 4, [1.0] * 4]))
    voltages = batch.record("voltages")
    assert (voltages[0] == 0.0).all()
    assert (voltages[1] == voltages[1, 0]).all()
    assert batch.record("v")[0, 2] < -0.5 < 0.5 < batch.record("v")[1, 2]
    batch.step()  # keeps the last actions
    np.testing.assert_array_equal(batch.record("voltages"), voltages)


UNFIT = [{"seeds": seeds} for seeds in ([1, 2], [1, 2, 3, -1], [])]
UNFIT += [{"keys": np.zeros(shape, np.uint64)} for shape in ((3, 2), 8)]
MASKS = (np.ones(3, bool), [1, 0, 1, 0], np.ones((4, 1), bool), "all")
UNFIT += [{"seeds": [1, 2, 3, 4], "mask": mask} for mask in MASKS]


@pytest.mark.parametrize("arguments", UNFIT, ids=str)
def test_invalid_reset_raises_value_error_and_changes_nothing(arguments):
    batch = fly(SEEDS[:4], steps=3)
    before, results = batch.snapshot(), batch.results.copy()
    with pytest.raises(ValueError, match=r"seeds|keys|mask|non-negative"):
        batch.reset(**arguments)
    with pytest.raises(ValueError, match="shape"):
        fly(SEEDS[:4], steps=3, control=Control.MOTOR).step(np.zeros((3, 4)))
    assert batch.snapshot().tobytes() == before.tobytes()
    np.testing.assert_array_equal(batch.results, results)


def test_every_field_is_readable_as_a_copy(hundred):
    for name in FLIGHT.names:
        values = hundred.record(name)
        assert values.shape == (100, *FLIGHT[name].shape)
        before = values.copy()
        values[...] = 7
        np.testing.assert_array_equal(hundred.record(name), before)
    for name in RESULTS:
        assert hundred.result(name).shape == (100,)
    with pytest.raises(ValueError, match="altitude"):
        hundred.record("altitude")


def test_four_thousand_flights_fit_in_two_hundred_megabytes():
    tracemalloc.start()
    try:
        batch = FlightBatch(4096, threads=2)
        batch.reset(seeds=list(range(4096)))
        batch.step()
        _, peak = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert peak < 200e6
    assert batch.snapshot().nbytes < 100e6


def test_sensors_that_are_switched_off_measure_nothing():
    def flown(*switches):
        batch = FlightBatch(2, sensors="lab", task=TaskParams(kind="hover", start="hover"))
        batch.reset(seeds=[0, 1])
        for gnss, camera in switches:
            batch.switch_sensors(gnss=gnss, camera=camera)
            batch.step()
        return batch

    batch = flown((None, None))
    assert batch.record("block_valid")[:, POSITION_BLOCK].all()
    assert batch.record("block_valid")[:, FEATURE_SLICE][:, :2].any()
    batch = flown((False, None), (None, False))
    assert not batch.record("block_valid")[:, POSITION_BLOCK].any()
    assert not batch.record("block_valid")[:, FEATURE_SLICE].any()
    batch = flown((False, False), (True, None))
    assert batch.record("block_valid")[:, POSITION_BLOCK].all()
    assert not batch.record("block_valid")[:, FEATURE_SLICE].any()
    batch.reset(seeds=[0, 1])
    assert batch.record("block_valid")[:, FEATURE_SLICE][:, :2].any()
    same = flown((True, True), (True, None), (None, None))
    assert same.snapshot().tobytes() == flown(*[(None, None)] * 3).snapshot().tobytes()
    with pytest.raises(ValueError, match="gnss"):
        batch.switch_sensors(gnss=1)


def test_switched_faults_equal_scheduled_ones():
    def flown(start, switches):
        span = {"start": start, "duration": 0.25}
        faults = (GnssOutage(**span), AccelBiasStep(**span))
        batch = new_batch(9, task=TaskParams(kind="hover", start="hover"), faults=faults)
        batch.reset(seeds=range(9))
        for k in range(120):
            if k in switches:
                batch.switch_faults(switches[k])
            batch.step()
        return batch

    scheduled, switched = flown(0.25, {}), flown(90.0, {49: True, 99: False})
    for name in ("r", "b_a", "r_hat", "L", "fault_count"):
        np.testing.assert_array_equal(switched.record(name), scheduled.record(name), err_msg=name)
    assert not np.array_equal(flown(90.0, {}).record("r_hat"), scheduled.record("r_hat"))
    assert flown(90.0, {110: True}).active_faults()["gnss_outage"].all()
    with pytest.raises(ValueError, match="active"):
        scheduled.switch_faults(1)

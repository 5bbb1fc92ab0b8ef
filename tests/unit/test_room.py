"""Flights take only the memory that their configuration uses. They access neither memory outside
nor parts that their record lacks."""

import gymnasium
import numpy as np
import pytest

import quad_gym
import quad_gym.batch.flight_batch as flight_batch
from quad_gym import Uniform
from quad_gym.batch import memory
from quad_gym.batch.flight_batch import FlightBatch
from quad_gym.records import FLIGHT_BLOCK, FLIGHT_FIELDS, PARTS, Source, room_of
from tests.builders import flown_batch
from tests.golden.flights import cases

EVERYTHING = frozenset(name for name, _ in PARTS)
CASES = [
    pytest.param(name, marks=[pytest.mark.slow] * (k % 3 > 0)) for k, name in enumerate(cases())
]
TRUTH = {"source": Source.TRUTH, "run_filter": False}


def flown(case, steps=4):
    """The batch of three flights of a golden case, in which episodes end and begin."""
    keywords = dict(case)
    name = f"QuadGym/{keywords.pop('id', 'Circle')}-v0"
    env = gymnasium.make_vec(name, num_envs=3, duration=0.06, threads=1, **keywords)
    env.reset(seed=0)
    for _ in range(steps):
        env.step(np.full((3, 4), 0.1))
    return env.unwrapped.flights.batch


@pytest.mark.parametrize("name", CASES)
def test_memory_around_the_flights_is_neither_written_nor_read(monkeypatch, name):
    """Flights lie between guards of zeros or NaN, which stay as they are and change no flight."""
    found, size = [], FLIGHT_BLOCK.itemsize // 64 * 64 + 64
    for filling in (0x00, 0xFF):
        guards = []

        def guarded_zeros(count, dtype, filling=filling, guards=guards):
            raw = np.full(count * dtype.itemsize + 2 * size + 64, filling, np.uint8)
            first = size - (raw.ctypes.data + size) % 64 + 64
            last = first + count * dtype.itemsize
            raw[first:last] = 0
            guards += [raw[:first], raw[last:]]
            return raw[first:last].view(dtype)

        monkeypatch.setattr(memory, "aligned_zeros", guarded_zeros)
        found.append(flown(cases()[name]).snapshot().tobytes())
        assert guards
        assert all((guard == filling).all() for guard in guards)
    assert found[0] == found[1]


@pytest.mark.parametrize("name", CASES)
def test_parts_that_a_record_lacks_are_neither_written_nor_read(monkeypatch, name):
    """Flights in full records are equal, and the extra parts, filled before, stay unchanged."""
    small = flown(cases()[name], steps=12)
    kept = set(small._blocks.dtype.names)
    monkeypatch.setattr(flight_batch, "room_of", lambda used: room_of(EVERYTHING))
    begin = FlightBatch.reset

    def fill_and_reset(batch, *args, **options):
        for field in set(FLIGHT_BLOCK.names) - kept:
            batch._blocks[field] = 7
        return begin(batch, *args, **options)

    monkeypatch.setattr(FlightBatch, "reset", fill_and_reset)
    full = flown(cases()[name], steps=12)
    assert full._blocks.dtype == FLIGHT_BLOCK
    for field in FLIGHT_BLOCK.names:
        if field in kept:
            np.testing.assert_array_equal(small.record(field), full.record(field), err_msg=field)
        else:
            assert (full.record(field) == 7).all(), field


def test_the_parts_make_the_record():
    assert [field for _, fields in PARTS for field in fields] == list(FLIGHT_FIELDS)
    for name in EVERYTHING:
        room = room_of(frozenset({name}))
        for field in room.dtype.names:
            offset = room.dtype.fields[field][1]
            assert offset + room.skipped == FLIGHT_BLOCK.fields[field][1]
    assert room_of(EVERYTHING) == (FLIGHT_BLOCK, 0)


def test_unused_features_take_no_memory():
    def size(**options):
        return FlightBatch(8, threads=1, **options).snapshot().nbytes

    truth, prompt = size(**TRUTH), quad_gym.sensor_suite("rtk").simplified()
    assert truth < 0.5 * size(sensors="lab")
    assert size(sensors="lab") < size(sensors=prompt) < size(sensors="rtk")
    drawn = size(**TRUTH, randomization={"mass": Uniform(0.7, 0.8)})
    assert truth < drawn < size(**TRUTH, faults=["rotor_loss"])


def test_fields_without_room_read_as_zero_or_nan():
    batch = flown_batch(range(11), 60, **TRUTH)
    assert batch.record("L").shape == (11, 15, 15)
    assert (batch.record("L") == 0.0).all()
    assert np.isnan(batch.record("block_nis")).all()
    assert batch.record("filter_status").dtype == batch.record("waiting_valid").astype("u8").dtype
    assert batch.record("r_hat", np.array([3, 5])).shape == (2, 3)

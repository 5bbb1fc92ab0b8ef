"""Flights take the memory that their configuration uses, and touch none beyond it."""

import itertools

import numpy as np
import pytest

import quad_gym
import quad_gym.batch.flight_batch as flight_batch
from quad_gym import Uniform
from quad_gym.batch.flight_batch import FlightBatch
from quad_gym.records import FLIGHT_BLOCK, FLIGHT_FIELDS, PARTS, Source, room_of
from tests.builders import flown_batch

EVERYTHING = frozenset(name for name, _ in PARTS)


def late(suite):
    suite = quad_gym.sensor_suite(suite)
    return suite.replace(gnss=suite.gnss.replace(latency=0.005))


TRUTH = {"source": Source.TRUTH, "run_filter": False}
CHOICES = {
    "truth": TRUTH,
    "noisy": TRUTH | {"source": Source.NOISY, "world": "fresh_breeze"},
    "lab": {"sensors": "lab"},
    "gated": {"sensors": "rtk"},
    "late": {"sensors": late("lab")},
    "late and gated": {"sensors": late("rtk")},
}
MORE = {
    "features": {"randomization": {"features_yaw": Uniform(-1.0, 1.0)}},
    "ground": {"world": quad_gym.WorldParams(ground=quad_gym.GroundParams())},
    "plain": {},
    "trajectory": {"task": quad_gym.TaskParams(kind="trajectory", start="hover")},
    "drawn": {"randomization": {"mass": Uniform(0.7, 0.8)}},
    "faults": {"faults": ["rotor_loss"]},
    "obstacles": {
        "world": quad_gym.WorldParams(
            obstacles=(quad_gym.Wall(center_I=(2.0, 0.5, 1.0), shift_I=(0.2, 0.0, 0.0)),),
            geofence=((-5.0, -5.0, -1.0), (5.0, 5.0, 3.0)),
        )
    },
}
CASES = {
    f"{name}, {more}": CHOICES[name] | MORE[more] for name, more in itertools.product(CHOICES, MORE)
}


@pytest.mark.parametrize("name", CASES)
def test_flights_touch_nothing_beyond_their_room(name, monkeypatch):
    """The same flights in full records, of which what there was no room for is filled before."""
    small = flown_batch(range(11), 60, **CASES[name])
    kept = set(small.snapshot().dtype.names)
    monkeypatch.setattr(flight_batch, "room_of", lambda used: room_of(EVERYTHING))
    begin = FlightBatch.reset

    def fill_and_reset(batch, **options):
        for field in set(FLIGHT_BLOCK.names) - kept:
            batch._blocks[field] = 7
        return begin(batch, **options)

    monkeypatch.setattr(FlightBatch, "reset", fill_and_reset)
    full = flown_batch(range(11), 60, **CASES[name])
    assert full.snapshot().dtype == FLIGHT_BLOCK
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


def test_what_is_not_used_takes_no_memory():
    def size(**options):
        return FlightBatch(8, threads=1, **options).snapshot().nbytes

    truth = size(**TRUTH)
    assert truth < 0.5 * size(sensors="lab")
    prompt = quad_gym.sensor_suite("rtk").simplified()
    assert size(sensors="lab") < size(sensors=prompt) < size(sensors="rtk")
    assert truth < size(**TRUTH | MORE["drawn"]) < size(**TRUTH | MORE["faults"])


def test_fields_without_room_read_as_nothing():
    batch = flown_batch(range(11), 60, **TRUTH)
    assert batch.record("L").shape == (11, 15, 15)
    assert (batch.record("L") == 0.0).all()
    assert np.isnan(batch.record("block_nis")).all()
    assert batch.record("filter_status").dtype == batch.record("waiting_valid").astype("u8").dtype
    assert batch.record("r_hat", np.array([3, 5])).shape == (2, 3)

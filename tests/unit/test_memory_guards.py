"""Flights touch the memory that they have room for, and nothing beside it. A batch has room for the
parts of a flight's record that it uses. Here that room lies between guards: whatever flies, they
stay as they are, and what is in them makes no difference."""

import gymnasium
import numpy as np
import pytest

from quad_gym.batch import memory
from quad_gym.records import FLIGHT_BLOCK
from tests.golden.flights import cases

STEPS = 4


def fly_between(monkeypatch, filling, case):
    """Fly some steps with every byte of the guards `filling`; return (guards, flights)."""
    guards, size = [], FLIGHT_BLOCK.itemsize // 64 * 64 + 64

    def guarded_zeros(count, dtype):
        raw = np.full(count * dtype.itemsize + 2 * size + 64, filling, np.uint8)
        first = size - (raw.ctypes.data + size) % 64 + 64
        last = first + count * dtype.itemsize
        raw[first:last] = 0
        guards.append((raw[:first], raw[last:]))
        return raw[first:last].view(dtype)

    monkeypatch.setattr(memory, "aligned_zeros", guarded_zeros)
    keywords = dict(case)
    name = f"QuadGym/{keywords.pop('id', 'Circle')}-v0"
    env = gymnasium.make_vec(name, num_envs=3, duration=0.06, threads=1, **keywords)
    env.reset(seed=0)  # episodes end and begin on the way
    for _ in range(STEPS):
        env.step(np.full((3, 4), 0.1))
    flown = env.unwrapped.flights.batch.snapshot()
    env.close()
    return guards, flown


@pytest.mark.parametrize("name", cases())
def test_memory_beside_the_flights_is_neither_written_nor_read(monkeypatch, name):
    flown = []
    for filling in (0x00, 0xFF):  # of floats: zeros, and NaN
        guards, flights = fly_between(monkeypatch, filling, cases()[name])
        assert guards
        for before, after in guards:
            assert (before == filling).all()
            assert (after == filling).all()
        flown.append(flights.tobytes())
    assert flown[0] == flown[1]

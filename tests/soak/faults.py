"""Random faults with the filter in the loop: valid records, covariances and reported failures."""

import numpy as np

from quad_gym.records import Source
from tests.field_flights import fly
from tests.soak import drawing
from tests.soak.drawing import chance, pick
from tests.soak.validity import (
    assert_failures_are_reported,
    assert_positive_definite,
    assert_records_are_finite,
)

ABOUT = "covariances, records and flags of flights with faults with valid ones"
FLIGHTS = 16
TASKS = ("hover", "circle", "lemniscate", "random_trajectory", "waypoints")


def run(rng):
    """Fly a random suite with random faults, and check each tick."""
    suite = drawing.suite(rng)
    given = drawing.faults(rng, suite, most=6)
    options = {
        "task": pick(rng, TASKS),
        "seed": int(rng.integers(1 << 32)),
        "start": pick(rng, ("ground", "hover", "mixed", "moving")),
        "world": pick(rng, ("calm", "breeze", "fresh_breeze")),
        "filter_start": pick(rng, ("cold", "cold", "warm")),
        "source": pick(rng, (Source.ESTIMATE, Source.ESTIMATE, Source.TRUTH)),
    }
    ticks = int(rng.integers(100, 700))
    batch = fly(suite, FLIGHTS, faults=given, run_filter=True, threads=1, **options)
    failures, nis = np.zeros((2, batch.count)), batch.record("nis")
    for tick in range(ticks):
        batch.step()
        made, _, failures, nis = assert_failures_are_reported(batch, failures, nis)
        checked = np.flatnonzero(made | (tick % 20 == 0))
        if checked.size:
            assert_positive_definite(batch.record("L", checked))
        if tick % 20 == 0 or tick == ticks - 1:
            assert_records_are_finite(batch)
        lost = ~(np.abs(batch.record("r")).max(axis=1) < 1e3)
        lost |= chance(rng, 0.005) & (rng.random(FLIGHTS) < 0.5)
        if lost.any():
            batch.reset(mask=lost)
            failures, nis = failures * ~lost, batch.record("nis")
    return False

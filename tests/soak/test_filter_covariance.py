"""Millions of filter updates, all suites and faults: valid covariances, every failure counted.
QUAD_GYM_SOAK_UPDATES sets the total number of updates, by default 10^6; `make soak` makes 10^7.
After every update LAPACK factors the covariance again. An update without effect must have been
rejected by the gate or counted as a failure."""

import os

import numpy as np
import pytest

import quad_gym
from quad_gym.faults import PRESETS
from quad_gym.records import Source
from tests.field_flights import fly
from tests.soak.validity import assert_failures_are_reported, assert_positive_definite

UPDATES = int(float(os.environ.get("QUAD_GYM_SOAK_UPDATES", "1e6")))
SHARES = {"lab": 0.55, "rtk": 0.25, "consumer": 0.1, "indoor": 0.1}
"""Shares of the updates: `lab` has measurements every 5 ms, `consumer` every 100 ms."""
COUNTS = {"lab": 64, "rtk": 256, "consumer": 256, "indoor": 256}
"""Number of flights in a batch, so that each lasts 10 s or more with 10^7 updates."""
CASES = [
    (suite, kind, fault)
    for suite in SHARES
    for kind in ("ukf", "ekf")
    for fault in (*PRESETS, "all")
    if fault == "all" or all(
        not part.needs or getattr(quad_gym.sensor_suite(suite), part.needs) is not None
        for part in PRESETS[fault]
    )
]  # fmt: skip


@pytest.fixture(scope="module")
def tally():
    """Yield counts over all cases, and print them at the end."""
    counts = {"updates": 0, "failed updates": 0, "failed predictions": 0, "wholly left out": 0}
    yield counts
    print("\n" + ", ".join(f"{number:,} {name}" for name, number in counts.items()))


@pytest.mark.slow
@pytest.mark.parametrize(("name", "kind", "fault"), CASES)
def test_covariances_stay_positive_definite_and_failures_are_reported(name, kind, fault, tally):
    suite = quad_gym.sensor_suite(name)
    suite = suite.replace(estimator=suite.estimator.replace(kind=kind))
    number = CASES.index((name, kind, fault))
    source = Source.TRUTH if number % 2 else Source.ESTIMATE
    options = {"seed": 1000 * number, "source": source, "run_filter": True, "threads": 1}
    batch = fly(suite, COUNTS[name], faults=fault, **options)
    cases = sum(case[0] == name for case in CASES)
    goal, updates, ticks = UPDATES * SHARES[name] / cases, 0, 0
    failures, nis = np.zeros((2, batch.count)), batch.record("nis")
    while updates < goal:
        batch.step()
        ticks += 1
        made, rejected, failures, nis = assert_failures_are_reported(batch, failures, nis)
        updates += int(made.sum())
        tally["wholly left out"] += rejected
        looked_at = np.flatnonzero(made | (ticks % 20 == 0))
        if looked_at.size:
            assert_positive_definite(batch.record("L", looked_at))
        # reset vehicles that have crashed or flown for long
        lost = ~(np.abs(batch.record("r")).max(axis=1) < 1e3) | (ticks % 4000 == 0)
        if lost.any():
            tally["failed updates"] += int(failures[0, lost].sum())
            tally["failed predictions"] += int(failures[1, lost].sum())
            batch.reset(mask=lost)
            failures, nis = failures * ~lost, batch.record("nis")
    tally["updates"] += updates
    tally["failed updates"] += int(failures[0].sum())
    tally["failed predictions"] += int(failures[1].sum())

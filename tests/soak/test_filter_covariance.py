"""Millions of filter updates, all suites and faults: valid covariances, every failure counted.
QUAD_GYM_SOAK_UPDATES sets the total number of updates, by default 10^6; `make soak` makes 10^7.
After every update LAPACK factors the covariance again. An update without effect must have been
rejected by the gate or counted as a failure."""

import os

import numpy as np
import pytest

import quad_gym
from quad_gym.faults import PRESETS
from quad_gym.records import FilterStatus, GateDecision, Source
from tests.field_flights import fly

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


def assert_positive_definite(L):
    """Check that factors L (n, 15, 15) are lower triangular, and that LAPACK can factor L L^T. A
    column of L may have either sign: the large turn of a reset can change it, but not L L^T."""
    assert np.isfinite(L).all()
    assert not np.triu(L, 1).any()
    assert (np.diagonal(L, axis1=1, axis2=2) != 0.0).all()
    P = L @ L.transpose(0, 2, 1)
    np.testing.assert_array_equal(P, P.transpose(0, 2, 1))
    sigma = np.sqrt(np.diagonal(P, axis1=1, axis2=2))
    correlation = P / sigma[:, :, np.newaxis] / sigma[:, np.newaxis]
    assert abs(correlation).max() <= 1.0 + 1e-12
    np.linalg.cholesky(correlation)


def assert_failures_are_reported(batch, failures, nis):
    """Check that the status reports all failures, and that each accepted update had an effect.

    Returns:
        Flags of flights with an update, the number of wholly rejected updates, failures and NIS.
    """
    counted = np.array([batch.record("update_failures"), batch.record("prediction_failures")])
    status, now = batch.record("filter_status").astype(np.int64), batch.record("nis")
    np.testing.assert_array_equal(counted[0] > 0.0, status & FilterStatus.UPDATE_FAILED > 0)
    np.testing.assert_array_equal(counted[1] > 0.0, status & FilterStatus.PREDICTION_FAILED > 0)
    assert ((counted - failures) <= 2.0).all()
    measured, gate = batch.record("block_valid") > 0.0, batch.record("gate")
    made, accepted = measured.any(axis=1), (measured & (gate == GateDecision.ACCEPTED)).any(axis=1)
    failed = counted[0] > failures[0]
    known = np.isfinite(now) & np.isfinite(nis)  # no NIS for an image processed in steps
    np.testing.assert_array_equal((now != nis)[known], (accepted & ~failed)[known])
    np.testing.assert_array_equal((measured & (gate == GateDecision.FAILED)).any(axis=1), failed)
    return made, int((made & ~accepted & ~failed).sum()), counted, now


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

"""Valid records of flights: finite numbers, positive definite covariances, reported failures."""

import numpy as np

from quad_gym.records import FLIGHT_FIELDS, FilterStatus, GateDecision

NOT_MEASURED = (
    "start_given",
    "innovation",
    "innovation_sigma",
    "block_nis",
    "obstacle_distance",
    "nis",  # after an update in steps
    "stamps",  # without a waiting measurement
    "drawn",  # for a sensor that the suite lacks
)
"""Fields that hold NaN where nothing was given or measured."""
ALWAYS_FINITE = [field.name for field in FLIGHT_FIELDS if field.name not in NOT_MEASURED]
FAR_OFF = 100.0
"""NIS of a direction beyond which the joint NIS without a gate may be zero."""


def assert_records_are_finite(batch):
    for name in ALWAYS_FINITE:
        bad = ~np.isfinite(batch.record(name).astype(float))
        assert not bad.any(), f"{name} of flights {np.unique(np.nonzero(bad)[0])[:9]}"


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
    used = (gate == GateDecision.ACCEPTED) | (gate == GateDecision.WEAKENED)
    made, accepted = measured.any(axis=1), (measured & used).any(axis=1)
    failed = counted[0] > failures[0]
    known = np.isfinite(now) & np.isfinite(nis)  # no NIS for an image processed in steps
    # without a gate, directions that are far off have a NIS of zero: see `FilterEstimate.nis`
    known &= (now != 0.0) | (np.nan_to_num(batch.record("block_nis")).max(axis=1) < FAR_OFF)
    np.testing.assert_array_equal((now != nis)[known], (accepted & ~failed)[known])
    np.testing.assert_array_equal((measured & (gate == GateDecision.FAILED)).any(axis=1), failed)
    return made, int((made & ~accepted & ~failed).sum()), counted, now

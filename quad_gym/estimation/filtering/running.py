"""Runs a tape with a filter: in compiled code, except while the heading is unknown."""

from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from quad_gym.estimation.filtering.engine import Floats
from quad_gym.estimation.filtering.filters import KalmanFilter
from quad_gym.estimation.filtering.samples import Measurement
from quad_gym.estimation.filtering.tape import Tape, TapeWriter
from quad_gym.records import KEPT, WIDTH, Operation


class Results(NamedTuple):
    """Results of a piece of a tape."""

    estimates: Floats
    """(n, KEPT + 1) estimates, whose last number is 1 where the heading is known"""
    innovations: Floats  #: (m, blocks, REPORTED)
    valid: Any  #: (m, MAX_BLOCKS) True where a block was measured


def run_filter(kf: KalmanFilter, writer: TapeWriter) -> Iterator[Results]:
    """Run a tape from the present state of a filter, piece by piece.

    Args:
        kf: The filter.
        writer: The tape, and its measurements.
    """
    status = kf.status
    copies: dict[int, Any] = {}
    slots: NDArray[Any] | None = None
    for piece in writer.pieces():
        first, estimates, innovations = 0, _no_rows(KEPT + 1), _no_rows(0)
        if slots is None:
            first, before, reports = run_while_unknown(kf, writer, piece, copies)
            estimates = np.reshape(before, (-1, KEPT + 1))
            innovations = np.array(reports)
        if first < len(piece.operations):
            if slots is None:
                slots = np.zeros((piece.slots, kf._engine.words[0].size), np.uint64)
                for k, (words, _) in copies.items():
                    slots[k].reshape(-1, WIDTH)[:] = words[0]
            kept, reported = (rows[0, ..., 0] for rows in kf._engine.run(piece.after(first), slots))
            kept = np.column_stack([kept, np.ones(len(kept))])
            kept[: len(estimates)] = estimates
            if len(innovations):
                reported[: len(innovations)] = innovations
            estimates, innovations = kept, reported
        yield Results(estimates, innovations, piece.valid)
    kf.warn_of_news(status)


def _no_rows(width: int) -> Floats:
    return np.empty((0, width))


def run_while_unknown(
    kf: KalmanFilter, writer: TapeWriter, tape: Tape, copies: dict[int, Any]
) -> tuple[int, list[Floats], list[Floats]]:
    """Run a tape until the heading is known, also in all copies that may be restored.

    Args:
        kf: The filter.
        writer: The measurements.
        tape: The tape.
        copies: Copies of the filter's memory by number; further ones are added.

    Returns:
        Number of operations that were run, estimates and innovations.
    """
    estimates: list[Floats] = []
    innovations: list[Floats] = []
    for k, (code, index, target) in enumerate(tape.operations.tolist()):
        if kf.heading_known and all(weights is None for _, weights in copies.values()):
            return k, estimates, innovations
        if code == Operation.KEEP:
            estimates.append(_estimate(kf))
            continue
        updates = code == Operation.UPDATE
        measurement = writer.measurement(tape.first + index) if updates else None
        kf._operate((code, index, target), tape.samples, measurement, copies)
        if measurement is not None and target >= 0:
            innovations.append(_innovations(kf, measurement))
    return len(tape.operations), estimates, innovations


def _innovations(kf: KalmanFilter, measurement: Measurement) -> Floats:
    """Return innovations (blocks, REPORTED)."""
    innovation, sigma, nis, gate = kf._innovations(measurement.blocks)
    return np.column_stack([innovation, sigma, nis, gate])


def _estimate(kf: KalmanFilter) -> Floats:
    """Return an estimate (KEPT + 1,)."""
    values: Sequence[Any] = (
        *(kf.position, kf.velocity, kf.R_BI.ravel(), kf.accel_bias, kf.gyro_bias),
        *(np.diag(kf.covariance), [kf.diverged, kf.heading_known]),
    )
    return np.concatenate(values)

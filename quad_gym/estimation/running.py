"""Runs a tape with a filter: in compiled code, except while the heading is unknown."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from quad_gym.estimation.engine import Floats
from quad_gym.estimation.filters import KalmanFilter
from quad_gym.estimation.samples import Measurement
from quad_gym.estimation.tape import Tape, TapeWriter
from quad_gym.records import KEPT, WIDTH, Operation


def run_filter(kf: KalmanFilter, writer: TapeWriter, tape: Tape) -> tuple[Floats, Floats]:
    """Run a tape from the present state of a filter.

    Args:
        kf: The filter.
        writer: The inputs.
        tape: The tape with them.

    Returns:
        Estimates (n, KEPT + 1), whose last number is 1 where the heading is known, and innovations
        (m, blocks, REPORTED).
    """
    status = kf.status
    first, copies, estimates, innovations = run_while_unknown(kf, writer, tape)
    if first < len(tape.operations):
        slots = np.zeros((tape.slots, kf._engine.words[0].size), np.uint64)
        for slot, (words, _) in ((slots[k], copy) for k, copy in copies.items()):
            slot.reshape(-1, WIDTH)[:] = words[0]
        rest = tape.after(first)
        kept, reported = (rows[0, ..., 0] for rows in kf._engine.run(rest, slots))
        kept = np.column_stack([kept, np.ones(len(kept))])
        kept[: len(estimates)] = np.reshape(estimates, (-1, KEPT + 1))
        if innovations:
            reported[: len(innovations)] = innovations
    else:
        kept, reported = np.array(estimates).reshape(-1, KEPT + 1), np.array(innovations)
    kf.warn_of_news(status)
    return kept, reported


def run_while_unknown(
    kf: KalmanFilter, writer: TapeWriter, tape: Tape
) -> tuple[int, dict[int, Any], list[Floats], list[Floats]]:
    """Run a tape until the heading is known, also in all copies that may be restored.

    Returns:
        Number of operations that were run, the copies, estimates and innovations.
    """
    copies: dict[int, Any] = {}
    estimates: list[Floats] = []
    innovations: list[Floats] = []
    for k, (code, index, target) in enumerate(tape.operations.tolist()):
        if kf.heading_known and all(weights is None for _, weights in copies.values()):
            return k, copies, estimates, innovations
        match code:
            case Operation.PREDICT:
                kf._apply(writer.samples[index])
            case Operation.UPDATE:
                measurement = writer.measurements[index]
                kf._apply(measurement)
                if target >= 0:
                    innovations.append(_innovations(kf, measurement))
            case Operation.COPY:
                copies[target] = kf._copy()
            case Operation.RESTORE:
                kf._restore(copies[target])
            case Operation.KEEP:
                estimates.append(_estimate(kf))
    return len(tape.operations), copies, estimates, innovations


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

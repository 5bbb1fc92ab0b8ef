"""Results of a replay from the pieces of its tape: estimates, and innovations by measurement."""

import bisect
import math
from collections.abc import Iterable
from typing import Any

import numpy as np

from quad_gym.estimation.filtering.running import Results
from quad_gym.estimation.logs import Floats
from quad_gym.estimation.replaying.results import Measured
from quad_gym.records import AID_BLOCK, AID_BLOCKS, AID_MOST, FEATURE_BLOCKS, FREEDOMS, Aid
from quad_gym.rotations import dcm_to_quaternion


def collected(
    pieces: Iterable[Results], blocks: Iterable[int], count: int, stamps: Floats
) -> tuple[dict[str, Any], dict[int, Measured]]:
    """Return columns of `Replay` by name, and innovations by block.

    Args:
        pieces: Results of all pieces of a tape.
        blocks: Blocks of innovations, in the order of the results.
        count: Number of estimates.
        stamps: Times of measurement and arrival (m, 2) of the updates.
    """
    columns: dict[str, Any] = {}
    rows: dict[int, list[Floats]] = {block: [] for block in blocks}
    first = updates = 0
    for kept, reported, valid in pieces:
        for name, values in _columns_of(kept).items():
            if name not in columns:
                columns[name] = np.empty((count, *values.shape[1:]), values.dtype)
            columns[name][first : first + len(kept)] = values
        first += len(kept)
        times = stamps[updates : updates + len(valid)]
        updates += len(valid)
        for row, (block, found) in enumerate(rows.items()):
            have = valid[:, block]
            if have.any():
                found.append(np.column_stack([times[have], reported[have, row]]))
    measured = {
        block: _measured(np.concatenate(found), FREEDOMS[block])
        for block, found in rows.items()
        if found
    }
    return columns, measured


def _columns_of(kept: Floats) -> dict[str, Any]:
    """Return fields of `Replay` from stored estimates."""
    r, v, R, b_a, b_g, variances, state = np.split(kept, np.cumsum((3, 3, 9, 3, 3, 15)), 1)
    return {
        "position": r,
        "velocity": v,
        "quaternion": dcm_to_quaternion(R.reshape(-1, 3, 3)),
        "accel_bias": b_a,
        "gyro_bias": b_g,
        "sigma": np.sqrt(variances),
        "heading_known": state[:, 1] > 0.0,
        "diverged": state[:, 0] > 0.0,
    }


def _measured(table: Floats, d: int) -> Measured:
    """Return innovations from rows of two times and REPORTED numbers."""
    values = table[:, 2:]
    if d == 2 and (values[:, 4] > math.pi).all():
        d = 1  # headings alone: nothing was measured upward
    return Measured(
        *(table[:, 0], table[:, 1], values[:, :d], values[:, 3 : 3 + d]),
        *(values[:, 6], values[:, 7]),
    )


def name_of(block: int) -> str:
    """Return the name of a block of innovations."""
    if block < FEATURE_BLOCKS:
        return ("gnss_position", "gnss_baseline", "gnss_velocity")[block]
    if block >= AID_BLOCKS:
        aid = Aid(bisect.bisect(AID_BLOCK, block) - 1)
        number = f"_{block - AID_BLOCK[aid]}" if AID_MOST[aid] > 1 else ""
        return f"{aid.name.lower()}{number}"
    return f"feature_{block - FEATURE_BLOCKS}"

"""Trajectories as the records that kernels look up."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from quad_gym.params.trajectories import Trajectory
from quad_gym.records import (
    HEADING_GIVEN,
    HEADING_TOWARD,
    HEADING_VELOCITY,
    PATH,
    PIECE,
    aligned_zeros,
)

_RULES = {"given": HEADING_GIVEN, "along": HEADING_VELOCITY, "toward": HEADING_TOWARD}


def pack_paths(trajectories: Sequence[Trajectory]) -> tuple[NDArray[Any], NDArray[Any]]:
    """Return the paths (n,) of PATH and all their segments (m,) of PIECE."""
    paths = aligned_zeros(len(trajectories), PATH)
    counts = [len(trajectory.times) - 1 for trajectory in trajectories]
    pieces = aligned_zeros(sum(counts), PIECE)
    first = 0
    for path, trajectory, count in zip(paths, trajectories, counts, strict=True):
        path["first"], path["pieces"] = first, count
        path["closed"], path["duration"] = trajectory.closed, trajectory.duration
        path["heading"], path["point"] = _RULES[trajectory.heading], trajectory.point
        path["begin_heading"], path["end_heading"] = trajectory.end_headings
        own = slice(first, first + count)
        pieces["begin"][own] = trajectory.times[:-1]
        pieces["terms"][own] = np.moveaxis(trajectory.coefficients, 1, 0)
        first += count
    return paths, pieces

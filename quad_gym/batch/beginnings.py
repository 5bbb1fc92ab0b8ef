"""Distances of given starts from the positions at which a reference may begin."""

import numpy as np
from numpy.typing import NDArray

from quad_gym.kernels.task.heights import GATE_SPREAD, LOWEST_GATE
from quad_gym.params.task import TaskParams
from quad_gym.params.trajectories import Trajectory

Floats = NDArray[np.float64]


def check_in_bounds(task: TaskParams, places: Floats) -> None:
    """Refuse starts (n, 3) in I [m] with which an episode would end in its first step."""
    distance = distance_from_reference(task, places)
    worst = int(distance.argmax())
    if distance[worst] > task.out_of_bounds:
        raise ValueError(
            f"position must be within out_of_bounds={task.out_of_bounds:g} m of the reference, got "
            f"{places[worst]}, {distance[worst]:g} m from where that begins"
        )


def distance_from_reference(task: TaskParams, places: Floats) -> Floats:
    """Return distances (n,) of positions (n, 3) in I from the nearest beginning of a reference."""
    radius, height = task.radius, task.height
    if task.kind == "trajectory":
        each = [_from_trajectory(path, task, places) for path in task.trajectories]
        return np.min(each, axis=0)
    if task.kind == "random_trajectory":
        return np.maximum(np.linalg.norm(places - (0.0, 0.0, height), axis=1) - radius, 0.0)
    if task.kind == "waypoints":
        gates = LOWEST_GATE * height, (LOWEST_GATE + GATE_SPREAD) * height
        return _from_ring(places, (0.4 * radius, radius), gates)
    if task.kind == "lemniscate":
        return np.linalg.norm(places - (0.0, 0.0, height), axis=1)
    if task.randomize_reference:
        return _from_ring(places, (0.5 * radius, 1.25 * radius), (height, height))
    return np.linalg.norm(places - (radius, 0.0, height), axis=1)


def _from_ring(places: Floats, radii: tuple[float, float], heights: tuple[float, float]) -> Floats:
    """Return distances (n,) from the region between two radii and two heights."""
    level, z = np.hypot(places[:, 0], places[:, 1]), places[:, 2]
    aside = np.maximum(np.maximum(radii[0] - level, level - radii[1]), 0.0)
    return np.hypot(aside, np.maximum(np.maximum(heights[0] - z, z - heights[1]), 0.0))


def _from_trajectory(path: Trajectory, task: TaskParams, places: Floats) -> Floats:
    """Return distances (n,) from the beginnings of a trajectory, at any drawn heading."""
    if not task.randomize_reference:
        return np.linalg.norm(places - path(0.0), axis=1)
    points = path(path.instants(200)) if path.closed else path(0.0)[np.newaxis]
    level = np.hypot(points[:, 0], points[:, 1])
    rings = [_from_ring(places, (r, r), (z, z)) for r, z in zip(level, points[:, 2], strict=True)]
    return np.min(rings, axis=0)

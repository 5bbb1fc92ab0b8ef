"""Distances from obstacles and lines of sight: for starts, and for the views of tasks."""

import functools
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from quad_gym.kernels import entries
from quad_gym.packing.world import pack_obstacles
from quad_gym.params.obstacles import Obstacle
from quad_gym.params.world import WorldParams
from quad_gym.records import SETTINGS

Floats = NDArray[np.float64]


def nearest_obstacle(
    obstacles: Sequence[Obstacle], centers: Floats, points: Floats
) -> tuple[Floats, Floats]:
    """Return distances (n,) of points (n, 3) in I from the nearest obstacle's surface [m].

    They are negative inside, and infinite without obstacles. The second array (n, 3) holds vectors
    to the nearest points, in I [m]; `centers` (n, obstacles, 3) belong to the obstacles.
    """
    distances, vectors = np.full(len(points), np.inf), np.zeros((len(points), 3))
    given = (np.ascontiguousarray(array, np.float64) for array in (points, centers))
    entries.nearest_obstacles(*given, _settings(tuple(obstacles)), distances, vectors)
    return distances, vectors


def hidden_points(
    obstacles: Sequence[Obstacle], centers: Floats, eyes: Floats, points: Floats
) -> NDArray[np.bool_]:
    """Return a mask (n, m) of points (m, 3) or (n, m, 3) behind an obstacle, seen from eyes (n, 3).

    All are in I [m], as are the centers (n, obstacles, 3) of the obstacles.
    """
    each = np.broadcast_to(points, (len(eyes), *points.shape[-2:]))
    hidden = np.zeros(each.shape[:2], bool)
    given = (np.ascontiguousarray(array, np.float64) for array in (eyes, each, centers))
    entries.hide_points(*given, _settings(tuple(obstacles)), hidden)
    return hidden


@functools.lru_cache(maxsize=64)
def _settings(obstacles: tuple[Obstacle, ...]) -> NDArray[Any]:
    """Return settings with the shapes of obstacles, shape (1,)."""
    settings = np.zeros(1, SETTINGS)
    pack_obstacles(settings[0], obstacles)
    return settings


def require_room(name: str, points: Floats, world: WorldParams) -> None:
    """Refuse places (n, 3) that an obstacle may reach by its shift, or beyond the geofence."""
    reach: list[Floats] = []
    for k, obstacle in enumerate(world.obstacles):
        shared = 0.0 if obstacle.follows is None else reach[obstacle.follows]
        reach.append(np.array(obstacle.shift_I) + shared)
        gap = points - np.array(obstacle.center_I)
        aslant = min(abs(part) for part in obstacle.axis) > 1e-9
        if not aslant:  # the shift that comes nearest is the one that does along each axis
            gap = np.sign(gap) * np.maximum(np.abs(gap) - reach[k], 0.0)
        distance, _ = nearest_obstacle([obstacle], np.zeros((len(points), 1, 3)), gap)
        if aslant:  # at most so much nearer
            distance = distance - float(np.linalg.norm(reach[k]))
        close = np.flatnonzero(distance <= world.vehicle_radius)
        if close.size:
            shifted = ", shifted as it may be," if reach[k].any() else ""
            raise ValueError(
                f"{name} must be farther than vehicle_radius={world.vehicle_radius:g} m from all "
                f"obstacles, got {points[close[0]]}, which obstacle {k}{shifted} comes as near as "
                f"{max(float(distance[close[0]]), 0.0):.3g} m to"
            )
    if world.geofence is not None:
        low, high = world.geofence
        beyond = np.flatnonzero(((points < low) | (points > high)).any(axis=1))
        if beyond.size:
            raise ValueError(
                f"{name} must be within the geofence {world.geofence}, got {points[beyond[0]]}"
            )

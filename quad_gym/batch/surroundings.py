"""Distances from obstacles and lines of sight, in NumPy: for starts, views of tasks and records.

The kernels in `quad_gym.kernels.obstacles.shapes` compute the same for places of flights.
"""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from quad_gym.kernels.obstacles.shapes import AT_THE_END
from quad_gym.params.obstacles import Obstacle
from quad_gym.params.world import WorldParams
from quad_gym.records import Shape

Floats = NDArray[np.float64]


def _turned(obstacle: Obstacle, vectors: Floats) -> Floats:
    """(..., 3) vectors of I in the axes of an obstacle."""
    c, s = obstacle.axis
    x, y, z = (vectors[..., i] for i in range(3))
    return np.stack([c * x + s * y, c * y - s * x, z], axis=-1)


def _turned_back(obstacle: Obstacle, vectors: Floats) -> Floats:
    """(..., 3) vectors in the axes of an obstacle in I."""
    c, s = obstacle.axis
    x, y, z = (vectors[..., i] for i in range(3))
    return np.stack([c * x - s * y, s * x + c * y, z], axis=-1)


def _length(vectors: Floats) -> Floats:
    """(...,) lengths, summed in a fixed order."""
    x, y, z = (vectors[..., i] for i in range(3))
    return np.sqrt(x * x + y * y + z * z)


def _depths(obstacle: Obstacle, p: Floats) -> tuple[Floats, Floats]:
    """Return distances beyond each face, (n, 2 or 3), and outward directions, (n, 2 or 3, 3)."""
    signs, half = np.where(p < 0.0, -1.0, 1.0), np.array(obstacle.half_size)
    if obstacle.shape == Shape.WALL:
        return np.abs(p) - half, signs[:, :, np.newaxis] * np.eye(3)
    rho = np.sqrt(p[:, 0] * p[:, 0] + p[:, 1] * p[:, 1])
    aside = rho > 1e-12
    outward = np.zeros((len(p), 2, 3))
    outward[:, 0, :2] = np.where(aside[:, None], p[:, :2] / np.where(aside, rho, 1.0)[:, None], 0.0)
    outward[~aside, 0, 0] = 1.0
    outward[:, 1, 2] = signs[:, 2]
    return np.stack([rho - half[0], np.abs(p[:, 2]) - half[2]], axis=1), outward


def nearest_obstacle(
    obstacles: Sequence[Obstacle], centers: Floats, points: Floats
) -> tuple[Floats, Floats]:
    """Return distances (n,) of points (n, 3) in I from the nearest obstacle's surface [m].

    They are negative inside. The second array (n, 3) holds vectors to the nearest points, in I [m].
    `centers` (n, obstacles, 3) are those of at least one obstacle, in I [m].
    """
    best, found = np.full(len(points), np.inf), np.zeros((len(points), 3))
    for k, obstacle in enumerate(obstacles):
        p = _turned(obstacle, points - centers[:, k])
        depths, outward = _depths(obstacle, p)
        beyond = np.maximum(depths, 0.0)[:, :, np.newaxis] * outward
        out = np.zeros_like(p)
        for i in range(beyond.shape[1]):
            out -= beyond[:, i]
        deepest = depths.argmax(axis=1)
        every = np.arange(len(points))
        depth = depths[every, deepest]
        inside = -depth[:, np.newaxis] * outward[every, deepest]
        is_outside = depth > 0.0
        distance = np.where(is_outside, _length(out), depth)
        vector = _turned_back(obstacle, np.where(is_outside[:, np.newaxis], out, inside))
        closer = distance < best
        best = np.where(closer, distance, best)
        found = np.where(closer[:, np.newaxis], vector, found)
    return best, found


def hidden_points(
    obstacles: Sequence[Obstacle], centers: Floats, eyes: Floats, points: Floats
) -> NDArray[np.bool_]:
    """Return a mask (n, m) of points (m, 3) or (n, m, 3) behind an obstacle, seen from eyes (n, 3).

    All are in I [m], as are the centers (n, obstacles, 3) of the obstacles.
    """
    along_I = points - eyes[:, np.newaxis]
    end = 1.0 - AT_THE_END / np.maximum(_length(along_I), AT_THE_END)
    hidden = np.zeros(along_I.shape[:2], bool)
    for k, obstacle in enumerate(obstacles):
        start = _turned(obstacle, eyes - centers[:, k])[:, np.newaxis]
        along, half = _turned(obstacle, along_I), obstacle.half_size
        enters, leaves = _slab(start[..., 2], along[..., 2], half[2])
        if obstacle.shape == Shape.CYLINDER:
            spans = [_disc(start, along, half[0])]
        else:
            spans = [_slab(start[..., i], along[..., i], half[i]) for i in range(2)]
        for into, out in spans:
            enters, leaves = np.maximum(enters, into), np.minimum(leaves, out)
        hidden |= np.maximum(enters, 0.0) < np.minimum(leaves, end)
    return hidden


def _slab(start: Floats, along: Floats, half: float) -> tuple[Floats, Floats]:
    """Return the fractions of lines at which they enter and leave [-half, half]."""
    across, within = np.abs(along) > 1e-12, np.abs(start) < half
    per = np.where(across, along, 1.0)
    a, b = (-half - start) / per, (half - start) / per
    far = np.where(within, np.inf, -np.inf)
    return np.where(across, np.minimum(a, b), -far), np.where(across, np.maximum(a, b), far)


def _disc(start: Floats, along: Floats, radius: float) -> tuple[Floats, Floats]:
    """Return the fractions of lines at which they enter and leave a vertical infinite cylinder."""
    x, y, u, v = start[..., 0], start[..., 1], along[..., 0], along[..., 1]
    a, b, c = u * u + v * v, x * u + y * v, x * x + y * y - radius * radius
    across, root = a > 1e-24, b * b - a * c
    meets, per = root > 0.0, np.where(across, a, 1.0)
    reach, middle = np.sqrt(np.maximum(root, 0.0)) / per, -b / per
    far = np.where(np.where(across, meets, c < 0.0), np.inf, -np.inf)
    here = across & meets
    return np.where(here, middle - reach, -far), np.where(here, middle + reach, far)


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

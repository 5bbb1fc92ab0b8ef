"""Obstacles as polygons: visible faces of walls and cylinders, in NumPy."""

import numpy as np
from numpy.typing import NDArray

from quad_gym.records import Shape

Floats = NDArray[np.float64]

SIDES = 20  #: of the prism that represents a cylinder


def faces_of(obstacle: Floats, eye: Floats) -> list[Floats]:
    """Polygons (corners, 3) of a row of `FlightScene.obstacles` turned to the eye, in I [m].

    All faces are returned if the eye is inside.
    """
    shape, center, half, (c, s) = obstacle[0], obstacle[1:4], obstacle[4:7], obstacle[7:]
    if shape == Shape.CYLINDER:
        angle = np.linspace(0.0, 2.0 * np.pi, SIDES, endpoint=False)
        level = half[0] * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    else:
        level = half[:2] * np.array([[1.0, 1.0], [-1.0, 1.0], [-1.0, -1.0], [1.0, -1.0]])
        level = level @ np.array([[c, s], [-s, c]])
    low, high = (
        np.column_stack([center[:2] + level, np.full(len(level), center[2] + sign * half[2])])
        for sign in (-1.0, 1.0)
    )
    sides = [
        np.stack([low[k], low[j], high[j], high[k]])
        for k, j in zip(range(len(low)), np.roll(range(len(low)), -1), strict=True)
    ]
    faces = [*sides, low, high]
    seen = [face for face in faces if _faces(face, center, eye)]
    return seen or faces


def _faces(face: Floats, center: Floats, eye: Floats) -> bool:
    """True if a face of a convex body is turned to the eye."""
    normal = np.cross(face[1] - face[0], face[2] - face[1])
    outward = normal * np.sign(normal @ (face.mean(axis=0) - center))
    return bool(outward @ (eye - face[0]) > 0.0)

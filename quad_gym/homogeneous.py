"""Points and lines of the image plane in homogeneous coordinates (report section 2.2).

A point (x, y) is any [k x, k y, k] with k not 0; a line a x + b y + c = 0 is [a, b, c]. The point
where two lines meet is their cross product, and so is the line through two points.
"""

import numpy as np
from numpy.typing import ArrayLike, NDArray

from quad_gym import validation as check


def to_homogeneous(point: ArrayLike) -> NDArray[np.float64]:
    """(3,) homogeneous coordinates of a point (2,)."""
    return np.append(check.array("point", point, (2,)), 1.0)


def from_homogeneous(point: ArrayLike) -> NDArray[np.float64]:
    """(2,) the point of homogeneous coordinates (3,).

    Raises:
        ValueError: If the point lies at infinity, as the intersection of parallel lines does.
    """
    coordinates = check.array("point", point, (3,))
    if abs(coordinates[2]) <= 1e-15 * abs(coordinates).max():
        raise ValueError(f"point must not lie at infinity, got {coordinates}")
    return coordinates[:2] / coordinates[2]


def intersect(line_1: ArrayLike, line_2: ArrayLike) -> NDArray[np.float64]:
    """(3,) homogeneous point where two lines (3,) meet: l_1 x l_2 (report equation 3)."""
    return np.cross(check.array("line_1", line_1, (3,)), check.array("line_2", line_2, (3,)))


def line_through(point_1: ArrayLike, point_2: ArrayLike) -> NDArray[np.float64]:
    """(3,) the line through two homogeneous points (3,): p_1 x p_2."""
    return np.cross(check.array("point_1", point_1, (3,)), check.array("point_2", point_2, (3,)))

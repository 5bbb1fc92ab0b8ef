"""What stands in a world: walls and cylinders.

They stand upright, at places in the inertial frame I (east, north, up). A vehicle that comes closer
to one than its radius has collided, and the camera sees no feature behind one.
"""

import math
from dataclasses import dataclass

from quad_gym.params import checks as check
from quad_gym.params.checks import Checked, Vector
from quad_gym.records import Shape

FARTHEST_OBSTACLE = 1e4
"""No obstacle is larger, or farther from the origin, or shifted by more [m]."""
LEAST_SIZE = 1e-3
"""Smallest length, thickness, height or radius [m]."""


@dataclass(frozen=True, kw_only=True)
class Obstacle(Checked):
    """What all obstacles have: a place, which each episode may shift."""

    center_I: Vector = (0.0, 0.0, 0.0)
    """(3,) its middle in I [m]"""
    shift_I: Vector = (0.0, 0.0, 0.0)
    """(3,) largest shift along each axis of I, either way; each episode draws one uniformly [m]"""
    follows: int | None = None
    """number of an obstacle before it in `WorldParams.obstacles` whose shift it shares, on top of
    its own, as the other side of a gap does; None: it has its own alone"""

    def __post_init__(self) -> None:
        name = type(self).__name__
        self._check(check.vector, "center_I", "shift_I", length=3)
        if min(self.shift_I) < 0.0:
            raise ValueError(f"{name}.shift_I must be at least 0, got {self.shift_I}")
        for field in ("center_I", "shift_I"):
            check.number(
                f"{name}.{field}",
                max(abs(x) for x in getattr(self, field)),
                most=FARTHEST_OBSTACLE,
            )
        if self.follows is not None:
            self._set("follows", check.whole(f"{name}.follows", self.follows, least=0))

    @property
    def half_size(self) -> Vector:
        """(3,) half length, thickness and height; of a cylinder radius, radius, half height [m]."""
        raise NotImplementedError

    @property
    def axis(self) -> Vector:
        """(2,) level direction of the length, east and north."""
        return (1.0, 0.0)

    @property
    def shape(self) -> Shape:
        """Which of the shapes it is."""
        raise NotImplementedError


@dataclass(frozen=True, kw_only=True)
class Wall(Obstacle):
    """An upright box: a wall, a pillar, a house."""

    size: Vector = (4.0, 0.2, 3.0)
    """(3,) length, thickness and height [m]"""
    yaw: float = 0.0
    """of the length, from east toward north [rad]"""

    def __post_init__(self) -> None:
        super().__post_init__()
        self._check(check.vector, "size", length=3)
        for length in self.size:
            check.positive("Wall.size", length, least=LEAST_SIZE, most=FARTHEST_OBSTACLE)
        self._check(check.number, "yaw", least=-FARTHEST_OBSTACLE, most=FARTHEST_OBSTACLE)

    @property
    def half_size(self) -> Vector:
        """(3,) half length, thickness and height [m]."""
        length, thickness, height = self.size
        return (0.5 * length, 0.5 * thickness, 0.5 * height)

    @property
    def axis(self) -> Vector:
        """(2,) level direction of the length, east and north."""
        return (math.cos(self.yaw), math.sin(self.yaw))

    @property
    def shape(self) -> Shape:
        """A wall."""
        return Shape.WALL


@dataclass(frozen=True, kw_only=True)
class Cylinder(Obstacle):
    """An upright cylinder: a pillar, a tree, a mast."""

    radius: float = 0.2
    """[m]"""
    height: float = 3.0
    """[m]"""

    def __post_init__(self) -> None:
        super().__post_init__()
        self._check(check.positive, "radius", "height", least=LEAST_SIZE, most=FARTHEST_OBSTACLE)

    @property
    def half_size(self) -> Vector:
        """(3,) radius, radius and half height [m]."""
        return (self.radius, self.radius, 0.5 * self.height)

    @property
    def shape(self) -> Shape:
        """A cylinder."""
        return Shape.CYLINDER


def check_obstacles(name: str, obstacles: tuple[Obstacle, ...]) -> None:
    """Refuse what are no obstacles, and those that follow a later one.

    Args:
        name: What they are called in messages.
        obstacles: All of a world's.

    Raises:
        ValueError: If there are such.
    """
    for k, obstacle in enumerate(obstacles):
        if not isinstance(obstacle, Wall | Cylinder):
            raise ValueError(f"{name} must hold Wall and Cylinder, got {obstacle!r}")
        if obstacle.follows is not None and obstacle.follows >= k:
            raise ValueError(
                f"{name}[{k}].follows must be the number of one before it, less than {k}, got "
                f"{obstacle.follows}"
            )

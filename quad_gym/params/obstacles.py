"""Obstacles of a world: walls and cylinders.

They are upright, at places in the inertial frame I (east, north, up). A vehicle that comes closer
to one than its radius collides with it, and the camera cannot see features behind one.
"""

from functools import partial
from typing import Annotated, ClassVar

from quad_gym.params import checks as check
from quad_gym.params import portable
from quad_gym.params.checked import Checked
from quad_gym.params.checks import Vector
from quad_gym.records import Shape

FARTHEST_OBSTACLE = 1e4
"""Largest size of an obstacle, distance of its center from the origin, and shift [m]."""
MIN_SIZE = 1e-3  #: smallest length, thickness, height or radius [m]

Size = Annotated[float, partial(check.positive, least=MIN_SIZE, most=FARTHEST_OBSTACLE)]


class Obstacle(Checked):
    """Base of all obstacles: a place, which can be shifted at random in each episode."""

    center_I: check.Vector3 = (0.0, 0.0, 0.0)
    """(3,) center of the obstacle in I [m]"""
    shift_I: check.NonNegative3 = (0.0, 0.0, 0.0)
    """(3,) largest shift along each axis of I, in either direction [m]; each episode draws a shift
    uniformly"""
    follows: Annotated[int, partial(check.whole, least=0)] | None = None
    """index of an earlier obstacle in `WorldParams.obstacles` whose shift is added to this
    obstacle's own shift, as for the two sides of a gap; None: its own shift only"""

    shape: ClassVar[Shape]

    def __post_init__(self) -> None:
        super().__post_init__()
        for field in ("center_I", "shift_I"):
            farthest = max(abs(x) for x in getattr(self, field))
            check.number(f"{type(self).__name__}.{field}", farthest, most=FARTHEST_OBSTACLE)

    @property
    def half_size(self) -> Vector:
        """Half sizes (3,): length, thickness, height; of a cylinder radius, radius, height [m]."""
        raise NotImplementedError

    @property
    def axis(self) -> Vector:
        """Horizontal direction (2,) of the length, east and north [-]."""
        return (1.0, 0.0)


class Wall(Obstacle):
    """An upright box: a wall, a pillar, a house."""

    size: check.Vector3 = (4.0, 0.2, 3.0)
    """(3,) length, thickness and height [m]"""
    yaw: Annotated[float, check.between(-FARTHEST_OBSTACLE, FARTHEST_OBSTACLE)] = 0.0
    """direction of the length, from east toward north [rad]"""

    shape = Shape.WALL

    def __post_init__(self) -> None:
        super().__post_init__()
        for length in self.size:
            check.positive("Wall.size", length, least=MIN_SIZE, most=FARTHEST_OBSTACLE)

    @property
    def half_size(self) -> Vector:
        """Half length, half thickness and half height (3,) [m]."""
        length, thickness, height = self.size
        return (0.5 * length, 0.5 * thickness, 0.5 * height)

    @property
    def axis(self) -> Vector:
        """Horizontal direction (2,) of the length, east and north [-]."""
        return (portable.cos(self.yaw), portable.sin(self.yaw))


class Cylinder(Obstacle):
    """An upright cylinder: a pillar, a tree, a mast."""

    radius: Size = 0.2
    """radius of the cylinder [m]"""
    height: Size = 3.0
    """height of the cylinder [m]"""

    shape = Shape.CYLINDER

    @property
    def half_size(self) -> Vector:
        """Radius, radius and half height (3,) [m]."""
        return (self.radius, self.radius, 0.5 * self.height)


def check_obstacles(name: str, obstacles: tuple[Obstacle, ...]) -> None:
    """Refuse anything that is not an obstacle, and obstacles that follow a later one."""
    for k, obstacle in enumerate(obstacles):
        if not isinstance(obstacle, Wall | Cylinder):
            raise ValueError(f"{name} must contain Wall and Cylinder, got {obstacle!r}")
        if obstacle.follows is not None and obstacle.follows >= k:
            raise ValueError(
                f"{name}[{k}].follows must be the index of an earlier obstacle, less than {k}, got "
                f"{obstacle.follows}"
            )

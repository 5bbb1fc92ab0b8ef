"""The world around a vehicle: air, ground, battery and obstacles.

As in `params`: frozen, keyword-only, SI units, the source with every number. By default the air is
still, the ground far away and the battery always full, and there are no obstacles, as in the
laboratory's model.
"""

import math
from functools import partial
from pathlib import Path
from typing import Annotated, Any, ClassVar

import numpy as np

from quad_gym.params import checks as check
from quad_gym.params import portable
from quad_gym.params.checks import Checked, Matrix, Vector
from quad_gym.params.files import Saved, is_params_file, read_params
from quad_gym.params.vehicle import VehicleParams
from quad_gym.records import MAX_OBSTACLES, Shape

# --------------------------------------------------------------------------------------------------
# The ground that supports vehicles: feet, friction, and limits of a safe touchdown.
# --------------------------------------------------------------------------------------------------

FARTHEST_FOOT = 10.0  #: largest distance of a foot from the center of mass [m]
GROUND_HEIGHT = -0.1
"""Height of the ground in I [m]: a vehicle that stands on the laboratory's legs is at height 0."""


class GroundParams(Checked):
    """A level plane at `WorldParams.ground_height` that supports a vehicle anywhere.

    Four feet and the four rotor hubs can touch it. Contact is a constraint on velocities that is
    solved once per tick: the plane stops points that would move below it and pushes but never
    pulls; impacts are inelastic, and friction is Coulomb friction. After the tick of an impact,
    points of a tumbling vehicle may be 15 mm below the plane, and with a friction of 5, 5 cm. The
    contact has no stiffness, so every step size is stable (J. J. Moreau, "Unilateral contact
    and dry friction in finite freedom dynamics", 1988; D. E. Stewart, J. C. Trinkle, "An implicit
    time-stepping scheme for rigid body dynamics with inelastic collisions and Coulomb friction",
    Int. J. Numerical Methods in Engineering 39, 1996).
    """

    feet_B: check.Matrix43 = (
        (0.15, -0.15, -0.1),
        (0.15, 0.15, -0.1),
        (-0.15, 0.15, -0.1),
        (-0.15, -0.15, -0.1),
    )
    """(4, 3) positions of the soles of the feet relative to the center of mass, in B [m], in a
    level plane below all rotor hubs; default: legs of 0.1 m under the laboratory vehicle's arms"""
    friction: Annotated[float, check.between(0.0, 100.0)] = 0.6
    """Coulomb friction coefficient, for sticking and sliding; rubber on concrete has 0.6 to 0.85;
    0: no friction"""
    max_touchdown_speed: Annotated[float, partial(check.positive, least=0.2)] = 1.5
    """speed of the center of mass toward the ground above which a touchdown is a crash [m/s]; a
    free fall from 0.11 m ends at the default"""
    max_touchdown_tilt: check.AngleSize = math.radians(30.0)
    """angle between the body z axis and the vertical above which touching the ground is a crash
    [rad]; touching it with a rotor always is"""

    def __post_init__(self) -> None:
        super().__post_init__()
        feet = np.array(self.feet_B)
        if np.abs(feet).max() > FARTHEST_FOOT:
            self._refuse("feet_B", f"be within {FARTHEST_FOOT:g} m")
        if np.linalg.svd(feet[:, :2] - feet[:, :2].mean(axis=0))[1][1] < 1e-3 or not (
            np.ptp(feet[:, 2]) <= 1e-9 and feet[0, 2] < 0.0
        ):
            must = "be four points of a level plane below the center of mass, not all on one line"
            self._refuse("feet_B", must)


# --------------------------------------------------------------------------------------------------
# Obstacles of a world: walls and cylinders.
#
# They are upright, at places in the inertial frame I (east, north, up). A vehicle that comes closer
# to one than its radius collides with it, and the camera cannot see features behind one.
# --------------------------------------------------------------------------------------------------

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
    yaw: check.Angle = 0.0
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


# --------------------------------------------------------------------------------------------------
# The world around a vehicle: air, ground, battery and obstacles.
# --------------------------------------------------------------------------------------------------

MAX_WIND = 200.0  #: largest wind speed [m/s]; the strongest tornadoes reach some 135 m/s


class BatteryParams(Checked):
    """A battery whose voltage falls with the energy drawn so far and with the present power.

    With the charge s in [0, 1], `s' = -P / energy` and `P = sum(kN W_i^3) / motor_efficiency`; the
    open-circuit voltage is `U0 = max_voltage (empty_voltage + (1 - empty_voltage) s)`, and the
    motors get at most U with `U = U0 - resistance P / U`. The battery delivers at most
    `U0^2 / (4 resistance)`, at U = U0 / 2. The rotors take `P = V I` at the voltage
    `V = W / motor_speed_per_volt` of steady speeds, and the motors get at most the V at which V I
    is the largest power of the battery: rotors that would take more slow down to that power. At
    s = 0 the battery cuts off. A resistance with which the power for hovering cannot be delivered
    is refused.
    """

    energy: check.Positive = 88e3
    """energy of a full battery [J]; three lithium-polymer cells of 2.2 A h: 3 x 3.7 V x 2.2 A h"""
    charge: check.UpToOne = 1.0
    """charge at the start of an episode as a fraction of a full battery, in (0, 1]"""
    empty_voltage: check.UpToOne = 0.83
    """open-circuit voltage of an empty battery divided by the voltage of a full one; 3.5 V / 4.2 V
    per cell"""
    resistance: check.NonNegative = 0.03
    """internal resistance of the battery and its leads [ohm]; some 10 milliohm per cell"""
    motor_efficiency: check.UpToOne = 0.75
    """mechanical power of the rotors divided by electrical power; typical of small brushless
    motors"""


class WorldParams(Checked, Saved):
    """Wind, drag, ground, battery and obstacles.

    Drag of the disc and of the rotors depends on the velocity of the vehicle relative to the air.
    The filter models the height of the ground; filter and controller model nothing else of it.
    """

    wind_I: check.Vector3 = (0.0, 0.0, 0.0)
    """(3,) steady wind, the velocity of the air east, north, up in I [m/s]"""
    gust_wind_speed: Annotated[float, check.between(0.0, MAX_WIND)] = 0.0
    """W20, the wind speed at 20 feet above ground, which sets the intensity of the Dryden gusts
    [m/s]; 0: no gusts. MIL-F-8785C, 3.7.3.4: 7.7 is light, 15.4 moderate, 23.2 severe turbulence"""
    linear_drag_B: check.NonNegative3 = (0.0, 0.0, 0.0)
    """(3,) drag force along each body axis per air velocity along that axis, opposing it [N s/m];
    M. Faessler, A. Franchi, D. Scaramuzza, "Differential flatness of quadrotor dynamics subject to
    rotor drag", RA-L 2018: mass times (0.544, 0.386, 0) 1/s for their vehicle"""
    rotor_drag_B: check.NonNegative3 = (0.0, 0.0, 0.0)
    """(3,) drag force along each body axis per air velocity along that axis and per rad/s of the
    sum of the rotor speeds, opposing the velocity [N s/m per rad/s]; J. Svacha, K. Mohta, V. Kumar,
    "Improving quadrotor trajectory tracking by compensating for aerodynamic effects", ICUAS 2017"""
    ground_effect: bool = False
    """True: thrust increases near the ground, by 1 / (1 - (radius / (4 z))^2) for a rotor at the
    height z; I. C. Cheeseman, W. E. Bennett, "The effect of the ground on a helicopter rotor in
    forward flight", ARC R&M 3021, 1955. Heights below half a radius count as half a radius, so
    thrust increases by at most a third; for a tilted vehicle the increase is multiplied by the
    cosine of the tilt"""
    rotor_radius: check.Positive = 0.127
    """radius of the rotors, for the ground effect [m]; ten-inch propellers"""
    ground_height: float = GROUND_HEIGHT
    """height of the ground in I, for contact, ground effect, gusts, optical flow and range finder
    [m]; the center of mass of a vehicle that stands on its legs is at height 0"""
    ground: GroundParams | None = None
    """ground contact: a plane at `ground_height` that supports a vehicle anywhere, with a crash if
    the vehicle touches down too fast or too tilted; None: only a launch pad supports vehicles, at
    the start"""
    battery: BatteryParams | None = None
    """battery of the vehicle; None: always full voltage"""
    obstacles: tuple[Obstacle, ...] = ()
    """walls and cylinders, at most MAX_OBSTACLES of them: touching one is a collision and ends the
    episode, and the camera sees nothing behind one"""
    vehicle_radius: Annotated[float, partial(check.positive, most=100.0)] = 0.42
    """distance between center of mass and obstacle below which the vehicle touches the obstacle
    [m]; the laboratory's rotor hubs are 0.30 m from the center of mass, and its propellers reach
    0.13 m beyond"""
    geofence: Annotated[Matrix, partial(check.matrix, rows=2, columns=3)] | None = None
    """(2, 3) lowest and highest corner in I of a box [m]; an episode ends when the center of mass
    leaves the box; None: no geofence"""

    def __post_init__(self) -> None:
        super().__post_init__()
        if np.linalg.norm(self.wind_I) > MAX_WIND:
            self._refuse("wind_I", f"be at most {MAX_WIND:g} m/s")
        if not isinstance(self.obstacles, (tuple, list)):
            self._refuse("obstacles", "be a tuple of Wall and Cylinder", repr(self.obstacles))
        self._set("obstacles", tuple(self.obstacles))
        check_obstacles("WorldParams.obstacles", self.obstacles)
        if len(self.obstacles) > MAX_OBSTACLES:
            self._refuse("obstacles", f"be at most {MAX_OBSTACLES}", len(self.obstacles))
        if not all(low < high for low, high in zip(*(self.geofence or ()), strict=True)):
            self._refuse("geofence", "be a lower and an upper corner")


def _slalom(first: float = 48.0, spacing: float = 12.0, gaps: int = 10) -> tuple[Wall, ...]:
    """Walls from the north and from the south, each pair with a gap of 3 to 6 m.

    The northern edge of a gap is drawn within 1.5 m of its middle place, and its width by itself;
    gaps are alternately to the north and to the south, so that none leads straight to the next.
    """
    walls, size = [], (0.3, 30.0, 12.0)
    for k in range(gaps):
        x, edge = first - spacing * k, (3.75 if k % 2 else 0.75)
        north, south = (x, edge + 15.0, 6.0), (x, edge - 4.5 - 15.0, 6.0)
        walls.append(Wall(center_I=north, size=size, shift_I=(0.0, 1.5, 0.0)))
        walls.append(Wall(center_I=south, size=size, shift_I=(0.0, 1.5, 0.0), follows=2 * k))
    return tuple(walls)


def _windy(speed: float) -> WorldParams:
    """Return a world with an east wind and gusts of a speed [m/s]."""
    return WorldParams(
        wind_I=(speed, 0.0, 0.0),
        gust_wind_speed=speed,
        ground_effect=True,
        battery=BatteryParams(),
    )


_WORLDS = {
    "calm": WorldParams(),
    # a gentle breeze (Beaufort 3) that an outdoor flight meets on most days
    "breeze": _windy(4.0),
    # a fresh breeze (Beaufort 5), near the limit of small vehicles
    "fresh_breeze": _windy(8.0),
    # for OutageDash: ten walls, 12 m apart, from east to west, each with a gap somewhere else
    "slalom": WorldParams(
        obstacles=_slalom(), geofence=((-200.0, -14.0, -1.0), (72.0, 14.0, 12.0))
    ),
}


def world_params(name: str | Path, vehicle: VehicleParams | None = None) -> WorldParams:
    """Return a world by its name, for a vehicle, or the world in a file.

    Except in "calm", the vehicle determines its drag, battery and size:

    - linear drag is the mass times (0.544, 0.386, 0) 1/s, Faessler et al. (see `WorldParams`); a
      Crazyflie has 0.2 1/s (J. Foerster, "System identification of the Crazyflie 2.0 nano
      quadrocopter", ETH Zurich 2015: 9.2e-7 N s/m per rad/s of its rotors' sum);
    - the battery has the laboratory's energy per mass of the vehicle, 113 kJ/kg; a Crazyflie's, of
      one cell with 0.25 A h and 3.7 V, has 116. Its resistance lowers the voltage by the same
      share in hover, 3 %;
    - rotor and vehicle radius grow with the distance of the hubs from the center of mass; a
      Crazyflie's propellers have a radius of 23 mm and reach 69 mm, here 20 mm and 65 mm.

    Args:
        name: "calm" as in the report, "breeze", "fresh_breeze", or "slalom" with walls; or a file
            that ends with ".toml", as `WorldParams.save` writes it.
        vehicle: The true vehicle; None: the laboratory's. Environments pass theirs.

    Raises:
        ValueError: If there is no such world, or a name or value in the file is invalid.
        OSError: If the file cannot be read.
    """
    if is_params_file(name):
        return read_params(Path(name), WorldParams, lambda base: _base(base, vehicle))
    return _base(name, vehicle)


def _base(name: Any, vehicle: VehicleParams | None) -> WorldParams:
    world = _WORLDS[check.choice("world", name, tuple(_WORLDS))]
    if name == "calm":
        return world
    lab, vehicle = VehicleParams(), vehicle or VehicleParams()
    size, mass = _reach(vehicle) / _reach(lab), vehicle.mass
    world = world.replace(
        rotor_radius=size * world.rotor_radius, vehicle_radius=size * world.vehicle_radius
    )
    if world.battery is None:
        return world
    return world.replace(
        linear_drag_B=(mass * 0.544, mass * 0.386, 0.0),
        battery=world.battery.replace(
            energy=mass / lab.mass * world.battery.energy,
            resistance=_load(vehicle) / _load(lab) * world.battery.resistance,
        ),
    )


def _reach(vehicle: VehicleParams) -> float:
    """Return the mean distance of the rotor hubs from the center of mass [m]."""
    return float(np.linalg.norm(vehicle.rotor_positions_B, axis=1).mean())


def _load(vehicle: VehicleParams) -> float:
    """Return the resistance of the hovering rotors at the largest voltage [ohm]."""
    speed = vehicle.motor_speed_per_volt * vehicle.hover_voltage
    return vehicle.max_voltage**2 / (4.0 * vehicle.torque_coefficient * speed**3)

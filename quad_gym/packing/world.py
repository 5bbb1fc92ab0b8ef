"""World and randomization as numbers in the records that kernels read."""

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from quad_gym.params import portable
from quad_gym.params.obstacles import Obstacle
from quad_gym.params.randomization import FEATURE_DRAWS, DrawingTable, Randomization
from quad_gym.params.sensors import SensorSuite
from quad_gym.params.vehicle import VehicleParams
from quad_gym.params.world import WorldParams
from quad_gym.records import COLUMNS, MAX_START_VELOCITY, SETTINGS, Start, Supply

FALLEN_THROUGH = 0.5  #: depth below ground that supports vehicles at which an episode ends [m]


def pack_options(
    s: Any, world: WorldParams, draws: DrawingTable, *, known: bool, limited: bool
) -> None:
    """Write the options of a world and its draws."""

    def present(name: str, *values: float) -> bool:
        return any(values) or bool(draws.kind[COLUMNS[name]].any())

    winds = [present(f"wind_{part}") for part in ("east", "north", "up", "speed", "direction")]
    s["gusts"] = present("gust_wind_speed", world.gust_wind_speed)
    drags = (present(name, *getattr(world, name)) for name in ("linear_drag_B", "rotor_drag_B"))
    s["linear_drag"], s["ground_effect"] = any(drags), world.ground_effect
    s["air"] = any(world.wind_I) or any(winds)
    s["air"] |= s["gusts"] | s["linear_drag"] | s["ground_effect"]
    s["supply"] = Supply.LIMIT if limited or present("max_voltage") else Supply.NOMINAL
    if world.battery is not None:
        s["supply"] = Supply.BATTERY
    s["observe_world"] = s["privileged"] and (world != WorldParams() or bool(draws.names))
    pack_start(s, draws)
    s["randomized"], s["known"] = bool(draws.names), known
    _pack_limits(s, world)
    for name in ("kind", "a", "b", "c", "d", "low", "high", "center", "spread"):
        s[f"draw_{name}"] = np.asarray(getattr(draws, name))


def pack_start(s: Any, draws: DrawingTable) -> None:
    """Write the variance of velocity and tilt at the start; the field `start` is already set."""
    if s["start"] == Start.MOVING:  # uniform on [-most, most]
        s["start_velocity_variance"] = MAX_START_VELOCITY**2 / 3.0
    if "start_velocity_I" in draws.names:
        s["start_velocity_variance"] += draws.mean_square("start_velocity_I")
    for i, name in enumerate(("start_roll", "start_pitch")):
        if name in draws.names:
            # no angle is more uncertain than one uniform on the circle
            s["start_tilt_variance"][i] = min(draws.mean_square(name)[0], math.pi**2 / 3.0)


def pack_places(
    s: Any, draws: DrawingTable, true_sensors: SensorSuite, sensors: SensorSuite
) -> None:
    """Write whether features are drawn, and their positions without draws, after `pack_options`."""
    s["features_drawn"] = bool(set(FEATURE_DRAWS) & set(draws.names))
    if s["features_drawn"]:
        believed = true_sensors if s["known"] else sensors
        for k, suite in enumerate((true_sensors, believed)):
            assert suite.camera is not None
            s["feature_places"][k, : len(suite.camera.features_I)] = suite.camera.features_I


def pack_obstacles(s: Any, obstacles: Sequence[Obstacle]) -> None:
    """Write obstacles into a settings record."""
    s["obstacle_count"] = len(obstacles)
    for k, obstacle in enumerate(obstacles):
        s["obstacle_shape"][k] = obstacle.shape
        s["obstacle_center"][k], s["obstacle_shift"][k] = obstacle.center_I, obstacle.shift_I
        s["obstacle_half"][k], s["obstacle_axis"][k] = obstacle.half_size, obstacle.axis
        s["obstacle_follows"][k] = -1 if obstacle.follows is None else obstacle.follows


def _pack_limits(s: Any, world: WorldParams) -> None:
    """Write obstacles, geofence and ground into a settings record."""
    pack_obstacles(s, world.obstacles)
    s["vehicle_radius"] = world.vehicle_radius
    if world.geofence is not None:
        s["fenced"], s["fence"] = True, world.geofence
    if world.ground is not None:
        s["grounded"], s["friction"] = True, world.ground.friction
        # ground contact ends an episode by a crash only; a vehicle far below has fallen through
        s["min_height"] = min(s["min_height"], world.ground_height - FALLEN_THROUGH)
        s["hard_speed"] = world.ground.max_touchdown_speed
        s["hard_up"] = portable.cos(world.ground.max_touchdown_tilt)
    s["contacts"] = bool(world.obstacles) or world.geofence is not None


def world_settings(world: WorldParams) -> NDArray[Any]:
    """Return a settings record that holds only the options of a world, shape (1,)."""
    settings = np.zeros(1, SETTINGS)
    draws = DrawingTable(Randomization({}), VehicleParams(), SensorSuite(), world)
    pack_options(settings[0], world, draws, known=False, limited=False)
    return settings

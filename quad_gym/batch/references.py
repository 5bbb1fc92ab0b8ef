"""Checks of references: a vehicle can follow them, and begin episodes at them."""

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from quad_gym.kernels.task.heights import GATE_SPREAD, LOWEST_GATE, RANDOM_RISE
from quad_gym.params.control import ActionParams
from quad_gym.params.randomization import DrawingTable
from quad_gym.params.task import TaskParams
from quad_gym.params.trajectories import Trajectory
from quad_gym.params.vehicle import VehicleParams
from quad_gym.params.world import WorldParams
from quad_gym.records import COLUMNS, Control

Floats = NDArray[np.float64]

MAX_THRUST = 2.0
"""Largest thrust-to-weight ratio that an action commands; motor voltages have no such limit."""

SHARPNESS = {"circle": 1.0, "lemniscate": 17.0 / 8.0}
"""Largest acceleration of a reference over its radius times its squared frequency, by task."""

LARGER, FASTER = 1.25, 0.8
"""Factors on radius and period of the sharpest draw, with `randomize_reference`."""


def check_reference(
    task: TaskParams, vehicle: VehicleParams, actions: ActionParams, control: Control
) -> None:
    """Refuse references that need more than the assumed vehicle or the scales of actions allow."""
    limits: dict[str, Any] = {"max_tilt": task.max_tilt}
    if control in (Control.WRENCH, Control.CTBR, Control.ATTITUDE):
        limits["max_thrust"] = min(
            MAX_THRUST * vehicle.mass * vehicle.gravity, 4.0 * vehicle.max_rotor_force
        )
    if control is Control.CTBR:
        limits["max_body_rates"] = actions.rate_scale
    elif control is Control.ATTITUDE:  # roll and pitch at full action, together
        cosine = math.cos(actions.tilt_scale)
        limits["max_tilt"] = min(task.max_tilt, math.acos(cosine * cosine))
    elif control is Control.VELOCITY:
        limits["max_speed"] = math.sqrt(3.0) * actions.velocity_scale
    for k, trajectory in enumerate(task.trajectories):
        name = "trajectory" if len(task.trajectories) == 1 else f"trajectory[{k}]"
        trajectory.check(vehicle, name=name, **limits)
    if task.kind in SHARPNESS:
        _check_period(task, vehicle, limits.get("max_thrust", 4.0 * vehicle.max_rotor_force))


def _check_period(task: TaskParams, vehicle: VehicleParams, limit: float) -> None:
    """Refuse a period whose centripetal acceleration needs more thrust than the limit [N]."""
    larger, faster = (LARGER, FASTER) if task.randomize_reference else (1.0, 1.0)
    omega = 2.0 * math.pi / (faster * task.period)
    acceleration = SHARPNESS[task.kind] * larger * task.radius * omega**2
    thrust = vehicle.mass * math.hypot(acceleration, vehicle.gravity)
    if thrust > limit:
        raise ValueError(
            f"period is infeasible for this vehicle: with radius={task.radius:g} m, "
            f"{task.period:g} s need an acceleration of {acceleration:.4g} m/s^2 and a thrust of "
            f"{thrust:.4g} N, above the limit of {limit:.4g} N"
        )


# ---- the ground ------------------------------------------------------------------------------


def check_standing(
    task: TaskParams, vehicle: VehicleParams, world: WorldParams, draws: DrawingTable
) -> None:
    """Refuse ground on which the vehicle cannot stand, or where no episode of a task can begin.

    A foot has to be below all rotor hubs, as standing on these is a crash; a start on the ground
    has to be within `TaskParams.out_of_bounds` of the reference.
    """
    if world.ground is None:
        return
    feet, hubs = (np.array(p)[:, 2] for p in (world.ground.feet_B, vehicle.rotor_positions_B))
    if feet.max() >= hubs.min():
        raise ValueError(
            "GroundParams.feet_B must be below the vehicle's lowest rotor hub, at "
            f"{hubs.min():g} m, got {feet.max():g} m"
        )
    standing = world.ground_height - world.ground.feet_B[0][2]
    column = COLUMNS["start_position_I"].stop - 1
    lower, upper = (max(float(ends[column]), 0.0) for ends in (draws.low, draws.high))
    for low, high in _reference_heights(task):
        above, below = standing + lower - high, low - (standing + upper)
        # a start in the air is near the reference, unless the ground lifts it
        distance = max(above, below) if task.may_start_on_ground else above
        if distance > task.out_of_bounds:
            begins = f"{low:g}" if low == high else f"{low:g} to {high:g}"
            raise ValueError(
                "WorldParams.ground_height must let a vehicle stand within "
                f"out_of_bounds={task.out_of_bounds:g} m of the reference, which begins at a "
                f"height of {begins} m, got {world.ground_height:g}, where it stands at "
                f"{standing:g} m"
            )


def check_pad(task: TaskParams) -> None:
    """Refuse a task whose launch pad, at height 0, is out of bounds wherever a reference begins."""
    if not task.may_start_on_ground:
        return
    distance = max(max(low, -high, 0.0) for low, high in _reference_heights(task))
    if distance > task.out_of_bounds:
        raise ValueError(
            f"out_of_bounds must be at least {distance:g} m, or start 'hover' or 'moving': with "
            f"start={task.start!r} episodes begin on the launch pad, {distance:g} m from the "
            f"reference, got out_of_bounds={task.out_of_bounds:g} m"
        )


def _reference_heights(task: TaskParams) -> list[tuple[float, float]]:
    """Return the lowest and highest start of each reference of a task [m]."""
    if task.kind == "waypoints":
        return [(LOWEST_GATE * task.height, (LOWEST_GATE + GATE_SPREAD) * task.height)]
    if task.kind == "random_trajectory":
        rise = RANDOM_RISE * task.radius
        return [(task.height - rise, task.height + rise)]
    if task.kind != "trajectory":
        return [(task.height, task.height)]
    heights = []
    for path in task.trajectories:
        anywhere = task.randomize_reference and path.closed
        z = path(path.instants(200))[:, 2] if anywhere else path(0.0)[2:3]
        heights.append((float(z.min()), float(z.max())))
    return heights


# ---- given starts ----------------------------------------------------------------------------


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
        return np.min([_from_path(path, task, places) for path in task.trajectories], axis=0)
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


def _from_path(path: Trajectory, task: TaskParams, places: Floats) -> Floats:
    """Return distances (n,) from the beginnings of a trajectory, at any drawn heading."""
    if not task.randomize_reference:
        return np.linalg.norm(places - path(0.0), axis=1)
    points = path(path.instants(200)) if path.closed else path(0.0)[np.newaxis]
    level = np.hypot(points[:, 0], points[:, 1])
    rings = [_from_ring(places, (r, r), (z, z)) for r, z in zip(level, points[:, 2], strict=True)]
    return np.min(rings, axis=0)

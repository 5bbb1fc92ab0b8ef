"""Checks that vehicles can stand on the ground of a world or on the launch pad, and begin there."""

import numpy as np

from quad_gym.kernels.task.heights import GATE_SPREAD, LOWEST_GATE, RANDOM_RISE
from quad_gym.params.randomization import DrawingTable
from quad_gym.params.task import TaskParams
from quad_gym.params.vehicle import VehicleParams
from quad_gym.params.world import WorldParams
from quad_gym.records import COLUMNS


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

"""Flights that follow user-defined trajectories: feasibility, and the one of each flight."""

import math
from typing import TYPE_CHECKING, Any

import numpy as np

from quad_gym.params.control import ActionParams
from quad_gym.params.task import TaskParams
from quad_gym.params.trajectories import Trajectory
from quad_gym.params.vehicle import VehicleParams
from quad_gym.records import Control

if TYPE_CHECKING:
    from quad_gym.batch.flight_batch import FlightBatch

MOST_THRUST = 2.0
"""Largest thrust-to-weight ratio that an action commands; motor voltages have no such limit."""


def check_trajectories(
    task: TaskParams, vehicle: VehicleParams, actions: ActionParams, control: Control
) -> None:
    """Refuse trajectories that the vehicle cannot fly, or that no action commands.

    Args:
        task: Task with the trajectories, and the tilt at which episodes end.
        vehicle: The vehicle that the controller assumes.
        actions: Scales of the actions.
        control: Meaning of an action.

    Raises:
        ValueError: If a trajectory is refused.
    """
    limits: dict[str, Any] = {"max_tilt": task.max_tilt}
    if control in (Control.WRENCH, Control.CTBR, Control.ATTITUDE):
        limits["max_thrust"] = min(
            MOST_THRUST * vehicle.mass * vehicle.gravity, 4.0 * vehicle.max_rotor_force
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


def followed(batch: "FlightBatch", flight: int) -> tuple[Trajectory, float] | None:
    """See `FlightBatch.trajectory`."""
    trajectories = batch.task.trajectories
    if not trajectories:
        return None
    which = np.array([flight])
    chosen = trajectories[int(batch.record("path", which)[0])]
    cosine, sine = batch.record("path_turn", which)[0]
    if cosine == 0.0 == sine:  # never reset
        cosine = 1.0
    share = float(batch.record("path_share", which)[0])
    return chosen.turned(math.atan2(sine, cosine)), share * chosen.duration * chosen.closed

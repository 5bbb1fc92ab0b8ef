"""Flights that follow users' trajectories: whether they can, and which one each follows."""

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
"""Largest thrust that an action commands, over the weight; motor voltages have no such limit."""


def check_trajectories(
    task: TaskParams, vehicle: VehicleParams, actions: ActionParams, control: Control
) -> None:
    """Refuse trajectories that the vehicle cannot fly, or that no action commands.

    Args:
        task: Has the trajectories, and the tilt at which episodes end.
        vehicle: As the controller believes it to be.
        actions: Scales of the actions.
        control: What an action means.

    Raises:
        ValueError: If there is one.
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

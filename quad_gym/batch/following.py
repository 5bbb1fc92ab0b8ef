"""References: feasibility, and the user-defined trajectory of each flight."""

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
            f"period must be one that the vehicle can fly: with radius={task.radius:g} m, "
            f"{task.period:g} s need an acceleration of {acceleration:.4g} m/s^2 and a thrust of "
            f"{thrust:.4g} N, above the limit of {limit:.4g} N"
        )


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

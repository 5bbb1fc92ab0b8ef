"""Feasibility of a trajectory: the demand that exceeds a limit, its time, and the excess."""

import functools
import math
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from quad_gym.params import checks as check
from quad_gym.params.trajectories.flatness import motion_of
from quad_gym.params.trajectories.pieces import Floats, Reference, derivative
from quad_gym.params.vehicle import VehicleParams

INTERVAL, SAMPLES, MAX_SAMPLES = 0.01, 16, 400
"""Interval of the checks [s], and their least and largest number per segment."""

MIN_THRUST = 0.01
"""Thrust as a fraction of the weight below which, in free fall, the direction of body z is
undefined."""

JUMP = 1e-5
"""Largest jump between segments of position [m], velocity [m/s] and acceleration [m/s^2]."""

TURNABOUT = 1.0  #: change of the heading between two checks that no vehicle can follow [rad]

ROUNDING = 1e-6
"""Fraction of a limit by which a demand may exceed it, so that a limit that is just met is
accepted."""


class Demand(NamedTuple):
    """The largest demands of a trajectory on a vehicle."""

    thrust: tuple[float, float]  #: smallest and largest total thrust [N]
    rotor_force: tuple[float, float]  #: smallest and largest thrust of any single rotor [N]
    tilt: float  #: largest angle between body z and the vertical [rad]
    body_rates: tuple[float, float, float]
    """largest magnitude of the body rate about each body axis [rad/s]"""
    speed: float  #: largest speed [m/s]
    acceleration: float  #: largest acceleration [m/s^2]


def check_trajectory(
    trajectory: Reference,
    vehicle: VehicleParams,
    *,
    max_thrust: float | None = None,
    max_tilt: float = math.pi,
    max_body_rates: ArrayLike | None = None,
    max_speed: float | None = None,
    name: str = "trajectory",
) -> Demand:
    """Check that a vehicle can fly the trajectory, and return the largest demands.

    Thrust, attitude and body rates follow from acceleration, jerk and yaw (differential
    flatness), torques from snap, and the forces of the four rotors from thrust and torques.
    Drag and the lag of the rotors are neglected.

    Args:
        vehicle: The vehicle; its rotor forces must be between 0 and their values at full
            voltage.
        max_thrust: Bound of the total thrust, if below the rotors' own [N].
        max_tilt: Bound of the angle between body z and the vertical [rad].
        max_body_rates: (3,) bounds of the body rates about the body axes [rad/s]; None: no
            bound.
        max_speed: Bound of the speed [m/s]; None: no bound.
        name: Name of the trajectory in messages.

    Returns:
        The largest demands.

    Raises:
        ValueError: If a demand exceeds its limit, or the trajectory jumps. The message names
            the demand, the time, the segment and the excess.
    """
    check.instance("vehicle", vehicle, VehicleParams)
    rates = None
    if max_body_rates is not None:
        rates = check.vector("max_body_rates", max_body_rates, length=3)
    thrust = None if max_thrust is None else check.positive("max_thrust", max_thrust)
    speed = None if max_speed is None else check.positive("max_speed", max_speed)
    tilt = check.positive("max_tilt", max_tilt, most=math.pi)
    return _checked(trajectory, vehicle, thrust, tilt, rates, speed, name)


@functools.lru_cache(maxsize=256)
def _checked(
    trajectory: Reference,
    vehicle: VehicleParams,
    max_thrust: float | None,
    max_tilt: float,
    max_rates: tuple[float, ...] | None,
    max_speed: float | None,
    name: str,
) -> Demand:
    _refuse_jumps(trajectory, name)
    times = sampling_times(trajectory)
    _refuse_turnabouts(trajectory, times, name)
    motion = motion_of(trajectory, vehicle, times)
    speeds, accelerations = (np.linalg.norm(trajectory(times, k), axis=1) for k in (1, 2))
    force, rates = motion.rotor_forces, np.abs(motion.body_rates)
    largest = vehicle.max_rotor_force
    min_thrust = MIN_THRUST * vehicle.mass * vehicle.gravity
    # name, values over time, unit, lower and upper limit
    demands: list[tuple[str, Floats, str, float, float]] = [
        ("a speed", speeds, "m/s", 0.0, max_speed or math.inf),
        ("a thrust", motion.thrust, "N", min_thrust, max_thrust or 4.0 * largest),
        ("a tilt", np.degrees(motion.tilt), "degrees", 0.0, math.degrees(max_tilt)),
    ]
    if max_rates is not None:
        demands += [
            (f"a body rate about {axis}", rates[:, k], "rad/s", 0.0, max_rates[k])
            for k, axis in enumerate("xyz")
        ]
    demands += [(f"a force of rotor {k + 1}", force[:, k], "N", 0.0, largest) for k in range(4)]
    _refuse_excess(trajectory, demands, times, name)
    return Demand(
        thrust=(float(motion.thrust.min()), float(motion.thrust.max())),
        rotor_force=(float(force.min()), float(force.max())),
        tilt=float(motion.tilt.max()),
        body_rates=tuple(rates.max(axis=0).tolist()),
        speed=float(speeds.max()),
        acceleration=float(accelerations.max()),
    )


def _refuse_excess(
    trajectory: Reference,
    demands: list[tuple[str, Floats, str, float, float]],
    times: Floats,
    name: str,
) -> None:
    """Refuse demands beyond limits; name the one that exceeds its limit by the largest fraction."""
    worst, words = 0.0, ""
    for what, values, unit, least, most in demands:
        high, low = int(np.argmax(values)), int(np.argmin(values))
        if values[high] > most * (1.0 + ROUNDING) and values[high] / most - 1.0 > worst:
            worst = values[high] / most - 1.0
            share = f"{100.0 * worst:.0f} %" if worst > 0.01 else f"{100.0 * worst:.2g} %"
            words = (
                f"{what} of {values[high]:.4g} {unit} {_where(trajectory, times[high])}, "
                f"{share} above the limit of {most:.4g} {unit}"
            )
        scale = most if math.isfinite(most) else 1.0
        short = (least - values[low]) / scale
        if short > ROUNDING and short > worst:
            worst = short
            words = (
                f"{what} of {values[low]:.4g} {unit} {_where(trajectory, times[low])}, "
                f"{least - values[low]:.3g} {unit} below the limit of {least:.3g} {unit}"
            )
    if words:
        raise ValueError(
            f"{name} is infeasible for this vehicle: it needs {words}. Give it more time, or "
            "smaller bounds of speed and acceleration"
        )


def _where(trajectory: Reference, time: float) -> str:
    segments = len(trajectory.times) - 1
    segment = min(int(np.searchsorted(trajectory.times, time, side="right")), segments)
    return f"at {time:.3f} s (segment {segment} of {segments})"


def _refuse_turnabouts(trajectory: Reference, times: Floats, name: str) -> None:
    """Refuse headings that turn about at once, as along a path that stops and comes back."""
    turns = np.diff(trajectory.yaw(times))
    turns = np.abs((turns + np.pi) % (2.0 * np.pi) - np.pi)
    k = int(turns.argmax())
    if turns[k] > TURNABOUT:
        raise ValueError(
            f"{name} must not jump: its heading does by {np.degrees(turns[k]):.0f} degrees "
            f"{_where(trajectory, times[k + 1])}"
        )


def sampling_times(trajectory: Reference) -> Floats:
    """Return the times at which demands are checked [s]."""
    lengths = np.diff(trajectory.times)
    count = int(np.clip(np.ceil(lengths.max() / INTERVAL), SAMPLES, MAX_SAMPLES))
    return trajectory.instants(count)


def _refuse_jumps(trajectory: Reference, name: str) -> None:
    """Refuse segments that do not continue each other."""
    lengths = np.diff(trajectory.times)
    for order, (what, unit) in enumerate(
        (("position", "m"), ("velocity", "m/s"), ("acceleration", "m/s^2"))
    ):
        terms = derivative(trajectory.coefficients[..., :3], order)
        ends = np.zeros(terms.shape[1:])
        for row in terms:
            ends = ends * lengths[:, np.newaxis] + row
        begins = terms[-1]
        if trajectory.closed:
            gaps = np.abs(np.roll(begins, -1, axis=0) - ends).max(axis=1)
        else:
            gaps = np.abs(begins[1:] - ends[:-1]).max(axis=1)
        scale = 1.0 + float(np.abs(ends).max())
        if gaps.size and gaps.max() > JUMP * scale:
            k = int(gaps.argmax())
            raise ValueError(
                f"{name} must not jump: its {what} does by {gaps[k]:.3g} {unit} at "
                f"{trajectory.times[k + 1]:.3f} s, after segment {k + 1}"
            )

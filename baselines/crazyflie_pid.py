"""Cascaded PID of the Crazyflie, as a policy that computes motor voltages from observations.

Structure and gains are the defaults of Bitcraze's firmware (crazyflie-firmware, 2025:
`platform_defaults_cf2.h`, `position_controller_pid.c`, `attitude_pid_controller.c`,
`power_distribution_quadrotor.c`, `motors.c`). No code is copied.
"""

from functools import partial
from typing import Annotated, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from quad_gym.params import checks as check
from quad_gym.params.checks import Checked, Vector, Vector3

Array = NDArray[np.float64]

SLOW = 100.0  #: rate of the loops of position and velocity [Hz]
_FIELDS = ("position", "velocity", "R_BI", "body_rates", "reference_position", "reference_heading")


class CrazyflieGains(Checked):
    """Gains along or about x, y, z: angles in degrees, thrusts from 0 to 65,535."""

    position: Vector3 = (2.0, 2.0, 2.0)
    """desired velocity per position error [1/s]"""
    position_integral: Vector3 = (0.0, 0.0, 0.5)
    """desired velocity per integral of the position error [1/s^2]"""
    max_velocity: Vector3 = (1.1, 1.1, 1.1)
    """limit of the desired velocity [m/s]"""
    velocity: Vector3 = (25.0, 25.0, 25e3)
    """tilt [deg], and along z thrust, per velocity error"""
    velocity_integral: Vector3 = (1.0, 1.0, 15e3)
    """tilt [deg], and along z thrust, per integral of the velocity error"""
    max_change: Vector3 = (20.0, 20.0, 32767.0)
    """limit of the desired tilt [deg], and of the change of thrust"""
    base_thrust: float = 36e3
    """thrust without errors"""
    min_thrust: float = 20e3
    """limit of the thrust"""
    attitude: Vector3 = (6.0, 6.0, 6.0)
    """desired body rate per angle error [1/s]"""
    attitude_integral: Vector3 = (3.0, 3.0, 1.0)
    """desired body rate per integral of the angle error [1/s^2]"""
    attitude_derivative: Vector3 = (0.0, 0.0, 0.35)
    """change of the desired body rate per angular rate [-]"""
    max_angle_integral: Vector3 = (20.0, 20.0, 360.0)
    """limit of the integral of the angle error [deg s]"""
    body_rates: Vector3 = (250.0, 250.0, 120.0)
    """thrust per error of the body rate [s/deg]"""
    body_rates_integral: Vector3 = (500.0, 500.0, 16.7)
    """thrust per integral of this error [1/deg]"""
    body_rates_derivative: Vector3 = (2.5, 2.5, 0.0)
    """thrust per angular acceleration [s^2/deg]"""
    max_rate_integral: Vector3 = (33.3, 33.3, 166.7)
    """limit of the integral of the rate error [deg]"""
    max_force: check.Positive = 0.12
    """force of a rotor at a thrust of 65,535 [N]"""
    force_curve: Annotated[Vector, partial(check.vector, length=4)] = (
        -0.02476538,
        0.06523794,
        -0.02679250,
        0.00677679,
    )
    """force of a rotor over the voltage of its motor, lowest power first [N/V^k], by which the
    firmware compensates the battery"""


class _Memory(NamedTuple):
    """Memory of the loops between steps, (n, 3) each; `held` has roll, pitch and thrust."""

    step: int
    of_position: Array
    of_velocity: Array
    of_angle: Array
    of_rate: Array
    held: Array
    angle: Array
    rate: Array


class CrazyfliePID:
    """Position, velocity, attitude and body rates in a cascade of PID loops.

    The loops of position and velocity run at 100 Hz in axes that turn with the yaw, the others in
    every step. Thrusts of the rotors become voltages by the firmware's curve, at most the
    attribute `battery` [V]: the vehicle's largest voltage, or a measured one, a number or (n, 1).

    Args:
        env: A `QuadGym` environment with `action="motor"`, `layout="absolute"` and a control rate
            that is a multiple of 100 Hz; the firmware's is 500 Hz.
        gains: The gains.

    Raises:
        ValueError: If the controller does not support the environment.
    """

    def __init__(self, env: Any, gains: CrazyflieGains | None = None) -> None:
        flights = getattr(getattr(env, "unwrapped", env), "flights", None)
        if flights is None:
            raise ValueError(f"env must be a QuadGym environment, got {type(env).__name__}")
        shown = {field.name: field.slice for field in flights.table}
        if flights.action != "motor" or not set(_FIELDS) <= set(shown):
            raise ValueError(
                'env must have action="motor" and layout="absolute", and observe a state'
            )
        if flights.control_rate % SLOW:
            raise ValueError(
                f"env must have a control_rate that is a multiple of {SLOW:g} Hz, got "
                f"{flights.control_rate:g} Hz"
            )
        self.gains = CrazyflieGains() if gains is None else gains
        self._g = {n: np.array(value) for n, value in vars(self.gains).items()}
        self._slices = {name: shown[name] for name in _FIELDS}
        self._dt, self._every = 1.0 / flights.control_rate, round(flights.control_rate / SLOW)
        vehicle = flights.batch.vehicle
        self._hover = vehicle.hover_voltage
        self.battery: float | Array = vehicle.max_voltage
        volts = np.linspace(0.0, 6.0, 601)
        force = np.polynomial.polynomial.polyval(volts, self.gains.force_curve)
        self._curve = force[force > 0.0], volts[force > 0.0]
        self._mixer = np.sign(vehicle.effectiveness[1:]) * [[0.5], [0.5], [1.0]]

    def predict(
        self,
        observation: Any,
        state: _Memory | None = None,
        episode_start: Any = None,
        deterministic: bool = True,
    ) -> tuple[Array, _Memory]:
        """Return actions (n, 4), and the memory that the next call takes as `state`."""
        rows = np.atleast_2d(np.asarray(observation, np.float64))
        part = {name: rows[:, where] for name, where in self._slices.items()}
        R_BI = part["R_BI"].reshape(-1, 3, 3)
        angle = np.degrees(_angles(R_BI))
        rate, zero = np.degrees(part["body_rates"]), np.zeros((len(rows), 3))
        fresh = _Memory(0, zero, zero, zero, zero, zero, angle, rate)
        m = fresh if state is None else state
        if episode_start is not None and np.any(episode_start):
            begins = np.broadcast_to(episode_start, len(rows))[:, np.newaxis]
            pairs = zip(fresh[1:], m[1:], strict=True)
            m = _Memory._make([m.step, *(np.where(begins, *pair) for pair in pairs)])
        if m.step % self._every == 0:
            m = self._slow(part, angle, m)
        thrusts, m = self._fast(part["reference_heading"], angle, rate, m)
        volts = np.interp(thrusts / 65535.0 * self.gains.max_force, *self._curve)
        excess = volts.max(axis=1, keepdims=True) - self.battery
        volts = np.maximum(volts - np.maximum(excess, 0.0), 0.0)
        action = np.clip(volts / self._hover - 1.0, -1.0, 1.0)
        return (action if np.ndim(observation) > 1 else action[0]), m._replace(step=m.step + 1)

    def _slow(self, part: dict[str, Array], angle: Array, m: _Memory) -> _Memory:
        """Return the memory with the desired roll, pitch and thrust by position and velocity."""
        g, dt = self._g, 1.0 / SLOW
        yaw = np.radians(angle[:, 2])
        error = _turned(part["reference_position"] - part["position"], yaw)
        of_position = m.of_position + dt * error
        wanted = g["position"] * error + g["position_integral"] * of_position
        wanted = np.clip(wanted, -g["max_velocity"], g["max_velocity"])
        error = wanted - _turned(part["velocity"], yaw)
        of_velocity = m.of_velocity + dt * error
        change = g["velocity"] * error + g["velocity_integral"] * of_velocity
        change = np.clip(change, -g["max_change"], g["max_change"])
        thrust = np.clip(change[:, 2] + g["base_thrust"], g["min_thrust"], 65535.0)
        held = np.stack([-change[:, 1], change[:, 0], thrust], axis=1)
        return m._replace(of_position=of_position, of_velocity=of_velocity, held=held)

    def _fast(self, heading: Array, angle: Array, rate: Array, m: _Memory) -> tuple[Array, _Memory]:
        """Return the thrusts (n, 4) of the rotors by attitude and body rates, and the memory."""
        g, dt = self._g, self._dt
        yaw = np.degrees(np.arctan2(heading[:, 1], heading[:, 0]))
        error = np.column_stack([m.held[:, :2], yaw]) - angle
        error[:, 2] = _wrapped(error[:, 2])
        limit = g["max_angle_integral"]
        of_angle = np.clip(m.of_angle + dt * error, -limit, limit)
        wanted = g["attitude"] * error + g["attitude_integral"] * of_angle
        wanted -= g["attitude_derivative"] * _wrapped(angle - m.angle) / dt
        error, limit = wanted - rate, g["max_rate_integral"]
        of_rate = np.clip(m.of_rate + dt * error, -limit, limit)
        turn = g["body_rates"] * error + g["body_rates_integral"] * of_rate
        turn -= g["body_rates_derivative"] * (rate - m.rate) / dt
        thrusts = m.held[:, 2:] + np.clip(turn, -32767.0, 32767.0) @ self._mixer
        return thrusts, m._replace(of_angle=of_angle, of_rate=of_rate, angle=angle, rate=rate)


def _angles(R_BI: Array) -> Array:
    """Roll, pitch (nose down) and yaw (n, 3) [rad] of matrices (n, 3, 3) from I to B."""
    roll = np.arctan2(R_BI[:, 1, 2], R_BI[:, 2, 2])
    pitch = np.arcsin(np.clip(-R_BI[:, 0, 2], -1.0, 1.0))
    return np.stack([roll, pitch, np.arctan2(R_BI[:, 0, 1], R_BI[:, 0, 0])], axis=1)


def _turned(v_I: Array, yaw: Array) -> Array:
    """Vectors (n, 3) in axes that turn with the yaw (n,) [rad]."""
    c, s = np.cos(yaw), np.sin(yaw)
    x, y, z = v_I.T
    return np.stack([c * x + s * y, c * y - s * x, z], axis=1)


def _wrapped(angle: Array) -> Array:
    """Angles within half a turn [deg]."""
    return np.asarray((angle + 180.0) % 360.0 - 180.0)

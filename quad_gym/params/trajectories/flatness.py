"""Thrust, attitude, body rates and torques that a motion requires, by differential flatness.

Without drag, `f z = m (a + g e3)`, and body y is `unit(z x x*)` with the desired heading x*. Both
are differentiated twice: body rates come from jerk and yaw rate, their change from snap.

Source: Mellinger and Kumar, Minimum snap trajectory generation and control for quadrotors, ICRA
2011; axes as in the report's controller.
"""

from typing import NamedTuple

import numpy as np

from quad_gym.params.trajectories.pieces import Floats, Reference
from quad_gym.params.vehicle import VehicleParams

Jet = tuple[Floats, Floats, Floats]  #: a vector (n, 3) over time with its first two derivatives


class Motion(NamedTuple):
    """Demands of a motion at n instants."""

    thrust: Floats  #: (n,) total thrust of the rotors [N]
    R_BI: Floats  #: (n, 3, 3) attitude; its rows are the body axes in I
    body_rates: Floats  #: (n, 3) body rates in B [rad/s]
    torque: Floats  #: (n, 3) torque in B [N m]
    rotor_forces: Floats  #: (n, 4) thrust of each rotor [N]

    @property
    def tilt(self) -> Floats:
        """(n,) angle between body z and the vertical [rad]."""
        return np.arccos(np.clip(self.R_BI[:, 2, 2], -1.0, 1.0))


def motion_of(trajectory: Reference, vehicle: VehicleParams, times: Floats) -> Motion:
    """Return the demands of a trajectory on a vehicle at times (n,) [s]."""
    force = (
        trajectory(times, 2) + np.array([0.0, 0.0, vehicle.gravity]),
        trajectory(times, 3),
        trajectory(times, 4),
    )
    z = _unit(force)
    y = _unit(_cross(z, _heading(trajectory, times)))
    x = _cross(y, z)
    rates = np.stack([-_dot(z[1], y[0]), _dot(z[1], x[0]), -_dot(y[1], x[0])], axis=1)
    changes = np.stack(
        [
            -_dot(z[2], y[0]) - _dot(z[1], y[1]),
            _dot(z[2], x[0]) + _dot(z[1], x[1]),
            -_dot(y[2], x[0]) - _dot(y[1], x[1]),
        ],
        axis=1,
    )
    inertia = np.array(vehicle.inertia)
    torque = changes @ inertia.T + np.cross(rates, rates @ inertia.T)
    thrust = vehicle.mass * np.linalg.norm(force[0], axis=1)
    wrench = np.column_stack([thrust, torque])
    forces = np.linalg.solve(vehicle.effectiveness, wrench.T).T
    return Motion(thrust, np.stack([x[0], y[0], z[0]], axis=1), rates, torque, forces)


def _heading(trajectory: Reference, times: Floats) -> Jet:
    """Return the desired horizontal direction of body x."""
    angle, rate, change = (trajectory.yaw(times, k)[:, np.newaxis] for k in range(3))
    zero = np.zeros_like(angle)
    ahead = np.hstack([np.cos(angle), np.sin(angle), zero])
    left = np.hstack([-np.sin(angle), np.cos(angle), zero])
    return ahead, rate * left, change * left - rate**2 * ahead


def _dot(a: Floats, b: Floats) -> Floats:
    return np.einsum("ni,ni->n", a, b)


def _cross(a: Jet, b: Jet) -> Jet:
    """The cross product and its derivatives."""
    return (
        np.cross(a[0], b[0]),
        np.cross(a[1], b[0]) + np.cross(a[0], b[1]),
        np.cross(a[2], b[0]) + 2.0 * np.cross(a[1], b[1]) + np.cross(a[0], b[2]),
    )


def _unit(a: Jet) -> Jet:
    """The direction and its derivatives; where there is none, numbers too large for any vehicle."""
    length = np.maximum(np.linalg.norm(a[0], axis=1), 1e-9)[:, np.newaxis]
    u = a[0] / length
    growth = _dot(u, a[1])[:, np.newaxis]
    u1 = (a[1] - growth * u) / length
    change = (_dot(u1, a[1]) + _dot(u, a[2]))[:, np.newaxis]
    return u, u1, (a[2] - 2.0 * growth * u1 - change * u) / length

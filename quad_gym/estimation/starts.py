"""Starts from one fix without a second antenna: level, the heading from elsewhere or nowhere.

All that is uncertain at the start is a linear function of independent errors s,

    x = (r, v, e, b_a, b_g, d) = G s,

so that `L L^T = G diag(s^2) G^T` follows from a QR factorization, also where it is singular. The
position hangs on the attitude, as the antenna was measured and not the center of mass: with r =
antenna - R^T l its error is that of the fix and J e, J = R_hat^T [l x]. The heading hangs on what
tells it (`magnetic_heading`).
"""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from quad_gym.packing.aids import slow_states
from quad_gym.params.sensors import SensorSuite
from quad_gym.records import Aid

Floats = NDArray[np.float64]

LEVEL_SIGMA = 0.03
"""Of roll and pitch of a vehicle put down or hovering, where the suite says nothing [rad]; as in
`quad_gym.params.suites`."""

_R, _V, _E, _BA, _BG, _D = 0, 3, 6, 9, 12, 15


class Heading(NamedTuple):
    """A heading, and the errors on which it depends."""

    angle: float
    """of the body x axis, from east toward north [rad]"""
    sigma: float
    """of what is its own [rad]"""
    of_tilt: tuple[float, float] = (0.0, 0.0)
    """by which it errs per error of roll and pitch [-]"""
    of_slow: dict[int, float] = {}  # noqa: RUF012  (a NamedTuple's default is not changed)
    """by which it errs per slow error, by its place [rad per unit]"""


class FirstEstimate(NamedTuple):
    """What a filter starts from."""

    position: Floats
    """(3,) in I [m]"""
    velocity: Floats
    """(3,) in I [m/s]"""
    R_BI: Floats
    """(3, 3)"""
    factor: Floats
    """(15 + n, 15 + n) lower, of the covariance, n slow errors last"""


def level(angle: float) -> Floats:
    """R_BI of a level vehicle whose x axis has a heading."""
    c, s = math.cos(angle), math.sin(angle)
    return np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]])


def magnetic_heading(sensors: SensorSuite, field_B: Floats, sigma: float | None) -> Heading:
    """The heading of a level vehicle by its magnetometer.

    To first order `m = f + f x e + delta g + b + v` in B with f = R_hat m_I and g = R_hat (m_I x
    e3). The heading makes the part of m across the level field f_h u vanish, along t = e3 x u:

        e_z = (f_z u . e + delta t . g + t . b + t . v) / f_h

    Args:
        sensors: A suite with a magnetometer.
        field_B: (3,) measured [T].
        sigma: White noise per axis [T]; None: as the suite says.

    Raises:
        ValueError: If the measured field has no level part.
    """
    magnetometer = sensors.magnetometer
    assert magnetometer is not None
    m_I = np.array(magnetometer.field_I)
    strength = math.hypot(field_B[0], field_B[1])
    if strength < 1e-3 * magnetometer.strength:
        raise ValueError(f"magnetometer must measure a level part of the field, got {field_B}")
    angle = math.atan2(m_I[1], m_I[0]) - math.atan2(field_B[1], field_B[0])
    R_hat = level(angle)
    f, g = R_hat @ m_I, R_hat @ np.cross(m_I, (0.0, 0.0, 1.0))
    f_h = math.hypot(f[0], f[1])
    u = np.array([f[0], f[1], 0.0]) / f_h
    t = np.array([-u[1], u[0], 0.0])
    states = slow_states(sensors)
    iron, declination = states.vectors[Aid.MAGNETOMETER], states.scalars[Aid.MAGNETOMETER]
    of_slow = {iron + i: float(t[i] / f_h) for i in range(2)}
    of_slow[declination] = float(t @ g / f_h)
    white = magnetometer.white_sigma if sigma is None else sigma
    tilt = (float(f[2] * u[0] / f_h), float(f[2] * u[1] / f_h))
    return Heading(angle, white / f_h, tilt, of_slow)


def level_start(
    sensors: SensorSuite,
    antenna_I: Floats,
    position_root: Floats,
    velocity: Floats,
    velocity_sigma: Floats,
    tilt_sigma: float,
    heading: Heading,
) -> FirstEstimate:
    """The first estimate of a level vehicle, and the factor of its covariance.

    Args:
        sensors: A suite with GNSS.
        antenna_I: (3,) the primary antenna [m].
        position_root: (3, 3) a root of the covariance of this [m].
        velocity: (3,) in I [m/s].
        velocity_sigma: (3,) deviations of this.
        tilt_sigma: Of roll and pitch [rad].
        heading: Of the body x axis.
    """
    assert sensors.gnss is not None
    imu, slow = sensors.imu, slow_states(sensors).first_sigmas
    n = _D + len(slow)
    R_BI = level(heading.angle)
    lever = np.array(sensors.gnss.primary_antenna_B)
    G = np.zeros((n, n))
    G[_R : _R + 3, _R : _R + 3] = position_root
    G[_V : _V + 3, _V : _V + 3] = np.diag(velocity_sigma)
    e = np.zeros((3, n))  # the error angles, by independent errors
    e[0, _E] = e[1, _E + 1] = tilt_sigma
    e[2, _E : _E + 2] = tilt_sigma * np.array(heading.of_tilt)
    e[2, _E + 2] = heading.sigma
    for place, gain in heading.of_slow.items():
        e[2, _D + place] = gain * slow[place]
    G[_E : _E + 3] = e
    x, y, z = lever
    G[_R : _R + 3] += R_BI.T @ np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]]) @ e
    for first, sigma in ((_BA, imu.accel_bias_sigma), (_BG, imu.gyro_bias_sigma)):
        G[first : first + 3, first : first + 3] = sigma * np.eye(3)
    G[_D:, _D:] = np.diag(slow)
    return FirstEstimate(antenna_I - R_BI.T @ lever, velocity, R_BI, lower_factor(G))


def lower_factor(root: Floats) -> Floats:
    """The lower factor L, with a diagonal of at least zero, of L L^T = root root^T."""
    upper = np.linalg.qr(root.T, mode="r")
    signs = np.where(np.diag(upper) < 0.0, -1.0, 1.0)
    return np.ascontiguousarray((signs[:, np.newaxis] * upper).T)

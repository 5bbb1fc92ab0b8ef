"""Starts from one fix: level, or tilted as measured at rest; and Wahba's problem, for others.

All that is uncertain at the start is a linear function of independent errors s,

    x = (r, v, e, b_a, b_g, d) = G s,

so that `L L^T = G diag(s^2) G^T` follows from a QR factorization, also where it is singular. The
position depends on the attitude, as the antenna was measured and not the center of mass: with r =
antenna - R^T l its error is the error of the fix plus J e, J = R_hat^T [l x]. The heading depends
on its source (`magnetic_heading`, `baseline_heading`).

R_hat is T level(heading): T turns the level frame, whose x axis is the body's without its vertical
part, into B. Errors are taken in the level frame and turned, e = T e_L. A resting accelerometer
measures `f = g k + g k x e + b_a + v` with the vertical k = T e3, so that

    e_L = e3 x T^T (b_a + v) / g + (0, 0, error of the heading).

An accelerometer is so good that an error theta of the heading matters to higher orders: the error
angles of a turn by theta about k are `theta k + theta^2 q / 2 + ...`, q = (k_y k_z, -k_x k_z,
-k_x k_y), while for a level vehicle they are theta alone. `still_start` models the term with q as
a separate error with the same mean square, and bounds the third order by theta^3 / 6.
"""

import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from quad_gym.kernels import entries
from quad_gym.packing.aids import slow_states
from quad_gym.params import checks as check
from quad_gym.params.portable import turned
from quad_gym.params.sensors import SensorSuite
from quad_gym.records import START, Aid

Floats = NDArray[np.float64]

LEVEL_SIGMA = 0.03
"""Standard deviation of roll and pitch of a vehicle put down or hovering, if the suite has none
[rad]; as in `quad_gym.params.suites`."""

MAX_MOTION = 0.1
"""Fraction of gravity by which the specific force of a vehicle at rest may differ from it: twice
the effect of the bias of a cheap accelerometer."""

STEEPEST_NOSE = 0.05  #: horizontal fraction of the x axis below which its heading is undefined

STEEP = 0.2
"""Horizontal fraction of a baseline, 12 degrees from the vertical, below which it does not observe
the heading; as in `kernels/filter/align.py`."""

_D = 15  #: the first time-correlated error among the states


class FirstHeading(NamedTuple):
    """A heading, and the errors on which it depends."""

    angle: float  #: heading of the body x axis, from east toward north [rad]
    sigma: float  #: standard deviation of its independent error [rad]
    of_tilt: tuple[float, float] = (0.0, 0.0)
    """error of the heading per error of the tilt, about the first two axes of the level frame
    [-]"""
    of_slow: dict[int, float] = {}  # noqa: RUF012  (a NamedTuple's default is not changed)
    """error of the heading per time-correlated sensor error, by its index [rad per unit]"""


class Tilt(NamedTuple):
    """Direction of the vertical in the body, and the errors on which it depends."""

    T: Floats  #: (3, 3) rotation from the level frame to B
    sigma: float  #: standard deviation of its independent error, about each level axis [rad]
    of_bias: float = 0.0
    """error of the tilt per accelerometer bias across the vertical [rad s^2/m]"""


LEVEL = Tilt(np.eye(3), 0.0)  #: a level vehicle


class FirstEstimate(NamedTuple):
    """First estimate of a filter."""

    position: Floats  #: (3,) position in I [m]
    velocity: Floats  #: (3,) velocity in I [m/s]
    R_BI: Floats  #: (3, 3) attitude
    factor: Floats
    """(15 + n, 15 + n) lower factor of the covariance, with n time-correlated errors last"""


def level(angle: float) -> Floats:
    """Return R_BI of a level vehicle whose x axis has a heading."""
    c, s = math.cos(angle), math.sin(angle)
    return np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]])


def resting_tilt(accel: Floats, sigma: float, gravity: float) -> Tilt:
    """Return the tilt of a vehicle at rest from its accelerometer.

    Args:
        accel: (3,) measured specific force in B [m/s^2].
        sigma: Standard deviation of its white noise, per axis [m/s^2].
        gravity: Gravitational acceleration that the filter assumes [m/s^2].

    Raises:
        ValueError: If the measurement is not from a vehicle at rest, or its x axis is vertical.
    """
    size = float(np.linalg.norm(accel))
    if abs(size - gravity) > MAX_MOTION * gravity:
        raise ValueError(
            f"accel must be from a vehicle at rest, within {100 * MAX_MOTION:g} % of gravity, "
            f"{gravity:g} m/s^2, got {size:g} m/s^2"
        )
    k = accel / size
    x = np.array([1.0, 0.0, 0.0]) - k[0] * k
    share = float(np.linalg.norm(x))
    if share < STEEPEST_NOSE:
        raise ValueError(f"accel must be from a vehicle whose x axis is not vertical, got {k}")
    x /= share
    return Tilt(np.column_stack([x, np.cross(k, x), k]), sigma / gravity, 1.0 / gravity)


def known_heading(angle: float, sigma: float, tilt: Tilt) -> FirstHeading:
    """Return a given heading of the body x axis, which roll changes if that axis is not level."""
    return FirstHeading(angle, sigma, (float(tilt.T[0, 2] / tilt.T[0, 0]), 0.0))


def magnetic_heading(
    sensors: SensorSuite, field_B: Floats, sigma: float | None, tilt: Tilt = LEVEL
) -> FirstHeading:
    """Return the heading of a vehicle of known tilt from its magnetometer.

    To first order `m = f + f x e + delta g + T^T b + v` in the level frame with f = R m_I and g = R
    (m_I x e3), where R is the rotation by the heading. The heading makes the part of m across the
    level field f_h u vanish, along t = e3 x u:

        e_z = (f_z u . e + delta t . g + T t . b + t . v) / f_h

    Args:
        sensors: A suite with a magnetometer.
        field_B: (3,) measured field [T].
        sigma: Standard deviation of the white noise, per axis [T]; None: the suite's value.
        tilt: Tilt of the vehicle.

    Raises:
        ValueError: If the measured field has no level part.
    """
    magnetometer = sensors.magnetometer
    assert magnetometer is not None
    field = turned(tilt.T.T, field_B)
    m_I = np.array(magnetometer.field_I)
    strength = math.sqrt(field[0] * field[0] + field[1] * field[1])
    if strength < 1e-3 * magnetometer.strength:
        raise ValueError(f"magnetometer must measure a level part of the field, got {field_B}")
    angle = math.atan2(m_I[1], m_I[0]) - math.atan2(field[1], field[0])
    R_hat = level(angle)
    f, g = turned(R_hat, m_I), turned(R_hat, (m_I[1], -m_I[0], 0.0))
    f_h = math.sqrt(f[0] * f[0] + f[1] * f[1])
    u = np.array([f[0], f[1], 0.0]) / f_h
    t = np.array([-u[1], u[0], 0.0])
    states = slow_states(sensors)
    iron, declination = states.vectors[Aid.MAGNETOMETER], states.scalars[Aid.MAGNETOMETER]
    of_slow = {iron + i: float(by / f_h) for i, by in enumerate(turned(tilt.T, t))}
    of_slow[declination] = float((t[0] * g[0] + t[1] * g[1]) / f_h)
    white = magnetometer.noise_sigma if sigma is None else sigma
    of_tilt = (float(f[2] * u[0] / f_h), float(f[2] * u[1] / f_h))
    return FirstHeading(angle, white / f_h, of_tilt, of_slow)


def baseline_heading(sensors: SensorSuite, baseline_I: Floats, tilt: Tilt) -> FirstHeading:
    """Return the heading by two antennas, for a vehicle of known tilt.

    The baseline, (3,) from the primary antenna, acts as a magnetic field whose direction is
    measured in I.

    Raises:
        ValueError: If the baseline is too steep.
    """
    assert sensors.gnss is not None
    baseline_B = np.array(sensors.gnss.baseline_B)
    scale = math.sqrt(sensors.estimator.initial_covariance_scale)
    sigma = scale * sensors.gnss.first_baseline_sigma
    f = tilt.T.T @ (baseline_B / np.linalg.norm(baseline_B))
    f_h = math.hypot(f[0], f[1])
    if f_h < STEEP or math.hypot(baseline_I[0], baseline_I[1]) == 0.0:
        raise ValueError(
            "gnss_baseline_G must not be within 12 degrees of the vertical where accel gives the "
            "tilt: use a heading in its place"
        )
    angle = math.atan2(baseline_I[1], baseline_I[0]) - math.atan2(f[1], f[0])
    slope = f[2] / f_h
    return FirstHeading(angle, sigma / f_h, (float(slope * f[0] / f_h), float(slope * f[1] / f_h)))


def still_start(
    sensors: SensorSuite,
    antenna_I: Floats,
    position_root: Floats,
    velocity: Floats,
    velocity_sigma: Floats,
    tilt: Tilt,
    heading: FirstHeading,
) -> FirstEstimate:
    """Return the first estimate of a vehicle of known tilt, with the factor of its covariance."""
    assert sensors.gnss is not None
    imu, slow = sensors.imu, slow_states(sensors).first_sigmas
    record = np.zeros(1, START)
    given = {
        "antenna_I": antenna_I,
        "position_root": position_root,
        "velocity_sigma": velocity_sigma,
        "T": tilt.T,
        "tilt_sigma": tilt.sigma,
        "tilt_of_bias": tilt.of_bias,
        "heading": heading.angle,
        "heading_sigma": heading.sigma,
        "heading_of_tilt": heading.of_tilt,
        "lever_B": sensors.gnss.primary_antenna_B,
        "accel_bias_sigma": imu.accel_bias_sigma,
        "gyro_bias_sigma": imu.gyro_bias_sigma,
        "slow_states": len(slow),
    }
    for name, value in given.items():
        record[name] = value
    record["slow_sigma"][0, : len(slow)] = slow
    for place, gain in heading.of_slow.items():
        record["heading_of_slow"][0, place] = gain
    entries.start_level(record)
    found, n = record[0], _D + len(slow)
    factor = found["factor"][:n, :n].copy()
    return FirstEstimate(found["position"].copy(), velocity, found["R_BI"].copy(), factor)


def state_at_rest(
    sensors: SensorSuite, position: ArrayLike, heading: float, time: float
) -> dict[str, Any]:
    """Return keywords of `set_state` for a level vehicle at rest at a known place (3,) in I [m].

    `SensorSuite.initial_pose` gives the errors of position and heading.
    """
    pose, form, imu = sensors.initial_pose, sensors.estimator, sensors.imu
    tilt = form.initial_tilt_sigma or LEVEL_SIGMA
    variances = np.concatenate(
        [
            np.full(3, pose.position_sigma**2),
            np.full(3, form.initial_velocity_variance),
            [tilt**2, tilt**2, pose.heading_sigma**2],
            np.full(3, imu.accel_bias_sigma**2),
            np.full(3, imu.gyro_bias_sigma**2),
        ]
    )
    return {
        "position": check.array("position", position, (3,)),
        "velocity": np.zeros(3),
        "R_BI": level(check.number("heading", heading)),
        "accel_bias": np.zeros(3),
        "gyro_bias": np.zeros(3),
        "covariance": np.diag(variances),
        "time": time,
    }


def lower_factor(root: Floats) -> Floats:
    """Return the lower factor L, with a nonnegative diagonal, of L L^T = root root^T."""
    upper = np.linalg.qr(root.T, mode="r")
    signs = np.where(np.diag(upper) < 0.0, -1.0, 1.0)
    return np.ascontiguousarray((signs[:, np.newaxis] * upper).T)


def solve_wahba(weights: ArrayLike, v_I: ArrayLike, v_B: ArrayLike) -> Floats:
    """Return the rotation that best maps vectors in I to the same vectors measured in B.

    It minimizes `sum_i a_i |v_B,i - R_BI v_I,i|^2`.

    Args:
        weights: (n,) weights a_i, none negative and not all zero.
        v_I: (n, 3) vectors in I.
        v_B: (n, 3) the same vectors in B.

    Returns:
        (3, 3) R_BI, a proper rotation.

    Raises:
        ValueError: If the shapes do not fit, a value is not finite, or the vectors do not determine
            the rotation (all parallel, for example).

    Source: report section 4.1; F. L. Markley, J. Astronautical Sciences 36(3), 1988.
    """
    a = check.array("weights", weights, (None,))
    vectors_I = check.array("v_I", v_I, (len(a), 3))
    vectors_B = check.array("v_B", v_B, (len(a), 3))
    if (a < 0.0).any() or not (a > 0.0).any():
        raise ValueError(f"weights must be at least 0 and not all zero, got {a}")
    R_BI = np.empty((3, 3))
    uniqueness = entries.wahba_of_vectors(a, vectors_I, vectors_B, R_BI)
    if not uniqueness > 1e-10:
        raise ValueError(
            "v_I and v_B must determine a rotation: at least two directions must differ"
        )
    return R_BI

"""Starts from one fix: level, or tilted as measured at rest; and Wahba's problem, for others.

All that is uncertain at the start is a linear function of independent errors s,

    x = (r, v, e, b_a, b_g, d) = G s,

so that `L L^T = G diag(s^2) G^T` follows from a QR factorization, also where it is singular. The
position depends on the attitude, as the antenna was measured and not the center of mass: with r =
antenna - R^T l its error is the error of the fix plus J e, J = R_hat^T [l x]. The heading depends
on its source (`kernels/filter/still.py`, `head_by_baseline`).

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

from quad_gym.frames import ecef_to_enu
from quad_gym.kernels import entries
from quad_gym.packing.aids import slow_states
from quad_gym.params import checks as check
from quad_gym.params.sensors import SensorSuite
from quad_gym.records import START, Aid
from quad_gym.records.inputs import FIX

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


class FirstEstimate(NamedTuple):
    """First estimate of a filter."""

    position: Floats  #: (3,) position in I [m]
    velocity: Floats  #: (3,) velocity in I [m/s]
    R_BI: Floats  #: (3, 3) attitude
    factor: Floats
    """(15 + n, 15 + n) lower factor of the covariance, with n time-correlated errors last"""


def level(angle: float) -> Floats:
    """Return R_BI of a level vehicle whose x axis has a heading."""
    start = np.zeros(1, START)
    start["T"], start["heading"] = np.eye(3), angle
    entries.start_level(start)
    return start["R_BI"][0].copy()


def level_start(sensors: SensorSuite) -> NDArray[Any]:
    """Return the start of a level vehicle, (1,) START, with the numbers of a suite."""
    slow, imu = slow_states(sensors).first_sigmas, sensors.imu
    start = np.zeros(1, START)
    start["T"] = np.eye(3)
    start["tilt_sigma"] = sensors.estimator.initial_tilt_sigma or LEVEL_SIGMA
    start["heading_sigma"] = sensors.initial_pose.heading_sigma
    start["velocity_sigma"] = math.sqrt(sensors.estimator.initial_velocity_variance)
    start["accel_bias_sigma"], start["gyro_bias_sigma"] = imu.accel_bias_sigma, imu.gyro_bias_sigma
    start["slow_sigma"][0, : len(slow)], start["slow_states"] = slow, len(slow)
    if sensors.gnss is not None:
        start["lever_B"] = sensors.gnss.primary_antenna_B
    return start


def empty_fix(sensors: SensorSuite) -> NDArray[Any]:
    """Return a fix without measurements, (1,) FIX, with the numbers of a suite."""
    fix, gnss, compass = np.zeros(1, FIX), sensors.gnss, sensors.magnetometer
    fix["R_IG"], fix["sigma"], fix["baseline"] = np.eye(3), 1.0, (1.0, 0.0, 0.0)
    fix["scale"] = math.sqrt(sensors.estimator.initial_covariance_scale)
    fix["place_sigma"] = sensors.initial_pose.position_sigma
    if gnss is not None:
        fix["R_IG"], fix["sigma"] = ecef_to_enu(gnss.reference_antenna_G), gnss.position_sigma_I
        fix["velocity_sigma"] = gnss.velocity_sigma or 0.0
        fix["takes_baseline"] = gnss.has_baseline
    if compass is not None:
        states = slow_states(sensors)
        fix["field_I"], fix["field_sigma"] = compass.field_I, compass.noise_sigma
        fix["iron"] = states.vectors[Aid["MAGNETOMETER"]]
        fix["declination"] = states.scalars[Aid["MAGNETOMETER"]]
    return fix


def rest(start: NDArray[Any], accel: Floats, sigma: float, gravity: float) -> None:
    """Give a start the tilt of a vehicle at rest from its accelerometer.

    Args:
        start: (1,) START; changed.
        accel: (3,) measured specific force in B [m/s^2].
        sigma: Standard deviation of its white noise, per axis [m/s^2].
        gravity: Gravitational acceleration that the filter assumes [m/s^2].
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
    start["T"] = np.column_stack([x, np.cross(k, x), k])
    start["tilt_sigma"], start["tilt_of_bias"] = sigma / gravity, 1.0 / gravity


def head_by_baseline(start: NDArray[Any], sensors: SensorSuite, baseline_I: Floats) -> None:
    """Give a start (1,) START of known tilt the heading by two antennas.

    The baseline, (3,) from the primary antenna, acts as a magnetic field whose direction is
    measured in I.
    """
    assert sensors.gnss is not None
    baseline_B = np.array(sensors.gnss.baseline_B)
    scale = math.sqrt(sensors.estimator.initial_covariance_scale)
    sigma = scale * sensors.gnss.first_baseline_sigma
    f = start["T"][0].T @ (baseline_B / np.linalg.norm(baseline_B))
    f_h = math.hypot(f[0], f[1])
    if f_h < STEEP or math.hypot(baseline_I[0], baseline_I[1]) == 0.0:
        raise ValueError(
            "gnss_baseline_G must not be within 12 degrees of the vertical where accel gives the "
            "tilt: use a heading in its place"
        )
    slope = f[2] / f_h
    start["heading"] = math.atan2(baseline_I[1], baseline_I[0]) - math.atan2(f[1], f[0])
    start["heading_sigma"] = sigma / f_h
    start["heading_of_tilt"] = slope * f[0] / f_h, slope * f[1] / f_h


def still_start(start: NDArray[Any], velocity: Floats) -> FirstEstimate:
    """Return the first estimate of a vehicle of known tilt, with the factor of its covariance."""
    entries.start_level(start)
    found = start[0]
    n = _D + int(found["slow_states"])
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

"""A level start made one that stands as a resting accelerometer says."""

import numpy as np
from numpy.typing import NDArray

from quad_gym.params.sensors import SensorSuite

_R, _E, _BA = slice(0, 3), slice(6, 9), slice(9, 12)
Floats = NDArray[np.float64]


def _cross(v: Floats) -> Floats:
    """[v x]."""
    return np.array([[0.0, -v[2], v[1]], [v[2], 0.0, -v[0]], [-v[1], v[0], 0.0]])


def leveled(R_BI: Floats, P: Floats, force: Floats, sensors: SensorSuite) -> tuple[Floats, Floats]:
    """Tilt a level attitude so that its vertical is along the specific force of a vehicle at rest.

    With the vertical k in B, `f = g R(e) k + b_a + v` leaves of the error angles e the tilt `k x
    (b_a + v) / g`, and the heading as it was. The position follows, as an antenna was measured.

    Args:
        R_BI: (3, 3) level attitude.
        P: (15, 15) covariance in the order r, v, e, b_a, b_g.
        force: (3,) specific force in B [m/s^2], not zero.
        sensors: What the filter believes of accelerometer and GNSS.

    Returns:
        The attitude and its covariance.
    """
    k, up, g = force / np.linalg.norm(force), R_BI[:, 2], sensors.estimator.gravity
    axis = np.cross(up, k)
    if k @ up > -0.99:
        turn = np.eye(3) + _cross(axis) + _cross(axis) @ _cross(axis) / (1.0 + k @ up)
    else:  # upside down: about x, and from there
        half = np.diag([1.0, -1.0, -1.0])
        axis = np.cross(half @ up, k)
        turn = _cross(axis) + _cross(axis) @ _cross(axis) / (1.0 + k @ half @ up)
        turn = (np.eye(3) + turn) @ half
    tilted, P = turn @ R_BI, P.copy()
    by_bias = _cross(k) / g
    white = sensors.imu.believed_accel_sigma**2
    of_heading = float(up @ P[_E, _E] @ up) * np.outer(k, k)
    P[_E, _E] = by_bias @ (P[_BA, _BA] + white * np.eye(3)) @ by_bias.T + of_heading
    P[_E, _BA] = by_bias @ P[_BA, _BA]
    P[_BA, _E] = P[_E, _BA].T
    assert sensors.gnss is not None
    J = tilted.T @ _cross(np.array(sensors.gnss.primary_antenna_B))
    sigma = sensors.estimator.initial_scale * np.array(sensors.gnss.position_sigma_I) ** 2
    P[_R], P[:, _R] = 0.0, 0.0
    P[_R, _E], P[_R, _BA] = J @ P[_E, _E], J @ P[_E, _BA]
    P[_E, _R], P[_BA, _R] = P[_R, _E].T, P[_R, _BA].T
    P[_R, _R] = np.diag(sigma) + J @ P[_E, _E] @ J.T
    return tilted, P

"""First estimate of a vehicle of known tilt, from one fix: scalar code, for one flight.

`quad_gym.estimation.starts` has the equations.
"""

import math

from quad_gym.kernels.compiling import kernel
from quad_gym.kernels.maths.elementary import sin_cos
from quad_gym.kernels.maths.linalg import cross, load3, load33, store, vector

_R, _V, _E, _BA, _BG, _D = 0, 3, 6, 9, 12, 15


@kernel
def start_still(s):
    """Compute position, attitude and factor of the covariance of a START record."""
    n = _D + s.slow_states
    G, e, T = s.factor, s.e, s.T
    for j in range(n + 1):
        for i in range(n):
            G[i, j] = 0.0
        for i in range(3):
            e[i, j] = 0.0
    sine, cosine = sin_cos(s.heading)
    level = ((cosine, sine, 0.0), (-sine, cosine, 0.0), (0.0, 0.0, 1.0))
    R_BI, lever = load33(T) @ level, load3(s.lever_B)
    store(s.R_BI, R_BI)
    store(s.position, load3(s.antenna_I) - R_BI.T @ lever)
    _error_angles(s, e, T, n)
    for j in range(n + 1):
        e_x, e_y, e_z = e[0, j], e[1, j], e[2, j]
        for i in range(3):
            G[_E + i, j] = T[i, 0] * e_x + T[i, 1] * e_y + T[i, 2] * e_z
    k = (T[0, 2], T[1, 2], T[2, 2])
    bend = math.sqrt(0.75) * _variance(e, n)  # of second order in the heading, see there
    G[_E, n], G[_E + 1, n] = bend * k[1] * k[2], -bend * k[0] * k[2]
    G[_E + 2, n] = -bend * k[0] * k[1]
    for j in range(n + 1):  # r = antenna - R^T l
        e_j = vector(G[_E, j], G[_E + 1, j], G[_E + 2, j])
        moved = R_BI.T @ cross(lever, e_j)
        for i in range(3):
            G[_R + i, j] = moved[i]
    for i in range(3):
        for j in range(3):
            G[_R + i, j] += s.position_root[i, j]
        G[_V + i, _V + i] = s.velocity_sigma[i]
        G[_BA + i, _BA + i], G[_BG + i, _BG + i] = s.accel_bias_sigma, s.gyro_bias_sigma
    for i in range(s.slow_states):
        G[_D + i, _D + i] = s.slow_sigma[i]
    _reduce(G, n)


@kernel
def _variance(e, n):
    """Variance of the heading."""
    total = 0.0
    for j in range(n):
        total += e[2, j] * e[2, j]
    return total


@kernel
def _error_angles(s, e, T, n):
    """Set the error angles in the level frame, by independent errors."""
    bias = s.tilt_of_bias * s.accel_bias_sigma
    for i in range(3):
        e[0, _BA + i], e[1, _BA + i] = -bias * T[i, 1], bias * T[i, 0]
    e[0, _E] = s.tilt_sigma
    e[1, _E + 1] = s.tilt_sigma
    for j in range(n):
        e[2, j] = s.heading_of_tilt[0] * e[0, j] + s.heading_of_tilt[1] * e[1, j]
    e[2, _E + 2] = s.heading_sigma
    for i in range(s.slow_states):
        e[2, _D + i] = s.heading_of_slow[i] * s.slow_sigma[i]
    variance = _variance(e, n)
    turned = bias * math.sqrt(variance)  # an error of the tilt by one of the heading
    steepness = math.sqrt(T[0, 2] * T[0, 2] + T[1, 2] * T[1, 2])
    third = math.sqrt(15.0 * variance * variance * variance) / 6.0 * steepness
    tilt = math.sqrt(s.tilt_sigma * s.tilt_sigma + turned * turned + third * third)
    e[0, _E] = tilt
    e[1, _E + 1] = tilt


@kernel
def _reduce(G, n):
    """Replace G (n, n + 1) by the lower factor L of L L^T = G G^T, by reflections of columns."""
    for k in range(n):
        square = 0.0
        for j in range(k, n + 1):
            square += G[k, j] * G[k, j]
        size = math.sqrt(square)
        if size > 0.0:
            v_k = G[k, k] + math.copysign(size, G[k, k])
            half = size * abs(v_k)
            for i in range(k + 1, n):
                along = v_k * G[i, k]
                for j in range(k + 1, n + 1):
                    along += G[k, j] * G[i, j]
                along = along / half
                # the reflected column, with the sign that makes the diagonal positive
                G[i, k] = math.copysign(1.0, v_k) * (along * v_k - G[i, k])
                for j in range(k + 1, n + 1):
                    G[i, j] -= along * G[k, j]
            G[k, k] = size
        for j in range(k + 1, n + 1):
            G[k, j] = 0.0

"""First estimate of a vehicle of known tilt, from one fix: scalar code, for one flight.

`quad_gym.estimation.filtering.starts` has the equations.
"""

import math

from quad_gym.kernels.compiling import kernel
from quad_gym.kernels.maths.elementary import atan2, sin_cos
from quad_gym.kernels.maths.linalg import cross, load3, load33, store, vector
from quad_gym.records.inputs import MIN_COURSE, Outcome

_OK, _RANGE = int(Outcome.OK), int(Outcome.OUT_OF_RANGE)
_R, _V, _E, _BA, _BG, _D = 0, 3, 6, 9, 12, 15


@kernel
def turned(R, v):
    """The product of a matrix (3, 3) and a vector, with plain sums."""
    return vector(
        R[0, 0] * v[0] + R[0, 1] * v[1] + R[0, 2] * v[2],
        R[1, 0] * v[0] + R[1, 1] * v[1] + R[1, 2] * v[2],
        R[2, 0] * v[0] + R[2, 1] * v[1] + R[2, 2] * v[2],
    )


@kernel
def set_heading(s, fix):
    """Set the heading of a START record from a FIX, and the errors on which it depends.

    Its source is a magnetic field, the course, or else a given number. Roll changes the heading of
    an axis that is not level.
    """
    for i in range(s.slow_states):
        s.heading_of_slow[i] = 0.0
    if fix.has_field:
        return _set_magnetic_heading(s, fix)
    s.heading_of_tilt[0], s.heading_of_tilt[1] = s.T[0, 2] / s.T[0, 0], 0.0
    if fix.course:
        x, y = fix.velocity_I[0], fix.velocity_I[1]
        speed = math.sqrt(x * x + y * y)
        if speed < MIN_COURSE * fix.velocity_sigma:
            return _RANGE
        across = fix.velocity_sigma / speed
        s.heading = atan2(y, x)
        s.heading_sigma = math.sqrt(s.heading_sigma * s.heading_sigma + across * across)
    else:
        s.heading = fix.heading
    return _OK


@kernel
def _set_magnetic_heading(s, fix):
    """Set the heading of a vehicle of known tilt from its magnetometer.

    To first order `m = f + f x e + delta g + T^T b + v` in the level frame with f = R m_I and g = R
    (m_I x e3), where R is the rotation by the heading. The heading makes the part of m across the
    level field f_h u vanish, along t = e3 x u:

        e_z = (f_z u . e + delta t . g + T t . b + t . v) / f_h
    """
    m_I, m_B = fix.field_I, load3(fix.field_B)
    x, y, _ = turned(s.T.T, m_B)
    strength = math.sqrt(m_I[0] * m_I[0] + m_I[1] * m_I[1] + m_I[2] * m_I[2])
    if not math.sqrt(x * x + y * y) >= 1e-3 * strength:
        return _RANGE
    s.heading = atan2(m_I[1], m_I[0]) - atan2(y, x)
    sine, cosine = sin_cos(s.heading)
    f_x, f_y = cosine * m_I[0] + sine * m_I[1], cosine * m_I[1] - sine * m_I[0]
    g_x, g_y = cosine * m_I[1] - sine * m_I[0], -sine * m_I[1] - cosine * m_I[0]
    f_h = math.sqrt(f_x * f_x + f_y * f_y)
    u_x, u_y = f_x / f_h, f_y / f_h
    s.heading_sigma = fix.field_sigma / f_h
    s.heading_of_tilt[0], s.heading_of_tilt[1] = m_I[2] * u_x / f_h, m_I[2] * u_y / f_h
    by = turned(s.T, vector(-u_y, u_x, 0.0))
    for i in range(3):
        s.heading_of_slow[fix.iron + i] = by[i] / f_h
    s.heading_of_slow[fix.declination] = (u_x * g_y - u_y * g_x) / f_h
    return _OK


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

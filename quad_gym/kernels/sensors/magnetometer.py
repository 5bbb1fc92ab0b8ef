"""The magnetometer: the Earth's magnetic field in three axes of the body.

It measures `z = (I + D) R(delta) m_I + b + v` in B with white noise v, where m_I is the field by a
model of the Earth's field, delta the error of this model's declination, b hard iron and D soft
iron. The filter has b and delta among its states (`filter/slow.py`) and does not model D:

    h = R_BI (m_I + delta m_I x e3) + b

With a pair of sigma points, R(+-e) = I + even +- odd, that is odd and even in its offset as

    odd:   odd R f + (I + even) ddelta R g + db,   even:   even R f + ddelta odd R g,

f = m_I + delta g and g = m_I x e3; and the derivative along an offset is (R f) x de + ddelta R g +
db. No term of an offset that has no error angles is even.

Where GNSS has one antenna, the field determines the heading of the filter's nearly level start: the
expected field gets the measured direction. With the vertical k, the level direction h of the field
and s = k x h, all in B, the field's level and vertical share m_h and m_z, the innovation vanishes
along s, so that the derivative relates the heading's error to others:

    m_h (k . e) = m_z (h . e) - m_h delta + s . b + s . v
"""

import math

from quad_gym.kernels.compiling import kernel
from quad_gym.kernels.filter.error_state import BA, D, E, R, V
from quad_gym.kernels.filter.recovery import (
    MOST_ANGLE,
    drifts,
    inflate_gyro_bias,
    inflate_heading,
    raise_diagonal,
)
from quad_gym.kernels.maths.elementary import maximum, minimum, sin_cos
from quad_gym.kernels.maths.factors import cholesky
from quad_gym.kernels.maths.linalg import (
    add,
    add33,
    add_outer,
    add_scaled,
    apply,
    apply_transposed,
    cross,
    dot,
    keep3,
    keep33,
    load3,
    load4,
    load33,
    load_block,
    load_column3,
    multiply,
    outer,
    scale,
    select3,
    store3,
    store_block,
    sub,
    sum_of_outers,
    transpose,
)
from quad_gym.kernels.maths.random import normal_pair, stream_of
from quad_gym.kernels.maths.rotation import level_attitude, quaternion_to_dcm
from quad_gym.kernels.sensors.aid import (
    aid_due,
    begin_aid,
    deliver,
    deliver_first,
    draw_matrix,
    gate_aid,
)
from quad_gym.kernels.sensors.stage import sensor_stage
from quad_gym.kernels.simd.lanes import select
from quad_gym.records import AID_BLOCKS, AID_GROUPS, DRAW_AID, Aid, FilterForm, Sensor

_S, _SENSOR = int(Aid.MAGNETOMETER), int(Sensor.MAGNETOMETER)
_BLOCK = AID_BLOCKS + _S
_EKF = int(FilterForm.EKF)
_DRIFT_TIME = 0.5
"""Time within which the magnetometer pulls the heading back [s]: shorter than it really is, so that
the bias may be larger than a drift implies."""


@kernel
def _begin(flight, p, settings, mask):
    begin_aid(flight, p, settings, _S, mask)
    draw_matrix(flight, p, _S, mask)


@kernel
def _sample(flight, p, settings, work, stages, mask, starting):
    """Measure when due."""
    due = aid_due(flight, p, settings, _S, mask, starting)
    stream = stream_of(flight)
    a, b = normal_pair(stream, DRAW_AID + 2 * _S)
    c, _ = normal_pair(stream, DRAW_AID + 2 * _S + 1)
    m, (s, t) = load3(p.aid_numbers[_S]), sin_cos(flight.aid_scalar[_S])
    field_I = (t * m[0] + s * m[1], t * m[1] - s * m[0], m[2])
    field_B = apply(quaternion_to_dcm(load4(flight.q)), field_I)
    field_B = add(field_B, apply(load33(flight.aid_matrix[_S]), field_B))
    noise = scale(p.aid_sigma[_S], (a, b, c))
    values = add(add(field_B, load3(flight.aid_vector[_S])), noise)
    if starting and settings.heading_sensor == _SENSOR and settings.warm == 0:
        deliver_first(flight, _S, mask, values)
    else:
        deliver(flight, work, settings, _S, mask, due, values)


@kernel
def _align(flight, p, work, settings, mask):
    """Initialize the heading with the direction of the field, and the covariance to match."""
    P, L, R_BI = work.P, flight.L, load33(flight.R_hat)
    m, z = load3(p.aid_numbers[_S]), load3(flight.aid_measurement[_S])
    R_BI = multiply(R_BI, level_attitude(apply_transposed(R_BI, z), m))
    for i in range(0, D, 3):
        for j in range(0, i + 3, 3):
            store_block(P, i, j, sum_of_outers(L, i, L, j, j + 3))
    for i in range(settings.slow_states):
        for j in range(D + i):
            P[D + i, j] = 0.0 * p.dt
        sigma = p.slow_sigma[i]
        P[D + i, D + i] = select(sigma > 0.0, sigma * sigma, 1.0)  # GNSS has not drifted yet
    iron, delta = D + settings.aid_vector[_S], D + settings.aid_scalar[_S]
    _tie_heading(p, P, m, R_BI, iron, delta)
    _tie_position(p, P, R_BI, iron, delta)
    cholesky(P, D + settings.slow_states, work.inverse_diagonal)
    for i in range(D):
        for j in range(i + 1):
            L[i, j] = select(mask, P[i, j], L[i, j])
    for i in range(settings.slow_states):
        estimated = mask & (p.slow_sigma[i] > 0.0)
        for j in range(D + i + 1):
            kept = flight.L_slow[i, j]
            flight.L_slow[i, j] = select(estimated, P[D + i, j], kept)
    antenna_I = apply(load33(p.R_IG), load3(flight.gnss_position))
    keep33(flight.R_hat, mask, R_BI)
    keep3(flight.r_hat, mask, sub(antenna_I, apply_transposed(R_BI, load3(p.antenna))))


@kernel
def _tie_heading(p, P, m, R_BI, iron, delta):
    """Replace the error of the heading in P by the error of the field's heading, see above."""
    zero = 0.0 * p.dt
    level = math.sqrt(m[0] * m[0] + m[1] * m[1])
    h, k = apply(R_BI, (m[0] / level, m[1] / level, zero)), apply(R_BI, (zero, zero, zero + 1.0))
    s, steep = cross(k, h), m[2] / level
    F = outer(k, sub(scale(steep, h), k))  # e = F e + ..., where only the tilt counts
    F = add33(((zero + 1.0, zero, zero), (zero, zero + 1.0, zero), (zero, zero, zero + 1.0)), F)
    P_bb, P_dd = P[iron, iron], P[delta, delta]
    white = p.initial_covariance_scale * p.aid_sigma[_S] * p.aid_sigma[_S]
    alone = P_dd + (white + P_bb) / (level * level)
    P_ee = multiply(multiply(F, _full(P)), transpose(F))
    store_block(P, E, E, add_outer(P_ee, scale(alone, k), k))
    store_block(P, E, V, multiply(F, load_block(P, E, V)))
    for i in range(BA, D, 3):
        store_block(P, i, E, multiply(load_block(P, i, E), transpose(F)))
    with_iron = scale(P_bb / level, s)
    store3(P[iron, E : E + 3], scale(with_iron[0], k))
    store3(P[iron + 1, E : E + 3], scale(with_iron[1], k))
    store3(P[iron + 2, E : E + 3], scale(with_iron[2], k))
    store3(P[delta, E : E + 3], scale(-P_dd, k))


@kernel
def _tie_position(p, P, R_BI, iron, delta):
    """Correlate the position with the attitude in P, as an antenna was measured: see `align.py`."""
    zero = 0.0 * p.dt
    x, y, z = load3(p.antenna)
    J = multiply(transpose(R_BI), ((zero, -z, y), (z, zero, -x), (-y, x, zero)))
    J_t = transpose(J)
    with_attitude, s, k = (
        multiply(_full(P), J_t),
        load3(p.position_sigma_I),
        p.initial_covariance_scale,
    )
    white = (
        (k * s[0] * s[0], zero, zero),
        (zero, k * s[1] * s[1], zero),
        (zero, zero, k * s[2] * s[2]),
    )
    store_block(P, R, R, add33(white, multiply(J, with_attitude)))
    store_block(P, E, R, with_attitude)
    store_block(P, V, R, multiply(transpose(load_block(P, E, V)), J_t))
    for i in range(BA, D, 3):
        store_block(P, i, R, multiply(load_block(P, i, E), J_t))
    for i in (iron, iron + 1, iron + 2, delta):
        store3(P[i], apply(J, load3(P[i, E : E + 3])))


@kernel
def _full(P):
    """Full covariance of the error angles, from the lower triangle in P."""
    return (
        (P[E, E], P[E + 1, E], P[E + 2, E]),
        (P[E + 1, E], P[E + 1, E + 1], P[E + 2, E + 1]),
        (P[E + 2, E], P[E + 2, E + 1], P[E + 2, E + 2]),
    )


@kernel
def _expected_field(flight, p, settings):
    """R f and R g, see above."""
    R_BI, m, delta = load33(flight.R_hat), load3(p.aid_numbers[_S]), settings.aid_scalar[_S]
    g = (m[1], -m[0], 0.0 * m[2])
    return apply(R_BI, add(m, scale(flight.slow_hat[delta], g))), apply(R_BI, g)


@kernel
def _put_center(flight, p, work, settings, k, valid, f_B):
    """Fill rows k to k + 2 of center, measured and noise."""
    first = settings.aid_vector[_S]
    center = add(f_B, load3(flight.slow_hat[first : first + 3]))
    variance = p.aid_sigma[_S] * p.aid_sigma[_S]
    for i in range(3):
        work.z_hat[k + i] = select(valid, center[i], 0.0)
        work.z[k + i] = select(valid, flight.aid_measurement[_S, i], 0.0)
        for j in range(3):
            work.Rz[k + i, k + j] = 0.0 * variance
        work.Rz[k + i, k + i] = select(valid, variance, 1.0)


@kernel
def _expect(flight, p, work, settings, k):
    """Fill rows k to k + 2."""
    L, M, inverse_c = flight.L, flight.L_slow, work.inverse_spread
    valid, last = flight.block_valid[_BLOCK] > 0.0, D + settings.slow_states - 1
    first, delta = settings.aid_vector[_S], settings.aid_scalar[_S]
    f_B, g_B = _expected_field(flight, p, settings)
    _put_center(flight, p, work, settings, k, valid, f_B)
    zero = 0.0 * f_B[0]
    nothing = (zero, zero, zero)
    for j in range(last + 1):
        db, turned = load_column3(M, first, j), scale(M[delta, j], g_B)
        straight = add(turned, db)
        if j < 9:
            half_sum = nothing
            if (settings.form & _EKF) != 0:
                straight = add(straight, cross(f_B, load_column3(L, E, j)))
            else:
                odd, even = load33(work.odd[j]), load33(work.even[j])
                bent = add_scaled(apply(even, turned), inverse_c, apply(odd, f_B))
                straight = add(straight, bent)
                half_sum = add_scaled(apply(odd, turned), inverse_c, apply(even, f_B))
            store3(work.E[8 - j][k : k + 3], select3(valid, half_sum, nothing))
        store3(work.A[last - j][k : k + 3], select3(valid, straight, nothing))


@kernel
def _gate(flight, p, work, settings, k):
    gate_aid(flight, p, work, settings, _S, k, 3.0)


@kernel
def _inflate(flight, p, work, settings):
    """Inflate hard iron, attitude and gyro biases.

    The variances of hard iron and of the heading are raised to the square of a rejected innovation.
    Where innovations drift, a gyro bias rotates the attitude while the magnetometer pulls it back:
    the variances of the attitude are raised to the square of the mean innovation, as an angle, and
    the variances of the gyro biases to the square of the rate that rotates as far in `_DRIFT_TIME`.
    """
    alarm, mask = work.alarm[AID_GROUPS + _S] > 0.0, work.taking > 0.0
    nu, k = load3(flight.innovation[_BLOCK]), D + settings.aid_vector[_S]
    m, R_BI, P = load3(p.aid_numbers[_S]), load33(flight.R_hat), work.P
    square = nu[0] * nu[0] + nu[1] * nu[1] + nu[2] * nu[2]
    vertical = (R_BI[0][2], R_BI[1][2], R_BI[2][2])
    inflate_heading(P, vertical, square / (m[0] * m[0] + m[1] * m[1]), alarm)
    mean = load3(flight.innovation_drift[AID_GROUPS + _S])
    sigma = load3(flight.innovation_sigma[_BLOCK])
    off = (mean[0] * sigma[0], mean[1] * sigma[1], mean[2] * sigma[2])
    turned = dot(off, off) / (m[0] * m[0] + m[1] * m[1])
    drifting = select(mask & drifts(flight, AID_GROUPS + _S), 1.0, 0.0)
    raise_diagonal(P, E, drifting * minimum(turned, MOST_ANGLE * MOST_ANGLE))
    inflate_gyro_bias(P, math.sqrt(turned) / _DRIFT_TIME, drifting)
    for i in range(3):
        P[k + i, k + i] = maximum(P[k + i, k + i], select(alarm, nu[i] * nu[i], 0.0))


magnetometer_stage = sensor_stage(
    Sensor.MAGNETOMETER, _begin, _sample, _expect, _gate, _inflate, _align
)

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
from quad_gym.kernels.filter.columns import columns_of
from quad_gym.kernels.filter.error_state import (
    BA,
    D,
    E,
    R,
    V,
    keep_covariance,
    load_covariance,
    reset_heading,
    reset_variances,
)
from quad_gym.kernels.filter.measurements import by_derivative, put_block, put_three, with_pairs
from quad_gym.kernels.filter.recovery import reset_drifted_heading
from quad_gym.kernels.filter.starts import lever_of_attitude
from quad_gym.kernels.numbers.elementary import maximum, sin_cos
from quad_gym.kernels.numbers.lanes import select, zero_like
from quad_gym.kernels.numbers.linalg import (
    cross,
    diagonal,
    dot,
    keep,
    load3,
    load4,
    load33,
    load_block,
    load_column3,
    load_symmetric,
    outer,
    rounded,
    store,
    store_block,
    vector,
)
from quad_gym.kernels.numbers.random import normal_pair, stream_of
from quad_gym.kernels.numbers.rotation import level_attitude, quaternion_to_dcm
from quad_gym.kernels.sensors.common import aid_stage, draw_matrix
from quad_gym.records import (
    AID_BLOCK,
    AID_GROUPS,
    AID_NUMBERS,
    DRAW_AID,
    POSITION_BLOCK,
    Aid,
    FaultKind,
    FieldFault,
)

_S = int(Aid["MAGNETOMETER"])
_BLOCK, _DRAW = AID_BLOCK[_S], DRAW_AID[_S]
_N = AID_NUMBERS[_S]


@kernel
def _draw(flight, p, mask):
    draw_matrix(flight, p, _S, mask)


@kernel
def _measure(flight, p, i):
    """The field in B, with all errors."""
    stream = stream_of(flight)
    a, b = normal_pair(stream, _DRAW)
    c, _ = normal_pair(stream, _DRAW + 1)
    m, (s, t) = load3(p.aid_numbers[_N]), sin_cos(flight.aid_scalar[_S])
    field_I = (t * m[0] + s * m[1], t * m[1] - s * m[0], m[2])
    field_B = quaternion_to_dcm(load4(flight.q)) @ field_I
    field_B = field_B + load33(flight.aid_matrix[_S]) @ field_B + load3(flight.aid_vector[_S])
    return p.aid_sigma[_S] * vector(a, b, c) + field_B, True


@kernel
def _align(flight, p, work, settings, mask):
    """Initialize the heading with the direction of the field, and the covariance to match."""
    P, R_BI = work.P, load33(flight.R_hat)
    m, z = load3(p.aid_numbers[_N]), load3(flight.measurement[_BLOCK])
    R_BI = R_BI @ level_attitude(R_BI.T @ z, m)
    load_covariance(P, flight, None)
    for i in range(settings.slow_states):
        for j in range(D + i):
            P[D + i, j] = zero_like(p.dt)
        P[D + i, D + i] = p.slow_sigma[i] * p.slow_sigma[i]
    iron, delta = D + settings.aid_vector[_S], D + settings.aid_scalar[_S]
    _tie_heading(p, P, m, R_BI, iron, delta)
    _tie_position(p, P, R_BI, iron, delta)
    keep_covariance(flight, settings, P, mask)
    antenna_I = load33(p.R_IG) @ load3(flight.measurement[POSITION_BLOCK])
    keep(flight.R_hat, mask, R_BI)
    keep(flight.r_hat, mask, antenna_I - R_BI.T @ load3(p.antenna))


@kernel
def _tie_heading(p, P, m, R_BI, iron, delta):
    """Replace the error of the heading in P by the error of the field's heading, see above."""
    zero = zero_like(p.dt)
    level = math.sqrt(m[0] * m[0] + m[1] * m[1])
    h, k = R_BI @ (m[0] / level, m[1] / level, zero), R_BI @ (zero, zero, zero + 1.0)
    s, steep = cross(k, h), m[2] / level
    # e = F e + ..., where only the tilt counts
    F = diagonal((zero + 1.0, zero + 1.0, zero + 1.0)) + rounded(outer(k, steep * h - k))
    P_bb, P_dd = P[iron, iron], P[delta, delta]
    white = p.initial_covariance_scale * p.aid_sigma[_S] * p.aid_sigma[_S]
    alone = P_dd + (white + P_bb) / (level * level)
    store_block(P, E, E, F @ load_symmetric(P, E) @ F.T + outer(alone * k, k))
    store_block(P, V, E, load_block(P, V, E) @ F.T)
    for i in range(BA, D, 3):
        store_block(P, i, E, load_block(P, i, E) @ F.T)
    with_iron = P_bb / level * s
    for i in range(3):
        store(P[iron + i, E : E + 3], with_iron[i] * k)
    store(P[delta, E : E + 3], -P_dd * k)


@kernel
def _tie_position(p, P, R_BI, iron, delta):
    """Correlate the position with the attitude in P, as an antenna is measured: `starts.py`."""
    J, s = lever_of_attitude(R_BI, load3(p.antenna)), load3(p.position_sigma_I)
    k, with_attitude = p.initial_covariance_scale, load_symmetric(P, E) @ J.T
    white = diagonal((k * s[0] * s[0], k * s[1] * s[1], k * s[2] * s[2]))
    store_block(P, R, R, white + J @ with_attitude)
    store_block(P, R, E, with_attitude.T)
    store_block(P, V, R, load_block(P, V, E) @ J.T)
    for i in range(BA, D, 3):
        store_block(P, i, R, load_block(P, i, E) @ J.T)
    for i in (iron, iron + 1, iron + 2, delta):
        store(P[i, R : R + 3], J @ load3(P[i, E : E + 3]))


@kernel
def _expected_field(flight, p, settings):
    """R_BI (m_I + delta m_I x e3) and R_BI (m_I x e3)."""
    m, R_BI = load3(p.aid_numbers[_N]), load33(flight.R_hat)
    g = (m[1], -m[0], zero_like(m[2]))
    return R_BI @ (flight.slow_hat[settings.aid_scalar[_S]] * g + m), R_BI @ g


@kernel
def _expect(flight, p, work, settings, i, k, valid):
    """Fill rows k to k + 2."""
    L, inverse_c, last = work.L, work.inverse_spread, columns_of(settings) - 1
    first, delta = settings.aid_vector[_S], settings.aid_scalar[_S]
    f_B, g_B = _expected_field(flight, p, settings)
    z, variance = load3(flight.measurement[_BLOCK]), p.aid_sigma[_S] * p.aid_sigma[_S]
    z_hat = f_B + load3(flight.slow_hat[first : first + 3])
    put_block(work, settings, k, valid, z, z_hat, diagonal((variance, variance, variance)))
    iron, declination = settings.motion_columns + first, settings.motion_columns + delta
    for j in range(last + 1):
        db, turned = load_column3(L, iron, j), L[declination, j] * g_B
        a, s = turned + db, zero_like(db)
        if j < 3:  # other columns do not change the attitude
            odd, even = load33(work.odd[j]), load33(work.even[j])
            if with_pairs(settings):
                s = odd @ turned + inverse_c * (even @ f_B)
            if by_derivative(settings):
                a = a + cross(f_B, load_column3(L, E, j))
            else:
                a = a + (even @ turned + inverse_c * (odd @ f_B))
        if j < settings.motion_columns:
            put_three(work.E[j], k, valid, s)
        put_three(work.A[last - j], k, valid, a)


@kernel
def _reset(flight, p, work, settings, states, lanes, alone, nu):
    """Reset hard iron; where no other sensor measures the heading, the heading, too.

    An error of the heading changes neither the vertical part of the field nor the length of its
    level part. Hard iron gets a variance for these changes: otherwise they would change the tilt.
    """
    first, m, square = settings.aid_vector[_S], load3(p.aid_numbers[_N]), dot(nu, nu)
    own = p.slow_sigma[first] * p.slow_sigma[first]
    expected, _ = _expected_field(flight, p, settings)
    R_BI = load33(flight.R_hat)
    f, found = R_BI.T @ expected, R_BI.T @ (expected + nu)
    longer = math.sqrt(found[0] * found[0] + found[1] * found[1])
    longer = longer - math.sqrt(f[0] * f[0] + f[1] * f[1])
    other = longer * longer + (found[2] - f[2]) * (found[2] - f[2])
    iron = maximum(own, select(alone, other, square))
    reset_variances(work.P, D + first, states, lanes, (iron, iron, iron))
    variance = (square + own) / (m[0] * m[0] + m[1] * m[1])
    reset_heading(work.P, load33(flight.R_hat), states, lanes & alone, variance)
    reset_drifted_heading(flight, p, work, AID_GROUPS + _S, lanes & alone, variance)


@kernel
def disturb_field(flight, settings, field_B, due):
    """The field in B that a disturbed magnetometer measures, in the lanes `due`.

    The sign of an angle is that of the vertical part of the fault's direction.
    """
    k = FaultKind.MAGNETOMETER_DISTURBANCE
    active, vector = due & (flight.fault_active[k] > 0.0), load3(flight.fault_vector[k])
    disturbed = load3(flight.field_frozen)
    if settings.fault_field == FieldFault.IRON:
        disturbed = field_B + vector
    elif settings.fault_field == FieldFault.TURNED:
        s, c = sin_cos(select(vector[2] > 0.0, flight.fault_size[k], -flight.fault_size[k]))
        x, y, z = field_B
        disturbed = (c * x - s * y, s * x + c * y, z)
    field_B = select(active, disturbed, field_B)
    keep(flight.field_frozen, due, field_B)
    return field_B


magnetometer_stage = aid_stage(
    Aid(_S), _measure, _expect, _reset, _draw, _align, disturb=disturb_field
)

"""The magnetometer: the Earth's magnetic field in three axes of the body.

It measures `z = (I + D) R(delta) m_I + b + v` in B with white noise v, where m_I is the field that
a model of the Earth's field tells, delta the error of that model's declination, b hard iron and D
soft iron. The filter has b and delta among its states (`filter/slow.py`) and knows nothing of D:

    h = R_BI (m_I + delta m_I x e3) + b

With a pair of sigma points, R(+-e) = I + even +- odd, that is odd and even in its offset as

    odd:   odd R f + (I + even) ddelta R g + db,   even:   even R f + ddelta odd R g,

f = m_I + delta g and g = m_I x e3; and the derivative along an offset is (R f) x de + ddelta R g +
db. No term of an offset that has no error angles is even.
"""

from quad_gym.kernels.compiling import kernel, stage
from quad_gym.kernels.filter.error_state import D, E
from quad_gym.kernels.maths.elementary import sin_cos
from quad_gym.kernels.maths.linalg import (
    add,
    add_outer,
    apply,
    cross,
    load3,
    load4,
    load33,
    load_block,
    load_column3,
    scale,
    select3,
    store3,
    store_block,
)
from quad_gym.kernels.maths.random import normal_pair, stream_of
from quad_gym.kernels.maths.rotation import quaternion_to_dcm
from quad_gym.kernels.measurements.aid import (
    ACTS,
    aid_due,
    begin_aid,
    deliver,
    draw_matrix,
    judge_aid,
)
from quad_gym.kernels.simd.blocks import lanes_of
from quad_gym.kernels.simd.lanes import select
from quad_gym.records import AID_BLOCKS, AID_GROUPS, DRAW_AID, Act, Aid, FilterForm

_S = int(Aid.MAGNETOMETER)
_BEGIN, _SAMPLE = int(Act.BEGIN), int(Act.SAMPLE)
_EXPECT, _JUDGE = int(Act.EXPECT), int(Act.JUDGE)
_EKF = int(FilterForm.EKF)


@kernel
def _measure(flight, p, settings, mask, starting):
    """Measure where it is due."""
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
    deliver(flight, settings, _S, mask, due, values)


@kernel
def _expected_field(flight, p, settings):
    """R f and R g, see above."""
    R_BI, m, delta = load33(flight.R_hat), load3(p.aid_numbers[_S]), settings.aid_scalar[_S]
    g = (m[1], -m[0], 0.0 * m[2])
    return apply(R_BI, add(m, scale(flight.slow_hat[delta], g))), apply(R_BI, g)


@kernel
def _put_center(flight, p, work, settings, k, has, f_B):
    """Fill rows k to k + 2 of center, measured and noise."""
    first = settings.aid_vector[_S]
    center = add(f_B, load3(flight.slow_hat[first : first + 3]))
    variance = p.aid_sigma[_S] * p.aid_sigma[_S]
    for i in range(3):
        work.h[k + i] = select(has, center[i], 0.0)
        work.z[k + i] = select(has, flight.aid_measurement[_S, i], 0.0)
        for j in range(3):
            work.Rz[k + i, k + j] = 0.0 * variance
        work.Rz[k + i, k + i] = select(has, variance, 1.0)


@kernel
def _expect(flight, p, work, settings, k):
    """Fill rows k to k + 2."""
    L, M, c = flight.L, flight.L_slow, work.spread
    has, last = flight.aid_valid[_S] > 0.0, D + settings.slow_states - 1
    first, delta = settings.aid_vector[_S], settings.aid_scalar[_S]
    f_B, g_B = _expected_field(flight, p, settings)
    _put_center(flight, p, work, settings, k, has, f_B)
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
                bent = add(scale(1.0 / c, apply(odd, f_B)), apply(even, turned))
                straight = add(straight, bent)
                half_sum = add(scale(1.0 / c, apply(even, f_B)), apply(odd, turned))
            store3(work.E[8 - j][k : k + 3], select3(has, half_sum, nothing))
        store3(work.A[last - j][k : k + 3], select3(has, straight, nothing))


@kernel
def _doubt(flight, p, work, settings, mask):
    """Add the square of a rejected innovation to the variance of hard iron, and of the heading."""
    doubted = mask & (flight.rejected_in_row[AID_GROUPS + _S] >= p.gate_patience)
    nu, k = load3(flight.innovation[AID_BLOCKS + _S]), D + settings.aid_vector[_S]
    m, R_BI, P = load3(p.aid_numbers[_S]), load33(flight.R_hat), work.P
    square = nu[0] * nu[0] + nu[1] * nu[1] + nu[2] * nu[2]
    angle = select(doubted, square / (m[0] * m[0] + m[1] * m[1]), 0.0)
    vertical = (R_BI[0][2], R_BI[1][2], R_BI[2][2])
    store_block(P, E, E, add_outer(load_block(P, E, E), scale(angle, vertical), vertical))
    for i in range(3):
        P[k + i, k + i] = P[k + i, k + i] + select(doubted, nu[i] * nu[i], 0.0)


@stage
def magnetometer_stage(flight, world, model, settings, work, stages, flag):
    """An `Act` of the magnetometer; see `aid.py` for `flag`."""
    flying, scratch, act, k = lanes_of(flight), lanes_of(work), flag % ACTS, flag // ACTS
    p, mask = lanes_of(model), scratch.mask > 0.0
    if act == _BEGIN:
        begin_aid(flying, lanes_of(world), settings, _S, mask)
        draw_matrix(flying, lanes_of(world), _S, mask)
    elif act == _SAMPLE:
        _measure(flying, lanes_of(world), settings, mask, k > 0)
    elif act == _EXPECT:
        _expect(flying, p, scratch, settings, k)
    elif act == _JUDGE:
        judge_aid(flying, p, scratch, settings, _S, k)
    else:
        _doubt(flying, p, scratch, settings, scratch.taking > 0.0)

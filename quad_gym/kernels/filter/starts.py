"""First estimates: alignment by one fix, at rest or by Wahba's problem, and warm starts."""

import math

import numpy as np

from quad_gym.kernels.compiling import Stage, call_stage, kernel, stage
from quad_gym.kernels.filter.error_state import BA, BG, D, E, R, V, keep_covariance
from quad_gym.kernels.filter.gate import forget_innovations
from quad_gym.kernels.filter.recovery import begin_recovery
from quad_gym.kernels.filter.slow import begin_slow, stages_of
from quad_gym.kernels.numbers.blocks import reset
from quad_gym.kernels.numbers.elementary import TINY, atan2, maximum, minimum, sin_cos
from quad_gym.kernels.numbers.lanes import select, zero_like
from quad_gym.kernels.numbers.linalg import (
    cross,
    diagonal,
    dot,
    keep,
    keep_block,
    keep_lower,
    load3,
    load4,
    load33,
    load_block,
    load_symmetric,
    outer,
    rounded,
    store,
    store_block,
    unit_or,
    vector,
)
from quad_gym.kernels.numbers.random import normal_pair, six_normals, stream_of
from quad_gym.kernels.numbers.rotation import euler_to_dcm, level_attitude, quaternion_to_dcm
from quad_gym.records import (
    AIDS,
    BASELINE_BLOCK,
    DRAW_FIRST_BIASES,
    DRAW_MARK,
    DRAW_SLOW,
    DRAW_WARM,
    DRAW_WARM_DRIFT,
    POSITION_BLOCK,
    WARM_DRAWS,
)
from quad_gym.records.inputs import MIN_COURSE, Outcome

# --------------------------------------------------------------------------------------------------
# Wahba's problem: the rotation that best turns one set of vectors into another.
#
# Minimize sum_i a_i |v_B,i - R_BI v_I,i|^2 over rotations R_BI. With B = sum a_i v_B,i v_I,i^T = U
# S V^T the solution is R_BI = U diag(1, 1, det U det V) V^T (G. Wahba, SIAM Review 7(3), 1965; F.
# L. Markley, J. Astronautical Sciences 36(3), 1988).
# --------------------------------------------------------------------------------------------------

_SWEEPS = 10


@kernel
def _rotate_pair(a, b, v, w):
    """Rotate columns a and b of B, and v and w of V with them, so that a . b = 0."""
    gamma = dot(a, b)
    orthogonal = gamma == 0.0
    zeta = (dot(b, b) - dot(a, a)) / (2.0 * select(orthogonal, 1.0, gamma))
    tangent = select(zeta < 0.0, -1.0, 1.0) / (abs(zeta) + math.sqrt(1.0 + zeta * zeta))
    tangent = select(orthogonal, 0.0, tangent)
    cosine = 1.0 / math.sqrt(1.0 + tangent * tangent)
    sine = cosine * tangent
    return (
        cosine * a - rounded(sine * b),
        sine * a + rounded(cosine * b),
        cosine * v - rounded(sine * w),
        sine * v + rounded(cosine * w),
    )


@kernel
def _sorted(a, b, v, w):
    """Swap columns a and b of B, and v and w of V with them, where b is longer."""
    larger = dot(b, b) > dot(a, a)
    return select(larger, b, a), select(larger, a, b), select(larger, w, v), select(larger, v, w)


@kernel
def _perpendicular(a):
    """A vector perpendicular to the unit vector a, with a length well above zero."""
    return select(abs(a[0]) < 0.6, cross(a, (1.0, 0.0, 0.0)), cross(a, (0.0, 1.0, 0.0)))


@kernel
def _perpendicular_unit(candidate, a):
    """The direction of `candidate` made perpendicular to a, or another if it has none."""
    fallback = unit_or(_perpendicular(a), a)
    once = unit_or(candidate - rounded(dot(candidate, a) * a), fallback)
    return unit_or(once - rounded(dot(once, a) * a), fallback)


@kernel
def wahba(B):
    """The rotation R_BI that maximizes tr(R_BI^T B), by one-sided Jacobi rotations.

    B is the attitude profile matrix, sum of a_i v_B,i v_I,i^T.

    Returns:
        (R_BI, uniqueness): the second is (s_2 + d s_3) / s_1 for singular values s and d = det U
        det V; where it is zero, a whole family of rotations is equally good and R_BI is one of
        them.
    """
    a0, a1, a2 = B.T
    one, zero = 1.0 + zero_like(B[0][0]), zero_like(B[0][0])
    v0, v1, v2 = (one, zero, zero), (zero, one, zero), (zero, zero, one)
    for _ in range(_SWEEPS):
        a0, a1, v0, v1 = _rotate_pair(a0, a1, v0, v1)
        a0, a2, v0, v2 = _rotate_pair(a0, a2, v0, v2)
        a1, a2, v1, v2 = _rotate_pair(a1, a2, v1, v2)

    # largest singular value first, smallest last
    a0, a1, v0, v1 = _sorted(a0, a1, v0, v1)
    a1, a2, v1, v2 = _sorted(a1, a2, v1, v2)
    a0, a1, v0, v1 = _sorted(a0, a1, v0, v1)

    u0 = unit_or(a0, (1.0, 0.0, 0.0))
    u1 = _perpendicular_unit(a1, u0)
    # the third columns as cross products: the factor det U det V is then in them
    u2 = cross(u0, u1)
    v2_right = cross(v0, v1)
    R_IB = outer(v0, u0) + rounded(outer(v1, u1)) + rounded(outer(v2_right, u2))
    s0, s1 = math.sqrt(dot(a0, a0)), math.sqrt(dot(a1, a1))
    signed_s2 = dot(a2, u2) * dot(v2, v2_right)
    return R_IB.T, (s1 + signed_s2) / maximum(s0, TINY)


# --------------------------------------------------------------------------------------------------
# Alignment: initialization of the filter from its first fix.
#
# Source: report section 3.4.2; heading of the mark and level starts are ours.
# --------------------------------------------------------------------------------------------------

_NOTHING = (0.0, 0.0, 0.0)
_NO_HEADING = math.pi / math.sqrt(3.0)  #: standard deviation of an unknown angle
_STEEP = 0.2  #: level share of a baseline 12 degrees from the vertical: too small for a heading


@kernel
def lever_of_attitude(R_BI, l_B):
    """J = R_hat^T [l x]: with R = R(e) R_hat, the error of r = antenna - R^T l grows by J e."""
    zero = zero_like(l_B[0])
    x, y, z = l_B
    return R_BI.T @ ((zero, -z, y), (z, zero, -x), (-y, x, zero))


@kernel
def _tie_position_to_attitude(P, R_BI, l_B, mask):
    """Add to P the dependence of the start's position on its attitude, in the lanes `mask`."""
    J = lever_of_attitude(R_BI, l_B)
    tied = J @ load_symmetric(P, E)
    keep_block(P, R, E, mask, tied)
    keep_lower(P, R, mask, load_symmetric(P, R) + tied @ J.T)


@kernel
def _put(P, row, mask, variance):
    P[row, row] = select(mask, variance, P[row, row])


@kernel
def initialize(flight, p, mask, x_I, v_I=_NOTHING, v_variance=_NOTHING, tilt_variance=_NOTHING):
    """Start the filter from the first fix, in the lanes `mask`.

    Attitude by Wahba's problem from the measured baseline and the body z axis taken as vertical,
    with equal weights, or level with the baseline's heading (a single antenna counts as a vertical
    baseline); position from the antenna; velocity and biases zero. For a level start, the
    covariance includes the dependence of the position on the attitude. The steeper the baseline,
    the less certain the heading. Where the baseline is too steep for a heading, the body x axis is
    added to Wahba's problem, or gives the heading alone; where it is unknown, too, so is the
    heading.

    Args:
        flight, p, mask: Record, parameters assumed by the filter, lanes to work on.
        x_I: Level direction in I of the body x axis, if the place of the start determines it; else
            zero.
        v_I: Known velocity of the start, in I [m/s].
        v_variance: Variance per axis, added to the variance of a start at rest [m^2/s^2].
        tilt_variance: Variances added for roll and pitch [rad^2]; the third element is not used.
    """
    inflation = math.sqrt(p.initial_covariance_scale)
    attitude = inflation * p.first_baseline_sigma
    baseline_B = (1.0 / p.baseline_length) * load3(p.baseline)
    level_share = math.sqrt(baseline_B[0] * baseline_B[0] + baseline_B[1] * baseline_B[1])
    heading = minimum(attitude / maximum(level_share, 1e-9), _NO_HEADING)
    placed = (level_share < _STEEP) & (dot(x_I, x_I) > 0.0)
    heading = select(placed, inflation * p.heading_sigma, heading)

    R_IG = load33(p.R_IG)
    baseline_I = unit_or(R_IG @ load3(flight.measurement[BASELINE_BLOCK]), (0.0, 0.0, 1.0))
    nothing = zero_like(x_I)
    x_B = (nothing[0] + 1.0, nothing[1], nothing[2])
    ahead = outer(x_B, select(placed, x_I, nothing))
    profile = outer(baseline_B, baseline_I) + rounded(ahead)
    profile = (profile[0], profile[1], (profile[2][0], profile[2][1], profile[2][2] + 1.0))
    R_BI, _ = wahba(profile)
    level = p.initial_tilt_sigma > 0.0
    ahead_B, ahead_I = select(placed, x_B, baseline_B), select(placed, x_I, baseline_I)
    R_BI = select(level, level_attitude(ahead_B, ahead_I), R_BI)
    antenna_I = R_IG @ load3(flight.measurement[POSITION_BLOCK])
    keep(flight.R_hat, mask, R_BI)
    keep(flight.r_hat, mask, antenna_I - R_BI.T @ load3(p.antenna))
    keep(flight.v_hat, mask, v_I)
    flight.filter_status = select(mask, np.uint64(0), flight.filter_status)
    reset(flight, mask, 0.0, "b_a_hat b_g_hat prediction_failures update_failures")
    reset(flight, mask, 0.0, "nis nis_dimension v_corrected arc")
    begin_recovery(flight, mask)

    P, tilt = flight.P, select(level, p.initial_tilt_sigma, attitude)
    for i in range(15):
        for j in range(i):
            P[i, j] = select(mask, 0.0, P[i, j])
    for i in range(3):
        place, angle = inflation * p.position_sigma_I[i], tilt * tilt + tilt_variance[i]
        if i == 2:
            angle = heading * heading
        _put(P, R + i, mask, place * place)
        _put(P, V + i, mask, p.initial_velocity_variance + v_variance[i])
        _put(P, E + i, mask, angle)
        _put(P, BA + i, mask, p.accel_bias_sigma * p.accel_bias_sigma)
        _put(P, BG + i, mask, p.gyro_bias_sigma * p.gyro_bias_sigma)
    _tie_position_to_attitude(P, R_BI, load3(p.antenna), mask & level)


@kernel
def known_velocity(flight, settings):
    """Velocity of the start in I that the filter receives, and the variance of its random part.

    A velocity given by the caller of a reset is known; its variance is zero.
    """
    known, zero = load3(flight.start_given[3:]), zero_like(flight.tick)
    drawn = load3(settings.start_velocity_variance)
    return (
        (_or(known[0], zero), _or(known[1], zero), _or(known[2], zero)),
        (
            select(known[0] == known[0], zero, drawn[0]),
            select(known[1] == known[1], zero, drawn[1]),
            select(known[2] == known[2], zero, drawn[2]),
        ),
    )


@kernel
def _or(given, other):
    """A number, or another where it is NaN."""
    return select(given == given, given, other)


@kernel
def look_along_mark(flight, p):
    """Level direction in I of the body x axis, as accurate as the place of the start gives it."""
    R_BI = quaternion_to_dcm(load4(flight.q))
    zero = zero_like(p.dt)
    x_I = unit_or((R_BI[0][0], R_BI[0][1], zero), (zero + 1.0, zero, zero))
    n, _ = normal_pair(stream_of(flight), DRAW_MARK)
    s, c = sin_cos(p.heading_sigma * n)
    return (c * x_I[0] - s * x_I[1], s * x_I[0] + c * x_I[1], zero)


@stage
def align_stage(flight, world, model, settings, work, stages, flag):
    """Start the filter from its first fix."""
    mask = work.mask > 0.0
    if settings.slow_states > 0:
        begin_slow(flight, model, settings, mask)
    call_stage(stages, Stage.FORGET_INNOVATIONS, flight, world, model, settings, work, 0)
    v_I, v_variance = known_velocity(flight, settings)
    tilt_variance = load3(settings.start_tilt_variance)
    x_I = look_along_mark(flight, world)
    initialize(flight, model, mask, x_I, v_I, v_variance, tilt_variance)


@stage
def forget_innovations_stage(flight, world, model, settings, work, stages, flag):
    """Forget the innovations of the previous episode."""
    forget_innovations(flight, work.mask > 0.0)


# --------------------------------------------------------------------------------------------------
# First estimate of a vehicle of known tilt, from one fix: scalar code, for one flight.
#
# `quad_gym.estimation.starts` has the equations.
# --------------------------------------------------------------------------------------------------

_OK, _RANGE = int(Outcome.OK), int(Outcome.OUT_OF_RANGE)


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
    """Compute position, attitude and covariance of a START record."""
    n = D + s.slow_states
    G, e, T = s.root, s.e, s.T
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
            G[E + i, j] = T[i, 0] * e_x + T[i, 1] * e_y + T[i, 2] * e_z
    k = (T[0, 2], T[1, 2], T[2, 2])
    bend = math.sqrt(0.75) * _variance(e, n)  # of second order in the heading, see there
    G[E, n], G[E + 1, n] = bend * k[1] * k[2], -bend * k[0] * k[2]
    G[E + 2, n] = -bend * k[0] * k[1]
    for j in range(n + 1):  # r = antenna - R^T l
        e_j = vector(G[E, j], G[E + 1, j], G[E + 2, j])
        moved = R_BI.T @ cross(lever, e_j)
        for i in range(3):
            G[R + i, j] = moved[i]
    for i in range(3):
        for j in range(3):
            G[R + i, R + j] += s.position_root[i, j]
        G[V + i, V + i] = s.velocity_sigma[i]
        G[BA + i, BA + i], G[BG + i, BG + i] = s.accel_bias_sigma, s.gyro_bias_sigma
    for i in range(s.slow_states):
        G[D + i, D + i] = s.slow_sigma[i]
    _square(G, s.P, n)


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
        e[0, BA + i], e[1, BA + i] = -bias * T[i, 1], bias * T[i, 0]
    e[0, E] = s.tilt_sigma
    e[1, E + 1] = s.tilt_sigma
    for j in range(n):
        e[2, j] = s.heading_of_tilt[0] * e[0, j] + s.heading_of_tilt[1] * e[1, j]
    e[2, E + 2] = s.heading_sigma
    for i in range(s.slow_states):
        e[2, D + i] = s.heading_of_slow[i] * s.slow_sigma[i]
    variance = _variance(e, n)
    turned = bias * math.sqrt(variance)  # an error of the tilt by one of the heading
    steepness = math.sqrt(T[0, 2] * T[0, 2] + T[1, 2] * T[1, 2])
    third = math.sqrt(15.0 * variance * variance * variance) / 6.0 * steepness
    tilt = math.sqrt(s.tilt_sigma * s.tilt_sigma + turned * turned + third * third)
    e[0, E] = tilt
    e[1, E + 1] = tilt


@kernel
def _square(G, P, n):
    """Fill P (n, n) with G G^T."""
    for i in range(n):
        for j in range(n):
            total = 0.0
            for k in range(n + 1):
                total += G[i, k] * G[j, k]
            P[i, j] = total


# --------------------------------------------------------------------------------------------------
# A warm start: the filter has been running before the episode begins, and has converged.
#
# Its covariance P is one that filters with this configuration reach, rotated to the heading of the
# start; its errors are drawn from exactly this covariance. They are correlated with the true biases
# as in a real filter, whose estimate and error are independent: with P = W W^T, the last six
# columns of W multiply the standard normals that the true biases were drawn with. Estimates of slow
# errors of sensors are correlated with the true ones in the same way.
# --------------------------------------------------------------------------------------------------


@kernel
def _heading(R_BI):
    """Rotation about the vertical from east to the direction of the body x axis: v_I = T v_0."""
    zero = zero_like(R_BI[0][0])
    one = zero + 1.0
    c, s, _ = unit_or((R_BI[0][0], R_BI[0][1], zero), (one, zero, zero))
    return ((c, -s, zero), (s, c, zero), (zero, zero, one))


@kernel
def _draw_errors(settings, stream, work, slow, T):
    """Fill work.dx with the errors W u of a vehicle that faces east; return the normals of d."""
    states, draws = 15, WARM_DRAWS
    if slow is not None:
        states, draws = 15 + slow.slow_states, WARM_DRAWS + 2 * slow.slow_states
    u, errors = work.z, work.dx
    for k in range(8):
        u[2 * k], u[2 * k + 1] = normal_pair(stream, DRAW_WARM + k)
    n_a, n_g = six_normals(stream, DRAW_FIRST_BIASES)
    for i in range(3):
        u[15 + i], u[18 + i] = n_a[i], n_g[i]
    n_d = n_a
    if slow is not None:
        for i in range(slow.slow_states):
            k = WARM_DRAWS + i + i // 3 * 3
            u[k], u[k + 3] = normal_pair(stream, DRAW_SLOW + i)  # the second gave the true error
        for s in range(AIDS):
            k = WARM_DRAWS + 2 * slow.aid_vector[s] + 3
            if slow.aid_vector[s] >= 0:  # as seen from I, as its errors are
                store(u[k : k + 3], T @ load3(u[k : k + 3]))
        if slow.estimates_drift:
            n_own, n_d = six_normals(stream, DRAW_WARM_DRIFT)
            for i in range(3):
                u[WARM_DRAWS + i], u[WARM_DRAWS + 3 + i] = n_own[i], n_d[i]
    for i in range(states):
        total = settings.warm_root[i, 0] * u[0]
        for k in range(1, draws):
            total = total + settings.warm_root[i, k] * u[k]
        errors[i] = total
    return n_d


@kernel
def _turn_of_slow(slow, i, T, other):
    """Rotation of three states from `i` on, slow errors included, of a vehicle that faces east.

    The drift of positions is in I, as positions are. Vectors of aiding sensors are in B, but rotate
    with the heading as seen from I, see `batch/starts.py`.
    """
    turn = other
    if slow.estimates_drift and i == D:
        turn = T
    for s in range(AIDS):
        if slow.aid_vector[s] >= 0 and i == D + slow.aid_vector[s]:
            turn = T.T
    return turn


@kernel
def _start_aids(flight, slow, T, d, mask):
    """Set the estimates of slow errors of aiding sensors: the true ones minus the drawn errors."""
    for s in range(AIDS):
        k = slow.aid_vector[s]
        if k >= 0:
            error = T.T @ load3(d[D + k : D + k + 3])
            keep(flight.slow_hat[k : k + 3], mask, load3(flight.aid_vector[s]) - error)
        k = slow.aid_scalar[s]
        if k >= 0:
            estimate = flight.aid_scalar[s] - d[D + k]
            flight.slow_hat[k] = select(mask, estimate, flight.slow_hat[k])


@kernel
def _start_warm(flight, p, work, settings, stages, slow):
    """Start a converged filter, where `work.mask`; `slow`: the settings or None, see `slow.py`.

    The settings have the covariance P of a vehicle that faces east, and its root W.
    """
    states, mask, P, d = 15, work.mask > 0.0, work.P, work.dx
    if slow is not None:
        states = 15 + slow.slow_states
    R_BI = quaternion_to_dcm(load4(flight.q))
    T = _heading(R_BI)
    n_d = _draw_errors(settings, stream_of(flight), work, slow, T)
    keep(flight.r_hat, mask, load3(flight.r) - T @ load3(d[R : R + 3]))
    keep(flight.v_hat, mask, load3(flight.v) - T @ load3(d[V : V + 3]))
    reset(flight, mask, 0.0, "v_corrected arc")
    keep(flight.R_hat, mask, euler_to_dcm(load3(d[E : E + 3])).T @ R_BI)
    keep(flight.b_a_hat, mask, load3(flight.b_a) - load3(d[BA : BA + 3]))
    keep(flight.b_g_hat, mask, load3(flight.b_g) - load3(d[BG : BG + 3]))

    one = 1.0 + zero_like(T[0][0])
    eye = diagonal((one, one, one))
    for i in range(0, states, 3):
        left = T if i in (R, V) else eye  # the rest is in B
        if slow is not None:
            left = _turn_of_slow(slow, i, T, left)
        for j in range(0, i + 3, 3):
            right = T if j in (R, V) else eye
            if slow is not None:
                right = _turn_of_slow(slow, j, T, right)
            store_block(P, i, j, left @ load_block(settings.warm_covariance, i, j) @ right.T)
    keep_covariance(flight, slow, P, mask)
    if slow is not None:
        if slow.estimates_drift:
            s = load3(settings.warm_drift_sigma)
            true = T @ (s[0] * n_d[0], s[1] * n_d[1], s[2] * n_d[2])
            keep(flight.drift, mask, true)
            keep(flight.slow_hat, mask, true - T @ load3(d[D : D + 3]))
        _start_aids(flight, slow, T, d, mask)


warm_stage, warm_with_slow_stage = stages_of("warm", _start_warm)

"""A warm start: the filter has been running before the episode begins, and has converged.

Its covariance P is one that filters with this configuration reach, rotated to the heading of the
start; its errors are drawn from exactly this covariance. They are correlated with the true biases
as in a real filter, whose estimate and error are independent: with P = W W^T, the last six columns
of W multiply the standard normals that the true biases were drawn with. Estimates of slow errors of
sensors are correlated with the true ones in the same way.
"""

from quad_gym.kernels.compiling import kernel, stage
from quad_gym.kernels.filter.error_state import BA, BG, D, E, R, V
from quad_gym.kernels.filter.slow import keep_slow_factor
from quad_gym.kernels.maths.factors import cholesky
from quad_gym.kernels.maths.linalg import (
    apply,
    apply_transposed,
    keep3,
    keep33,
    load3,
    load4,
    load_block,
    multiply,
    store3,
    store_block,
    sub,
    transpose,
    unit_or,
)
from quad_gym.kernels.maths.random import normal_pair, six_normals, stream_of
from quad_gym.kernels.maths.rotation import euler_to_dcm, quaternion_to_dcm
from quad_gym.kernels.simd.blocks import lanes_of
from quad_gym.kernels.simd.lanes import select
from quad_gym.records import (
    AIDS,
    DRAW_FIRST_BIASES,
    DRAW_SLOW,
    DRAW_WARM,
    DRAW_WARM_DRIFT,
    WARM_DRAWS,
)


@kernel
def _heading(R_BI):
    """Rotation about the vertical from east to the direction of the body x axis: v_I = T v_0."""
    zero = 0.0 * R_BI[0][0]
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
                store3(u[k : k + 3], apply(T, load3(u[k : k + 3])))
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
    with the heading as seen from I, see `batch/warm_start.py`.
    """
    turn = other
    if slow.estimates_drift and i == D:
        turn = T
    for s in range(AIDS):
        if slow.aid_vector[s] >= 0 and i == D + slow.aid_vector[s]:
            turn = transpose(T)
    return turn


@kernel
def _start_aids(flight, slow, T, d, mask):
    """Set the estimates of slow errors of aiding sensors: the true ones minus the drawn errors."""
    for s in range(AIDS):
        k = slow.aid_vector[s]
        if k >= 0:
            error = apply_transposed(T, load3(d[D + k : D + k + 3]))
            estimate = sub(load3(flight.aid_vector[s]), error)
            keep3(flight.slow_hat[k : k + 3], mask, estimate)
        k = slow.aid_scalar[s]
        if k >= 0:
            estimate = flight.aid_scalar[s] - d[D + k]
            flight.slow_hat[k] = select(mask, estimate, flight.slow_hat[k])


@kernel
def start_warm(flight, settings, stream, work, mask, slow=None):
    """Start a converged filter, where `mask`.

    Args:
        flight: Record with the true state and biases; the estimate is set.
        settings: Has the covariance P of a vehicle that faces east, and its root W.
        stream: The random stream at the episode's first instant.
        work: Workspace.
        mask: Lanes to work on.
        slow: The settings, where sensors have slow errors, see `slow.py`, or None.
    """
    states = 15
    if slow is not None:
        states = 15 + slow.slow_states
    R_BI = quaternion_to_dcm(load4(flight.q))
    T = _heading(R_BI)
    n_d = _draw_errors(settings, stream, work, slow, T)
    d = work.dx
    keep3(flight.r_hat, mask, sub(load3(flight.r), apply(T, load3(d[R : R + 3]))))
    keep3(flight.v_hat, mask, sub(load3(flight.v), apply(T, load3(d[V : V + 3]))))
    R_error = euler_to_dcm(load3(d[E : E + 3]))
    keep33(flight.R_hat, mask, multiply(transpose(R_error), R_BI))
    keep3(flight.b_a_hat, mask, sub(load3(flight.b_a), load3(d[BA : BA + 3])))
    keep3(flight.b_g_hat, mask, sub(load3(flight.b_g), load3(d[BG : BG + 3])))

    zero = 0.0 * T[0][0]
    one = zero + 1.0
    eye = ((one, zero, zero), (zero, one, zero), (zero, zero, one))
    for i in range(0, states, 3):
        left = T if i < E else eye  # the rest is in B
        if slow is not None:
            left = _turn_of_slow(slow, i, T, left)
        for j in range(0, i + 3, 3):
            right = T if j < E else eye
            if slow is not None:
                right = _turn_of_slow(slow, j, T, right)
            block = multiply(left, load_block(settings.warm_covariance, i, j))
            store_block(work.P, i, j, multiply(block, transpose(right)))
    cholesky(work.P, states, work.inverse_diagonal)  # P is known to be positive definite
    for i in range(15):
        for j in range(i + 1):
            flight.L[i, j] = select(mask, work.P[i, j], flight.L[i, j])
    if slow is not None:
        keep_slow_factor(flight, slow, work, mask)
        if slow.estimates_drift:
            s = load3(settings.warm_drift_sigma)
            true = apply(T, (s[0] * n_d[0], s[1] * n_d[1], s[2] * n_d[2]))
            keep3(flight.gnss_drift, mask, true)
            keep3(flight.slow_hat, mask, sub(true, apply(T, load3(d[D : D + 3]))))
        _start_aids(flight, slow, T, d, mask)


@stage
def warm_stage(flight, world, model, settings, work, stages, flag):
    """Start a converged filter."""
    flying, scratch = lanes_of(flight), lanes_of(work)
    start_warm(flying, settings, stream_of(flying), scratch, scratch.mask > 0.0)


@stage
def warm_with_slow_stage(flight, world, model, settings, work, stages, flag):
    """Start a converged filter that estimates slow errors of sensors."""
    flying, scratch = lanes_of(flight), lanes_of(work)
    start_warm(flying, settings, stream_of(flying), scratch, scratch.mask > 0.0, settings)

"""A warm start: the filter has been running before the episode begins, and has converged.

Its covariance P is one that filters with this configuration reach, rotated to the heading of the
start; its errors are drawn from exactly this covariance. They are correlated with the true biases
as in a real filter, whose estimate and error are independent: with P = W W^T, the last six columns
of W multiply the standard normals that the true biases were drawn with. Estimates of slow errors of
sensors are correlated with the true ones in the same way.
"""

from quad_gym.kernels.compiling import kernel
from quad_gym.kernels.filter.error_state import BA, BG, D, E, R, V
from quad_gym.kernels.filter.slow import keep_factor, stages_of
from quad_gym.kernels.maths.factors import cholesky
from quad_gym.kernels.maths.linalg import diagonal, keep, load3, load4, store, unit_or
from quad_gym.kernels.maths.matrices import load_block, store_block
from quad_gym.kernels.maths.random import normal_pair, six_normals, stream_of
from quad_gym.kernels.maths.rotation import euler_to_dcm, quaternion_to_dcm
from quad_gym.kernels.simd.blocks import reset
from quad_gym.kernels.simd.lanes import select, zero_like
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
    with the heading as seen from I, see `batch/warm_start.py`.
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
        left = T if i < E else eye  # the rest is in B
        if slow is not None:
            left = _turn_of_slow(slow, i, T, left)
        for j in range(0, i + 3, 3):
            right = T if j < E else eye
            if slow is not None:
                right = _turn_of_slow(slow, j, T, right)
            store_block(P, i, j, left @ load_block(settings.warm_covariance, i, j) @ right.T)
    cholesky(P, states, work.inverse_diagonal)  # P is known to be positive definite
    keep_factor(flight, slow, work, mask)
    if slow is not None:
        if slow.estimates_drift:
            s = load3(settings.warm_drift_sigma)
            true = T @ (s[0] * n_d[0], s[1] * n_d[1], s[2] * n_d[2])
            keep(flight.gnss_drift, mask, true)
            keep(flight.slow_hat, mask, true - T @ load3(d[D : D + 3]))
        _start_aids(flight, slow, T, d, mask)


warm_stage, warm_with_slow_stage = stages_of("warm", _start_warm)

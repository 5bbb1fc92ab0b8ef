"""A warm start: the filter has been running before the episode begins, and has converged.

Its covariance P is one that filters of the same configuration reach, turned to the heading of the
start; its errors are drawn from exactly that covariance. They go with the true biases as those of a
real filter do, whose estimate and error are independent: of P = W W^T, the last six columns of W
belong to the standard normals that the true biases were drawn with. Where the filter estimates the
slow error of GNSS positions, that is not zero any more, and goes with its error likewise.
"""

from quad_gym.kernels.compiling import kernel, stage
from quad_gym.kernels.filter.drift import keep_drift
from quad_gym.kernels.filter.error_state import BA, BG, D, E, R, V
from quad_gym.kernels.maths.factors import cholesky
from quad_gym.kernels.maths.linalg import (
    apply,
    keep3,
    keep33,
    load3,
    load4,
    load_block,
    multiply,
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
    DRAW_FIRST_BIASES,
    DRAW_WARM,
    DRAW_WARM_DRIFT,
    WARM_DRAWS,
    WARM_DRIFT_DRAWS,
)


@kernel
def _heading(R_BI):
    """The turn about the vertical that takes east to where the body x axis points: v_I = T v_0."""
    zero = 0.0 * R_BI[0][0]
    one = zero + 1.0
    c, s, _ = unit_or((R_BI[0][0], R_BI[0][1], zero), (one, zero, zero))
    return ((c, -s, zero), (s, c, zero), (zero, zero, one))


@kernel
def _draw_errors(settings, stream, work, drift):
    """Fill work.h with the errors W u of a vehicle that looks east; return the normals of d."""
    states, draws = 15, WARM_DRAWS
    if drift is not None:
        states, draws = 18, WARM_DRAWS + WARM_DRIFT_DRAWS
    u, errors = work.z, work.h
    for k in range(8):
        u[2 * k], u[2 * k + 1] = normal_pair(stream, DRAW_WARM + k)
    n_a, n_g = six_normals(stream, DRAW_FIRST_BIASES)
    for i in range(3):
        u[15 + i], u[18 + i] = n_a[i], n_g[i]
    n_d = n_a
    if drift is not None:
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
def start_warm(flight, settings, stream, work, mask, drift=None):
    """Start a converged filter, where `mask`.

    Args:
        flight: Record with the true state and biases; the estimate is set.
        settings: Has the covariance P of a vehicle that looks east, and the root W of it.
        stream: The random stream at the episode's first instant.
        work: Workspace.
        mask: Which lanes.
        drift: Rows of the factor for the slow error of GNSS positions, see `drift.py`, or None.
    """
    states = 15 if drift is None else 18
    R_BI = quaternion_to_dcm(load4(flight.q))
    T = _heading(R_BI)
    n_d = _draw_errors(settings, stream, work, drift)
    d = work.h
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
        left = T if i < E or i == D else eye  # the rest is in B
        for j in range(0, i + 3, 3):
            right = T if j < E or j == D else eye
            block = multiply(left, load_block(settings.warm_covariance, i, j))
            store_block(work.P, i, j, multiply(block, transpose(right)))
    cholesky(work.P, states, work.inverse_diagonal)  # P is known to be positive definite
    for i in range(15):
        for j in range(i + 1):
            flight.L[i, j] = select(mask, work.P[i, j], flight.L[i, j])
    if drift is not None:
        s = load3(settings.warm_drift_sigma)
        true = apply(T, (s[0] * n_d[0], s[1] * n_d[1], s[2] * n_d[2]))
        keep3(flight.gnss_drift, mask, true)
        keep_drift(flight, drift, work, mask, sub(true, apply(T, load3(d[D : D + 3]))))


@stage
def warm_stage(flight, world, model, settings, work, stages, flag):
    """Start a converged filter."""
    flying, scratch = lanes_of(flight), lanes_of(work)
    start_warm(flying, settings, stream_of(flying), scratch, scratch.mask > 0.0)


@stage
def warm_with_drift_stage(flight, world, model, settings, work, stages, flag):
    """The same of a filter that estimates the slow error of GNSS positions."""
    flying, scratch = lanes_of(flight), lanes_of(work)
    mask, drift = scratch.mask > 0.0, flying.L_drift
    start_warm(flying, settings, stream_of(flying), scratch, mask, drift)

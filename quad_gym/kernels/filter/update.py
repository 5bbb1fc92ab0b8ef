"""The filter's update: antenna position, baseline direction and feature directions at once.

See `ukf.py` for the form of the unscented transform and of the update. The stacked measurement is
made of triples, all in I or B: r + R^T l_p, unit(R^T l_b), v + R^T (w x l_p), and for each feature
unit(R (X - r) - l_c), for a direction in the camera frame differs from one in B by a fixed rotation
only. A triple that a lane lacks is masked: its deviations and innovation are zero and its noise is
one, which gives exactly the update without it. Triples that every lane lacks are left out.
"""

import math

import numpy as np

from quad_gym.kernels.compiling import kernel, stage
from quad_gym.kernels.filter.ekf import measure_columns
from quad_gym.kernels.filter.error_state import BA, BG, E, R, V, reset_matrix, turn_factor
from quad_gym.kernels.filter.expected import compare_center, measure_sigma_points
from quad_gym.kernels.filter.innovations import judge_innovations, mark_failed
from quad_gym.kernels.filter.recovery import raise_doubts
from quad_gym.kernels.filter.slow import load_slow, measure_slow, shift_slow
from quad_gym.kernels.maths.elementary import is_finite
from quad_gym.kernels.maths.factors import cholesky, solve_left_vector, solve_right
from quad_gym.kernels.maths.linalg import (
    add,
    add_outer,
    add_to_diagonal,
    keep3,
    keep33,
    load3,
    load33,
    load_block,
    multiply,
    scale,
    scale33,
    store_block,
    sum_of_outers,
    sum_of_outers_of_rows,
    sum_of_squares,
)
from quad_gym.kernels.maths.rotation import euler_to_dcm
from quad_gym.kernels.measurements.aid import expect_aids, judge_aids, measured_by_aids
from quad_gym.kernels.simd.blocks import lanes_of
from quad_gym.kernels.simd.lanes import any_of, logical_not, select
from quad_gym.records import FilterForm, FilterStatus

_EKF, _TURN = int(FilterForm.EKF), int(FilterForm.TURN)
_GATE, _WATCH = int(FilterForm.GATE), int(FilterForm.GATE | FilterForm.INNOVATIONS)
_GRADUAL = int(FilterForm.GRADUAL)
_UPDATE_FAILED = np.uint64(FilterStatus.UPDATE_FAILED)


@kernel
def _innovate(work, n, c):
    """Turn work.z into the innovation: what was measured less what the sigma points expect."""
    S, mu = work.E, work.mu
    for k in range(n):
        total = S[0, k]
        for j in range(1, 9):
            total = total + S[j, k]
        mu[k] = total / c
        work.z[k] = work.z[k] - work.h[k] - mu[k]


@kernel
def _sum_noise(p, work, n, doubt):
    """Multiply the measurement noise in work.Rz by `doubt` and add the even parts' share."""
    S, mu = work.E, work.mu
    excess = p.sigma_beta - p.sigma_spread * p.sigma_spread
    for i in range(0, n, 3):
        mu_i = scale(excess, (mu[i], mu[i + 1], mu[i + 2]))
        for j in range(0, i + 3, 3):
            block = sum_of_outers_of_rows(S, S, i, j, 9)
            block = add_outer(block, mu_i, (mu[j], mu[j + 1], mu[j + 2]))
            if i == j:
                noise = scale33(doubt, load_block(work.Rz, i, i))
                block = (add(block[0], noise[0]), add(block[1], noise[1]), add(block[2], noise[2]))
            store_block(work.Rz, i, j, block)


_DOUBTS = (100.0, 100.0 / 9.0, 100.0 / 90.0)
"""Factors on the noise of the steps of a measurement; the sum of their inverses is one."""


@kernel
def update(flight, p, work, feature_count, mask, form=0, slow=None, stages=None):
    """Condition the estimate on the valid measurements of the present instant, where `mask`.

    A lane whose result is not finite keeps its state bit for bit, sets UPDATE_FAILED and counts it.
    The gate masks after the spread c of the sigma points was chosen for all measurements; c enters
    the moments in their fourth order only.

    With GRADUAL, lanes whose attitude is uncertain process images in steps: three updates by the
    same measurements with more noise, each about the estimate that the one before has left. Their
    information adds up to that of the measurements, so that a linear model would see no difference;
    the derivatives of this one are taken where they matter. (R. Zanetti, "Recursive Update
    Filtering for Nonlinear Estimation", IEEE Trans. Automatic Control 57(6), 2012, on the idea.)

    Args:
        flight: Record; reads the measurements and their validity, changes the estimate.
        p: Parameters as the filter believes them.
        work: Workspace.
        feature_count: Features in use.
        mask: Which lanes.
        form: A `FilterForm`.
        slow: The settings, where sensors have slow errors, see `slow.py`, or None.
        stages: The table of stages, which has those of aiding sensors; None without slow errors.
    """
    loose, first = mask & (p.sigma_spread < 0.0), 2  # nobody
    if (form & _GRADUAL) != 0 and feature_count > 0:
        loose = mask & _is_loose(flight, p, feature_count)
        if any_of(loose):
            first = 0
    failures = flight.update_failures
    for part in range(first, 3):
        doubt = select(loose, _DOUBTS[part], 1.0)
        well = flight.update_failures == failures  # a step that fails is the last
        taking, again = mask & well & (loose | (part == 2)), loose & (part > 0)
        _update_by(flight, p, work, feature_count, taking, form, doubt, again, slow, stages)
    if (form & _GRADUAL) != 0:
        flight.nis = select(loose, np.nan, flight.nis)


@kernel
def _is_loose(flight, p, feature_count):
    """Where the camera sees a feature and the attitude deviates by more than `gradual_above`."""
    seen = flight.feature_valid[0]
    for i in range(1, feature_count):
        seen = seen + flight.feature_valid[i]
    P_ee = sum_of_squares(flight.L, E, 9)
    variance = P_ee[0][0] + P_ee[1][1] + P_ee[2][2]
    return (seen > 0.0) & (variance > p.gradual_above * p.gradual_above)


@kernel
def _update_by(flight, p, work, feature_count, mask, form, doubt, again, slow, stages):
    """Condition the estimate on the measurements with `doubt` times their noise, where `mask`.

    `again`: where these measurements were met before, with another doubt.
    """
    use_position = any_of(flight.position_valid > 0.0)
    use_baseline = any_of(flight.baseline_valid > 0.0)
    use_velocity = any_of(flight.velocity_valid > 0.0)
    states, columns = 15, 9  # of the state, and of L those that matter
    if slow is not None:
        states = 15 + slow.slow_states
        columns = states
    last = columns - 1
    n = compare_center(
        flight, p, work, feature_count, use_position, use_baseline, use_velocity, slow
    )
    first_of_aids = n
    if slow is not None:
        sensors, numbers = measured_by_aids(flight, slow)
        n += 3 * sensors
    if n == 0:
        return
    measured = 3.0 * (flight.position_valid + flight.baseline_valid + flight.velocity_valid)
    for i in range(feature_count):
        measured = measured + 3.0 * flight.feature_valid[i]
    if slow is not None:
        measured = measured + numbers
    estimated = 15 if slow is None else 15 + slow.slow_errors
    c = p.sigma_spread * math.sqrt(p.sigma_kappa + 1.0 * estimated + measured)
    if (form & _EKF) != 0:
        measure_columns(
            flight, p, work, n, feature_count, use_position, use_baseline, use_velocity, last
        )
    else:
        measure_sigma_points(
            flight, p, work, feature_count, use_position, use_baseline, use_velocity, c, last
        )
    if slow is not None:
        measure_slow(flight, slow, work, n, use_position)
    if slow is not None:
        expect_aids(flight, p, work, slow, stages, first_of_aids, c)
    _innovate(work, n, c)
    if (form & _WATCH) != 0:
        if slow is not None:
            judge_aids(flight, p, work, slow, stages, first_of_aids, mask, again)
        left_out = judge_innovations(
            flight,
            p,
            work,
            feature_count,
            use_position,
            use_baseline,
            use_velocity,
            form,
            mask,
            again,
            columns,
            slow,
        )
        measured = measured - left_out
    _sum_noise(p, work, n, doubt)

    # C = A^T Rz^(-T/2), kept as rows of work.A; y = Rz^(-1/2) innovation
    A, z, N, t, L9 = work.A, work.z, work.N, work.t, work.L9
    pivot = cholesky(work.Rz, n, work.inverse_diagonal)
    solve_right(A, columns, work.Rz, n, work.inverse_diagonal, 0)
    solve_left_vector(work.Rz, z, n, work.inverse_diagonal)
    nis = z[0] * z[0]
    for k in range(1, n):
        nis = nis + z[k] * z[k]

    # N = I + C C^T = K K^T, t = K^-1 C y
    for j in range(columns):
        total = A[j, 0] * z[0]
        for k in range(1, n):
            total = total + A[j, k] * z[k]
        t[j] = total
    for i in range(0, columns, 3):
        for j in range(0, i + 3, 3):
            if i == j:
                store_block(N, i, i, add_to_diagonal(sum_of_squares(A, i, n), 1.0))
            else:
                store_block(N, i, j, sum_of_outers(A, i, A, j, n))
    cholesky(N, columns, work.inverse_diagonal)
    solve_left_vector(N, t, columns, work.inverse_diagonal)
    for j in range(columns):
        nis = nis - t[j] * t[j]

    # L9 K^-T: with the columns last first it is the updated factor's, last first again
    L = flight.L
    for i in range(15):
        for j in range(min(columns, 15)):
            L9[i, last - j] = L[i, j]
    if slow is not None:
        load_slow(flight, slow, L9)
    solve_right(L9, states, N, columns, work.inverse_diagonal, columns - 3)

    dx = work.h  # no longer needed
    total = 0.0 * nis
    for i in range(states):
        shift = L9[i, 0] * t[0]
        for j in range(1, columns):
            shift = shift + L9[i, j] * t[j]
        dx[i] = shift
        total = total + shift
    if (form & _TURN) != 0:
        turn_factor(L9, reset_matrix((dx[E], dx[E + 1], dx[E + 2])), states, columns)
    wanted = mask & (measured > 0.0)
    ok = wanted & (pivot > 0.0) & is_finite(total)
    keep3(flight.r_hat, ok, add(load3(flight.r_hat), (dx[R], dx[R + 1], dx[R + 2])))
    keep3(flight.v_hat, ok, add(load3(flight.v_hat), (dx[V], dx[V + 1], dx[V + 2])))
    R_BI = multiply(euler_to_dcm((dx[E], dx[E + 1], dx[E + 2])), load33(flight.R_hat))
    keep33(flight.R_hat, ok, R_BI)
    keep3(flight.b_a_hat, ok, add(load3(flight.b_a_hat), (dx[BA], dx[BA + 1], dx[BA + 2])))
    keep3(flight.b_g_hat, ok, add(load3(flight.b_g_hat), (dx[BG], dx[BG + 1], dx[BG + 2])))
    for i in range(15):
        for j in range(min(i + 1, columns)):
            L[i, j] = select(ok, L9[i, last - j], L[i, j])
    if slow is not None:
        shift_slow(flight, slow, L9, ok, dx)
    flight.nis = select(ok, nis, flight.nis)
    flight.nis_dimension = select(ok, measured, flight.nis_dimension)
    failed = wanted & logical_not(ok)
    flight.filter_status = select(
        failed, flight.filter_status | _UPDATE_FAILED, flight.filter_status
    )
    flight.update_failures = flight.update_failures + select(failed, 1.0, 0.0)
    if (form & _WATCH) != 0 and any_of(failed):
        mark_failed(flight, feature_count, failed, slow)
    if (form & _GATE) != 0:
        raise_doubts(flight, p, work, feature_count, mask & logical_not(failed), slow, stages)


@stage
def update_stage(flight, world, model, settings, work, stages, flag):
    """Update the estimate with the valid measurements; `flag`: how many features are in use."""
    scratch = lanes_of(work)
    update(lanes_of(flight), lanes_of(model), scratch, flag, scratch.mask > 0.0, settings.form)


@stage
def update_with_slow_stage(flight, world, model, settings, work, stages, flag):
    """The same by a filter that estimates slow errors of sensors."""
    flying, scratch = lanes_of(flight), lanes_of(work)
    mask, form = scratch.mask > 0.0, settings.form
    update(flying, lanes_of(model), scratch, flag, mask, form, settings, stages)

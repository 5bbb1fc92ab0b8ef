"""The measurement update of the filter, with all blocks of a measurement at once.

See `predict.py` for the form of the unscented transform, and for the EKF. Sensors
(`kernels/sensors/`) fill three rows of the stacked measurement for each block. A block that a lane
lacks is masked: its columns and innovation are zero and its noise is one, which gives exactly the
update without it. Blocks that no lane has are left out.
"""

import math

import numpy as np

from quad_gym.kernels.compiling import Stage, call_stage, kernel
from quad_gym.kernels.filter.error_state import BA, BG, E, R, V, reset_matrix, turn_factor
from quad_gym.kernels.filter.freedoms import find_directions, nis_along
from quad_gym.kernels.filter.gate import MONITORED
from quad_gym.kernels.filter.measurements import (
    call_measured,
    count_failure,
    count_measured,
    mark_failed,
)
from quad_gym.kernels.filter.monitoring import flag_shifted, follow_corrections
from quad_gym.kernels.filter.rows import columns_of
from quad_gym.kernels.filter.slow import load_slow, shift_slow, stages_of, turn_iron
from quad_gym.kernels.maths.elementary import is_finite, maximum
from quad_gym.kernels.maths.factors import cholesky, solve_left_vector, solve_right
from quad_gym.kernels.maths.linalg import (
    add_to_diagonal,
    dot,
    keep,
    load3,
    load33,
    outer,
    store,
    vector,
)
from quad_gym.kernels.maths.matrices import (
    load_block,
    load_column3,
    store_block,
    sum_of_outers,
    sum_of_outers_of_rows,
    sum_of_squares,
)
from quad_gym.kernels.maths.rotation import euler_to_dcm, split_rotation, split_turn, vector_to_dcm
from quad_gym.kernels.simd.lanes import any_of, logical_not, no_lane, select, zero_like
from quad_gym.records import FEATURE_BLOCKS, Act, FilterForm, GateDecision


@kernel
def _split_turns(flight, work, c, form):
    """Fill work.odd and work.even with the rotations of the sigma points."""
    for j in range(9):
        d = c * load_column3(flight.L, E, j)
        even, odd, _ = split_rotation(d)
        if (form & FilterForm.FIRST_ESTIMATES.value) != 0:
            even, odd = split_turn(d)
        store(work.odd[j], odd)
        store(work.even[j], even)


@kernel
def _innovate(work, n, c):
    """Fill work.nu, the innovation: the measurement minus the mean of the sigma points."""
    even, mu = work.E, work.mu
    for k in range(n):
        total = even[0, k]
        for j in range(1, 9):
            total = total + even[j, k]
        mu[k] = total / c
        work.nu[k] = work.z[k] - work.z_hat[k] - mu[k]


@kernel
def _sum_noise(p, work, n, factor):
    """Multiply the measurement noise in work.Rz by `factor` and add the even parts' share."""
    even, mu = work.E, work.mu
    excess = p.sigma_beta - p.sigma_spread * p.sigma_spread
    for i in range(0, n, 3):
        mu_i = excess * vector(mu[i], mu[i + 1], mu[i + 2])
        for j in range(0, i + 3, 3):
            mu_j = vector(mu[j], mu[j + 1], mu[j + 2])
            block = sum_of_outers_of_rows(even, even, i, j, 9) + outer(mu_i, mu_j)
            if i == j:
                block = factor * load_block(work.Rz, i, i) + block
            store_block(work.Rz, i, j, block)


_FACTORS = (1e6, 1e6 / 9.0, 1e5 / 9.0, 1e4 / 9.0, 1e3 / 9.0, 100.0 / 9.0, 10.0 / 9.0)
"""Factors on the noise of the steps of a measurement; the sum of their inverses is one."""
_LAST = len(_FACTORS) - 1
_FEW, _FIRST_OF_FEW = _LAST - 2, 100.0
"""The first of the last three steps, and its factor where these are enough."""
_VAGUE = 0.2  #: standard deviation of a direction above which three steps are too few [rad]


@kernel
def update(flight, p, work, settings, stages, slow):
    """Update the estimate with the valid measurements of the present instant, where `work.mask`.

    A lane whose result is not finite keeps its state bit for bit, sets UPDATE_FAILED and counts it.
    The gate masks after the spread c of the sigma points was chosen for all measurements; c enters
    the moments in their fourth order only.

    With GRADUAL, lanes whose attitude is uncertain process images in steps: three updates by the
    same measurements with more noise, or seven where a direction is uncertain by `_VAGUE`, each
    about the estimate from the one before. The information of the steps adds up to the
    measurements' own, so a linear model gives the same result as one step; the derivatives of this
    nonlinear one are taken where they matter. (R. Zanetti, "Recursive Update Filtering for
    Nonlinear Estimation", IEEE Trans. Automatic Control 57(6), 2012, on the idea.)
    """
    mask, first, form = work.mask > 0.0, _LAST, settings.form
    loose = no_lane(p.sigma_spread)
    hidden, vague = loose, loose
    if (form & FilterForm.GRADUAL.value) != 0 and settings.feature_count > 0:
        loose, vague = _are_loose(flight, p, work, settings.feature_count)
        loose, vague = mask & loose, mask & vague
        if any_of(loose):
            first = 0 if any_of(vague) else _FEW
            if (form & FilterForm.GATE.value) == 0:  # a gate leaves them out by itself
                hidden = _hide_unsure(flight, work, settings.feature_count, loose)
    failures = flight.update_failures
    for part in range(first, _LAST + 1):
        few = _FIRST_OF_FEW if part == _FEW else _FACTORS[part]
        factor = select(vague, _FACTORS[part], select(loose, few, 1.0))
        well = flight.update_failures == failures  # a step that fails is the last
        taking = mask & well & (vague | (loose & (part >= _FEW)) | (part == _LAST))
        again = (vague & (part > 0)) | (loose & (part > _FEW))
        _update_by(flight, p, work, settings, stages, taking, factor, again, slow)
    if any_of(hidden):
        _show_hidden(flight, work, settings, hidden)
    if (form & FilterForm.GRADUAL.value) != 0:
        flight.nis = select(loose, np.nan, flight.nis)


@kernel
def _are_loose(flight, p, work, feature_count):
    """Lanes in which a visible feature's direction is uncertain, and lanes where it is by `_VAGUE`.

    A direction is uncertain above `recursive_update_threshold`; features that are left out do not
    count as vague. Its error comes from attitude and position; the position's share grows as the
    feature gets nearer. Set work.hidden for features too uncertain for a linear model even in
    steps.
    """
    P_rr, P_ee = sum_of_squares(flight.L, R, 3), sum_of_squares(flight.L, E, 9)
    position = P_rr[0][0] + P_rr[1][1] + P_rr[2][2]
    attitude = P_ee[0][0] + P_ee[1][1] + P_ee[2][2]
    too_much, r = p.recursive_update_threshold * p.recursive_update_threshold, load3(flight.r_hat)
    loose = no_lane(attitude)
    vague = loose
    for i in range(feature_count):
        offset = load3(p.features[i]) - r
        square, seen = dot(offset, offset), flight.block_valid[FEATURE_BLOCKS + i] > 0.0
        loose = loose | (seen & (position > (too_much - attitude) * square))
        unsure = seen & (position > (p.gate_uncertainty - attitude) * square)
        work.hidden[i] = select(unsure, 1.0, 0.0)
        much = seen & (position > (_VAGUE * _VAGUE - attitude) * square)
        vague = vague | (much & logical_not(unsure))
    return loose, loose & vague


@kernel
def _hide_unsure(flight, work, feature_count, mask):
    """Hide features whose directions are too uncertain to use; return the lanes that have any.

    Each step would infer a wrong distance from a wrong direction and make the filter overconfident.
    """
    some = no_lane(work.hidden[0])
    for i in range(feature_count):
        hidden = mask & (work.hidden[i] > 0.0)
        some = some | hidden
        work.hidden[i] = select(hidden, 1.0, 0.0)
        valid = flight.block_valid[FEATURE_BLOCKS + i]
        flight.block_valid[FEATURE_BLOCKS + i] = select(hidden, 0.0, valid)
    return some


@kernel
def _show_hidden(flight, work, settings, mask):
    """Restore hidden features, and mark them as left out: they have no innovation."""
    for i in range(settings.feature_count):
        hidden, block = mask & (work.hidden[i] > 0.0), FEATURE_BLOCKS + i
        flight.block_valid[block] = select(hidden, 1.0, flight.block_valid[block])
        if (settings.form & MONITORED) != 0:
            flight.gate[block] = select(hidden, GateDecision.UNSURE, flight.gate[block])
            flight.block_nis[block] = select(hidden, np.nan, flight.block_nis[block])
            keep(flight.innovation[block], hidden, (np.nan, np.nan, np.nan))
            keep(flight.innovation_sigma[block], hidden, (np.nan, np.nan, np.nan))


@kernel
def _whiten(work, n, columns):
    """Solve the update; return the NIS, and the lanes in which the noise is positive definite.

    On return, work.M is the factor M of I + C C^T = M M^T with C = A^T Rz^(-T/2), and work.y is
    M^-1 C Rz^(-1/2) nu.
    """
    A, nu, M, y = work.A, work.nu, work.M, work.y
    pivot = cholesky(work.Rz, n, work.inverse_diagonal)
    solve_right(A, columns, work.Rz, n, work.inverse_diagonal, 0)  # rows of C
    solve_left_vector(work.Rz, nu, n, work.inverse_diagonal)
    nis = nu[0] * nu[0]
    for k in range(1, n):
        nis = nis + nu[k] * nu[k]
    for j in range(columns):
        total = A[j, 0] * nu[0]
        for k in range(1, n):
            total = total + A[j, k] * nu[k]
        y[j] = total
    for i in range(0, columns, 3):
        for j in range(0, i + 3, 3):
            if i == j:
                store_block(M, i, i, add_to_diagonal(sum_of_squares(A, i, n), 1.0))
            else:
                store_block(M, i, j, sum_of_outers(A, i, A, j, n))
    cholesky(M, columns, work.inverse_diagonal)
    solve_left_vector(M, y, columns, work.inverse_diagonal)
    for j in range(columns):
        nis = nis - y[j] * y[j]
    return nis, pivot > 0.0


@kernel
def _correct(flight, work, states, columns, slow):
    """Fill work.L9 with L9 M^-T, the updated factor, and work.dx; return the sum of dx.

    With the columns last first, L9 M^-T is the updated factor's, last first again.
    """
    L, L9, y, dx, last = flight.L, work.L9, work.y, work.dx, columns - 1
    for i in range(15):
        for j in range(min(columns, 15)):
            L9[i, last - j] = L[i, j]
    if slow is not None:
        load_slow(flight, slow, L9)
    solve_right(L9, states, work.M, columns, work.inverse_diagonal, columns - 3)
    total = zero_like(work.spread)
    for i in range(states):
        shift = L9[i, 0] * y[0]
        for j in range(1, columns):
            shift = shift + L9[i, j] * y[j]
        dx[i] = shift
        total = total + shift
    return total


@kernel
def _keep(flight, p, work, form, columns, ok, slow):
    """Keep the updated estimate and factor, in the lanes `ok`."""
    L, L9, dx, last = flight.L, work.L9, work.dx, columns - 1
    keep(flight.r_hat, ok, load3(flight.r_hat) + load3(dx[R:]))
    keep(flight.v_hat, ok, load3(flight.v_hat) + load3(dx[V:]))
    if (form & FilterForm.FIRST_ESTIMATES.value) != 0:
        keep(flight.v_corrected, ok, load3(flight.v_corrected) + load3(dx[V:]))
    if (form & MONITORED) != 0:
        follow_corrections(flight, p, L9, dx, columns, ok, slow)
    turn = euler_to_dcm(load3(dx[E:]))
    if (form & FilterForm.FIRST_ESTIMATES.value) != 0:
        turn = vector_to_dcm(load3(dx[E:]))
    keep(flight.R_hat, ok, turn @ load33(flight.R_hat))
    keep(flight.b_a_hat, ok, load3(flight.b_a_hat) + load3(dx[BA:]))
    keep(flight.b_g_hat, ok, load3(flight.b_g_hat) + load3(dx[BG:]))
    for i in range(15):
        for j in range(min(i + 1, columns)):
            L[i, j] = select(ok, L9[i, last - j], L[i, j])
    if slow is not None:
        shift_slow(flight, slow, L9, ok, dx)


@kernel
def _update_by(flight, p, work, settings, stages, mask, factor, again, slow):
    """Update with the measurements, their noise multiplied by `factor`, in the lanes `mask`.

    `again`: lanes that process these measurements in a later step.
    """
    n, form = count_measured(flight, work, settings), settings.form
    if n == 0:
        return
    columns, states, estimated = 9, 15, 15
    if slow is not None:
        columns, states = columns_of(slow), 15 + slow.slow_states
        estimated = 15 + slow.slow_errors  # the others only fill up a block
    measured = work.measured
    c = p.sigma_spread * math.sqrt(p.sigma_kappa + 1.0 * estimated + measured)
    work.spread, work.inverse_spread = c, 1.0 / c
    if (form & FilterForm.EKF.value) == 0:
        _split_turns(flight, work, c, form)
    call_measured(flight, p, work, settings, stages, Act.EXPECT)
    _innovate(work, n, c)
    if (form & MONITORED) != 0:
        zero = zero_like(c)
        work.taking, work.again = select(mask, 1.0, 0.0), select(again, 1.0, 0.0)
        work.left_out = zero
        call_stage(stages, Stage.GATE, flight, p, p, settings, work, 0)
        measured = measured - work.left_out
    _sum_noise(p, work, n, factor)
    without = find_directions(flight, p, work, settings)
    along = nis_along(p, work, n)
    nis, definite = _whiten(work, n, columns)
    total = _correct(flight, work, states, columns, slow)
    if (form & FilterForm.TURN.value) != 0:
        correction = load3(work.dx[E:])
        T = reset_matrix(correction)
        if (form & FilterForm.FIRST_ESTIMATES.value) != 0:
            T = vector_to_dcm(correction)
        if slow is not None:
            turn_iron(flight, slow, p, work.L9, T, correction, columns)
        turn_factor(work.L9, T, states, columns)
    wanted = mask & (measured > 0.0)
    ok = wanted & definite & is_finite(total) & is_finite(nis)
    _keep(flight, p, work, form, columns, ok, slow)
    nis = maximum(nis - along, 0.0)  # a difference of rounding errors where it is zero
    if (form & FilterForm.GATE.value) != 0:
        nis = select(work.used_nis > 0.0, nis * work.suite_nis / work.used_nis, nis)
    flight.nis = select(ok, nis, flight.nis)
    flight.nis_dimension = select(ok, measured - without, flight.nis_dimension)
    failed = wanted & logical_not(ok)
    count_failure(flight, failed)
    if (form & MONITORED) != 0 and any_of(failed):
        mark_failed(flight, failed)
    updated = mask & (work.measured > 0.0)
    if (form & FilterForm.GATE.value) != 0:
        work.taking = select(updated & logical_not(failed), 1.0, 0.0)
        call_stage(stages, Stage.RECOVER, flight, p, p, settings, work, 0)
    elif (form & MONITORED) != 0:
        flag_shifted(flight, p, updated)


update_stage, update_with_slow_stage = stages_of("update", update)

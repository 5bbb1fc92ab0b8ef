"""The measurement update of the filter, with all blocks of a measurement at once.

See `predict.py` for the form of the unscented transform, and for the EKF. The update never forms
P_zz. With A and E the columns a / c and s / c of the measurement, and Rz = E E^T + (beta - alpha^2)
mu mu^T + R its noise, so that P_zz = A A^T + Rz, the matrix inversion lemma gives

    P+ = L1 (I + C C^T)^-1 L1^T + diag(0, S),  C = A^T Rz^-T/2,

over the columns L1 that measurements depend on (`columns.py`). As a sum of squares it stays
accurate when a measurement is 10^8 times as good as the prediction.

Sensors (`kernels/sensors/`) fill three rows of the stacked measurement for each block. A block that
a lane lacks is masked: its columns and innovation are zero and its noise is one, which gives
exactly the update without it. Blocks that no lane has are left out.
"""

import math

import numpy as np

from quad_gym.kernels.compiling import Stage, call_stage, kernel
from quad_gym.kernels.filter.columns import columns_of, factor_columns, keep_updated, row_of
from quad_gym.kernels.filter.error_state import (
    BA,
    BG,
    E,
    R,
    V,
    reset_matrix,
    take_up_corrections,
)
from quad_gym.kernels.filter.gate import MONITORED
from quad_gym.kernels.filter.measurements import (
    call_measured,
    count_failure,
    count_measured,
    flag_shifted,
    follow_corrections,
    mark_failed,
    without_directions,
)
from quad_gym.kernels.filter.progressive import (
    FEW,
    MOST_STEPS,
    count_steps,
    drop_even,
    factor_of,
    hide_unsure,
    share_second_order,
    show_hidden,
)
from quad_gym.kernels.filter.slow import shift_slow, stages_of, turn_iron
from quad_gym.kernels.numbers.elementary import is_finite, maximum
from quad_gym.kernels.numbers.factors import cholesky, solve_left_vector, solve_right
from quad_gym.kernels.numbers.lanes import any_of, logical_not, no_lane, select, zero_like
from quad_gym.kernels.numbers.linalg import (
    add_to_diagonal,
    keep,
    load3,
    load33,
    load_block,
    load_column3,
    outer,
    store,
    store_block,
    store_column3,
    sum_of_outers,
    sum_of_outers_of_rows,
    sum_of_squares,
    vector,
)
from quad_gym.kernels.numbers.rotation import (
    euler_to_dcm,
    split_rotation,
    split_turn,
    vector_to_dcm,
)
from quad_gym.records import Act, FilterForm

_LEAST_SHARE = 0.9
"""Share of the blocks' NIS per degree of freedom below which the joint NIS is inexact."""


@kernel
def _split_turns(work, c, form):
    """Fill work.odd and work.even with the rotations of the sigma points."""
    for j in range(3):  # other columns do not change the attitude
        d = c * load_column3(work.L, E, j)
        even, odd, _ = split_rotation(d)
        if (form & FilterForm.FIRST_ESTIMATES.value) != 0:
            even, odd = split_turn(d)
        store(work.odd[j], odd)
        store(work.even[j], even)


@kernel
def _mean_even(work, n, c, rows):
    """Fill work.mu with the mean of the sigma points minus the center."""
    even, mu = work.E, work.mu
    for k in range(n):
        total = even[0, k]
        for j in range(1, rows):
            total = total + even[j, k]
        mu[k] = total / c


@kernel
def _innovate(work, n):
    """Fill work.nu, the innovation: the measurement minus the mean of the sigma points."""
    for k in range(n):
        work.nu[k] = work.z[k] - work.z_hat[k] - work.mu[k]


@kernel
def _sum_noise(p, work, n, factor, rows):
    """Multiply the measurement noise in work.Rz by `factor` and add the even parts' share."""
    even, mu = work.E, work.mu
    excess = p.sigma_beta - p.sigma_spread * p.sigma_spread
    for i in range(0, n, 3):
        mu_i = excess * vector(mu[i], mu[i + 1], mu[i + 2])
        for j in range(0, i + 3, 3):
            mu_j = vector(mu[j], mu[j + 1], mu[j + 2])
            block = sum_of_outers_of_rows(even, even, i, j, rows) + outer(mu_i, mu_j)
            if i == j:
                block = factor * load_block(work.Rz, i, i) + block
            store_block(work.Rz, i, j, block)


@kernel
def _put_noise(work, n):
    """Fill work.Rz where there are no even parts, with the noise of its blocks."""
    for i in range(0, n, 3):
        for j in range(0, i, 3):
            store_block(work.Rz, i, j, zero_like(load_block(work.Rz, i, i)))


@kernel
def update(flight, p, work, settings, stages, slow):
    """Update the estimate with the valid measurements of the present instant, where `work.mask`.

    A lane whose result is not finite keeps its state bit for bit, sets UPDATE_FAILED and counts it.
    The gate masks after the spread c of the sigma points was chosen for all measurements; c enters
    the moments in their fourth order only.

    With GRADUAL, lanes in which a measurement is not linear process it in steps, see
    `progressive.py`.
    """
    mask, form = work.mask > 0.0, settings.form
    if settings.by_motion:
        call_stage(stages, Stage.MOTION, flight, p, p, settings, work, 0)
    gradual, extended = (form & FilterForm.GRADUAL.value) != 0, (form & FilterForm.EKF.value) != 0
    curved = True  # the half-sums of sigma pairs count
    hidden, further = no_lane(p.sigma_spread), zero_like(p.sigma_spread)
    # a gate leaves out features that are too uncertain by itself
    hiding = gradual and settings.feature_count > 0 and (form & FilterForm.GATE.value) == 0
    if gradual:
        for i in range(settings.feature_count):
            work.hidden[i] = zero_like(p.sigma_spread)
    failures, step, last = flight.update_failures, 0, 0
    while step <= last:
        if step > 0 and (form & FilterForm.FIRST_ESTIMATES.value) != 0:
            take_up_corrections(flight, slow, load33(flight.R_hat), further >= 1.0 * step)
        n, pivot = _expect(flight, p, work, settings, stages, slow)
        if n > 0:
            if not extended or gradual:
                _mean_even(work, n, work.spread, settings.motion_columns)
            if gradual and step == 0:
                further = count_steps(flight, p, work, settings, mask)
                if hiding:
                    hiding = False
                    hidden = hide_unsure(flight, work, settings.feature_count, mask)
                    if any_of(hidden):
                        continue  # without them
                for m in range(1, MOST_STEPS + 1):
                    if any_of(further >= 1.0 * m):
                        last = m
            if extended:
                curved = any_of(further > 0.0)
                drop_even(work, n, settings.motion_columns if gradual else 0, further < 1.0)
            well = flight.update_failures == failures  # a step that fails is the last
            taking = mask & well & (further >= 1.0 * step)
            factor = factor_of(further, step)
            steps = (step, further, factor, curved)
            _update_by(flight, p, work, settings, stages, n, taking, steps, pivot, slow)
        step += 1
    if settings.by_motion:
        call_stage(stages, Stage.MOTION, flight, p, p, settings, work, 1)
        if settings.late == 0 or settings.rewinds == 0:  # otherwise at the present instant
            call_stage(stages, Stage.HEADING, flight, p, p, settings, work, 0)
    if any_of(hidden):
        show_hidden(flight, work, settings, hidden)
    if gradual:
        flight.nis = select(further > 0.0, np.nan, flight.nis)


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
def _correct(work, states, columns):
    """Fill work.L9 with L1 M^-T, the root of the updated covariance, and work.dx; return its sum.

    The columns are last first, so that L1 M^-T is a lower triangle as L1 is.
    """
    L9, y, dx, last = work.L9, work.y, work.dx, columns - 1
    for i in range(states):
        for j in range(columns):
            L9[i, last - j] = work.L[i, j]
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
def _keep(flight, p, work, form, states, columns, ok, slow):
    """Keep the updated estimate and covariance, in the lanes `ok`."""
    dx, v, b_a, b_g = work.dx, row_of(slow, V), row_of(slow, BA), row_of(slow, BG)
    keep(flight.r_hat, ok, load3(flight.r_hat) + load3(dx[R:]))
    keep(flight.v_hat, ok, load3(flight.v_hat) + load3(dx[v:]))
    if (form & FilterForm.FIRST_ESTIMATES.value) != 0:
        keep(flight.v_corrected, ok, load3(flight.v_corrected) + load3(dx[v:]))
    if (form & MONITORED) != 0:
        follow_corrections(flight, p, work, columns, ok, slow)
    turn = euler_to_dcm(load3(dx[E:]))
    if (form & FilterForm.FIRST_ESTIMATES.value) != 0:
        turn = vector_to_dcm(load3(dx[E:]))
    keep(flight.R_hat, ok, turn @ load33(flight.R_hat))
    keep(flight.b_a_hat, ok, load3(flight.b_a_hat) + load3(dx[b_a:]))
    keep(flight.b_g_hat, ok, load3(flight.b_g_hat) + load3(dx[b_g:]))
    keep_updated(flight, work, slow, states, columns, ok)
    if slow is not None:
        shift_slow(flight, slow, ok, dx)


@kernel
def _expect(flight, p, work, settings, stages, slow):
    """Fill the stacked measurement, its prediction, noise and columns.

    Returns:
        Its length, and the least pivot of the covariance: negative or NaN where this is none.
    """
    n, form = count_measured(flight, work, settings), settings.form
    states, estimated, pivot = 15, 15, zero_like(p.sigma_spread)
    if slow is not None:
        states = 15 + slow.slow_states
        estimated = 15 + slow.slow_errors  # the others only fill up a block
    c = p.sigma_spread * math.sqrt(p.sigma_kappa + 1.0 * estimated + work.measured)
    work.spread, work.inverse_spread = c, 1.0 / c
    if n > 0:
        pivot = factor_columns(flight, work, slow, states, columns_of(settings))
        if (form & FilterForm.EKF.value) == 0 or (form & FilterForm.GRADUAL.value) != 0:
            _split_turns(work, c, form)
        call_measured(flight, p, work, settings, stages, Act.EXPECT)
    return n, pivot


@kernel
def _update_by(flight, p, work, settings, stages, n, mask, steps, pivot, slow):
    """Update with the n measurements, in the lanes `mask`.

    `steps`: the number of this step with these measurements, the number of steps that follow the
    first, the factor on the noise, and True if second-order terms count. `pivot`: see `_expect`.
    """
    step, further, factor, curved = steps
    form, columns, states = settings.form, columns_of(settings), 15
    if slow is not None:
        states = 15 + slow.slow_states
    measured = work.measured
    _innovate(work, n)
    if (form & MONITORED) != 0:
        zero = zero_like(measured)
        work.taking, work.again = select(mask, 1.0, 0.0), zero + (1.0 if step > 0 else 0.0)
        work.left_out = zero
        call_stage(stages, Stage.GATE, flight, p, p, settings, work, 0)
        measured = measured - work.left_out
    if any_of(further > FEW):
        share_second_order(work, n, settings.motion_columns, further)
    if curved:
        _sum_noise(p, work, n, factor, settings.motion_columns)
    else:
        _put_noise(work, n)
    along, without = without_directions(flight, p, work, settings)
    nis, definite = _whiten(work, n, columns)
    total = _correct(work, states, columns)
    if (form & FilterForm.TURN.value) != 0:
        correction = load3(work.dx[E:])
        T = reset_matrix(correction)
        if (form & FilterForm.FIRST_ESTIMATES.value) != 0:
            T = vector_to_dcm(correction)
        if slow is not None:
            turn_iron(flight, slow, p, work.L9, T, correction, columns)
        for j in range(columns - 3, columns):
            store_column3(work.L9, E, j, T @ load_column3(work.L9, E, j))
    wanted = mask & (measured > 0.0)
    ok = wanted & definite & (pivot >= 0.0) & is_finite(total) & is_finite(nis)
    _keep(flight, p, work, form, states, columns, ok, slow)
    nis = maximum(nis - along, 0.0)  # a difference of rounding errors where it is zero
    if (form & FilterForm.GATE.value) != 0:
        # a joint NIS is at least the mean of its parts; along directions far off, it is inexact
        known = nis * (measured - without) > _LEAST_SHARE * work.used_nis
        weighed = select(known, nis * work.suite_nis / work.used_nis, work.suite_nis)
        nis = select(work.used_nis > 0.0, weighed, nis)
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

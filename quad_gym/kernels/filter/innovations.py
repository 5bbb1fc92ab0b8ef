"""Innovations block by block: their size, how large they were expected, and the gate.

A block is a position, a baseline, a velocity or a feature. With the columns A and E of `ukf_update`
and the block's measurement noise R its innovation has the covariance `S = A A^T + E E^T + (beta -
alpha^2) mu mu^T + R` (3 x 3). A direction has two degrees of freedom: its innovation is taken
across the predicted direction, for along it the length of a unit vector tells nothing.

A block whose normalized innovation squared, chi-square in a filter that is right, lies beyond the
gate is masked as if the flight lacked it. So is a feature whose predicted direction is too
uncertain for a linear model: as a direction's error is bounded it would pass any gate, and its
update would be wrong and sure of itself. Where one kind of measurement has been rejected
`gate_patience` times in a row, the filter is likelier wrong than the sensor, see `recovery.py`.

Source: Y. Bar-Shalom, X. R. Li and T. Kirubarajan, Estimation with Applications to Tracking and
Navigation, 2001, sections 5.4 and 11.
"""

import math

import numpy as np

from quad_gym.kernels.compiling import kernel
from quad_gym.kernels.filter.recovery import (
    FITTING_FEATURES,
    LARGEST,
    camera_fits,
    follow_drift,
    follow_ratio,
)
from quad_gym.kernels.maths.elementary import clip, maximum
from quad_gym.kernels.maths.linalg import (
    add33,
    add_outer,
    apply,
    cross,
    dot,
    load_block,
    scale,
    sum_of_outers_of_rows,
    unit_or,
)
from quad_gym.kernels.simd.lanes import any_of, logical_not, select
from quad_gym.records import (
    BASELINE_BLOCK,
    FEATURE_BLOCKS,
    POSITION_BLOCK,
    VELOCITY_BLOCK,
    FilterForm,
    FilterStatus,
    Gate,
)

_REJECTED, _ACCEPTED = float(Gate.REJECTED), float(Gate.ACCEPTED)
_FAILED, _UNSURE = float(Gate.FAILED), float(Gate.UNSURE)
_UPDATE_FAILED = np.uint64(FilterStatus.UPDATE_FAILED)
_GATE = int(FilterForm.GATE)


@kernel
def _covariance(p, work, k, columns):
    """S of the block that begins at row k of the stacked measurement."""
    S = add33(
        sum_of_outers_of_rows(work.A, work.A, k, k, columns),
        sum_of_outers_of_rows(work.E, work.E, k, k, 9),
    )
    mu = (work.mu[k], work.mu[k + 1], work.mu[k + 2])
    excess = p.sigma_beta - p.sigma_spread * p.sigma_spread
    return add33(add_outer(S, scale(excess, mu), mu), load_block(work.Rz, k, k))


@kernel
def _nis_of_triple(S, nu):
    """nu^T S^-1 nu by the Cholesky factor of S."""
    l00 = math.sqrt(S[0][0])
    l10, l20 = S[1][0] / l00, S[2][0] / l00
    l11 = math.sqrt(S[1][1] - l10 * l10)
    l21 = (S[2][1] - l20 * l10) / l11
    l22 = math.sqrt(S[2][2] - l20 * l20 - l21 * l21)
    y0 = nu[0] / l00
    y1 = (nu[1] - l10 * y0) / l11
    y2 = (nu[2] - l20 * y0 - l21 * y1) / l22
    return y0 * y0 + y1 * y1 + y2 * y2


@kernel
def _across(u, S, nu):
    """Innovation and covariance of a direction, across u: (side, up), (S_ss, S_us, S_uu)."""
    side = unit_or((-u[1], u[0], 0.0 * u[0]), (1.0, 0.0, 0.0))  # vertical x u
    up = cross(u, side)
    S_side, S_up = apply(S, side), apply(S, up)
    return (dot(side, nu), dot(up, nu)), (dot(side, S_side), dot(up, S_side), dot(up, S_up))


@kernel
def _nis_of_direction(S, nu):
    """nu^T S^-1 nu of two numbers."""
    l00 = math.sqrt(S[0])
    l10 = S[1] / l00
    y0 = nu[0] / l00
    y1 = (nu[1] - l10 * y0) / math.sqrt(S[2] - l10 * l10)
    return y0 * y0 + y1 * y1


@kernel
def _keep_block(flight, s, has, nu, sigma, nis, rejected, unsure):
    """Write what is known of block s, where a lane has measured it."""
    for i in range(3):
        flight.innovation[s, i] = select(has, nu[i], flight.innovation[s, i])
        flight.innovation_sigma[s, i] = select(has, sigma[i], flight.innovation_sigma[s, i])
    flight.block_nis[s] = select(has, nis, flight.block_nis[s])
    decision = select(unsure, _UNSURE, select(rejected, _REJECTED, _ACCEPTED))
    flight.gate[s] = select(has, decision, flight.gate[s])
    flight.rejections[s] = select(has & rejected, flight.rejections[s] + 1.0, flight.rejections[s])


@kernel
def _mask_block(work, k, rejected, columns):
    """Leave the block at row k out of the update, where `rejected`."""
    for i in range(k, k + 3):
        for j in range(columns):
            work.A[j, i] = select(rejected, 0.0, work.A[j, i])
        for j in range(9):
            work.E[j, i] = select(rejected, 0.0, work.E[j, i])
        work.mu[i] = select(rejected, 0.0, work.mu[i])
        work.z[i] = select(rejected, 0.0, work.z[i])
        for j in range(k, k + 3):
            work.Rz[i, j] = select(rejected, 1.0 if i == j else 0.0, work.Rz[i, j])


@kernel
def _count_in_row(flight, group, measured, rejected, again):
    """Count a group's rejections in a row; an acceptance begins anew."""
    row = select(rejected, flight.rejected_in_row[group] + 1.0, 0.0)
    measured = measured & logical_not(again)
    flight.rejected_in_row[group] = select(measured, row, flight.rejected_in_row[group])
    accepted, before = measured & logical_not(rejected), flight.accepted_tick[group]
    flight.accepted_tick[group] = select(accepted, flight.tick, before)


@kernel
def _decide(flight, s, has, wanting, again, decision):
    """Where a block gets `decision`: as `wanting` says or, in a later step, as in the first."""
    return has & ((wanting & logical_not(again)) | (again & (flight.gate[s] == decision)))


@kernel
def _judge_triple(flight, p, work, k, s, has, again, gating, columns):
    """Keep the innovation of a position or velocity; return where it is rejected, and its NIS."""
    S = _covariance(p, work, k, columns)
    nu = (work.z[k], work.z[k + 1], work.z[k + 2])
    nis = _nis_of_triple(S, nu)
    rejected = _decide(flight, s, has, (nis > p.gate_position) & gating, again, _REJECTED)
    sigma = (math.sqrt(S[0][0]), math.sqrt(S[1][1]), math.sqrt(S[2][2]))
    nowhere = rejected & logical_not(rejected)
    has = has & logical_not(again)
    _keep_block(flight, s, has, nu, sigma, nis, rejected, nowhere)
    follow_drift(flight, s, has, nu[0] / sigma[0], nu[1] / sigma[1], nu[2] / sigma[2])
    return rejected, select(has, nis, 0.0)


@kernel
def _judge_direction(flight, p, work, k, s, has, again, gating, columns, most):
    """Keep the innovation of a direction; return where it is rejected, and where too uncertain.

    Besides, its innovation in deviations, and its NIS. Too uncertain is one whose predicted
    variances add up to more than `most`.
    """
    S = _covariance(p, work, k, columns)
    u = (work.h[k], work.h[k + 1], work.h[k + 2])
    nu, S2 = _across(u, S, (work.z[k], work.z[k + 1], work.z[k + 2]))
    nis = _nis_of_direction(S2, nu)
    unsure = _decide(flight, s, has, (S2[0] + S2[2] > most) & gating, again, _UNSURE)
    beyond = (nis > p.gate_direction) & gating & logical_not(unsure)
    rejected = _decide(flight, s, has, beyond, again, _REJECTED)
    none = np.nan + 0.0 * nis
    sigma = (math.sqrt(S2[0]), math.sqrt(S2[2]), none)
    has = has & logical_not(again)
    _keep_block(flight, s, has, (nu[0], nu[1], none), sigma, nis, rejected, unsure)
    scaled = (nu[0] / sigma[0], nu[1] / sigma[1])
    return rejected, unsure, scaled, select(has & logical_not(unsure), nis, 0.0)


@kernel
def judge_innovations(
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
):
    """Keep the innovations of the present measurements and mask those beyond the gate.

    Where measurements are processed in steps, the first decides for all.

    Args:
        flight: Record; keeps innovations, NIS, decisions and counters.
        p: Parameters as the filter believes them.
        work: Workspace, with `z` the innovation and `Rz` the measurement noise alone.
        feature_count: Features in use.
        use_position, use_baseline, use_velocity: Whether any lane has them.
        form: A `FilterForm`.
        mask: Which lanes.
        again: Which lanes take a later step of measurements that they have met before.
        columns: Rows of work.A in use.

    Returns:
        How many measurements were masked in each lane.
    """
    gating = (form & _GATE) != 0
    zero = 0.0 * p.sigma_beta
    left_out, total, freedoms = zero, zero, zero
    count, side, up = zero, zero, zero
    trusted = camera_fits(flight, p)
    k = 0
    if use_position:
        has = mask & (flight.position_valid > 0.0)
        rejected, nis = _judge_triple(
            flight, p, work, k, POSITION_BLOCK, has, again, gating, columns
        )
        # a fix that is rejected while the camera fits tells of GNSS, not of the filter
        counts = select(has & logical_not(rejected & trusted), 1.0, 0.0)
        total, freedoms = total + counts * nis, freedoms + 3.0 * counts
        if gating:
            _mask_block(work, k, rejected, columns)
            _count_in_row(flight, POSITION_BLOCK, has, rejected, again)
            left_out = left_out + select(rejected, 3.0, 0.0)
        k += 3
    if use_baseline:
        has = mask & (flight.baseline_valid > 0.0)
        rejected, _, scaled, nis = _judge_direction(
            flight, p, work, k, BASELINE_BLOCK, has, again, gating, columns, np.inf
        )
        first = has & logical_not(again)
        follow_drift(flight, BASELINE_BLOCK, first, scaled[0], scaled[1], zero)
        counts = select(has & logical_not(rejected & trusted), 1.0, 0.0)
        total, freedoms = total + counts * nis, freedoms + 2.0 * counts
        if gating:
            _mask_block(work, k, rejected, columns)
            _count_in_row(flight, BASELINE_BLOCK, has, rejected, again)
            left_out = left_out + select(rejected, 3.0, 0.0)
        k += 3
    if use_velocity:
        has = mask & (flight.velocity_valid > 0.0)
        rejected, nis = _judge_triple(
            flight, p, work, k, VELOCITY_BLOCK, has, again, gating, columns
        )
        total, freedoms = total + nis, freedoms + select(has, 3.0, 0.0)
        if gating:
            _mask_block(work, k, rejected, columns)
            _count_in_row(flight, VELOCITY_BLOCK, has, rejected, again)
            left_out = left_out + select(rejected, 3.0, 0.0)
        k += 3
    seen, refused = zero, zero
    for i in range(feature_count):
        if any_of(flight.feature_valid[i] > 0.0):
            has = mask & (flight.feature_valid[i] > 0.0)
            s = FEATURE_BLOCKS + i
            rejected, unsure, scaled, nis = _judge_direction(
                flight, p, work, k, s, has, again, gating, columns, p.gate_uncertainty
            )
            total = total + nis
            freedoms = freedoms + select(has & logical_not(unsure), 2.0, 0.0)
            counts = select(has & logical_not(unsure | again), 1.0, 0.0)
            count = count + counts
            side = side + counts * clip(scaled[0], -LARGEST, LARGEST)
            up = up + counts * clip(scaled[1], -LARGEST, LARGEST)
            if gating:
                _mask_block(work, k, rejected | unsure, columns)
                left_out = left_out + select(rejected | unsure, 3.0, 0.0)
                seen = seen + select(has & logical_not(unsure), 1.0, 0.0)
                refused = refused + select(rejected, 1.0, 0.0)
            k += 3
    if feature_count > 0:
        root = math.sqrt(maximum(count, 1.0))
        follow_drift(flight, FEATURE_BLOCKS, count > 0.0, side / root, up / root, zero)
    if gating and feature_count > 0:
        _count_in_row(flight, FEATURE_BLOCKS, seen > 0.0, refused >= seen, again)
        fits = (seen - refused >= FITTING_FEATURES) & (2.0 * refused < seen) & logical_not(again)
        flight.fit_tick = select(fits, flight.tick, flight.fit_tick)
    first = mask & logical_not(again)
    follow_ratio(flight, p, total, freedoms, first)
    return left_out


@kernel
def _mark_block(flight, s, failed):
    flight.gate[s] = select(failed, _FAILED, flight.gate[s])


@kernel
def mark_failed(flight, feature_count, failed):
    """Say of the blocks of an update that failed as a whole that none was taken."""
    _mark_block(flight, POSITION_BLOCK, failed & (flight.position_valid > 0.0))
    _mark_block(flight, BASELINE_BLOCK, failed & (flight.baseline_valid > 0.0))
    _mark_block(flight, VELOCITY_BLOCK, failed & (flight.velocity_valid > 0.0))
    for i in range(feature_count):
        _mark_block(flight, FEATURE_BLOCKS + i, failed & (flight.feature_valid[i] > 0.0))


@kernel
def forget_innovations(flight, feature_count, mask):
    """Begin an episode without innovations, where `mask`."""
    for s in range(FEATURE_BLOCKS + feature_count):
        flight.block_nis[s] = select(mask, np.nan, flight.block_nis[s])
        flight.gate[s] = select(mask, 0.0, flight.gate[s])
        flight.rejections[s] = select(mask, 0.0, flight.rejections[s])
        for i in range(3):
            flight.innovation[s, i] = select(mask, np.nan, flight.innovation[s, i])
            flight.innovation_sigma[s, i] = select(mask, np.nan, flight.innovation_sigma[s, i])
    for group in range(4):
        flight.rejected_in_row[group] = select(mask, 0.0, flight.rejected_in_row[group])
        flight.reopened[group] = select(mask, 0.0, flight.reopened[group])

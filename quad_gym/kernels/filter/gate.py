"""The gate: the innovation of one block of the measurement, and its acceptance.

With the columns A and E of `update.py` and the block's measurement noise R, the innovation nu has
the covariance `P_zz = A A^T + E E^T + (beta - alpha^2) mu mu^T + R` (3 x 3). A direction has two
degrees of freedom: its innovation is taken across the predicted direction, as the length of a unit
vector carries no information. A block whose normalized innovation squared (NIS), chi-square in a
consistent filter, lies beyond the gate is masked as if it had not been measured.

Where a group of measurements has been rejected `max_rejections` times in a row, the filter is more
likely wrong than the sensor, see `recovery.py`.

Source: Y. Bar-Shalom, X. R. Li and T. Kirubarajan, Estimation with Applications to Tracking and
Navigation, 2001, section 5.4.
"""

import math

import numpy as np

from quad_gym.kernels.compiling import kernel, stage
from quad_gym.kernels.filter.columns import columns_of
from quad_gym.kernels.filter.measurements import (
    follow_ratio,
    forget_corrections,
    rows_of,
    rows_of_blocks,
)
from quad_gym.kernels.filter.motion import watch_compass
from quad_gym.kernels.filter.recovery import (
    OUTLIER,
    confirmed,
    count_rejections,
    glitches,
    limit_of,
    supported,
)
from quad_gym.kernels.numbers.blocks import reset
from quad_gym.kernels.numbers.elementary import clip, maximum, minimum
from quad_gym.kernels.numbers.lanes import any_of, logical_not, no_lane, select, zero_like
from quad_gym.kernels.numbers.linalg import (
    cross,
    dot,
    keep,
    load3,
    load_block,
    outer,
    store_block,
    sum_of_outers_of_rows,
    unit_or,
    vector,
)
from quad_gym.records import (
    AID_GROUPS,
    BASELINE_BLOCK,
    FEATURE_BLOCKS,
    FIRST_BLOCK,
    FIRST_GROUP,
    GROUP_COUNT,
    GROUP_FREEDOMS,
    SENSORS,
    SEVERAL,
    Aid,
    FilterForm,
    GateDecision,
)

_FREEDOMS = tuple(map(float, GROUP_FREEDOMS))
_COMPASS = AID_GROUPS + int(Aid["MAGNETOMETER"])
_GAIN = 0.05  #: change of a factor on the noise by one measurement
_ADAPTED = 1.3  #: mean NIS over the degrees of freedom above which the noise is adapted
_SERIES = 3.0  #: rejections in a row beyond which further ones do not adapt the noise
_MAX_FACTOR = 25.0  #: largest factor on the variance of a noise: five times its sigma
_POSITION_NUMBERS = 3.0
"""Numbers that determine a position: no more accepted ones agree with any position."""


@kernel
def innovation_covariance(p, work, settings, k):
    """P_zz of the block that begins at row k of the stacked measurement."""
    A, E, mu = work.A, work.E, load3(work.mu[k : k + 3])
    excess = p.sigma_beta - p.sigma_spread * p.sigma_spread
    P_zz = sum_of_outers_of_rows(A, A, k, k, columns_of(settings))
    P_zz = (
        P_zz + sum_of_outers_of_rows(E, E, k, k, settings.motion_columns) + outer(excess * mu, mu)
    )
    return P_zz + load_block(work.Rz, k, k)


@kernel
def _nis(P_zz, nu, numbers):
    """The NIS nu^T P_zz^-1 nu of the first `numbers` numbers, by the Cholesky factor of P_zz."""
    l00, total = math.sqrt(P_zz[0][0]), zero_like(nu[0])
    y0 = nu[0] / l00
    if numbers > 1.0:
        l10 = P_zz[1][0] / l00
        l11 = math.sqrt(P_zz[1][1] - l10 * l10)
        y1 = (nu[1] - l10 * y0) / l11
        total = y0 * y0 + y1 * y1
        if numbers > 2.0:
            l20 = P_zz[2][0] / l00
            l21 = (P_zz[2][1] - l20 * l10) / l11
            l22 = math.sqrt(P_zz[2][2] - l20 * l20 - l21 * l21)
            y2 = (nu[2] - l20 * y0 - l21 * y1) / l22
            total = total + y2 * y2
    else:
        total = y0 * y0
    return total


@kernel
def _across(side, up, P_zz):
    """Covariance of a direction's innovation across it: to the side, up, and none along it."""
    P_side, P_up, zero = P_zz @ side, P_zz @ up, zero_like(side[0])
    upward = dot(up, P_side)
    row = (dot(side, P_side), upward, zero)
    return (row, (upward, dot(up, P_up), zero), (zero, zero, zero))


@kernel
def _store_innovation(flight, s, first, nu, P_zz, numbers, nis):
    """Store the first `numbers` of the innovation of block s, in the lanes `first`."""
    none = np.nan + zero_like(nis)
    sigma = (math.sqrt(P_zz[0][0]), math.sqrt(P_zz[1][1]), math.sqrt(P_zz[2][2]))
    if numbers < 3.0:
        nu, sigma = (nu[0], nu[1], none), (sigma[0], sigma[1], none)
    if numbers < 2.0:
        nu, sigma = (nu[0], none, none), (sigma[0], none, none)
    keep(flight.innovation[s], first, nu)
    keep(flight.innovation_sigma[s], first, sigma)
    flight.block_nis[s] = select(first, nis, flight.block_nis[s])


@kernel
def _store_decision(flight, s, first, rejected, unsure, weakened):
    """Store the decision on block s, in the lanes `first`."""
    decision = select(rejected, GateDecision.REJECTED, GateDecision.ACCEPTED)
    decision = select(weakened, GateDecision.WEAKENED, decision)
    decision = select(unsure, GateDecision.UNSURE, decision)
    flight.gate[s] = select(first, decision, flight.gate[s])
    rejections = flight.rejections[s]
    flight.rejections[s] = select(first & rejected, rejections + 1.0, rejections)


@kernel
def mask_block(work, settings, k, rejected):
    """Mask the block at row k in the lanes `rejected`."""
    for i in range(k, k + 3):
        for j in range(columns_of(settings)):
            work.A[j, i] = select(rejected, 0.0, work.A[j, i])
        for j in range(settings.motion_columns):
            work.E[j, i] = select(rejected, 0.0, work.E[j, i])
        work.mu[i] = select(rejected, 0.0, work.mu[i])
        work.nu[i] = select(rejected, 0.0, work.nu[i])
        for j in range(k, k + 3):
            work.Rz[i, j] = select(rejected, 1.0 if i == j else 0.0, work.Rz[i, j])


@kernel
def _weigh(flight, p, settings, group, beyond, nis, limit):
    """Lanes in which a block `beyond` the gate is rejected, as its sensor is wrong.

    Elsewhere the IMU is wrong, and the block has a bounded weight. A block of several is wrong
    where most others agree with the estimate.
    """
    rejected = no_lane(nis)
    if any_of(beyond):
        rejected = supported(flight, p, settings, group)
        rejected = rejected | glitches(flight, p, group, nis, limit)
        if group in SEVERAL:  # most blocks of the last measurement agreed
            rejected = rejected | (flight.rejected_in_row[group] < 1.0)
    return beyond & rejected


@kernel
def _gate_block(flight, p, work, settings, k, s, group, limit, numbers):
    """Decide on block s of `numbers` numbers, at row k, and mask it where it is left out.

    A later step decides as the first one. The stored standard deviations and NIS are those with the
    suite's noise. A direction is left out where the sum of its predicted variances is too large.

    Returns:
        Lanes in which it is counted; lanes in which it is beyond the gate; lanes in which it is
        rejected as its last measurement; its NIS; half the NIS of its difference from the last one.
    """
    gating, none = (settings.form & FilterForm.GATE.value) != 0, no_lane(work.again)
    valid = (work.taking > 0.0) & (flight.block_valid[s] > 0.0)
    first, R = valid & (work.again <= 0.0), load_block(work.Rz, k, k)
    P_suite, nu = innovation_covariance(p, work, settings, k), load3(work.nu[k : k + 3])
    more = zero_like(R)
    if gating:
        more = (flight.noise_factor[group] - 1.0) * R
        store_block(work.Rz, k, k, R + more)
    whole = P_suite + more
    P_zz, unsure, masked = whole, none, numbers
    if group in (BASELINE_BLOCK, FEATURE_BLOCKS):
        u, masked = load3(work.z_hat[k : k + 3]), 3.0
        side = unit_or((-u[1], u[0], zero_like(u[0])), (1.0, 0.0, 0.0))  # vertical x u
        up = cross(u, side)
        P_suite, P_zz = _across(side, up, P_suite), _across(side, up, whole)
        nu = vector(dot(side, nu), dot(up, nu), zero_like(u[0]))
    if gating and group == FEATURE_BLOCKS:
        unsure = P_zz[0][0] + P_zz[1][1] > p.gate_uncertainty
    nis, change = _nis(P_zz, nu, numbers), nu - load3(flight.innovation[s])
    scatter = 0.5 * _nis(P_zz, change, numbers)
    suite_nis, used_nis = _nis(P_suite, nu, numbers), nis
    _store_innovation(flight, s, first, nu, P_suite, numbers, suite_nis)
    beyond, rejected = none, none
    if gating:
        beyond = first & logical_not(unsure) & (nis > limit_of(flight, group, limit))
        if group == _COMPASS:
            beyond = beyond | watch_compass(flight, p, first, nis < limit, nis > OUTLIER * limit)
        rejected = _weigh(flight, p, settings, group, beyond, nis, limit)
    weakened = beyond & logical_not(rejected)
    again = rejected & (flight.gate[s] == GateDecision.REJECTED)
    _store_decision(flight, s, first, rejected, unsure, weakened)
    if gating:
        gate = flight.gate[s]
        weakened = valid & (gate == GateDecision.WEAKENED)
        if any_of(weakened):
            share = select(weakened, maximum(nis / limit - 1.0, 0.0), 0.0)
            store_block(work.Rz, k, k, load_block(work.Rz, k, k) + share * whole)
            used_nis = nis / (1.0 + share)
        out = valid & ((gate == GateDecision.REJECTED) | (gate == GateDecision.UNSURE))
        mask_block(work, settings, k, out)
        work.left_out = work.left_out + select(out, masked, 0.0)
        used = valid & logical_not(out)
        work.suite_nis = work.suite_nis + select(used, suite_nis, 0.0)
        work.used_nis = work.used_nis + select(used, used_nis, 0.0)
    return first & logical_not(unsure), beyond, again, nis, scatter


@kernel
def gate_blocks(flight, p, work, settings, k, first, count, group, limit, numbers):
    """Decide on the blocks of a group from `first` on, at row k, and mask those left out.

    The group counts as rejected if half of its blocks are; otherwise rejected ones do not count.
    Rejections do not count against a filter that other sensors support. A block that is rejected
    again counts if the accepted ones determine a position without redundancy: three ranges agree
    with any estimate that has followed them, so a fourth one is the only evidence against it.
    """
    zero = zero_like(flight.tick)
    counted, refused, total, kept, scattered = zero, zero, zero, zero, zero
    denied, denials = zero, zero
    for s in range(first, first + count):
        if any_of(flight.block_valid[s] > 0.0):
            valid, beyond, again, nis, scatter = _gate_block(
                flight, p, work, settings, k, s, group, limit, numbers
            )
            denied = denied + select(valid & again, nis, 0.0)
            denials = denials + select(valid & again, 1.0, 0.0)
            counted, refused = counted + select(valid, 1.0, 0.0), refused + select(beyond, 1.0, 0.0)
            total = total + select(valid, nis, 0.0)
            kept = kept + select(valid & logical_not(beyond), nis, 0.0)
            scattered = scattered + select(valid, scatter, 0.0)
            k += 3
    measured, most = counted > 0.0, (counted > 0.0) & (refused >= 0.5 * counted)
    several, few = maximum(counted, 1.0), maximum(counted - refused, 1.0)
    nis, excused = select(most, total / several, kept / few), no_lane(zero)
    glitch = excused
    if any_of(most):
        excused = most & supported(flight, p, settings, group)
        glitch = most & glitches(flight, p, group, nis, limit)
    if (settings.form & FilterForm.GATE.value) != 0:
        _adapt_noise(flight, group, measured, scattered / several, numbers, limit)
    count_rejections(flight, group, measured, most, glitch)
    if group in SEVERAL:
        alone = (denials > 0.0) & logical_not(most)
        alone = alone & ((counted - refused) * numbers <= _POSITION_NUMBERS)
        if any_of(alone):
            alone = alone & logical_not(confirmed(flight, p, settings, group))
            nis = select(alone, (kept + denied) / maximum(counted - refused + denials, 1.0), nis)
    judged = measured & logical_not(excused)
    work.judged_nis = work.judged_nis + select(judged, nis, 0.0)
    work.judged_freedoms = work.judged_freedoms + select(judged, numbers, 0.0)


@kernel
def _gate_sensors(flight, p, work, settings):
    """Decide on the blocks of all groups with a measurement in any lane."""
    k = 0
    for sensor in range(SENSORS):
        if rows_of(flight, settings, sensor) > 0:
            for i in range(GROUP_COUNT[sensor]):
                first, group = FIRST_BLOCK[sensor] + i, FIRST_GROUP[sensor] + i
                # where a sensor has several groups, each is a block
                count = settings.sensor_blocks[sensor] if GROUP_COUNT[sensor] == 1 else 1
                rows = rows_of_blocks(flight, first, count)
                if rows > 0:
                    limit, numbers = p.gate[group], _FREEDOMS[group]
                    gate_blocks(flight, p, work, settings, k, first, count, group, limit, numbers)
                k += rows


@kernel
def _adapt_noise(flight, group, first, scatter, freedoms, limit):
    """Match the factor on a group's noise to the scatter of its innovations, where `first`.

    The scatter is half the NIS of the difference of two successive innovations. Its mean is the
    number of degrees of freedom if the noise is right; errors that the two have in common, of
    biases or of a fault, cancel. The factor grows while the mean exceeds `_ADAPTED` times that.
    Outliers, and further ones of a series beyond the gate, do not count.
    """
    mild = (scatter < OUTLIER * limit) & (flight.rejected_in_row[group] < _SERIES)
    factor = flight.noise_factor[group]
    growth = 1.0 + _GAIN * (minimum(scatter, limit) / freedoms - _ADAPTED)
    factor = select(first & mild, clip(growth * factor, 1.0, _MAX_FACTOR), factor)
    flight.noise_factor[group] = factor


MONITORED = int(FilterForm.GATE | FilterForm.INNOVATIONS)
"""Bits of a `FilterForm` with which innovations are stored, and the filter is monitored."""


@stage
def gate_stage(flight, world, model, settings, work, stages, flag):
    """Store the innovations of the present measurements and mask those beyond the gate.

    Works in the lanes work.taking. Where measurements are processed in steps, the first step
    decides for all: work.again are the lanes in a later step. On return, work.left_out counts the
    masked numbers of each lane.
    """
    zero = zero_like(model.sigma_beta)
    work.judged_nis, work.judged_freedoms = zero, zero
    work.suite_nis, work.used_nis = zero, zero
    _gate_sensors(flight, model, work, settings)
    first = (work.taking > 0.0) & (work.measured > 0.0) & logical_not(work.again > 0.0)
    follow_ratio(flight, model, work.judged_nis, work.judged_freedoms, first)


@kernel
def forget_innovations(flight, mask):
    """Reset the innovations at the start of an episode, in the lanes `mask`."""
    reset(flight, mask, np.nan, "block_nis innovation innovation_sigma")
    reset(flight, mask, 0.0, "gate rejections rejected_in_row resets")
    forget_corrections(flight, mask)

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

from quad_gym.kernels.compiling import kernel
from quad_gym.kernels.filter.measurements import call_measured
from quad_gym.kernels.filter.monitoring import (
    LARGEST,
    follow_mean,
    follow_ratio,
    forget_corrections,
)
from quad_gym.kernels.filter.recovery import (
    OUTLIER,
    accept_group,
    count_rejections,
    glitches,
    limit_of,
    supported,
)
from quad_gym.kernels.filter.rows import columns_of
from quad_gym.kernels.maths.elementary import clip, maximum, minimum
from quad_gym.kernels.maths.linalg import cross, dot, keep, load3, outer, unit_or
from quad_gym.kernels.maths.matrices import load_block, store_block, sum_of_outers_of_rows
from quad_gym.kernels.simd.blocks import reset
from quad_gym.kernels.simd.lanes import any_of, logical_not, no_lane, select, zero_like
from quad_gym.records import (
    AID_BLOCKS,
    AID_ROWS,
    FEATURE_BLOCKS,
    SEVERAL,
    Act,
    FilterForm,
    GateDecision,
)

_GAIN = 0.05  #: change of a factor on the noise by one measurement
_ADAPTED = 1.3  #: mean NIS over the degrees of freedom above which the noise is adapted
_SERIES = 3.0  #: rejections in a row beyond which further ones do not adapt the noise
_MAX_FACTOR = 25.0  #: largest factor on the variance of a noise: five times its sigma


@kernel
def _covariance(p, work, settings, k):
    """P_zz of the block that begins at row k of the stacked measurement."""
    A, E, mu = work.A, work.E, load3(work.mu[k : k + 3])
    excess = p.sigma_beta - p.sigma_spread * p.sigma_spread
    P_zz = sum_of_outers_of_rows(A, A, k, k, columns_of(settings))
    P_zz = P_zz + sum_of_outers_of_rows(E, E, k, k, 9) + outer(excess * mu, mu)
    return P_zz + load_block(work.Rz, k, k)


@kernel
def _nis_of_triple(P_zz, nu):
    """The NIS nu^T P_zz^-1 nu, by the Cholesky factor of P_zz."""
    l00 = math.sqrt(P_zz[0][0])
    l10, l20 = P_zz[1][0] / l00, P_zz[2][0] / l00
    l11 = math.sqrt(P_zz[1][1] - l10 * l10)
    l21 = (P_zz[2][1] - l20 * l10) / l11
    l22 = math.sqrt(P_zz[2][2] - l20 * l20 - l21 * l21)
    y0 = nu[0] / l00
    y1 = (nu[1] - l10 * y0) / l11
    y2 = (nu[2] - l20 * y0 - l21 * y1) / l22
    return y0 * y0 + y1 * y1 + y2 * y2


@kernel
def _across(u, P_zz, nu):
    """Innovation and covariance of a direction, across u: (side, up), (P_ss, P_us, P_uu)."""
    side = unit_or((-u[1], u[0], zero_like(u[0])), (1.0, 0.0, 0.0))  # vertical x u
    up = cross(u, side)
    P_side, P_up = P_zz @ side, P_zz @ up
    return (dot(side, nu), dot(up, nu)), (dot(side, P_side), dot(up, P_side), dot(up, P_up))


@kernel
def _nis_of_direction(P_zz, nu):
    """The NIS of two numbers."""
    l00 = math.sqrt(P_zz[0])
    l10 = P_zz[1] / l00
    y0 = nu[0] / l00
    y1 = (nu[1] - l10 * y0) / math.sqrt(P_zz[2] - l10 * l10)
    return y0 * y0 + y1 * y1


@kernel
def _minus(nu, last, numbers):
    """Difference of an innovation and the last one; zero behind its `numbers`."""
    if numbers < 3.0:
        return (nu[0] - last[0], zero_like(nu[0]), zero_like(nu[0]))
    return (nu[0] - last[0], nu[1] - last[1], nu[2] - last[2])


@kernel
def _store_innovation(flight, s, first, nu, sigma, nis, rejected, unsure, weakened):
    """Store the innovation of block s and the decision on it, in the lanes `first`."""
    keep(flight.innovation[s], first, nu)
    keep(flight.innovation_sigma[s], first, sigma)
    flight.block_nis[s] = select(first, nis, flight.block_nis[s])
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
        for j in range(9):
            work.E[j, i] = select(rejected, 0.0, work.E[j, i])
        work.mu[i] = select(rejected, 0.0, work.mu[i])
        work.nu[i] = select(rejected, 0.0, work.nu[i])
        for j in range(k, k + 3):
            work.Rz[i, j] = select(rejected, 1.0 if i == j else 0.0, work.Rz[i, j])


@kernel
def _decide(flight, s, valid, wanted, again, decision):
    """Lanes in which a block gets `decision`: as `wanted`, in a later step as in the first."""
    return valid & ((wanted & logical_not(again)) | (again & (flight.gate[s] == decision)))


@kernel
def _weigh(flight, p, settings, group, s, valid, nis, limit, again):
    """Lanes in which block s is rejected, and lanes in which its noise is increased.

    An innovation beyond the gate is an error of the sensor, or else of the IMU; then it has a
    bounded weight. A block of several is wrong where most others agree with the estimate.
    """
    rejected, weakened = no_lane(nis), no_lane(nis)
    if (settings.form & FilterForm.GATE.value) != 0:
        beyond = valid & (nis > limit_of(flight, group, limit))
        if any_of(beyond):
            hard = supported(flight, p, settings, group)
            hard = hard | glitches(flight, p, settings, group, nis, limit)
            if group in SEVERAL:  # most blocks of the last measurement agreed
                hard = hard | (flight.rejected_in_row[group] < 1.0)
            rejected = beyond & hard
            weakened = beyond & logical_not(hard)
    rejected = _decide(flight, s, valid, rejected, again, GateDecision.REJECTED)
    weakened = _decide(flight, s, valid, weakened, again, GateDecision.WEAKENED)
    return rejected, weakened


@kernel
def weaken(work, k, weakened, share, P_zz):
    """Add a share of P_zz to the noise of the block at row k, in the lanes `weakened`."""
    if any_of(weakened):
        share = select(weakened, maximum(share, 0.0), 0.0)  # a later step may be within the gate
        more = load_block(work.Rz, k, k) + share * P_zz
        store_block(work.Rz, k, k, more)


@kernel
def add_nis(work, counted, nis, freedoms):
    """Add a block to the statistics of the whole measurement, in the lanes `counted`."""
    work.judged_nis = work.judged_nis + select(counted, nis, 0.0)
    work.judged_freedoms = work.judged_freedoms + select(counted, freedoms, 0.0)


@kernel
def _gate_block(flight, p, work, settings, k, s, group, limit, numbers):
    """Store the innovation of block s, at row k, and decide on it.

    Its stored standard deviations and NIS are those with the suite's noise. A block with fewer
    `numbers` than three has masked rows behind them, which add nothing to its NIS.

    Returns:
        Lanes in which it is valid; lanes in which it is beyond the gate; its NIS; half the NIS of
        its difference from the last one; its innovation in standard deviations.
    """
    again = work.again > 0.0
    valid = (work.taking > 0.0) & (flight.block_valid[s] > 0.0)
    P_suite, nu = _covariance(p, work, settings, k), load3(work.nu[k : k + 3])
    P_zz = P_suite + scale_noise(flight, work, settings, k, group)
    nis, last = _nis_of_triple(P_zz, nu), flight.innovation[s]
    scatter = 0.5 * _nis_of_triple(P_zz, _minus(nu, last, numbers))
    rejected, weakened = _weigh(flight, p, settings, group, s, valid, nis, limit, again)
    weaken(work, k, weakened, nis / limit - 1.0, P_zz)
    sigma = (math.sqrt(P_zz[0][0]), math.sqrt(P_zz[1][1]), math.sqrt(P_zz[2][2]))
    scaled = (nu[0] / sigma[0], nu[1] / sigma[1], nu[2] / sigma[2])
    sigma = (math.sqrt(P_suite[0][0]), math.sqrt(P_suite[1][1]), math.sqrt(P_suite[2][2]))
    nis_suite = _nis_of_triple(P_suite, nu)
    if numbers < 3.0:
        none = np.nan + zero_like(nis)
        nu, sigma = (nu[0], none, none), (sigma[0], none, none)
        scaled = (scaled[0], zero_like(nis), zero_like(nis))
    first = valid & logical_not(again)
    _store_innovation(flight, s, first, nu, sigma, nis_suite, rejected, nis < nis, weakened)
    return valid, rejected | weakened, nis, scatter, scaled


@kernel
def gate_numbers(flight, p, work, settings, k, s, group, limit, numbers):
    """Store the innovation of block s, at row k, and mask it where its NIS exceeds `limit`.

    Rejections do not count against a filter that other sensors support.
    """
    valid, beyond, nis, scatter, scaled = _gate_block(
        flight, p, work, settings, k, s, group, limit, numbers
    )
    first = valid & logical_not(work.again > 0.0)
    judge(flight, p, work, settings, group, first, beyond, nis, scatter, numbers, limit)
    follow_mean(flight, group, first & logical_not(beyond), scaled)
    mask_rejected(flight, work, settings, k, s, valid, numbers)


@kernel
def no_blocks(flight):
    """Statistics of a measurement of several blocks before the first one, see `add_block`."""
    zero = zero_like(flight.tick)
    return zero, zero, zero, zero, zero, (zero, zero, zero)


@kernel
def add_block(statistics, counted, beyond, nis, scatter, scaled):
    """Add a block to the statistics of its measurement, in the lanes `counted`.

    These are the counts of blocks and of those beyond the gate, the sum of NIS of all and of the
    others, the sum of the scatter, and the sum of the others' innovations.
    """
    count, refused, total, kept, scattered, mean = statistics
    used = counted & logical_not(beyond)
    x, y, z = scaled
    return (
        count + select(counted, 1.0, 0.0),
        refused + select(counted & beyond, 1.0, 0.0),
        total + select(counted, nis, 0.0),
        kept + select(used, nis, 0.0),
        scattered + select(counted, scatter, 0.0),
        (
            mean[0] + select(used, clip(x, -LARGEST, LARGEST), 0.0),
            mean[1] + select(used, clip(y, -LARGEST, LARGEST), 0.0),
            mean[2] + select(used, clip(z, -LARGEST, LARGEST), 0.0),
        ),
    )


@kernel
def judge_several(flight, p, work, settings, group, statistics, freedoms, limit):
    """Take account of a measurement of several blocks.

    It counts as rejected if half of its blocks are; otherwise rejected ones do not count.
    """
    count, refused, total, kept, scatter, (x, y, z) = statistics
    first, most = count > 0.0, refused >= 0.5 * count
    several, few = maximum(count, 1.0), maximum(count - refused, 1.0)
    nis = select(most, total / several, kept / few)
    scatter, root = scatter / several, math.sqrt(few)
    judge(flight, p, work, settings, group, first, first & most, nis, scatter, freedoms, limit)
    follow_mean(flight, group, first & logical_not(most), (x / root, y / root, z / root))


@kernel
def gate_several(flight, p, work, settings, k, first, count, group, limit, numbers):
    """Do the same as `gate_numbers` for a measurement of blocks that are accepted one by one."""
    statistics = no_blocks(flight)
    for s in range(first, first + count):
        if any_of(flight.block_valid[s] > 0.0):
            valid, beyond, nis, scatter, scaled = _gate_block(
                flight, p, work, settings, k, s, group, limit, numbers
            )
            counted = valid & logical_not(work.again > 0.0)
            statistics = add_block(statistics, counted, beyond, nis, scatter, scaled)
            mask_rejected(flight, work, settings, k, s, valid, numbers)
            k += 3
    judge_several(flight, p, work, settings, group, statistics, numbers, limit)


@kernel
def gate_direction(flight, p, work, settings, k, s, group, valid, limit):
    """Store the innovation of a direction, block s, in the lanes `valid`.

    Returns:
        Lanes in which it is beyond the gate; lanes in which it is too uncertain, where the sum of
        its predicted variances exceeds `limit`; its NIS; half the NIS of its difference from the
        last one; its innovation in standard deviations.
    """
    gating, again = (settings.form & FilterForm.GATE.value) != 0, work.again > 0.0
    u, nu = load3(work.z_hat[k : k + 3]), load3(work.nu[k : k + 3])
    whole = _covariance(p, work, settings, k)
    nu_3 = nu
    nu, P_suite = _across(u, whole, nu_3)
    whole = whole + scale_noise(flight, work, settings, k, group)
    _, P_zz = _across(u, whole, nu_3)
    nis, last = _nis_of_direction(P_zz, nu), flight.innovation[s]
    scatter = 0.5 * _nis_of_direction(P_zz, (nu[0] - last[0], nu[1] - last[1]))
    vague = (P_zz[0] + P_zz[2] > limit) & gating
    unsure = _decide(flight, s, valid, vague, again, GateDecision.UNSURE)
    sure, most = valid & logical_not(unsure), p.gate_direction
    rejected, weakened = _weigh(flight, p, settings, group, s, sure, nis, most, again)
    weaken(work, k, weakened, nis / most - 1.0, whole)
    none = np.nan + zero_like(nis)
    scaled = (nu[0] / math.sqrt(P_zz[0]), nu[1] / math.sqrt(P_zz[2]))
    sigma = (math.sqrt(P_suite[0]), math.sqrt(P_suite[2]), none)
    nis_suite = _nis_of_direction(P_suite, nu)
    first = valid & logical_not(again)
    _store_innovation(
        flight, s, first, (nu[0], nu[1], none), sigma, nis_suite, rejected, unsure, weakened
    )
    return rejected | weakened, unsure, nis, scatter, scaled


@kernel
def mask_rejected(flight, work, settings, k, s, valid, numbers):
    """Mask block s at row k in the lanes in which it is left out."""
    if (settings.form & FilterForm.GATE.value) != 0:
        gate = flight.gate[s]
        rejected = valid & ((gate == GateDecision.REJECTED) | (gate == GateDecision.UNSURE))
        mask_block(work, settings, k, rejected)
        work.left_out = work.left_out + select(rejected, numbers, 0.0)


@kernel
def scale_noise(flight, work, settings, k, group):
    """Multiply the noise of the block at row k by the factor of its group; return the increase."""
    R = load_block(work.Rz, k, k)
    more = zero_like(R)
    if (settings.form & FilterForm.GATE.value) != 0:
        more = (flight.noise_factor[group] - 1.0) * R
        store_block(work.Rz, k, k, R + more)
    return more


@kernel
def judge(flight, p, work, settings, group, first, beyond, nis, scatter, freedoms, limit):
    """Take account of the NIS of a group in the lanes `first`, `beyond` the gate in some.

    Rejections do not count against a filter that other sensors support.
    """
    if (settings.form & FilterForm.GATE.value) != 0:
        glitch, excused = beyond, beyond
        if any_of(beyond):
            excused = beyond & supported(flight, p, settings, group)
            glitch = beyond & glitches(flight, p, settings, group, nis, limit)
        add_nis(work, first & logical_not(excused), nis, freedoms)
        adapt_noise(flight, group, first, scatter, freedoms, limit)
        count_rejections(flight, group, first, beyond, glitch, nis)
    else:
        add_nis(work, first, nis, freedoms)
        accept_group(flight, group, first)


@kernel
def adapt_noise(flight, group, first, scatter, freedoms, limit):
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


@kernel
def gate_innovations(flight, p, work, settings, stages, mask, again):
    """Store the innovations of the present measurements and mask those beyond the gate.

    Where measurements are processed in steps, the first step decides for all: `again` are the lanes
    in a later step. On return, work.left_out counts the masked numbers of each lane.
    """
    zero = zero_like(p.sigma_beta)
    work.taking, work.again = select(mask, 1.0, 0.0), select(again, 1.0, 0.0)
    work.judged_nis, work.judged_freedoms, work.left_out = zero, zero, zero
    call_measured(flight, p, work, settings, stages, Act.GATE)
    first = mask & (work.measured > 0.0) & logical_not(again)
    follow_ratio(flight, p, work.judged_nis, work.judged_freedoms, first)


@kernel
def forget_innovations(flight, feature_count, mask):
    """Reset the innovations at the start of an episode, in the lanes `mask`."""
    blocks, none = FEATURE_BLOCKS + feature_count, (np.nan, np.nan, np.nan)
    for k in range(blocks + AID_ROWS):
        s = k if k < blocks else k - blocks + AID_BLOCKS
        flight.block_nis[s] = select(mask, np.nan, flight.block_nis[s])
        flight.gate[s] = select(mask, 0.0, flight.gate[s])
        flight.rejections[s] = select(mask, 0.0, flight.rejections[s])
        keep(flight.innovation[s], mask, none)
        keep(flight.innovation_sigma[s], mask, none)
    forget_corrections(flight, mask)
    reset(flight, mask, 0.0, "rejected_in_row resets")

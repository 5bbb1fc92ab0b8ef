"""The gate: the innovation of one block of the measurement, and its acceptance.

With the columns A and E of `update.py` and the block's measurement noise R, the innovation has the
covariance `S = A A^T + E E^T + (beta - alpha^2) mu mu^T + R` (3 x 3). A direction has two degrees
of freedom: its innovation is taken across the predicted direction, as the length of a unit vector
carries no information. A block whose normalized innovation squared (NIS), chi-square in a
consistent filter, lies beyond the gate is masked as if it had not been measured.

Source: Y. Bar-Shalom, X. R. Li and T. Kirubarajan, Estimation with Applications to Tracking and
Navigation, 2001, section 5.4.
"""

import math

import numpy as np

from quad_gym.kernels.compiling import kernel
from quad_gym.kernels.filter.recovery import follow_drift
from quad_gym.kernels.filter.rows import columns_of
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
from quad_gym.kernels.simd.lanes import logical_not, select
from quad_gym.records import FilterForm, GateDecision

_GATE = int(FilterForm.GATE)
_REJECTED, _ACCEPTED = float(GateDecision.REJECTED), float(GateDecision.ACCEPTED)
_UNSURE = float(GateDecision.UNSURE)


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
def _store_block(flight, s, first, nu, sigma, nis, rejected, unsure):
    """Store the innovation of block s and the decision on it, in the lanes `first`."""
    for i in range(3):
        flight.innovation[s, i] = select(first, nu[i], flight.innovation[s, i])
        flight.innovation_sigma[s, i] = select(first, sigma[i], flight.innovation_sigma[s, i])
    flight.block_nis[s] = select(first, nis, flight.block_nis[s])
    decision = select(unsure, _UNSURE, select(rejected, _REJECTED, _ACCEPTED))
    flight.gate[s] = select(first, decision, flight.gate[s])
    rejections = flight.rejections[s]
    flight.rejections[s] = select(first & rejected, rejections + 1.0, rejections)


@kernel
def mask_block(work, k, rejected, columns):
    """Mask the block at row k in the lanes `rejected`."""
    for i in range(k, k + 3):
        for j in range(columns):
            work.A[j, i] = select(rejected, 0.0, work.A[j, i])
        for j in range(9):
            work.E[j, i] = select(rejected, 0.0, work.E[j, i])
        work.mu[i] = select(rejected, 0.0, work.mu[i])
        work.nu[i] = select(rejected, 0.0, work.nu[i])
        for j in range(k, k + 3):
            work.Rz[i, j] = select(rejected, 1.0 if i == j else 0.0, work.Rz[i, j])


@kernel
def count_rejections(flight, group, first, rejected):
    """Count the consecutive rejections of a group of measurements."""
    count = select(rejected, flight.rejected_in_row[group] + 1.0, 0.0)
    flight.rejected_in_row[group] = select(first, count, flight.rejected_in_row[group])
    accept_group(flight, group, first & logical_not(rejected))


@kernel
def accept_group(flight, group, accepted):
    """Note the time of a group's last accepted measurement."""
    before = flight.accepted_tick[group]
    flight.accepted_tick[group] = select(accepted, flight.tick, before)


@kernel
def _decide(flight, s, valid, wanted, again, decision):
    """Lanes in which a block gets `decision`: as `wanted`, in a later step as in the first."""
    return valid & ((wanted & logical_not(again)) | (again & (flight.gate[s] == decision)))


@kernel
def add_nis(work, counted, nis, freedoms):
    """Add a block to the statistics of the whole measurement, in the lanes `counted`."""
    work.judged_nis = work.judged_nis + select(counted, nis, 0.0)
    work.judged_freedoms = work.judged_freedoms + select(counted, freedoms, 0.0)


@kernel
def gate_numbers(flight, p, work, settings, k, s, group, valid, limit, numbers):
    """Store the innovation of block s; return the lanes in which it is rejected, and its NIS.

    A block of one number has two masked rows behind it, which add nothing to its NIS.

    Args:
        flight: Record.
        p: Parameters assumed by the filter.
        work: Workspace.
        settings: The filter's form.
        k: First row in the stacked measurement.
        s: Number of the block.
        group: Its group.
        valid: Lanes that have measured it, among those to be updated.
        limit: Largest accepted NIS.
        numbers: 1.0 or 3.0.
    """
    gating, again = (settings.form & _GATE) != 0, work.again > 0.0
    S = _covariance(p, work, k, columns_of(settings))
    nu = (work.nu[k], work.nu[k + 1], work.nu[k + 2])
    nis = _nis_of_triple(S, nu)
    rejected = _decide(flight, s, valid, (nis > limit) & gating, again, _REJECTED)
    sigma = (math.sqrt(S[0][0]), math.sqrt(S[1][1]), math.sqrt(S[2][2]))
    scaled = (nu[0] / sigma[0], nu[1] / sigma[1], nu[2] / sigma[2])
    if numbers < 3.0:
        none = np.nan + 0.0 * nis
        nu, sigma = (nu[0], none, none), (sigma[0], none, none)
        scaled = (scaled[0], 0.0 * nis, 0.0 * nis)
    nowhere, first = rejected & logical_not(rejected), valid & logical_not(again)
    _store_block(flight, s, first, nu, sigma, nis, rejected, nowhere)
    follow_drift(flight, group, first, scaled[0], scaled[1], scaled[2])
    return rejected, nis


@kernel
def gate_direction(flight, p, work, settings, k, s, valid, limit):
    """Store the innovation of a direction, block s.

    Args:
        flight: Record.
        p: Parameters assumed by the filter.
        work: Workspace.
        settings: The filter's form.
        k: First row in the stacked measurement.
        s: Number of the block.
        valid: Lanes that have measured it, among those to be updated.
        limit: Largest sum of its predicted variances; beyond, it is too uncertain.

    Returns:
        Lanes in which it is rejected, lanes in which it is too uncertain, its innovation in
        standard deviations, and its NIS.
    """
    gating, again = (settings.form & _GATE) != 0, work.again > 0.0
    S = _covariance(p, work, k, columns_of(settings))
    u = (work.z_hat[k], work.z_hat[k + 1], work.z_hat[k + 2])
    nu, S2 = _across(u, S, (work.nu[k], work.nu[k + 1], work.nu[k + 2]))
    nis = _nis_of_direction(S2, nu)
    unsure = _decide(flight, s, valid, (S2[0] + S2[2] > limit) & gating, again, _UNSURE)
    beyond = (nis > p.gate_direction) & gating & logical_not(unsure)
    rejected = _decide(flight, s, valid, beyond, again, _REJECTED)
    none = np.nan + 0.0 * nis
    sigma = (math.sqrt(S2[0]), math.sqrt(S2[2]), none)
    first = valid & logical_not(again)
    _store_block(flight, s, first, (nu[0], nu[1], none), sigma, nis, rejected, unsure)
    return rejected, unsure, (nu[0] / sigma[0], nu[1] / sigma[1]), nis


@kernel
def mask_rejected(flight, work, settings, k, group, valid, rejected, numbers):
    """Mask the block at row k in the lanes `rejected`, and count consecutive rejections."""
    first = valid & logical_not(work.again > 0.0)
    if (settings.form & _GATE) != 0:
        mask_block(work, k, rejected, columns_of(settings))
        count_rejections(flight, group, first, rejected)
        work.left_out = work.left_out + select(rejected, numbers, 0.0)
    else:
        accept_group(flight, group, valid)

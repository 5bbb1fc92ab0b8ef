"""The gate: the innovation of one block of the measurement, and whether it is accepted.

A block is a position, a baseline, a velocity, a feature, or what an aiding sensor measures. With
the columns A and E of `filter/update.py` and the block's measurement noise R its innovation has the
covariance `S = A A^T + E E^T + (beta - alpha^2) mu mu^T + R` (3 x 3). A direction has two degrees
of freedom: its innovation is taken across the predicted direction, for along it the length of a
unit vector tells nothing. A block whose normalized innovation squared, chi-square in a consistent
filter, lies beyond the gate is masked as if the flight lacked it.

Source: Y. Bar-Shalom, X. R. Li and T. Kirubarajan, Estimation with Applications to Tracking and
Navigation, 2001, section 5.4.
"""

import math

import numpy as np

from quad_gym.kernels.compiling import kernel
from quad_gym.kernels.filter.recovery import follow_drift
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
_FAILED, _UNSURE = float(GateDecision.FAILED), float(GateDecision.UNSURE)


@kernel
def covariance(p, work, k, columns):
    """S of the block that begins at row k of the stacked measurement."""
    S = add33(
        sum_of_outers_of_rows(work.A, work.A, k, k, columns),
        sum_of_outers_of_rows(work.E, work.E, k, k, 9),
    )
    mu = (work.mu[k], work.mu[k + 1], work.mu[k + 2])
    excess = p.sigma_beta - p.sigma_spread * p.sigma_spread
    return add33(add_outer(S, scale(excess, mu), mu), load_block(work.Rz, k, k))


@kernel
def nis_of_triple(S, nu):
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
def across(u, S, nu):
    """Innovation and covariance of a direction, across u: (side, up), (S_ss, S_us, S_uu)."""
    side = unit_or((-u[1], u[0], 0.0 * u[0]), (1.0, 0.0, 0.0))  # vertical x u
    up = cross(u, side)
    S_side, S_up = apply(S, side), apply(S, up)
    return (dot(side, nu), dot(up, nu)), (dot(side, S_side), dot(up, S_side), dot(up, S_up))


@kernel
def nis_of_direction(S, nu):
    """nu^T S^-1 nu of two numbers."""
    l00 = math.sqrt(S[0])
    l10 = S[1] / l00
    y0 = nu[0] / l00
    y1 = (nu[1] - l10 * y0) / math.sqrt(S[2] - l10 * l10)
    return y0 * y0 + y1 * y1


@kernel
def keep_block(flight, s, has, nu, sigma, nis, rejected, unsure):
    """Write what is known of block s, where a lane has measured it."""
    for i in range(3):
        flight.innovation[s, i] = select(has, nu[i], flight.innovation[s, i])
        flight.innovation_sigma[s, i] = select(has, sigma[i], flight.innovation_sigma[s, i])
    flight.block_nis[s] = select(has, nis, flight.block_nis[s])
    decision = select(unsure, _UNSURE, select(rejected, _REJECTED, _ACCEPTED))
    flight.gate[s] = select(has, decision, flight.gate[s])
    flight.rejections[s] = select(has & rejected, flight.rejections[s] + 1.0, flight.rejections[s])


@kernel
def mask_block(work, k, rejected, columns):
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
def count_in_row(flight, group, measured, rejected, again):
    """Count a group's rejections in a row; an acceptance begins anew."""
    row = select(rejected, flight.rejected_in_row[group] + 1.0, 0.0)
    measured = measured & logical_not(again)
    flight.rejected_in_row[group] = select(measured, row, flight.rejected_in_row[group])
    accepted, before = measured & logical_not(rejected), flight.accepted_tick[group]
    flight.accepted_tick[group] = select(accepted, flight.tick, before)


@kernel
def accept_group(flight, group, measured):
    """Note when a group was last accepted, without a gate."""
    before = flight.accepted_tick[group]
    flight.accepted_tick[group] = select(measured, flight.tick, before)


@kernel
def decide(flight, s, has, wanting, again, decision):
    """Where a block gets `decision`: as `wanting` says or, in a later step, as in the first."""
    return has & ((wanting & logical_not(again)) | (again & (flight.gate[s] == decision)))


@kernel
def judge_triple(flight, p, work, settings, k, s, has, columns):
    """Keep the innovation of a position or velocity; return where it is rejected, and its NIS."""
    gating, again = (settings.form & _GATE) != 0, work.again > 0.0
    S = covariance(p, work, k, columns)
    nu = (work.z[k], work.z[k + 1], work.z[k + 2])
    nis = nis_of_triple(S, nu)
    rejected = decide(flight, s, has, (nis > p.gate_position) & gating, again, _REJECTED)
    sigma = (math.sqrt(S[0][0]), math.sqrt(S[1][1]), math.sqrt(S[2][2]))
    nowhere = rejected & logical_not(rejected)
    has = has & logical_not(again)
    keep_block(flight, s, has, nu, sigma, nis, rejected, nowhere)
    follow_drift(flight, s, has, nu[0] / sigma[0], nu[1] / sigma[1], nu[2] / sigma[2])
    return rejected, select(has, nis, 0.0)


@kernel
def judge_direction(flight, p, work, settings, k, s, has, columns, most):
    """Keep the innovation of a direction; return where it is rejected, and where too uncertain.

    Besides, its innovation in deviations, and its NIS. Too uncertain is one whose predicted
    variances add up to more than `most`.
    """
    gating, again = (settings.form & _GATE) != 0, work.again > 0.0
    S = covariance(p, work, k, columns)
    u = (work.h[k], work.h[k + 1], work.h[k + 2])
    nu, S2 = across(u, S, (work.z[k], work.z[k + 1], work.z[k + 2]))
    nis = nis_of_direction(S2, nu)
    unsure = decide(flight, s, has, (S2[0] + S2[2] > most) & gating, again, _UNSURE)
    beyond = (nis > p.gate_direction) & gating & logical_not(unsure)
    rejected = decide(flight, s, has, beyond, again, _REJECTED)
    none = np.nan + 0.0 * nis
    sigma = (math.sqrt(S2[0]), math.sqrt(S2[2]), none)
    has = has & logical_not(again)
    keep_block(flight, s, has, (nu[0], nu[1], none), sigma, nis, rejected, unsure)
    scaled = (nu[0] / sigma[0], nu[1] / sigma[1])
    return rejected, unsure, scaled, select(has & logical_not(unsure), nis, 0.0)


@kernel
def leave_out(flight, work, settings, k, group, has, rejected, columns, numbers):
    """Mask the block at row k where it is `rejected`, and count that; without a gate it is none."""
    if (settings.form & _GATE) != 0:
        mask_block(work, k, rejected, columns)
        count_in_row(flight, group, has, rejected, work.again > 0.0)
        work.left_out = work.left_out + select(rejected, numbers, 0.0)
    else:
        accept_group(flight, group, has)


@kernel
def mark_block(flight, s, failed):
    """Say of block s that the update that it was part of failed."""
    flight.gate[s] = select(failed, _FAILED, flight.gate[s])

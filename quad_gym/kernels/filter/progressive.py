"""Progressive updates: measurements that are not linear in a wide prior are processed in steps.

Each step is an update with the same measurements and more noise, about the estimate from the one
before. The information of the steps adds up to the measurements' own: a linear model gives the same
result as one step, and the derivatives of another one are taken where they matter.

A measurement h is not linear where the second order of its model exceeds its noise. For a column l
of the covariance's factor, the half-sum s of its pair of sigma points over c^2 is the second-order
term l^T h'' l / 2. Their sum mu is the mean of the second order, so that its ratio to the noise is

    rho^2 = sum over the measured numbers k of mu_k^2 / R_kk,

with |mu|^2 over the variance across it for a direction, whose mu is mostly along it. mu adds up:
distances, lengths of unit vectors, fields and slant ranges are curved in one sense for all offsets.
The steps begin with 10^m times the noise, which divides rho by 10^(m/2), and then have 10^m / 9,
10^(m-1) / 9, ... 10 / 9 times the noise.

Source: R. Zanetti, "Recursive Update Filtering for Nonlinear Estimation", IEEE Trans. Automatic
Control 57(6), 2012, on the idea.
"""

import math

import numpy as np

from quad_gym.kernels.compiling import kernel
from quad_gym.kernels.filter.gate import MONITORED, innovation_covariance
from quad_gym.kernels.filter.measurements import is_direction
from quad_gym.kernels.numbers.lanes import any_of, no_lane, select, zero_like
from quad_gym.kernels.numbers.linalg import dot, keep, load3
from quad_gym.records import (
    FEATURE_BLOCKS,
    FIRST_BLOCK,
    SENSORS,
    GateDecision,
)

_FACTORS = (10.0 / 9.0, 100.0 / 9.0, 1e3 / 9.0, 1e4 / 9.0, 1e5 / 9.0, 1e6 / 9.0)
"""Factors on the noise, from the last step back to the second one."""
_FIRST = (10.0, 100.0, 1e3, 1e4, 1e5, 1e6)
"""Factors of the first step with 1, 2, ... further ones; the sum of inverses is one."""
MOST_STEPS = len(_FIRST)  #: largest number of steps after the first
FEW = 2.0  #: smallest number of further steps
_LARGE = (5.0, 20.0, 80.0, 300.0)  #: ratios rho, above each of which there is one step more


@kernel
def factor_of(further, step):
    """Factor on the noise in a step, counted from zero, where `further` ones follow the first."""
    factor = 1.0 + zero_like(further)
    for m in range(MOST_STEPS):
        chosen = _FIRST[m]
        if step > 0:
            chosen = _FACTORS[max(m + 1 - step, 0)]
        factor = select(further == 1.0 * (m + 1), chosen, factor)
    return factor


@kernel
def count_steps(flight, p, work, settings, mask):
    """Number of steps after the first that the present measurements need, in the lanes `mask`.

    Sets work.hidden for features too uncertain for a linear model even in steps. Steps are counted
    for the others.
    """
    square = _ratio_squared(flight, work, settings)
    tolerated = p.recursive_update_threshold * p.recursive_update_threshold
    if settings.feature_count > 0 and any_of(square > tolerated):
        _find_unsure(flight, p, work, settings, square > tolerated)
        square = _ratio_squared(flight, work, settings)
    steps = select(square > tolerated, FEW, 0.0)
    for m in range(len(_LARGE)):
        steps = select(square > _LARGE[m] * _LARGE[m], FEW + 1.0 + m, steps)
    return select(mask, steps, 0.0)


@kernel
def _ratio_squared(flight, work, settings):
    """rho^2, see the docstring of this file; features in work.hidden do not count."""
    k, total, mu, R = 0, zero_like(work.spread), work.mu, work.Rz
    for sensor in range(SENSORS):
        first = FIRST_BLOCK[sensor]
        for block in range(first, first + settings.sensor_blocks[sensor]):
            if any_of(flight.block_valid[block] > 0.0):
                x, y, z = mu[k] * mu[k], mu[k + 1] * mu[k + 1], mu[k + 2] * mu[k + 2]
                if is_direction(block):
                    twice = R[k, k] + R[k + 1, k + 1] + R[k + 2, k + 2]  # of two axes across
                    share = 2.0 * (x + y + z) / twice
                    if block >= FEATURE_BLOCKS:
                        share = select(work.hidden[block - FEATURE_BLOCKS] > 0.0, 0.0, share)
                else:
                    share = x / R[k, k] + y / R[k + 1, k + 1] + z / R[k + 2, k + 2]
                total = total + share
                k += 3
    return total


@kernel
def _find_unsure(flight, p, work, settings, lanes):
    """Set work.hidden for features that a gate leaves out as too uncertain, in `lanes`."""
    k = 0
    for sensor in range(SENSORS):
        first = FIRST_BLOCK[sensor]
        for block in range(first, first + settings.sensor_blocks[sensor]):
            valid = flight.block_valid[block] > 0.0
            if any_of(valid):
                if is_direction(block) and block >= FEATURE_BLOCKS:
                    P_zz = innovation_covariance(p, work, settings, k)
                    u = load3(work.z_hat[k : k + 3])
                    across = P_zz[0][0] + P_zz[1][1] + P_zz[2][2] - dot(u, P_zz @ u)
                    unsure = lanes & valid & (across > p.gate_uncertainty)
                    i = block - FEATURE_BLOCKS
                    work.hidden[i] = select(unsure, 1.0, work.hidden[i])
                k += 3


@kernel
def hide_unsure(flight, work, feature_count, mask):
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
def show_hidden(flight, work, settings, mask):
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
def share_second_order(work, n, rows, further):
    """Multiply the second order's part of the noise by the number of steps, where they are many.

    The steps have it in common: without this, where it stays large (a single range cannot reduce
    an error across its direction), each step would average it as independent noise.
    """
    root = select(further > FEW, 1.0, 0.0) * further
    root = math.sqrt(1.0 + root)
    for k in range(n):
        work.mu[k] = root * work.mu[k]
        for j in range(rows):
            work.E[j, k] = root * work.E[j, k]


@kernel
def drop_even(work, n, rows, mask):
    """Neglect the second order, as an EKF does, in the lanes `mask`; `rows`: 0 if it is not known.

    Not only where other lanes have it: the gate reads it in all.
    """
    for k in range(n):
        work.mu[k] = select(mask, 0.0, work.mu[k])
        for j in range(rows):
            work.E[j, k] = select(mask, 0.0, work.E[j, k])

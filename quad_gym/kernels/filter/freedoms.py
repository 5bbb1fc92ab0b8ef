"""Degrees of freedom of an update, and the share of its NIS that belongs to none.

A direction is a unit vector of three numbers with two degrees of freedom. Noise n across it
shortens its component along it by |n|^2 / 2, with a variance of `direction_variance_floor` in the
filter, so the square of the innovation along it may be a thousand times this variance. No state
depends on it to first order, so the update is right, but its share is removed from the NIS.

The components along several directions have the second order of the prior in common, and are
otherwise independent. Up to that order they do not depend on other measurements.
"""

import math

from quad_gym.kernels.compiling import kernel
from quad_gym.kernels.maths.factors import cholesky, solve_left_vector
from quad_gym.kernels.maths.linalg import dot, load3, store
from quad_gym.kernels.maths.matrices import load_block
from quad_gym.kernels.simd.lanes import any_of, logical_not, no_lane, select, zero_like
from quad_gym.records import (
    AID_BLOCKS,
    BASELINE_BLOCK,
    FEATURE_BLOCKS,
    FIRST_BLOCK,
    MAX_STATES,
    MAX_TOGETHER,
    SENSORS,
    FilterForm,
    GateDecision,
)

_SMALL = 0.01  #: share of a variance that may be neglected
assert MAX_TOGETHER <= MAX_STATES  # work.M has room for a number of each block


@kernel
def _left_out(flight, settings, block):
    """Lanes in which the gate has left out a block of the present measurements."""
    out = no_lane(flight.tick)
    if (settings.form & FilterForm.GATE.value) != 0:
        gate = flight.gate[block]
        out = (gate == GateDecision.REJECTED) | (gate == GateDecision.UNSURE)
    return out


@kernel
def find_directions(flight, p, work, settings):
    """Fill work.along; return how many numbers of the measurement are no degrees of freedom.

    A heading alone is a baseline with noise above pi along two axes, see `gnss_baseline.py`.
    """
    k, numbers = 0, zero_like(work.spread)
    for sensor in range(SENSORS):
        first = FIRST_BLOCK[sensor]
        for block in range(first, first + settings.sensor_blocks[sensor]):
            valid = flight.block_valid[block] > 0.0
            if any_of(valid):
                used = no_lane(numbers)
                if block == BASELINE_BLOCK or FEATURE_BLOCKS <= block < AID_BLOCKS:
                    used = valid & logical_not(_left_out(flight, settings, block))
                store(work.along[k : k + 3], select(used, 1.0, 0.0) * load3(work.z_hat[k : k + 3]))
                numbers = numbers + select(used, 1.0, 0.0)
                if block == BASELINE_BLOCK:
                    alone = used & (p.baseline_sigma > math.pi)
                    numbers = numbers + select(alone, 1.0, 0.0)
                k += 3
    return numbers


@kernel
def nis_along(p, work, n):
    """The NIS along the directions in work.along, from work.nu and work.Rz before whitening.

    Uses work.M and work.y. Where the second order of the prior is small, the components are
    independent.
    """
    nis, wide, blocks = zero_like(work.spread), no_lane(work.spread), n // 3
    for i in range(blocks):
        u, nu = load3(work.along[3 * i : 3 * i + 3]), load3(work.nu[3 * i : 3 * i + 3])
        variance = dot(u, load_block(work.Rz, 3 * i, 3 * i) @ u)
        shift = dot(u, load3(work.mu[3 * i : 3 * i + 3]))
        wide = wide | (p.sigma_beta * shift * shift > _SMALL * variance)
        none, length = variance <= 0.0, dot(u, nu)
        variance = select(none, 1.0, variance)
        work.M[i, i], work.y[i] = variance, length
        nis = nis + length * length / variance
    if any_of(wide):
        nis = select(wide, _joint_nis(work, blocks), nis)
    return nis


@kernel
def _joint_nis(work, blocks):
    """The same where the components are not independent."""
    M, y, size = work.M, work.y, (blocks + 2) // 3 * 3
    zero = zero_like(work.spread)
    for i in range(size):
        if i >= blocks:
            M[i, i], y[i] = zero + 1.0, zero
        for j in range(i):
            M[i, j] = zero
            if i < blocks:
                u_i, u_j = (
                    load3(work.along[3 * i : 3 * i + 3]),
                    load3(work.along[3 * j : 3 * j + 3]),
                )
                M[i, j] = dot(u_i, load_block(work.Rz, 3 * i, 3 * j) @ u_j)
    cholesky(M, size, work.inverse_diagonal)
    solve_left_vector(M, y, size, work.inverse_diagonal)
    nis = zero
    for i in range(size):
        nis = nis + y[i] * y[i]
    return nis

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
def without_directions(flight, p, work, settings):
    """The NIS along directions, and how many numbers of the measurement are no degrees of freedom.

    From work.nu and work.Rz before whitening; uses work.M and work.y. Where the second order of
    the prior is small, the components along directions are independent. A heading alone is a
    baseline with noise above pi along two axes, see `gnss_baseline.py`.
    """
    k, numbers = 0, zero_like(work.spread)
    nis, wide = numbers, no_lane(numbers)
    for sensor in range(SENSORS):
        first = FIRST_BLOCK[sensor]
        for block in range(first, first + settings.sensor_blocks[sensor]):
            valid = flight.block_valid[block] > 0.0
            if any_of(valid):
                if is_direction(block):
                    used = valid & logical_not(_left_out(flight, settings, block))
                    u, nu = load3(work.z_hat[k : k + 3]), load3(work.nu[k : k + 3])
                    variance, length = dot(u, load_block(work.Rz, k, k) @ u), dot(u, nu)
                    shift = dot(u, load3(work.mu[k : k + 3]))
                    wide = wide | (used & (p.sigma_beta * shift * shift > _SMALL * variance))
                    nis = nis + select(used, length * length / variance, 0.0)
                    numbers = numbers + select(used, 1.0, 0.0)
                    if block == BASELINE_BLOCK:
                        alone = used & (p.baseline_sigma > math.pi)
                        numbers = numbers + select(alone, 1.0, 0.0)
                k += 3
    if any_of(wide):
        _find_directions(flight, work, settings)
        nis = select(wide, _joint_nis(work, k // 3), nis)
    return nis, numbers


@kernel
def is_direction(block):
    """True if a block is a unit vector: a baseline or a feature."""
    return block == BASELINE_BLOCK or FEATURE_BLOCKS <= block < AID_BLOCKS


@kernel
def _find_directions(flight, work, settings):
    """Fill work.along."""
    k = 0
    for sensor in range(SENSORS):
        first = FIRST_BLOCK[sensor]
        for block in range(first, first + settings.sensor_blocks[sensor]):
            valid = flight.block_valid[block] > 0.0
            if any_of(valid):
                used = no_lane(work.spread)
                if is_direction(block):
                    used = valid & logical_not(_left_out(flight, settings, block))
                store(work.along[k : k + 3], select(used, 1.0, 0.0) * load3(work.z_hat[k : k + 3]))
                k += 3


@kernel
def _joint_nis(work, blocks):
    """The NIS along directions whose components are not independent."""
    M, y, size = work.M, work.y, (blocks + 2) // 3 * 3
    zero = zero_like(work.spread)
    for i in range(size):
        M[i, i], y[i] = zero + 1.0, zero
        for j in range(i):
            M[i, j] = zero
        if i < blocks:
            u = load3(work.along[3 * i : 3 * i + 3])
            y[i] = dot(u, load3(work.nu[3 * i : 3 * i + 3]))
            for j in range(i + 1):
                other = load3(work.along[3 * j : 3 * j + 3])
                M[i, j] = dot(u, load_block(work.Rz, 3 * i, 3 * j) @ other)
            M[i, i] = select(M[i, i] > 0.0, M[i, i], 1.0)
    cholesky(M, size, work.inverse_diagonal)
    solve_left_vector(M, y, size, work.inverse_diagonal)
    nis = zero
    for i in range(size):
        nis = nis + y[i] * y[i]
    return nis

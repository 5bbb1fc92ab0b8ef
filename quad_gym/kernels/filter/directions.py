"""Unit vectors as measurements: their noise, and pairs of them without cancellation."""

import math

from quad_gym.kernels.compiling import kernel
from quad_gym.kernels.maths.linalg import add, add_outer, add_scaled, add_to_diagonal, dot, scale
from quad_gym.kernels.simd.lanes import any_of, select


@kernel
def direction_noise(direction, variance, floor):
    """Variance (I - u u^T) + floor I: noise of a direction u, of rank 2 but for the floor."""
    negative = scale(-variance, direction)
    zero = 0.0 * variance
    empty = ((zero, zero, zero), (zero, zero, zero), (zero, zero, zero))
    return add_to_diagonal(add_outer(empty, negative, direction), variance + floor)


@kernel
def _inverse_root_minus_one(d):
    """(1 + d)^(-1/2) - 1 by its binomial series, exact to float64 for |d| < 0.01."""
    return d * (
        -1.0 / 2.0
        + d
        * (
            3.0 / 8.0
            + d
            * (
                -5.0 / 16.0
                + d
                * (35.0 / 128.0 + d * (-63.0 / 256.0 + d * (231.0 / 1024.0 - d * (429.0 / 2048.0))))
            )
        )
    )


@kernel
def _shrinkage(d):
    """(1 + d)^(-1/2) - 1 for d > -1."""
    value = _inverse_root_minus_one(d)
    if any_of(abs(d) >= 0.01):
        root = math.sqrt(1.0 + d)
        value = select(abs(d) < 0.01, value, -d / (root * (1.0 + root)))
    return value


@kernel
def direction_pair(v, inverse_norm, v_even, v_odd):
    """Half-difference, and half-sum less unit(v), of the pair unit(v + v_even +- v_odd).

    |v + v_even +- v_odd|^2 = |v|^2 (1 + d): the small d gives the lengths without cancellation.
    """
    centre = add(v, v_even)
    inverse_square = inverse_norm * inverse_norm
    d_even = inverse_square * (dot(v_even, add(v, centre)) + dot(v_odd, v_odd))
    d_odd = inverse_square * (2.0 * dot(centre, v_odd))
    plus, minus = _shrinkage(d_even + d_odd), _shrinkage(d_even - d_odd)
    both, gap = 0.5 * (plus + minus), 0.5 * (plus - minus)
    difference = add_scaled(add_scaled(v_odd, both, v_odd), gap, centre)
    half_sum = add_scaled(add_scaled(v_even, both, centre), gap, v_odd)
    return scale(inverse_norm, difference), scale(inverse_norm, half_sum)

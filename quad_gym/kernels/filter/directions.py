"""Unit vectors as measurements: their noise, and pairs of them without cancellation."""

import math

from quad_gym.kernels.compiling import kernel
from quad_gym.kernels.maths.linalg import add_to_diagonal, dot, outer
from quad_gym.kernels.maths.vectors import polynomial
from quad_gym.kernels.simd.lanes import any_of, select

_SERIES = (
    -1.0 / 2.0,
    3.0 / 8.0,
    -5.0 / 16.0,
    35.0 / 128.0,
    -63.0 / 256.0,
    231.0 / 1024.0,
    -429.0 / 2048.0,
)


@kernel
def direction_noise(direction, variance, floor):
    """Variance (I - u u^T) + floor I: noise of a direction u, of rank 2 except for the floor."""
    return add_to_diagonal(outer(-variance * direction, direction), variance + floor)


@kernel
def _inverse_root_minus_one(d):
    """(1 + d)^(-1/2) - 1 by its binomial series, exact to float64 for |d| < 0.01."""
    return d * polynomial(d, _SERIES)


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
    """Half-difference, and half-sum minus unit(v), of the pair unit(v + v_even +- v_odd).

    |v + v_even +- v_odd|^2 = |v|^2 (1 + d): the small d gives the lengths without cancellation.
    """
    center = v + v_even
    inverse_square = inverse_norm * inverse_norm
    d_even = inverse_square * (dot(v_even, v + center) + dot(v_odd, v_odd))
    d_odd = inverse_square * (2.0 * dot(center, v_odd))
    plus, minus = _shrinkage(d_even + d_odd), _shrinkage(d_even - d_odd)
    both, gap = 0.5 * (plus + minus), 0.5 * (plus - minus)
    difference = v_odd + both * v_odd + gap * center
    half_sum = v_even + both * center + gap * v_odd
    return inverse_norm * difference, inverse_norm * half_sum

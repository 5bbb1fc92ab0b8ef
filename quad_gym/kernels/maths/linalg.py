"""Products of vectors and matrices, which `vectors.py` gives operators."""

import math

from quad_gym.kernels.compiling import kernel
from quad_gym.kernels.maths.vectors import keep as keep
from quad_gym.kernels.maths.vectors import load3 as load3
from quad_gym.kernels.maths.vectors import load4 as load4
from quad_gym.kernels.maths.vectors import load33 as load33
from quad_gym.kernels.maths.vectors import load44 as load44
from quad_gym.kernels.maths.vectors import outer as outer
from quad_gym.kernels.maths.vectors import rounded as rounded
from quad_gym.kernels.maths.vectors import store as store
from quad_gym.kernels.maths.vectors import vector as vector
from quad_gym.kernels.simd.lanes import select, zero_like


@kernel
def dot(a, b):
    """The number a . b."""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@kernel
def cross(a, b):
    """The vector a x b."""
    x = a[1] * b[2] - a[2] * b[1]
    y = a[2] * b[0] - a[0] * b[2]
    return vector(x, y, a[0] * b[1] - a[1] * b[0])


@kernel
def norm(a):
    """The length |a|."""
    return math.sqrt(dot(a, a))


@kernel
def unit_or(a, fallback):
    """The unit vector a / |a|, or `fallback` where a is too short to have a direction."""
    square = dot(a, a)
    usable = square > 1e-60
    return select(usable, 1.0 / math.sqrt(select(usable, square, 1.0)) * a, fallback)


@kernel
def diagonal(d):
    """The matrix diag(d)."""
    zero = zero_like(d[0])
    return ((d[0], zero, zero), (zero, d[1], zero), (zero, zero, d[2]))


@kernel
def add_diagonal(m, d):
    """The matrix M + diag(d)."""
    (a, b, c), (d_a, d_b, d_c) = m, d
    return ((a[0] + d_a, a[1], a[2]), (b[0], b[1] + d_b, b[2]), (c[0], c[1], c[2] + d_c))


@kernel
def add_to_diagonal(m, s):
    """The matrix M + s I."""
    return add_diagonal(m, (s, s, s))

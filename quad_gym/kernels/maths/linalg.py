"""Loading, storing and products of vectors and matrices, which `vectors.py` gives operators.

Larger matrices are arrays in a workspace and are handled in blocks of 3 x 3, since the filter's
states and measurements come in threes: nine sums run in parallel, which hides the latency of the
multiply-adds.
"""

import math

from quad_gym.kernels.compiling import kernel
from quad_gym.kernels.maths.vectors import outer as outer
from quad_gym.kernels.maths.vectors import vector
from quad_gym.kernels.simd.lanes import select

# ---- vectors of three -------------------------------------------------------------------------


@kernel
def load3(a):
    """The first three numbers of an array, as a vector."""
    return vector(a[0], a[1], a[2])


@kernel
def store3(a, v):
    """Write a vector into the first three places of an array."""
    a[0] = v[0]
    a[1] = v[1]
    a[2] = v[2]


@kernel
def keep3(a, mask, v):
    """Write a vector into an array where `mask` is set."""
    for i in range(3):
        a[i] = select(mask, v[i], a[i])


@kernel
def add(a, b):
    """A + b."""
    return vector(a[0] + b[0], a[1] + b[1], a[2] + b[2])


@kernel
def sub(a, b):
    """A - b."""
    return a - b


@kernel
def scale(s, a):
    """S a."""
    return s * a


@kernel
def add_scaled(a, s, b):
    """A + s b, in one multiply-add for each number."""
    return a + s * b


@kernel
def dot(a, b):
    """A . b."""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@kernel
def cross(a, b):
    """A x b."""
    return vector(
        a[1] * b[2] - a[2] * b[1],
        a[2] * b[0] - a[0] * b[2],
        a[0] * b[1] - a[1] * b[0],
    )


@kernel
def norm(a):
    """|a|."""
    return math.sqrt(dot(a, a))


@kernel
def unit_or(a, fallback):
    """A / |a|, or `fallback` where a is too short to have a direction."""
    square = dot(a, a)
    usable = square > 1e-60
    inverse = 1.0 / math.sqrt(select(usable, square, 1.0))
    return vector(
        select(usable, inverse * a[0], fallback[0]),
        select(usable, inverse * a[1], fallback[1]),
        select(usable, inverse * a[2], fallback[2]),
    )


@kernel
def select3(mask, a, b):
    """The vector `a` where `mask`, else `b`."""
    return vector(select(mask, a[0], b[0]), select(mask, a[1], b[1]), select(mask, a[2], b[2]))


@kernel
def select33(mask, a, b):
    """The matrix `a` where `mask`, else `b`."""
    return (select3(mask, a[0], b[0]), select3(mask, a[1], b[1]), select3(mask, a[2], b[2]))


@kernel
def load4(a):
    """The first four numbers of an array, as a vector."""
    return vector(a[0], a[1], a[2], a[3])


@kernel
def store4(a, v):
    """Write four numbers into an array."""
    for i in range(4):
        a[i] = v[i]


# ---- matrices of three rows ------------------------------------------------------------------


@kernel
def load33(a):
    """A 3 x 3 array as a matrix."""
    return (
        (a[0, 0], a[0, 1], a[0, 2]),
        (a[1, 0], a[1, 1], a[1, 2]),
        (a[2, 0], a[2, 1], a[2, 2]),
    )


@kernel
def load44(a):
    """A 4 x 4 array as a matrix."""
    return (load4(a[0]), load4(a[1]), load4(a[2]), load4(a[3]))


@kernel
def store33(a, m):
    """Write a matrix into a 3 x 3 array."""
    for i in range(3):
        for j in range(3):
            a[i, j] = m[i][j]


@kernel
def keep33(a, mask, m):
    """Write a matrix into a 3 x 3 array where `mask` is set."""
    for i in range(3):
        for j in range(3):
            a[i, j] = select(mask, m[i][j], a[i, j])


@kernel
def transpose(m):
    """m^T."""
    return m.T


@kernel
def apply(m, v):
    """M v."""
    return m @ v


@kernel
def apply_transposed(m, v):
    """m^T v."""
    return m.T @ v


@kernel
def multiply(a, b):
    """A b."""
    return a @ b


# ---- blocks of larger arrays -----------------------------------------------------------------


@kernel
def load_block(a, i, j):
    """The 3 x 3 block of an array whose corner is at row i, column j."""
    return (
        (a[i, j], a[i, j + 1], a[i, j + 2]),
        (a[i + 1, j], a[i + 1, j + 1], a[i + 1, j + 2]),
        (a[i + 2, j], a[i + 2, j + 1], a[i + 2, j + 2]),
    )


@kernel
def store_block(a, i, j, m):
    """Write a 3 x 3 block."""
    a[i, j], a[i, j + 1], a[i, j + 2] = m[0]
    a[i + 1, j], a[i + 1, j + 1], a[i + 1, j + 2] = m[1]
    a[i + 2, j], a[i + 2, j + 1], a[i + 2, j + 2] = m[2]


@kernel
def keep_block(a, i, j, mask, m):
    """Write a 3 x 3 block where `mask` is set."""
    for row in range(3):
        for column in range(3):
            a[i + row, j + column] = select(mask, m[row][column], a[i + row, j + column])


@kernel
def add_outer(m, a, b):
    """M + a b^T."""
    return m + outer(a, b)


@kernel
def sum_of_outers(a, i, b, k, columns):
    """The sum over the first columns j of a[i : i + 3, j] b[k : k + 3, j]^T."""
    total = outer(load_column3(a, i, 0), load_column3(b, k, 0))
    for j in range(1, columns):
        total = total + outer(load_column3(a, i, j), load_column3(b, k, j))
    return total


@kernel
def sum_of_squares(a, i, columns):
    """The sum over the first columns j of a[i : i + 3, j] a[i : i + 3, j]^T, which is symmetric."""
    x, y, z = load_column3(a, i, 0)
    xx, yx, yy, zx, zy, zz = x * x, y * x, y * y, z * x, z * y, z * z
    for j in range(1, columns):
        x, y, z = load_column3(a, i, j)
        xx, yx, yy = xx + x * x, yx + y * x, yy + y * y
        zx, zy, zz = zx + z * x, zy + z * y, zz + z * z
    return ((xx, yx, zx), (yx, yy, zy), (zx, zy, zz))


@kernel
def sum_of_outers_of_rows(a, b, i, k, rows):
    """The sum over the first rows j of a[j, i : i + 3]^T b[j, k : k + 3]."""
    total = outer(_load_row3(a, 0, i), _load_row3(b, 0, k))
    for j in range(1, rows):
        total = total + outer(_load_row3(a, j, i), _load_row3(b, j, k))
    return total


@kernel
def _load_row3(a, i, j):
    return vector(a[i, j], a[i, j + 1], a[i, j + 2])


@kernel
def add33(a, b):
    """A + b."""
    return (add(a[0], b[0]), add(a[1], b[1]), add(a[2], b[2]))


@kernel
def scale33(s, a):
    """S a."""
    return s * a


@kernel
def add_to_diagonal(m, s):
    """M + s I."""
    return (
        (m[0][0] + s, m[0][1], m[0][2]),
        (m[1][0], m[1][1] + s, m[1][2]),
        (m[2][0], m[2][1], m[2][2] + s),
    )


@kernel
def load_column3(a, i, j):
    """Rows i to i + 2 of column j."""
    return vector(a[i, j], a[i + 1, j], a[i + 2, j])


@kernel
def store_column3(a, i, j, v):
    """Write a vector into rows i to i + 2 of column j."""
    for k in range(3):
        a[i + k, j] = v[k]

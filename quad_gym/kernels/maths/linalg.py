"""Small linear algebra on any number type.

A vector is a tuple of three numbers, a matrix a tuple of three rows; they live in registers. Larger
matrices are arrays in a workspace and are handled in blocks of 3 x 3, since the filter's states and
its measurements all come in threes: nine sums run side by side and hide the latency of the
multiply-adds.
"""

import math

from quad_gym.kernels.compiling import kernel
from quad_gym.kernels.maths.vectors import matrix, vector
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
    return vector(a[0] - b[0], a[1] - b[1], a[2] - b[2])


@kernel
def scale(s, a):
    """S a."""
    return vector(s * a[0], s * a[1], s * a[2])


@kernel
def add_scaled(a, s, b):
    """A + s b, in one multiply-add for each number."""
    return vector(a[0] + s * b[0], a[1] + s * b[1], a[2] + s * b[2])


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
    return matrix(select3(mask, a[0], b[0]), select3(mask, a[1], b[1]), select3(mask, a[2], b[2]))


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
    return matrix(
        (a[0, 0], a[0, 1], a[0, 2]),
        (a[1, 0], a[1, 1], a[1, 2]),
        (a[2, 0], a[2, 1], a[2, 2]),
    )


@kernel
def load44(a):
    """A 4 x 4 array as a matrix."""
    return matrix(load4(a[0]), load4(a[1]), load4(a[2]), load4(a[3]))


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
    return matrix(
        (m[0][0], m[1][0], m[2][0]),
        (m[0][1], m[1][1], m[2][1]),
        (m[0][2], m[1][2], m[2][2]),
    )


@kernel
def apply(m, v):
    """M v."""
    return vector(dot(m[0], v), dot(m[1], v), dot(m[2], v))


@kernel
def apply_transposed(m, v):
    """m^T v."""
    return vector(
        m[0][0] * v[0] + m[1][0] * v[1] + m[2][0] * v[2],
        m[0][1] * v[0] + m[1][1] * v[1] + m[2][1] * v[2],
        m[0][2] * v[0] + m[1][2] * v[1] + m[2][2] * v[2],
    )


@kernel
def multiply(a, b):
    """A b."""
    return matrix(
        apply_transposed(b, a[0]),
        apply_transposed(b, a[1]),
        apply_transposed(b, a[2]),
    )


# ---- blocks of larger arrays -----------------------------------------------------------------


@kernel
def load_block(a, i, j):
    """The 3 x 3 block of an array whose corner is at row i, column j."""
    return matrix(
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
def outer(a, b):
    """A b^T."""
    return matrix(scale(a[0], b), scale(a[1], b), scale(a[2], b))


@kernel
def add_outer(m, a, b):
    """M + a b^T."""
    return matrix(
        (m[0][0] + a[0] * b[0], m[0][1] + a[0] * b[1], m[0][2] + a[0] * b[2]),
        (m[1][0] + a[1] * b[0], m[1][1] + a[1] * b[1], m[1][2] + a[1] * b[2]),
        (m[2][0] + a[2] * b[0], m[2][1] + a[2] * b[1], m[2][2] + a[2] * b[2]),
    )


@kernel
def subtract_outer(m, a, b):
    """M - a b^T."""
    return matrix(
        (m[0][0] - a[0] * b[0], m[0][1] - a[0] * b[1], m[0][2] - a[0] * b[2]),
        (m[1][0] - a[1] * b[0], m[1][1] - a[1] * b[1], m[1][2] - a[1] * b[2]),
        (m[2][0] - a[2] * b[0], m[2][1] - a[2] * b[1], m[2][2] - a[2] * b[2]),
    )


@kernel
def sum_of_outers(a, i, b, k, columns):
    """The sum over the first columns j of a[i : i + 3, j] b[k : k + 3, j]^T."""
    total = outer(load_column3(a, i, 0), load_column3(b, k, 0))
    for j in range(1, columns):
        total = add_outer(total, load_column3(a, i, j), load_column3(b, k, j))
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
    return matrix((xx, yx, zx), (yx, yy, zy), (zx, zy, zz))


@kernel
def sum_of_outers_of_rows(a, b, i, k, rows):
    """The sum over the first rows j of a[j, i : i + 3]^T b[j, k : k + 3]."""
    total = outer((a[0, i], a[0, i + 1], a[0, i + 2]), (b[0, k], b[0, k + 1], b[0, k + 2]))
    for j in range(1, rows):
        total = add_outer(
            total, (a[j, i], a[j, i + 1], a[j, i + 2]), (b[j, k], b[j, k + 1], b[j, k + 2])
        )
    return total


@kernel
def add33(a, b):
    """A + b."""
    return matrix(add(a[0], b[0]), add(a[1], b[1]), add(a[2], b[2]))


@kernel
def add_scaled33(a, s, b):
    """A + s b."""
    return matrix(add_scaled(a[0], s, b[0]), add_scaled(a[1], s, b[1]), add_scaled(a[2], s, b[2]))


@kernel
def scale33(s, a):
    """S a."""
    return matrix(scale(s, a[0]), scale(s, a[1]), scale(s, a[2]))


@kernel
def add_to_diagonal(m, s):
    """M + s I."""
    return matrix(
        (m[0][0] + s, m[0][1], m[0][2]),
        (m[1][0], m[1][1] + s, m[1][2]),
        (m[2][0], m[2][1], m[2][2] + s),
    )


@kernel
def load_column3(a, i, j):
    """Rows i to i + 2 of column j."""
    return vector(a[i, j], a[i + 1, j], a[i + 2, j])

"""Small linear algebra on any number type.

A vector is a tuple of three numbers, a matrix a tuple of three rows; they live in registers. Larger
matrices are arrays in a workspace and are handled in blocks of 3 x 3, since the filter's states and
its measurements all come in threes: nine sums run side by side and hide the latency of the
multiply-adds.
"""

import math

from quad_gym.kernels.compiling import kernel
from quad_gym.kernels.maths.elementary import minimum
from quad_gym.kernels.simd.lanes import select

# ---- vectors of three -------------------------------------------------------------------------


@kernel
def load3(a):
    """The first three numbers of an array, as a vector."""
    return (a[0], a[1], a[2])


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
    return (a[0] + b[0], a[1] + b[1], a[2] + b[2])


@kernel
def sub(a, b):
    """A - b."""
    return (a[0] - b[0], a[1] - b[1], a[2] - b[2])


@kernel
def scale(s, a):
    """S a."""
    return (s * a[0], s * a[1], s * a[2])


@kernel
def dot(a, b):
    """A . b."""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@kernel
def cross(a, b):
    """A x b."""
    return (
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
    return (
        select(usable, inverse * a[0], fallback[0]),
        select(usable, inverse * a[1], fallback[1]),
        select(usable, inverse * a[2], fallback[2]),
    )


@kernel
def select3(mask, a, b):
    """The vector `a` where `mask`, else `b`."""
    return (select(mask, a[0], b[0]), select(mask, a[1], b[1]), select(mask, a[2], b[2]))


@kernel
def select33(mask, a, b):
    """The matrix `a` where `mask`, else `b`."""
    return (select3(mask, a[0], b[0]), select3(mask, a[1], b[1]), select3(mask, a[2], b[2]))


@kernel
def load4(a):
    """The first four numbers of an array, as a tuple."""
    return (a[0], a[1], a[2], a[3])


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
    return (
        (m[0][0], m[1][0], m[2][0]),
        (m[0][1], m[1][1], m[2][1]),
        (m[0][2], m[1][2], m[2][2]),
    )


@kernel
def apply(m, v):
    """M v."""
    return (dot(m[0], v), dot(m[1], v), dot(m[2], v))


@kernel
def apply_transposed(m, v):
    """m^T v."""
    return (
        m[0][0] * v[0] + m[1][0] * v[1] + m[2][0] * v[2],
        m[0][1] * v[0] + m[1][1] * v[1] + m[2][1] * v[2],
        m[0][2] * v[0] + m[1][2] * v[1] + m[2][2] * v[2],
    )


@kernel
def multiply(a, b):
    """A b."""
    return (
        apply_transposed(b, a[0]),
        apply_transposed(b, a[1]),
        apply_transposed(b, a[2]),
    )


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
def outer(a, b):
    """A b^T."""
    return (scale(a[0], b), scale(a[1], b), scale(a[2], b))


@kernel
def add_outer(m, a, b):
    """M + a b^T."""
    return (
        (m[0][0] + a[0] * b[0], m[0][1] + a[0] * b[1], m[0][2] + a[0] * b[2]),
        (m[1][0] + a[1] * b[0], m[1][1] + a[1] * b[1], m[1][2] + a[1] * b[2]),
        (m[2][0] + a[2] * b[0], m[2][1] + a[2] * b[1], m[2][2] + a[2] * b[2]),
    )


@kernel
def subtract_outer(m, a, b):
    """M - a b^T."""
    return (
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
    return ((xx, yx, zx), (yx, yy, zy), (zx, zy, zz))


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
    return (add(a[0], b[0]), add(a[1], b[1]), add(a[2], b[2]))


@kernel
def scale33(s, a):
    """S a."""
    return (scale(s, a[0]), scale(s, a[1]), scale(s, a[2]))


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
    return (a[i, j], a[i + 1, j], a[i + 2, j])


@kernel
def cholesky33(m):
    """The lower Cholesky factor with its diagonal inverted, the diagonal, and the least pivot."""
    p0 = m[0][0]
    i0 = 1.0 / math.sqrt(p0)
    l10, l20 = m[1][0] * i0, m[2][0] * i0
    p1 = m[1][1] - l10 * l10
    i1 = 1.0 / math.sqrt(p1)
    l21 = (m[2][1] - l20 * l10) * i1
    p2 = m[2][2] - l20 * l20 - l21 * l21
    i2 = 1.0 / math.sqrt(p2)
    return (
        ((i0, 0.0, 0.0), (l10, i1, 0.0), (l20, l21, i2)),
        (p0 * i0, p1 * i1, p2 * i2),
        minimum(minimum(p0, p1), p2),
    )


@kernel
def lower33(factor, diagonal):
    """The lower Cholesky factor itself, of what `cholesky33` returns."""
    zero = 0.0 * diagonal[0]
    return (
        (diagonal[0], zero, zero),
        (factor[1][0], diagonal[1], zero),
        (factor[2][0], factor[2][1], diagonal[2]),
    )


@kernel
def solve_right33(m, d):
    """X with x l^T = m, for the factor `d` of `cholesky33`."""
    x0 = (m[0][0] * d[0][0], m[1][0] * d[0][0], m[2][0] * d[0][0])
    x1 = (
        (m[0][1] - x0[0] * d[1][0]) * d[1][1],
        (m[1][1] - x0[1] * d[1][0]) * d[1][1],
        (m[2][1] - x0[2] * d[1][0]) * d[1][1],
    )
    x2 = (
        (m[0][2] - x0[0] * d[2][0] - x1[0] * d[2][1]) * d[2][2],
        (m[1][2] - x0[1] * d[2][0] - x1[1] * d[2][1]) * d[2][2],
        (m[2][2] - x0[2] * d[2][0] - x1[2] * d[2][1]) * d[2][2],
    )
    return ((x0[0], x1[0], x2[0]), (x0[1], x1[1], x2[1]), (x0[2], x1[2], x2[2]))


@kernel
def cholesky(a, n, inverse_diagonal):
    """Replace the lower triangle of a by its Cholesky factor.

    Args:
        a: Symmetric positive definite, (n, n); only its lower triangle is read and written.
        n: Its size, a multiple of three.
        inverse_diagonal: (n,), receives the inverses of the factor's diagonal.

    Returns:
        The least pivot: not positive, or NaN, where `a` is not positive definite.
    """
    least = a[0, 0]
    for j in range(0, n, 3):
        block = load_block(a, j, j)
        for k in range(j):
            column = load_column3(a, j, k)
            block = subtract_outer(block, column, column)
        factor, diagonal, pivot = cholesky33(block)
        least = select(pivot < least, pivot, select(pivot == pivot, least, pivot))
        a[j, j] = diagonal[0]
        a[j + 1, j] = factor[1][0]
        a[j + 1, j + 1] = diagonal[1]
        a[j + 2, j] = factor[2][0]
        a[j + 2, j + 1] = factor[2][1]
        a[j + 2, j + 2] = diagonal[2]
        inverse_diagonal[j] = factor[0][0]
        inverse_diagonal[j + 1] = factor[1][1]
        inverse_diagonal[j + 2] = factor[2][2]
        for i in range(j + 3, n, 3):
            block = load_block(a, i, j)
            for k in range(j):
                block = subtract_outer(block, load_column3(a, i, k), load_column3(a, j, k))
            store_block(a, i, j, solve_right33(block, factor))
    return least


@kernel
def solve_right(x, rows, factor, n, inverse_diagonal, staircase):
    """Replace x by the solution y of y L^T = x, for the factor L of `cholesky`.

    Args:
        x: (rows, n).
        rows: A multiple of three.
        factor, n, inverse_diagonal: As left by `cholesky`.
        staircase: Rows 0 to 2 of x are zero before this column, rows 3 to 5 before the column three
            less, and so on, and so are those of y; 0: x is full.
    """
    for j in range(0, n, 3):
        d = (
            (inverse_diagonal[j], 0.0, 0.0),
            (factor[j + 1, j], inverse_diagonal[j + 1], 0.0),
            (factor[j + 2, j], factor[j + 2, j + 1], inverse_diagonal[j + 2]),
        )
        for i in range(max(0, staircase - j), rows, 3):
            block = load_block(x, i, j)
            for k in range(max(0, staircase - i), j):
                block = subtract_outer(block, load_column3(x, i, k), load_column3(factor, j, k))
            store_block(x, i, j, solve_right33(block, d))


@kernel
def solve_left_vector(factor, x, n, inverse_diagonal):
    """Replace x (n,) by the solution y of L y = x, for the factor L of `cholesky`."""
    for i in range(n):
        rest = x[i]
        for k in range(i):
            rest = rest - factor[i, k] * x[k]
        x[i] = rest * inverse_diagonal[i]

"""Cholesky factors and solving with them, on any number type; see `linalg.py` for the types."""

import math

from quad_gym.kernels.compiling import kernel
from quad_gym.kernels.numbers.elementary import minimum
from quad_gym.kernels.numbers.lanes import select, zero_like
from quad_gym.kernels.numbers.linalg import (
    add_to_diagonal,
    load_block,
    load_column3,
    load_symmetric,
    outer,
    store_block,
)

KNOWN = 1e-30
"""Variance of a state that is exactly known, added to the others, too, which it does not change.
Float32 holds it and its inverse, too."""


@kernel
def cholesky33(m):
    """The lower Cholesky factor with its diagonal inverted, the diagonal, and the least pivot.

    Each pivot needs the one before it. The pivots are computed as in L D L^T, a chain of divisions
    alone, so that the roots, which take as long, are computed in parallel.
    """
    p0 = m[0][0]
    r0 = 1.0 / p0
    p1 = m[1][1] - (m[1][0] * r0) * m[1][0]
    r1 = 1.0 / p1
    rest = m[2][1] - (m[2][0] * r0) * m[1][0]
    p2 = m[2][2] - (m[2][0] * r0) * m[2][0] - (rest * r1) * rest
    i0, i1, i2 = math.sqrt(r0), math.sqrt(r1), math.sqrt(1.0 / p2)
    return (
        ((i0, 0.0, 0.0), (m[1][0] * i0, i1, 0.0), (m[2][0] * i0, rest * i1, i2)),
        (p0 * i0, p1 * i1, p2 * i2),
        minimum(minimum(p0, p1), p2),
    )


@kernel
def lower33(factor, diagonal):
    """The lower Cholesky factor itself, from the results of `cholesky33`."""
    zero = zero_like(diagonal[0])
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
    """Replace the lower triangle of a by its Cholesky factor; return the least pivot.

    The pivot is not positive, or NaN, where the matrix a (n, n) is not positive definite; n is a
    multiple of three. `inverse_diagonal` (n,) receives the inverses of the factor's diagonal.
    """
    least = a[0, 0]
    for j in range(0, n, 3):
        block = load_block(a, j, j)
        for k in range(j):
            column = load_column3(a, j, k)
            block = block - outer(column, column)
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
                block = block - outer(load_column3(a, i, k), load_column3(a, j, k))
            store_block(a, i, j, solve_right33(block, factor))
    return least


@kernel
def eliminate(a, factor, n, columns):
    """Fill `factor` with the first `columns` of the Cholesky factor of a (n, n), and with the rest.

    The rest, behind and below these columns, is the Schur complement: what remains of the lower
    triangle of a. Above the diagonal, the columns are zero. Both numbers are multiples of three.

    Returns:
        The least of the pivots and the diagonal of the rest: negative, or NaN, where the matrix
        is no covariance, except where only the rest is none.
    """
    zero = zero_like(a[0, 0])
    none = ((zero, zero, zero), (zero, zero, zero), (zero, zero, zero))
    least = a[0, 0]
    for j in range(0, n, 3):
        block, known = load_symmetric(a, j), min(j, columns)
        for k in range(known):
            column = load_column3(factor, j, k)
            block = block - outer(column, column)
        if j < columns:
            for i in range(0, j, 3):
                store_block(factor, i, j, none)
            inverse, diagonal, pivot = cholesky33(add_to_diagonal(block, KNOWN))
            x = select(block[0][0] == 0.0, 0.0, diagonal[0])
            y = select(block[1][1] == 0.0, 0.0, diagonal[1])
            z = select(block[2][2] == 0.0, 0.0, diagonal[2])
            block = lower33(inverse, (x, y, z))
        else:
            inverse, pivot = block, minimum(minimum(block[0][0], block[1][1]), block[2][2])
        store_block(factor, j, j, block)
        least = select(pivot < least, pivot, select(pivot == pivot, least, pivot))
        for i in range(j + 3, n, 3):
            block = load_block(a, i, j)
            for k in range(known):
                block = block - outer(load_column3(factor, i, k), load_column3(factor, j, k))
            if j < columns:
                block = solve_right33(block, inverse)
            store_block(factor, i, j, block)
    return least


@kernel
def solve_right(x, rows, factor, n, inverse_diagonal, staircase):
    """Replace x (rows, n) by the solution y of y L^T = x, for the factor L of `cholesky`.

    Rows 0 to 2 of x and y are zero before the column `staircase`, rows 3 to 5 before the column
    three less, and so on; 0: x is full. `rows` is a multiple of three.
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
                block = block - outer(load_column3(x, i, k), load_column3(factor, j, k))
            store_block(x, i, j, solve_right33(block, d))


@kernel
def solve_left_vector(factor, x, n, inverse_diagonal):
    """Replace x (n,) by the solution y of L y = x, for the factor L of `cholesky`."""
    for i in range(n):
        rest = x[i]
        for k in range(i):
            rest = rest - factor[i, k] * x[k]
        x[i] = rest * inverse_diagonal[i]

"""Larger matrices: arrays of a record, handled in blocks of 3 x 3.

The filter's states and measurements come in threes. Nine sums run in parallel, which hides the
latency of the multiply-adds.
"""

from quad_gym.kernels.compiling import kernel
from quad_gym.kernels.maths.linalg import outer, vector


@kernel
def load_row3(a, i, j):
    """Row i, columns j to j + 2."""
    return vector(a[i, j], a[i, j + 1], a[i, j + 2])


@kernel
def load_column3(a, i, j):
    """Rows i to i + 2 of column j."""
    return vector(a[i, j], a[i + 1, j], a[i + 2, j])


@kernel
def store_column3(a, i, j, v):
    """Write a vector into rows i to i + 2 of column j."""
    for k in range(3):
        a[i + k, j] = v[k]


@kernel
def load_block(a, i, j):
    """The 3 x 3 block of an array whose corner is at row i, column j."""
    return (load_row3(a, i, j), load_row3(a, i + 1, j), load_row3(a, i + 2, j))


@kernel
def store_block(a, i, j, m):
    """Write a 3 x 3 block."""
    a[i, j], a[i, j + 1], a[i, j + 2] = m[0]
    a[i + 1, j], a[i + 1, j + 1], a[i + 1, j + 2] = m[1]
    a[i + 2, j], a[i + 2, j + 1], a[i + 2, j + 2] = m[2]


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
    total = outer(load_row3(a, 0, i), load_row3(b, 0, k))
    for j in range(1, rows):
        total = total + outer(load_row3(a, j, i), load_row3(b, j, k))
    return total

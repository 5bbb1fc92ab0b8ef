"""Small computations with bitwise identical results on every processor.

NumPy and LAPACK choose their code by the processor, and with it the order of sums and the
polynomial of a sine. The results here become parameters of flights, so they are computed with
Python's floats, in a fixed order, and the C library's functions.
"""

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray

Floats = NDArray[np.float64]


def norm(vector: Sequence[float] | Floats) -> float:
    """Length of a vector (n,)."""
    return math.sqrt(math.fsum(float(x) * float(x) for x in vector))


def product(a: ArrayLike, b: ArrayLike) -> Floats:
    """Matrix product of a (n, m) and b (m, k)."""
    rows, columns = np.asarray(a, np.float64).tolist(), np.asarray(b, np.float64).T.tolist()
    return np.array([[math.fsum(map(_times, row, column)) for column in columns] for row in rows])


def _times(x: float, y: float) -> float:
    return x * y


def turned(matrix: ArrayLike, vector: ArrayLike) -> Floats:
    """Product of a matrix (n, 3) and a vector (3,), with plain sums, as C code computes it."""
    x, y, z = np.asarray(vector, np.float64).tolist()
    rows = np.asarray(matrix, np.float64).tolist()
    return np.array([a * x + b * y + c * z for a, b, c in rows])


def inverse(matrix: ArrayLike) -> Floats:
    """Inverse of a regular matrix (n, n), by elimination with partial pivoting."""
    rows = np.asarray(matrix, np.float64).tolist()
    n = len(rows)
    rows = [row + [float(i == j) for j in range(n)] for i, row in enumerate(rows)]
    for j in range(n):
        pivot = max(range(j, n), key=lambda i: abs(rows[i][j]))
        rows[j], rows[pivot] = rows[pivot], rows[j]
        if rows[j][j] == 0.0:
            raise ValueError("matrix must be regular, got a singular one")
        rows[j] = [x / rows[j][j] for x in rows[j]]
        for i in range(n):
            if i != j:
                factor = rows[i][j]
                rows[i] = [x - factor * y for x, y in zip(rows[i], rows[j], strict=True)]
    return np.array([row[n:] for row in rows])


def lower_root(matrix: ArrayLike, scale: ArrayLike) -> Floats:
    """Return the lower triangular L with L L^T = M, for a positive semidefinite M (n, n).

    A pivot below 1e-12 times its variance in `scale` (n,) counts as zero.
    """
    M, scales = np.asarray(matrix, np.float64).tolist(), np.asarray(scale, np.float64).tolist()
    n = len(M)
    L = [[0.0] * n for _ in range(n)]
    for j in range(n):
        pivot = M[j][j] - math.fsum(x * x for x in L[j][:j])
        if pivot <= 1e-12 * scales[j]:
            continue
        L[j][j] = math.sqrt(pivot)
        for i in range(j + 1, n):
            L[i][j] = (M[i][j] - math.fsum(map(_times, L[i][:j], L[j][:j]))) / L[j][j]
    return np.array(L)


def euler_dcm(e: Sequence[float]) -> Floats:
    """R(e) (3, 3) of the 3-1-2 Euler angles (roll, pitch, yaw) [rad]."""
    (sphi, sth, spsi), (cphi, cth, cpsi) = map(math.sin, e), map(math.cos, e)
    return np.array(
        [
            [cpsi * cth - sphi * spsi * sth, cth * spsi + cpsi * sphi * sth, -cphi * sth],
            [-cphi * spsi, cphi * cpsi, sphi],
            [cpsi * sth + cth * sphi * spsi, spsi * sth - cpsi * cth * sphi, cphi * cth],
        ]
    )

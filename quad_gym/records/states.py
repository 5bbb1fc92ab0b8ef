"""Order of a filter's states: in memory, and to the outside.

The covariance in memory has the error angles first: of the columns of its lower factor only three
then change the attitude, and only these are nonlinear (M. Morelande and B. Moran, "An Unscented
Transformation for Conditionally Linear Models", ICASSP 2007). All arrays that leave the package,
and the rows of a warm start, have the order of `SHOWN`.
"""

from typing import Any

import numpy as np
from numpy.typing import NDArray

E, R, V, BA, BG, D = 0, 3, 6, 9, 12, 15
"""First rows in memory: error angles, position, velocity, accelerometer and gyro bias, and slow
errors of sensors in filters that estimate them, see `kernels/filter/slow.py`."""

SHOWN = (R, V, E, BA, BG)
"""First rows in memory of position, velocity, error angles and biases, the order of arrays."""

ROWS = tuple(first + axis for first in SHOWN for axis in range(3))
"""Row in memory of each of the fifteen states in the order of arrays; slow errors follow."""


def shown_rows(states: int) -> NDArray[np.intp]:
    """Return the row in memory of each of `states` states in the order of arrays."""
    return np.array([*ROWS, *range(D, states)])


def covariance_of(P: NDArray[Any], arc: NDArray[Any]) -> NDArray[np.float64]:
    """Return the covariances (..., 15, 15) of filters, from two fields of their records."""
    whole = joint_covariance(P, np.zeros((*P.shape[:-2], 0, D)))
    whole[..., :6, :6] += arc[..., np.newaxis] * arc[..., np.newaxis, :]
    return whole


def variances_of(P: NDArray[Any], arc: NDArray[Any]) -> NDArray[np.float64]:
    """Return the diagonals (..., 15) of `covariance_of`, without the rest of it."""
    diagonals = np.einsum("...ii->...i", P)[..., ROWS].astype(np.float64)
    diagonals[..., :6] += arc**2
    return diagonals


def covariance_block_of(P: NDArray[Any], arc: NDArray[Any], first: int) -> NDArray[np.float64]:
    """Return the blocks (..., 3, 3) of `covariance_of` from row and column `first` on."""
    row = ROWS[first]
    lower = np.tril(P[..., row : row + 3, row : row + 3])
    block = np.asarray(lower + np.swapaxes(np.tril(lower, -1), -1, -2), np.float64)
    if first < 6:
        part = arc[..., first : first + 3]
        block += part[..., np.newaxis] * part[..., np.newaxis, :]
    return block


def joint_covariance(P: NDArray[Any], P_slow: NDArray[Any]) -> NDArray[np.float64]:
    """Return the covariances (..., 15 + n, 15 + n) of all states from the lower triangles.

    Args:
        P: (..., 15, 15), of which the lower triangle is read.
        P_slow: (..., n, 15 + n) rows of the slow errors below it.
    """
    states = D + P_slow.shape[-2]
    lower = np.zeros((*P.shape[:-2], states, states))
    lower[..., :D, :D], lower[..., D:, :] = P, P_slow[..., :states]
    lower = np.tril(lower)
    rows = shown_rows(states)
    whole = lower + np.swapaxes(np.tril(lower, -1), -1, -2)
    return np.ascontiguousarray(whole[..., rows[:, np.newaxis], rows])


def lower_triangle(covariance: NDArray[Any]) -> NDArray[np.float64]:
    """Return covariances (..., n, n) in the order of memory, zero above the diagonal."""
    order = np.argsort(shown_rows(covariance.shape[-1]))
    return np.tril(covariance[..., order[:, np.newaxis], order])


def lower_factors(P: NDArray[Any]) -> NDArray[np.float64]:
    """Return L, lower triangular, of P = L L^T for covariances (..., n, n), also singular ones.

    The column of a state that the ones before it determine is zero. Numbers that are not finite
    stay so.
    """
    L = np.zeros(P.shape)
    for j in range(P.shape[-1]):
        row = L[..., j, :j]
        rest = P[..., j:, j] - np.einsum("...ik,...k->...i", L[..., j:, :j], row)
        pivot = rest[..., :1]
        root = np.sqrt(np.where(pivot > 0.0, pivot, 1.0))
        L[..., j:, j] = np.where((pivot > 0.0) | np.isnan(pivot), rest / root, 0.0)
        L[..., j, j] = np.where(pivot > 0.0, root, np.where(np.isnan(pivot), np.nan, 0.0))[..., 0]
    return L

"""Rows of a block in the stacked measurement: zero, with noise one, where it is not measured.

Column j of the factor L is row `last - j` of work.A, and row 8 - j of work.E.
"""

from quad_gym.kernels.compiling import kernel
from quad_gym.kernels.filter.error_state import D, E
from quad_gym.kernels.maths.linalg import cross, load33
from quad_gym.kernels.maths.matrices import load_column3
from quad_gym.kernels.simd.lanes import select, zero_like
from quad_gym.records import FilterForm


@kernel
def columns_of(settings):
    """Columns of L that measurements depend on: without slow errors, the first nine."""
    columns = 9
    if settings.slow_states > 0:
        columns = D + settings.slow_states
    return columns


@kernel
def put_three(row, k, valid, values):
    """Write three numbers, in the lanes `valid`."""
    for i in range(3):
        row[k + i] = select(valid, values[i], 0.0)


@kernel
def put_block(work, settings, k, valid, z, z_hat, noise):
    """Write measurement, prediction and noise, in the lanes `valid`; slow errors add nothing."""
    put_three(work.z, k, valid, z)
    put_three(work.z_hat, k, valid, z_hat)
    for i in range(3):
        for j in range(3):
            work.Rz[k + i, k + j] = select(valid, noise[i][j], 1.0 if i == j else 0.0)
    for row in range(columns_of(settings) - 9):
        for i in range(3):
            work.A[row, k + i] = zero_like(work.spread)


@kernel
def put_column(work, settings, k, j, valid, a, s):
    """Write half-difference and half-sum of column j < 9, both over c, in the lanes `valid`."""
    put_three(work.A[columns_of(settings) - 1 - j], k, valid, a)
    put_three(work.E[8 - j], k, valid, s)


@kernel
def by_derivative(settings):
    """True in an EKF, whose columns are derivatives."""
    return (settings.form & FilterForm.EKF.value) != 0


@kernel
def with_pairs(settings):
    """True if pairs of sigma points are needed: in a UKF, and in an EKF for their half-sums."""
    return not by_derivative(settings) or (settings.form & FilterForm.GRADUAL.value) != 0


@kernel
def lever_column(flight, work, settings, j, R_BI, l_B):
    """Half-difference and half-sum of R^T l along column j; in an EKF derivative and half-sum."""
    odd, even, inverse_c = load33(work.odd[j]), load33(work.even[j]), work.inverse_spread
    a = R_BI.T @ (inverse_c * (odd.T @ l_B))
    s = R_BI.T @ (inverse_c * (even.T @ l_B))
    if by_derivative(settings):
        a = R_BI.T @ cross(load_column3(flight.L, E, j), l_B)
        if not with_pairs(settings):
            s = zero_like(a)
    return a, s

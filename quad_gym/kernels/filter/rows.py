"""Rows of a block in the stacked measurement: zero, with noise one, where it is not measured.

Column j of the factor L is row `last - j` of work.A, and row 8 - j of work.E.
"""

from quad_gym.kernels.compiling import kernel
from quad_gym.kernels.filter.error_state import D
from quad_gym.kernels.simd.lanes import select


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
def put_noise(work, k, valid, R):
    """Write the noise covariance of a block, in the lanes `valid`."""
    for i in range(3):
        for j in range(3):
            work.Rz[k + i, k + j] = select(valid, R[i][j], 1.0 if i == j else 0.0)


@kernel
def clear_slow_columns(work, k, settings):
    """Set the columns of slow errors to zero."""
    for row in range(columns_of(settings) - 9):
        for i in range(3):
            work.A[row, k + i] = 0.0 * work.spread

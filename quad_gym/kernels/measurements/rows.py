"""The rows of a block in the stacked measurement; zero, with noise one, where a lane lacks it.

Column j of the factor L is row `last - j` of work.A, and row 8 - j of work.E.
"""

from quad_gym.kernels.compiling import kernel
from quad_gym.kernels.filter.error_state import D
from quad_gym.kernels.simd.lanes import select


@kernel
def columns_of(slow):
    """Columns of L that measurements depend on: without slow errors the first nine."""
    columns = 9
    if slow is not None:
        columns = D + slow.slow_states
    return columns


@kernel
def put_three(row, k, has, values):
    """Write three numbers, where a lane `has` them."""
    for i in range(3):
        row[k + i] = select(has, values[i], 0.0)


@kernel
def put_noise(work, k, has, block):
    """Write the noise covariance, where a lane `has` the measurement."""
    for i in range(3):
        for j in range(3):
            work.Rz[k + i, k + j] = select(has, block[i][j], 1.0 if i == j else 0.0)


@kernel
def clear_slow_columns(work, k, slow):
    """Begin the columns of slow errors with zeros."""
    if slow is not None:
        for row in range(slow.slow_states + D - 9):
            for i in range(3):
                work.A[row, k + i] = 0.0 * work.spread

"""The columns of the covariance's factor that measurements depend on, and their update.

An update orders the states e, r, v, d, b_a, b_g, with the slow errors d if there are any. Where no
measurement depends on the velocity, v follows behind d. Then measurements depend on the first
columns of the lower factor L alone. Only these are computed,

    P = L1 L1^T + diag(0, S),

with the first columns L1 and the covariance S of the other states, given those. An update changes
L1 only, see `update.py`.
"""

from quad_gym.kernels.compiling import kernel
from quad_gym.kernels.filter.error_state import D
from quad_gym.kernels.numbers.factors import eliminate
from quad_gym.kernels.numbers.lanes import select
from quad_gym.kernels.numbers.linalg import keep_block, keep_lower, load_block, load_column3, outer


@kernel
def columns_of(settings):
    """Columns of L that measurements depend on: of e and r, of v if measured, and of d."""
    return settings.motion_columns + settings.slow_states


@kernel
def row_of(slow, row):
    """Row in the order of an update, of a state that is not slow, by its row in memory."""
    if slow is not None:
        if row >= slow.motion_columns:
            row += slow.slow_states
    return row


@kernel
def _row_in_memory(slow, row):
    """The inverse of `row_of`, for slow errors, too."""
    behind = row - slow.slow_states
    if row < slow.motion_columns:
        behind = row
    elif behind < slow.motion_columns:
        behind = D + row - slow.motion_columns
    return behind


@kernel
def factor_columns(flight, work, slow, states, columns):
    """Fill work.L with the first columns of the factor, zero above its diagonal, and with S.

    Returns:
        The least of the pivots and the diagonal of S, not positive or NaN where P is no covariance.
    """
    if slow is None:
        return eliminate(flight.P, work.L, states, columns)
    for i in range(states):
        for j in range(i + 1):
            a, b = _row_in_memory(slow, i), _row_in_memory(slow, j)
            row, column = max(a, b), min(a, b)
            if row < D:
                work.P[i, j] = flight.P[row, column]
            else:
                work.P[i, j] = flight.P_slow[row - D, column]
    return eliminate(work.P, work.L, states, columns)


@kernel
def _updated(work, i, j, columns):
    """The block of the updated covariance at row i and column j <= i."""
    L9 = work.L9
    first = max(0, columns - 3 - j)  # before it, the rows of j are zero
    total = outer(load_column3(L9, i, first), load_column3(L9, j, first))
    for k in range(first + 1, columns):
        total = total + outer(load_column3(L9, i, k), load_column3(L9, j, k))
    if j >= columns:
        total = total + load_block(work.L, i, j)
    return total


@kernel
def keep_updated(flight, work, slow, states, columns, ok):
    """Store the covariance work.L9 work.L9^T + diag(0, S), where `ok`."""
    P = flight.P if slow is None else work.P
    for i in range(0, states, 3):
        for j in range(0, i, 3):
            keep_block(P, i, j, ok, _updated(work, i, j, columns))
        keep_lower(P, i, ok, _updated(work, i, i, columns))
    if slow is not None:
        for i in range(states):
            for j in range(i + 1):
                a, b = _row_in_memory(slow, i), _row_in_memory(slow, j)
                row, column, value = max(a, b), min(a, b), work.P[i, j]
                if row < D:
                    flight.P[row, column] = select(ok, value, flight.P[row, column])
                else:
                    kept = flight.P_slow[row - D, column]
                    flight.P_slow[row - D, column] = select(ok, value, kept)

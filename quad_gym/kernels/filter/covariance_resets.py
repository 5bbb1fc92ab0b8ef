"""Resets of single states: covariances with others are cut, and variances set."""

import math

from quad_gym.kernels.compiling import kernel
from quad_gym.kernels.filter.error_state import E
from quad_gym.kernels.maths.elementary import maximum, minimum
from quad_gym.kernels.maths.linalg import diagonal, dot, outer
from quad_gym.kernels.maths.matrices import load_block, store_block
from quad_gym.kernels.simd.lanes import select, zero_like

MAX_ANGLE = math.pi / math.sqrt(3.0)
"""Largest standard deviation of an angle [rad], when it is unknown."""


@kernel
def reset_variance(P, row, states, lanes, variance):
    """Cut the covariances of a state, and set its variance, which becomes no smaller."""
    for i in range(row, states):
        for j in range(i // 3 * 3 + 3):
            if i != j and (i == row or j == row):
                P[i, j] = select(lanes, 0.0, P[i, j])
    P[row, row] = maximum(P[row, row], select(lanes, variance, 0.0))


@kernel
def reset_variances(P, first, states, lanes, variances):
    """Do the same for three states from the row `first` on."""
    for i in range(3):
        reset_variance(P, first + i, states, lanes, variances[i])


@kernel
def reset_heading(P, R_BI, states, lanes, variance):
    """Cut the covariances of the heading, the angle about the vertical, and set its variance."""
    k = R_BI.T[2]
    cut, P_ee = select(lanes, 1.0, 0.0), load_block(P, E, E)
    one = zero_like(cut) + 1.0
    M = diagonal((one, one, one)) + outer(-cut * k, k)
    for j in range(0, E, 3):
        store_block(P, E, j, M @ load_block(P, E, j))
    heading = cut * maximum(minimum(variance, MAX_ANGLE * MAX_ANGLE), dot(k, P_ee @ k))
    store_block(P, E, E, M @ P_ee @ M + outer(heading * k, k))
    for i in range(E + 3, states, 3):
        store_block(P, i, E, load_block(P, i, E) @ M)

"""The filters' error state (r_I, v_I, e, b_a, b_g), and its covariance when e is reset to zero.

e are the error Euler angles about the estimated attitude, R_BI = R(e) R_hat. After a step whose
mean error is m, R_hat becomes R(m) R_hat and e is counted from there: R(e_new) R(m) = R(e). Since
`de = S(e) w` turns body rates into Euler rates and S(0) is the identity,

    e_new = S(m)^-1 (e - m) + O(e - m)^2,

so that the covariance turns with it: P_e <- S^-1 P_e S^-T, and likewise its correlations. The
report leaves the covariance as it is.

Source: F. L. Markley, J. Guidance, Control, and Dynamics 26(2), 2003, for the reset in general.
"""

import math

from quad_gym.kernels.compiling import kernel
from quad_gym.kernels.maths.elementary import sin_cos
from quad_gym.kernels.maths.linalg import (
    apply,
    load_block,
    load_column3,
    multiply,
    store_block,
    transpose,
)

R, V, E, BA, BG, D = 0, 3, 6, 9, 12, 15
"""First rows of position, velocity, attitude error, accelerometer and gyro bias in the state, and
of the slow errors of sensors where the filter has such, see `slow.py`."""


@kernel
def reset_matrix(m):
    """S(m)^-1: what error Euler angles become when their mean m [rad] is set to zero."""
    s_phi, c_phi = sin_cos(m[0])
    s_th, c_th = sin_cos(m[1])
    zero = 0.0 * c_th
    return (
        (c_th, zero, -c_phi * s_th),
        (zero, zero + 1.0, s_phi),
        (s_th, zero, c_phi * c_th),
    )


@kernel
def turn_covariance(P, T):
    """P <- diag(I, I, T, I, I) P diag(...)^T in the lower triangle of P, by blocks of three."""
    store_block(P, E, R, multiply(T, load_block(P, E, R)))
    store_block(P, E, V, multiply(T, load_block(P, E, V)))
    store_block(P, E, E, multiply(multiply(T, load_block(P, E, E)), transpose(T)))
    store_block(P, BA, E, multiply(load_block(P, BA, E), transpose(T)))
    store_block(P, BG, E, multiply(load_block(P, BG, E), transpose(T)))


@kernel
def turn_factor(L9, T, rows, columns):
    """Turn the factor of a covariance likewise and make it lower triangular again.

    Args:
        L9: (rows, columns) the factor's first columns, last first; its rows of e are multiplied by
            T, which fills the three places above the diagonal that Givens rotations of columns
            clear.
        T: As of `reset_matrix`.
        rows: States.
        columns: At least the nine up to the error angles.
    """
    first = columns - 9
    for j in range(first, columns):
        turned = apply(T, load_column3(L9, E, j))
        for i in range(3):
            L9[E + i, j] = turned[i]
    _clear(L9, E, first + 2, first + 1, rows)
    _clear(L9, E, first + 2, first, rows)
    _clear(L9, E + 1, first + 1, first, rows)


@kernel
def _clear(L9, row, kept, cleared, rows):
    """Rotate two columns so that `cleared` vanishes at `row`; above it both are zero."""
    x, y = L9[row, kept], L9[row, cleared]
    inverse = 1.0 / math.sqrt(x * x + y * y)
    c, s = inverse * x, inverse * y
    for i in range(row, rows):
        a, b = L9[i, kept], L9[i, cleared]
        L9[i, kept] = c * a + s * b
        L9[i, cleared] = c * b - s * a
    L9[row, cleared] = 0.0 * x

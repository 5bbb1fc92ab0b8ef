"""The filters' error state (r_I, v_I, e, b_a, b_g), and its covariance when e is reset to zero.

The error Euler angles e are relative to the estimated attitude, R_BI = R(e) R_hat. After a step
with the mean error m, R_hat becomes R(m) R_hat and e is relative to that: R(e_new) R(m) = R(e).
Since `de = S(e) w` maps body rates to Euler rates and S(0) is the identity,

    e_new = S(m)^-1 (e - m) + O(e - m)^2,

so the covariance is transformed, too: P_e <- S^-1 P_e S^-T, and the correlations with e
accordingly. The report leaves the covariance unchanged.

With FIRST_ESTIMATES (optical flow, neither GNSS nor camera) the heading is unobservable. The error
e is then a rotation vector, R_BI = exp(-[e x]) R_hat, and keeps its direction in I when an update
corrects the attitude; a correction dv of the velocity adds R_hat^T e x dv to the velocity's error
in the next prediction. So an update gives no information about a rotation about the vertical
(docs/filter-equations.md, "Unobservable heading").

Sources: F. L. Markley, J. Guidance, Control, and Dynamics 26(2), 2003, for the reset in general; M.
Li and A. I. Mourikis, Int. J. Robotics Research 32(6), 2013, for first estimates.
"""

import math

from quad_gym.kernels.compiling import kernel
from quad_gym.kernels.maths.elementary import sin_cos
from quad_gym.kernels.maths.linalg import cross
from quad_gym.kernels.maths.matrices import (
    load_block,
    load_column3,
    store_block,
    store_column3,
    sum_of_outers,
)
from quad_gym.kernels.simd.lanes import zero_like

R, V, E, BA, BG, D = 0, 3, 6, 9, 12, 15
"""First rows of position, velocity, attitude error, accelerometer and gyro bias in the state, and
of the slow errors of sensors in filters that estimate them, see `slow.py`."""


@kernel
def reset_matrix(m):
    """S(m)^-1, the Jacobian of the reset of error Euler angles with mean m [rad]."""
    s_phi, c_phi = sin_cos(m[0])
    s_th, c_th = sin_cos(m[1])
    zero = zero_like(c_th)
    return (
        (c_th, zero, -c_phi * s_th),
        (zero, zero + 1.0, s_phi),
        (s_th, zero, c_phi * c_th),
    )


@kernel
def velocity_error(v, e, R_BI, change):
    """Velocity error v with error angles e when an update has changed v_hat."""
    return v + cross(R_BI.T @ e, change)


@kernel
def put_covariance(P, L, factor):
    """P <- factor L L^T, in the lower triangle by blocks of three."""
    for i in range(0, D, 3):
        for j in range(0, i + 3, 3):
            store_block(P, i, j, factor * sum_of_outers(L, i, L, j, j + 3))


@kernel
def turn_covariance(P, T):
    """P <- diag(I, I, T, I, I) P diag(...)^T in the lower triangle of P, by blocks of three."""
    store_block(P, E, R, T @ load_block(P, E, R))
    store_block(P, E, V, T @ load_block(P, E, V))
    store_block(P, E, E, T @ load_block(P, E, E) @ T.T)
    store_block(P, BA, E, load_block(P, BA, E) @ T.T)
    store_block(P, BG, E, load_block(P, BG, E) @ T.T)


@kernel
def turn_factor(L9, T, rows, columns):
    """Transform the factor of a covariance as well, and make it lower triangular again.

    L9 has `columns` of the factor, last first, at least the nine up to the error angles. Its rows
    of e are multiplied by T, which fills the three places above the diagonal that Givens rotations
    of columns clear.
    """
    first = columns - 9
    for j in range(first, columns):
        store_column3(L9, E, j, T @ load_column3(L9, E, j))
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
    L9[row, cleared] = zero_like(x)

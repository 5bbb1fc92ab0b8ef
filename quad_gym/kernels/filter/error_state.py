"""The filters' error state (r_I, v_I, e, b_a, b_g), its covariance, and resets of states.

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
(docs/filter-equations.md, "Unobservable heading"). As only motions in B are measured,
a heading error psi moves position and velocity in I along arcs: across them to first order, which P
contains, and along their radii in proportion to psi^2, which no update may change. `arc` has the
standard deviations of the second part, by which covariances in I are larger than P.

Sources: F. L. Markley, J. Guidance, Control, and Dynamics 26(2), 2003, for the reset in general; M.
Li and A. I. Mourikis, Int. J. Robotics Research 32(6), 2013, for first estimates.
"""

import math

from quad_gym.kernels.compiling import kernel
from quad_gym.kernels.numbers.elementary import maximum, minimum, sin_cos
from quad_gym.kernels.numbers.lanes import select, zero_like
from quad_gym.kernels.numbers.linalg import (
    cross,
    diagonal,
    dot,
    keep,
    load33,
    load_block,
    load_column3,
    outer,
    store_block,
    store_column3,
    sum_of_outers,
)

# --------------------------------------------------------------------------------------------------
# The filters' error state (r_I, v_I, e, b_a, b_g), and its covariance when e is reset to zero.
# --------------------------------------------------------------------------------------------------

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
def keep_arc(flight, ok):
    """Keep the deviations of r and v of second order in the heading's error psi, where `ok`.

    With the covariance c of a state with psi, its deviation across the arc is c psi / sigma^2, and
    that along the radius c (psi^2 - sigma^2) / (2 sigma^2), turned by a right angle. The factor of
    c in the second has the standard deviation 1 / sqrt(2).
    """
    z_B, half = load33(flight.R_hat).T[2], math.sqrt(0.5)
    for i in range(0, E, 3):
        c = sum_of_outers(flight.L, i, flight.L, E, i + 3) @ z_B
        keep(flight.arc[i:], ok, (-half * c[1], half * c[0], zero_like(c[2])))


@kernel
def variance_of(flight, row):
    """Variance of a state in I or B, from its row of the factor and its arc."""
    variance = flight.L[row, 0] * flight.L[row, 0]
    for j in range(1, row + 1):
        variance = variance + flight.L[row, j] * flight.L[row, j]
    if row < E:
        variance = variance + flight.arc[row] * flight.arc[row]
    return variance


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


# --------------------------------------------------------------------------------------------------
# Resets of single states: covariances with others are cut, and variances set.
# --------------------------------------------------------------------------------------------------

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

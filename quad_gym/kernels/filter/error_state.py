"""The filters' error state (e, r_I, v_I, b_a, b_g), and its covariance when e is reset to zero.

The error Euler angles e are relative to the estimated attitude, R_BI = R(e) R_hat. After a step
with the mean error m, R_hat becomes R(m) R_hat and e is relative to that: R(e_new) R(m) = R(e).
Since `de = S(e) w` maps body rates to Euler rates and S(0) is the identity,

    e_new = S(m)^-1 (e - m) + O(e - m)^2,

so the covariance is transformed, too: P_e <- S^-1 P_e S^-T, and the correlations with e
accordingly. The report leaves the covariance unchanged.

With FIRST_ESTIMATES (optical flow, neither GNSS nor camera) the heading is unobservable. The error
e is then a rotation vector, R_BI = exp(-[e x]) R_hat, and keeps its direction in I when an update
corrects the attitude; a correction dv of the velocity adds R_hat^T e x dv to the velocity's error
in the next prediction, or the next step of a progressive update. So an update gives no information
about a rotation about the vertical (docs/filter-equations.md, "Unobservable heading").
As only motions in B are measured,
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
    diagonal,
    dot,
    keep,
    keep_block,
    keep_lower,
    load3,
    load33,
    load_block,
    load_symmetric,
    outer,
    store_block,
)
from quad_gym.records.states import BA as BA
from quad_gym.records.states import BG as BG
from quad_gym.records.states import D as D
from quad_gym.records.states import E as E
from quad_gym.records.states import R as R
from quad_gym.records.states import V as V

# --------------------------------------------------------------------------------------------------
# The filters' error state (r_I, v_I, e, b_a, b_g), and its covariance when e is reset to zero.
# --------------------------------------------------------------------------------------------------


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
def crossed(f):
    """The matrix of d -> d x f."""
    zero = zero_like(f[0])
    return ((zero, f[2], -f[1]), (-f[2], zero, f[0]), (f[1], -f[0], zero))


@kernel
def take_up_corrections(flight, slow, R_BI, lanes):
    """Add to the velocity's error what changes of v_hat by updates add to it, and forget these.

    With an error e, the error v becomes v + R_BI^T e x change, in `lanes`, see above.
    """
    P, N = flight.P, crossed(load3(flight.v_corrected)) @ R_BI.T
    ee, ve, re = load_symmetric(P, E), load_block(P, V, E), load_block(P, R, E)
    moved = ve + N @ ee
    vv = load_symmetric(P, V) + moved @ N.T + N @ ve.T
    keep_block(P, V, E, lanes, moved)
    keep_block(P, V, R, lanes, load_block(P, V, R) + N @ re.T)
    keep_lower(P, V, lanes, vv)
    for i in (BA, BG):
        keep_block(P, i, V, lanes, load_block(P, i, V) + load_block(P, i, E) @ N.T)
    if slow is not None:
        rows = flight.P_slow
        for i in range(0, slow.slow_states, 3):
            moved = load_block(rows, i, V) + load_block(rows, i, E) @ N.T
            keep_block(rows, i, V, lanes, moved)
    zero = zero_like(flight.tick)
    keep(flight.v_corrected, lanes, (zero, zero, zero))


@kernel
def keep_arc(flight, ok):
    """Keep the deviations of r and v of second order in the heading's error psi, where `ok`.

    With the covariance c of a state with psi, its deviation across the arc is c psi / sigma^2, and
    that along the radius c (psi^2 - sigma^2) / (2 sigma^2), turned by a right angle. The factor of
    c in the second has the standard deviation 1 / sqrt(2).
    """
    z_B, half = load33(flight.R_hat).T[2], math.sqrt(0.5)
    for i in (R, V):
        c = load_block(flight.P, i, E) @ z_B
        keep(flight.arc[i - R :], ok, (-half * c[1], half * c[0], zero_like(c[2])))


@kernel
def variance_of(flight, row):
    """Variance of a state in I or B, by its row in memory, with its arc."""
    variance = flight.P[row, row]
    if row >= R and row < BA:
        variance = variance + flight.arc[row - R] * flight.arc[row - R]
    return variance


@kernel
def load_covariance(P, flight, slow):
    """Copy the lower triangle of the covariance of all states to P, by blocks of three.

    Blocks on the diagonal become symmetric. A record holds their lower triangles only.
    """
    for i in range(0, D, 3):
        for j in range(0, i, 3):
            store_block(P, i, j, load_block(flight.P, i, j))
        store_block(P, i, i, load_symmetric(flight.P, i))
    if slow is not None:
        own = flight.P_slow[:, D:]
        for i in range(0, slow.slow_states, 3):
            for j in range(0, D + i, 3):
                store_block(P, D + i, j, load_block(flight.P_slow, i, j))
            store_block(P, D + i, D + i, load_symmetric(own, i))


@kernel
def copy_triangle(P, source, first, rows, ok):
    """Copy `rows` of a lower triangle, from row `first` of the whole one on, where `ok`."""
    for i in range(rows):
        for j in range(first + i + 1):
            P[i, j] = select(ok, source[i, j], P[i, j])


@kernel
def keep_covariance(flight, slow, P, ok):
    """Store the covariance P of all states, where `ok`."""
    copy_triangle(flight.P, P, 0, D, ok)
    if slow is not None:
        copy_triangle(flight.P_slow, P[D:], D, slow.slow_states, ok)


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

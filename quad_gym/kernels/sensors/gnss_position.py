"""GNSS position: of the primary antenna.

It measures `z = r + R^T l_p + d + v` in I, with white noise v and, where positions drift, a slow
error d, which may be a state of the filter (`filter/slow.py`). With a pair of sigma points, R(+-e)
R_hat = (I + even +- odd) R_hat, that is

    odd:   dr + R_hat^T odd^T l_p + dd,   even:   R_hat^T even^T l_p,

and the derivative along an offset is dr + R_hat^T (de x l_p) + dd.
"""

import math

from quad_gym.kernels.compiling import kernel
from quad_gym.kernels.filter.covariance_resets import reset_variances
from quad_gym.kernels.filter.error_state import D, R
from quad_gym.kernels.filter.recovery import reset_drifted_velocity
from quad_gym.kernels.filter.rows import columns_of, lever_column, put_block, put_column
from quad_gym.kernels.filter.slow import stationary
from quad_gym.kernels.maths.elementary import exp, log
from quad_gym.kernels.maths.linalg import diagonal, dot, keep, load3, load33, rounded, vector
from quad_gym.kernels.maths.matrices import load_column3
from quad_gym.kernels.maths.random import six_normals, stream_of
from quad_gym.kernels.simd.lanes import select, zero_like
from quad_gym.records import DRAW_DRIFT, POSITION_BLOCK


@kernel
def measure(flight, p, R_BI, normals, mask):
    """Measure the antenna's position in G, in the lanes `mask`."""
    s = load3(p.position_sigma_I)
    antenna_I = load3(flight.r) + R_BI.T @ load3(p.antenna)
    noise_I = vector(s[0] * normals[0], s[1] * normals[1], s[2] * normals[2])
    noise_I = noise_I + load3(flight.gnss_drift)
    keep(flight.gnss_position, mask, load33(p.R_IG).T @ (antenna_I + noise_I))


@kernel
def drift_gnss(flight, p, mask, share):
    """Advance the slow error of GNSS positions to the next measurement, in the lanes `mask`.

    The first measurement comes a `share` of the period after the start.
    """
    n, _ = six_normals(stream_of(flight), DRAW_DRIFT)
    d, s, whole = load3(flight.gnss_drift), load3(p.drift_drive), p.drift_decay
    decay = exp(share * log(whole))
    root = math.sqrt((1.0 - decay) * (1.0 + decay) / ((1.0 - whole) * (1.0 + whole)))
    drive = vector(root * s[0] * n[0], root * s[1] * n[1], root * s[2] * n[2])
    keep(flight.gnss_drift, mask, decay * d + rounded(drive))


@kernel
def expect(flight, p, work, settings, k, valid):
    """Fill rows k to k + 2."""
    R_BI, l_B, s = load33(flight.R_hat), load3(p.antenna), load3(p.position_sigma_I)
    antenna_I = load3(flight.r_hat) + R_BI.T @ l_B
    if settings.estimates_drift:
        antenna_I = antenna_I + load3(flight.slow_hat)
    z = load33(p.R_IG) @ load3(flight.gnss_position)
    noise = diagonal((s[0] * s[0], s[1] * s[1], s[2] * s[2]))
    put_block(work, settings, k, valid, z, antenna_I, noise)
    for j in range(9):
        a, s = lever_column(flight, work, settings, j, R_BI, l_B)
        put_column(work, settings, k, j, valid, load_column3(flight.L, R, j) + a, s)
    if settings.estimates_drift:
        last = columns_of(settings) - 1
        for j in range(last + 1):
            row = work.A[last - j]
            for i in range(3):
                row[k + i] = row[k + i] + select(valid, flight.L_slow[i, j], 0.0)


@kernel
def reset(flight, p, work, settings, states, lanes, nu):
    """Reset the position, and its slow error to the stationary one.

    Where the estimate has drifted off, the velocity is reset, too.
    """
    square = dot(nu, nu)
    reset_drifted_velocity(flight, p, work, states, POSITION_BLOCK, lanes, square)
    zero = zero_like(square)
    drift = (zero, zero, zero)
    if settings.estimates_drift:
        drift = (stationary(p, 0), stationary(p, 1), stationary(p, 2))
        reset_variances(work.P, D, states, lanes, drift)
    squares = (square + drift[0], square + drift[1], square + drift[2])
    reset_variances(work.P, R, states, lanes, squares)

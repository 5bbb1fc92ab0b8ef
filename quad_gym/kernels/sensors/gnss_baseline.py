"""GNSS baseline: the direction from the primary to the secondary antenna.

It measures `z = unit(R^T l_b)` in I with noise across that direction. With a pair of sigma points,
R(+-e) R_hat = (I + even +- odd) R_hat, that is R_hat^T odd^T u and R_hat^T even^T u, u = unit(l_b);
the derivative along an offset is R_hat^T (de x u).

Noise n across a unit vector shortens its part along the direction by n^2 / 2, whose mean square is
2 sigma^4 for two axes of standard deviation sigma. It is added along the direction if sigma exceeds
`_COARSE`: the sigma points of an uncertain attitude are shortened, too, so that the filter would
attribute an innovation along the direction to the attitude.
"""

import math

import numpy as np

from quad_gym.kernels.compiling import kernel
from quad_gym.kernels.filter.directions import direction_noise
from quad_gym.kernels.filter.error_state import E
from quad_gym.kernels.filter.gate import add_nis, gate_direction, mask_rejected
from quad_gym.kernels.filter.recovery import (
    camera_fits,
    follow_drift,
    inflate_gyro_bias,
    inflate_heading,
    time_of,
)
from quad_gym.kernels.filter.rows import (
    clear_slow_columns,
    columns_of,
    put_noise,
    put_three,
)
from quad_gym.kernels.maths.elementary import maximum
from quad_gym.kernels.maths.linalg import (
    add,
    add_outer,
    add_to_diagonal,
    apply,
    apply_transposed,
    cross,
    dot,
    keep3,
    load3,
    load33,
    load_block,
    load_column3,
    norm,
    scale,
    store_block,
)
from quad_gym.kernels.simd.lanes import any_of, logical_not, select
from quad_gym.records import BASELINE_BLOCK, FilterForm

_EKF = int(FilterForm.EKF)
_COARSE = 0.05
"""Noise up to which this term is left out [rad], as in the laboratory: it makes no difference."""

# ---- simulation ------------------------------------------------------------------------------


@kernel
def noisy_baseline(r_b, normals, sigma_b, floor, length):
    """Measured baseline of known length, covariance |r_b|^2 sigma_b^2 (I - u u^T) + floor I.

    The symmetric root of that covariance is a (I - u u^T) + b u u^T (report equation 1, section
    3.1).
    """
    size = norm(r_b)
    u = scale(1.0 / size, r_b)
    b = math.sqrt(floor)
    a = math.sqrt((size * sigma_b) * (size * sigma_b) + floor)
    along = dot(u, normals)
    noisy = add(add(r_b, scale(a, normals)), scale((b - a) * along, u))
    return scale(length / norm(noisy), noisy)


@kernel
def measure(flight, p, R_BI, normals, mask):
    """Measure the baseline in G, in the lanes `mask`."""
    baseline_G = apply_transposed(load33(p.R_IG), apply_transposed(R_BI, load3(p.baseline)))
    measured = noisy_baseline(
        baseline_G, normals, p.baseline_sigma, p.direction_floor, p.baseline_length
    )
    keep3(flight.gnss_baseline, mask, measured)


# ---- update ----------------------------------------------------------------------------------


@kernel
def _center(flight, p, work, k, valid, R_BI, unit_baseline):
    """Fill the rows of predicted measurement, measurement and noise."""
    u_I = apply_transposed(R_BI, unit_baseline)
    put_three(work.z_hat, k, valid, u_I)
    measured = apply(load33(p.R_IG), load3(flight.gnss_baseline))
    put_three(work.z, k, valid, scale(1.0 / norm(measured), measured))
    variance = p.baseline_noise * p.baseline_noise
    noise = direction_noise(u_I, variance, p.direction_floor)
    white = p.baseline_sigma * p.baseline_sigma
    along = select(p.baseline_sigma > _COARSE, 2.0 * white * white, 0.0)
    put_noise(work, k, valid, add_outer(noise, scale(along, u_I), u_I))


@kernel
def expect(flight, p, work, settings, k):
    """Fill the rows from k on, if any lane has a baseline; return the next row."""
    valid = flight.block_valid[BASELINE_BLOCK] > 0.0
    if not any_of(valid):
        return k
    L, last = flight.L, columns_of(settings) - 1
    R_BI, inverse_c = load33(flight.R_hat), work.inverse_spread
    unit_baseline = scale(1.0 / p.baseline_length, load3(p.baseline))
    _center(flight, p, work, k, valid, R_BI, unit_baseline)
    clear_slow_columns(work, k, settings)
    for j in range(9):
        A, S = work.A[last - j], work.E[8 - j]
        if (settings.form & _EKF) != 0:
            turned = cross(load_column3(L, E, j), unit_baseline)
            put_three(A, k, valid, apply_transposed(R_BI, turned))
            put_three(S, k, valid, scale(0.0, turned))
        else:
            baseline_odd = scale(inverse_c, apply_transposed(load33(work.odd[j]), unit_baseline))
            baseline_even = scale(inverse_c, apply_transposed(load33(work.even[j]), unit_baseline))
            put_three(A, k, valid, apply_transposed(R_BI, baseline_odd))
            put_three(S, k, valid, apply_transposed(R_BI, baseline_even))
    return k + 3


@kernel
def gate(flight, p, work, settings, k):
    """Store the innovation in the rows from k on, and mask it beyond the gate."""
    if not any_of(flight.block_valid[BASELINE_BLOCK] > 0.0):
        return k
    valid = (work.taking > 0.0) & (flight.block_valid[BASELINE_BLOCK] > 0.0)
    rejected, _, scaled, nis = gate_direction(
        flight, p, work, settings, k, BASELINE_BLOCK, valid, np.inf
    )
    first = valid & logical_not(work.again > 0.0)
    follow_drift(flight, BASELINE_BLOCK, first, scaled[0], scaled[1], 0.0 * p.sigma_beta)
    # as for positions, see `gnss_position.py`
    add_nis(work, first & logical_not(rejected & camera_fits(flight, p)), nis, 2.0)
    mask_rejected(flight, work, settings, k, BASELINE_BLOCK, valid, rejected, 3.0)
    return k + 3


# ---- inflation -------------------------------------------------------------------------------


@kernel
def inflate(flight, p, work, settings):
    """Inflate the attitude and the gyro biases.

    The heading is inflated by the sideward innovation, roll and pitch by the upward one.
    """
    R_BI, P, alarm = load33(flight.R_hat), work.P, work.alarm[BASELINE_BLOCK]
    vertical = (R_BI[0][2], R_BI[1][2], R_BI[2][2])
    side = select(alarm > 0.0, flight.innovation[BASELINE_BLOCK, 0], 0.0)
    up = select(alarm > 0.0, flight.innovation[BASELINE_BLOCK, 1], 0.0)
    P_ee = load_block(P, E, E)
    heading = dot(vertical, apply(P_ee, vertical))
    tilt = 0.5 * (P_ee[0][0] + P_ee[1][1] + P_ee[2][2] - heading)
    more = maximum(up * up - tilt, 0.0)
    P_ee = add_outer(add_to_diagonal(P_ee, more), scale(-more, vertical), vertical)
    store_block(P, E, E, P_ee)
    inflate_heading(P, vertical, side * side, alarm > 0.0)
    turned = maximum(abs(side), abs(up))
    inflate_gyro_bias(P, turned / time_of(flight, p, BASELINE_BLOCK), alarm)

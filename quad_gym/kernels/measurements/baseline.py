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
from quad_gym.kernels.filter.recovery import (
    camera_fits,
    doubt_heading,
    doubt_rate,
    follow_drift,
    suspect_group,
    time_of,
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
from quad_gym.kernels.measurements.gate import judge_direction, leave_out
from quad_gym.kernels.measurements.rows import (
    clear_slow_columns,
    columns_of,
    put_noise,
    put_three,
)
from quad_gym.kernels.measurements.triples import triple_functions
from quad_gym.kernels.simd.lanes import any_of, logical_not, select
from quad_gym.records import BASELINE_BLOCK, FilterForm, Sensor

SENSOR = Sensor.GNSS
_EKF = int(FilterForm.EKF)
_COARSE = 0.05
"""Noise up to which that is left out [rad], as of the laboratory: it makes no difference."""

count, mark_failed, set_aside, exchange, keep_valid, choose = triple_functions(
    "baseline", BASELINE_BLOCK
)

# ---- simulation ------------------------------------------------------------------------------


@kernel
def noisy_baseline(r_b, normals, sigma_b, floor, length):
    """A measured baseline: covariance |r_b|^2 sigma_b^2 (I - u u^T) + floor I, known length.

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
    """Measure the baseline in G, where `mask`."""
    baseline_G = apply_transposed(load33(p.R_IG), apply_transposed(R_BI, load3(p.baseline)))
    measured = noisy_baseline(
        baseline_G, normals, p.baseline_sigma, p.direction_floor, p.baseline_length
    )
    keep3(flight.gnss_baseline, mask, measured)


# ---- update ----------------------------------------------------------------------------------


@kernel
def _center(flight, p, work, k, has, R_BI, unit_baseline):
    """Fill the rows of what is expected, of what was measured, and of the noise."""
    u_I = apply_transposed(R_BI, unit_baseline)
    put_three(work.h, k, has, u_I)
    measured = apply(load33(p.R_IG), load3(flight.gnss_baseline))
    put_three(work.z, k, has, scale(1.0 / norm(measured), measured))
    variance = p.baseline_noise * p.baseline_noise
    noise = direction_noise(u_I, variance, p.direction_floor)
    white = p.baseline_sigma * p.baseline_sigma
    along = select(p.baseline_sigma > _COARSE, 2.0 * white * white, 0.0)
    put_noise(work, k, has, add_outer(noise, scale(along, u_I), u_I))


@kernel
def expect(flight, p, work, settings, slow, k):
    """Fill the rows from k on, if any lane has a baseline; return the row behind them."""
    if not any_of(flight.baseline_valid > 0.0):
        return k
    L, last, has = flight.L, columns_of(slow) - 1, flight.baseline_valid > 0.0
    R_BI, inverse_c = load33(flight.R_hat), work.inverse_spread
    unit_baseline = scale(1.0 / p.baseline_length, load3(p.baseline))
    _center(flight, p, work, k, has, R_BI, unit_baseline)
    clear_slow_columns(work, k, slow)
    for j in range(9):
        A, S = work.A[last - j], work.E[8 - j]
        if (settings.form & _EKF) != 0:
            turned = cross(load_column3(L, E, j), unit_baseline)
            put_three(A, k, has, apply_transposed(R_BI, turned))
            put_three(S, k, has, scale(0.0, turned))
        else:
            baseline_odd = scale(inverse_c, apply_transposed(load33(work.odd[j]), unit_baseline))
            baseline_even = scale(inverse_c, apply_transposed(load33(work.even[j]), unit_baseline))
            put_three(A, k, has, apply_transposed(R_BI, baseline_odd))
            put_three(S, k, has, apply_transposed(R_BI, baseline_even))
    return k + 3


@kernel
def judge(flight, p, work, settings, slow, k):
    """Keep the innovation in the rows from k on, and mask it beyond the gate."""
    if not any_of(flight.baseline_valid > 0.0):
        return k
    has, columns = (work.taking > 0.0) & (flight.baseline_valid > 0.0), columns_of(slow)
    rejected, _, scaled, nis = judge_direction(
        flight, p, work, settings, k, BASELINE_BLOCK, has, columns, np.inf
    )
    first = has & logical_not(work.again > 0.0)
    follow_drift(flight, BASELINE_BLOCK, first, scaled[0], scaled[1], 0.0 * p.sigma_beta)
    # as for positions, see there
    counts = select(has & logical_not(rejected & camera_fits(flight, p)), 1.0, 0.0)
    work.judged_nis = work.judged_nis + counts * nis
    work.judged_freedoms = work.judged_freedoms + 2.0 * counts
    leave_out(flight, work, settings, k, BASELINE_BLOCK, has, rejected, columns, 3.0)
    return k + 3


# ---- doubts ----------------------------------------------------------------------------------


@kernel
def suspect(flight, p, work, settings, slow, k):
    """Note whether baselines make the filter doubt itself; not against a camera that fits."""
    suspect_group(flight, p, work, BASELINE_BLOCK, logical_not(camera_fits(flight, p)))
    return k


@kernel
def doubt(flight, p, work, settings, slow, k):
    """Raise the variances of what may be wrong, where baselines are doubted.

    That is the heading by the innovation to the side, and roll and pitch by that up; the gyro may
    have led there.
    """
    R_BI, P, doubted = load33(flight.R_hat), work.P, work.doubted[BASELINE_BLOCK]
    vertical = (R_BI[0][2], R_BI[1][2], R_BI[2][2])
    side = select(doubted > 0.0, flight.innovation[BASELINE_BLOCK, 0], 0.0)
    up = select(doubted > 0.0, flight.innovation[BASELINE_BLOCK, 1], 0.0)
    P_ee = load_block(P, E, E)
    heading = dot(vertical, apply(P_ee, vertical))
    tilt = 0.5 * (P_ee[0][0] + P_ee[1][1] + P_ee[2][2] - heading)
    more = maximum(up * up - tilt, 0.0)
    P_ee = add_outer(add_to_diagonal(P_ee, more), scale(-more, vertical), vertical)
    store_block(P, E, E, P_ee)
    doubt_heading(P, vertical, side * side, doubted > 0.0)
    turned = maximum(abs(side), abs(up))
    doubt_rate(P, turned / time_of(flight, p, BASELINE_BLOCK), doubted)
    return k

"""GNSS position: of the primary antenna.

It measures `z = r + R^T l_p + d + v` in I, with white noise v and, where positions drift, a slow
error d, which may be a state of the filter (`filter/slow.py`). With a pair of sigma points, R(+-e)
R_hat = (I + even +- odd) R_hat, that is

    odd:   dr + R_hat^T odd^T l_p + dd,   even:   R_hat^T even^T l_p,

and the derivative along an offset is dr + R_hat^T (de x l_p) + dd.
"""

import math

from quad_gym.kernels.compiling import kernel
from quad_gym.kernels.filter.error_state import D, E, R
from quad_gym.kernels.filter.gate import add_nis, gate_numbers, mask_rejected
from quad_gym.kernels.filter.recovery import (
    MOST_POSITION,
    camera_fits,
    drifts,
    enlarge,
    inflate_accel_bias,
    time_of,
)
from quad_gym.kernels.filter.rows import (
    clear_slow_columns,
    columns_of,
    put_noise,
    put_three,
)
from quad_gym.kernels.maths.elementary import exp, log, maximum
from quad_gym.kernels.maths.linalg import (
    add,
    apply,
    apply_transposed,
    cross,
    keep3,
    load3,
    load33,
    load_column3,
    norm,
    scale,
)
from quad_gym.kernels.maths.random import six_normals, stream_of
from quad_gym.kernels.simd.lanes import any_of, logical_not, select
from quad_gym.records import DRAW_DRIFT, POSITION_BLOCK, SENSOR_GROUPS, FilterForm

_EKF = int(FilterForm.EKF)

# ---- simulation ------------------------------------------------------------------------------


@kernel
def measure(flight, p, R_BI, normals, mask):
    """Measure the antenna's position in G, in the lanes `mask`."""
    s = load3(p.position_sigma_I)
    antenna_I = add(load3(flight.r), apply_transposed(R_BI, load3(p.antenna)))
    noise_I = (s[0] * normals[0], s[1] * normals[1], s[2] * normals[2])
    noise_I = add(noise_I, load3(flight.gnss_drift))
    keep3(flight.gnss_position, mask, apply_transposed(load33(p.R_IG), add(antenna_I, noise_I)))


@kernel
def drift_gnss(flight, p, mask, share):
    """Advance the slow error of GNSS positions to the next measurement, in the lanes `mask`.

    The first measurement comes a `share` of the period after the start.
    """
    n, _ = six_normals(stream_of(flight), DRAW_DRIFT)
    d, s, whole = load3(flight.gnss_drift), load3(p.drift_drive), p.drift_decay
    decay = exp(share * log(whole))
    root = math.sqrt((1.0 - decay) * (1.0 + decay) / ((1.0 - whole) * (1.0 + whole)))
    drive = (root * s[0] * n[0], root * s[1] * n[1], root * s[2] * n[2])
    keep3(flight.gnss_drift, mask, add(scale(decay, d), drive))


# ---- update ----------------------------------------------------------------------------------


@kernel
def _center(flight, p, work, settings, k, valid, R_BI):
    """Fill the rows of predicted measurement, measurement and noise."""
    antenna_I = add(load3(flight.r_hat), apply_transposed(R_BI, load3(p.antenna)))
    if settings.estimates_drift:
        antenna_I = add(antenna_I, load3(flight.slow_hat))
    put_three(work.z_hat, k, valid, antenna_I)
    put_three(work.z, k, valid, apply(load33(p.R_IG), load3(flight.gnss_position)))
    s = load3(p.position_sigma_I)
    zero = 0.0 * s[0]
    noise = ((s[0] * s[0], zero, zero), (zero, s[1] * s[1], zero), (zero, zero, s[2] * s[2]))
    put_noise(work, k, valid, noise)


@kernel
def expect(flight, p, work, settings, k):
    """Fill the rows from k on, if any lane has a position; return the next row."""
    valid = flight.block_valid[POSITION_BLOCK] > 0.0
    if not any_of(valid):
        return k
    L, last = flight.L, columns_of(settings) - 1
    R_BI, antenna, inverse_c = load33(flight.R_hat), load3(p.antenna), work.inverse_spread
    _center(flight, p, work, settings, k, valid, R_BI)
    clear_slow_columns(work, k, settings)
    for j in range(9):
        A, S = work.A[last - j], work.E[8 - j]
        dr = load_column3(L, R, j)
        if (settings.form & _EKF) != 0:
            lever = cross(load_column3(L, E, j), antenna)
            put_three(A, k, valid, add(dr, apply_transposed(R_BI, lever)))
            put_three(S, k, valid, scale(0.0, dr))
        else:
            lever_odd = scale(inverse_c, apply_transposed(load33(work.odd[j]), antenna))
            lever_even = scale(inverse_c, apply_transposed(load33(work.even[j]), antenna))
            put_three(A, k, valid, add(dr, apply_transposed(R_BI, lever_odd)))
            put_three(S, k, valid, apply_transposed(R_BI, lever_even))
    if settings.estimates_drift:
        for j in range(last + 1):
            row = work.A[last - j]
            for i in range(3):
                row[k + i] = row[k + i] + select(valid, flight.L_slow[i, j], 0.0)
    return k + 3


@kernel
def gate(flight, p, work, settings, k):
    """Store the innovation in the rows from k on, and mask it beyond the gate."""
    if not any_of(flight.block_valid[POSITION_BLOCK] > 0.0):
        return k
    valid = (work.taking > 0.0) & (flight.block_valid[POSITION_BLOCK] > 0.0)
    block, limit = POSITION_BLOCK, p.gate_position
    rejected, nis = gate_numbers(flight, p, work, settings, k, block, block, valid, limit, 3.0)
    # a fix that is rejected while the camera fits shows an error of GNSS, not of the filter
    counted = valid & logical_not(work.again > 0.0)
    counted = counted & logical_not(rejected & camera_fits(flight, p))
    add_nis(work, counted, nis, 3.0)
    mask_rejected(flight, work, settings, k, POSITION_BLOCK, valid, rejected, 3.0)
    return k + 3


# ---- inflation -------------------------------------------------------------------------------


@kernel
def inflate(flight, p, work, settings):
    """Inflate the position or its slow error, accelerometer biases and tilt.

    Where positions drift, a jump may be three times the innovation, as the drift has followed it in
    part; but an innovation beyond `MOST_POSITION` counts in full, so that any jump is followed.
    """
    nu, alarm, P = load3(flight.innovation[POSITION_BLOCK]), work.alarm[POSITION_BLOCK], work.P
    T, jumped = time_of(flight, p, POSITION_BLOCK), alarm > 0.0
    if settings.estimates_drift:
        jumped = _has_jumped(flight, p, work)
    for i in range(3):
        own = nu[i] * nu[i]
        square = select(jumped, own, 0.0)
        if settings.estimates_drift:
            square = select(jumped, maximum(enlarge(own, MOST_POSITION), own), 0.0)
            P[D + i, D + i] = maximum(P[D + i, D + i], square)
        P[R + i, R + i] = maximum(P[R + i, R + i], square)
    inflate_accel_bias(p, P, 2.0 * norm(nu) / (T * T), alarm)


@kernel
def _has_jumped(flight, p, work):
    """Lanes in which the vehicle, or GNSS, has likely jumped.

    Positions raise an alarm; or another sensor does while at least two consecutive fixes are
    rejected, as a single one may be an outlier; or innovations of fixes drift. A jump shows in
    these innovations as often as in the sum of the drift's corrections (`filter/jumps.py`). A
    camera that fits is evidence against a jump.
    """
    alarm = work.drifting
    for group in range(SENSOR_GROUPS):
        alarm = maximum(alarm, work.alarm[group])
    jumped = (alarm > 0.0) & (flight.rejected_in_row[POSITION_BLOCK] > 1.0)
    jumped = (jumped | drifts(flight, POSITION_BLOCK)) & logical_not(camera_fits(flight, p))
    return (work.taking > 0.0) & (jumped | (work.alarm[POSITION_BLOCK] > 0.0))

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
from quad_gym.kernels.filter.recovery import (
    MOST_POSITION,
    camera_fits,
    doubt_acceleration,
    drifts,
    enlarge,
    suspect_group,
    time_of,
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
from quad_gym.kernels.measurements.gate import judge_triple, leave_out
from quad_gym.kernels.measurements.rows import (
    clear_slow_columns,
    columns_of,
    put_noise,
    put_three,
)
from quad_gym.kernels.measurements.triples import triple_functions
from quad_gym.kernels.simd.lanes import any_of, logical_not, select
from quad_gym.records import DRAW_DRIFT, POSITION_BLOCK, SENSOR_GROUPS, FilterForm, Sensor

SENSOR = Sensor.GNSS
_EKF = int(FilterForm.EKF)

count, mark_failed, set_aside, exchange, keep_valid, choose = triple_functions(
    "position", POSITION_BLOCK
)

# ---- simulation ------------------------------------------------------------------------------


@kernel
def measure(flight, p, R_BI, normals, mask):
    """Measure the antenna's position in G, where `mask`."""
    s = load3(p.gnss_sigma)
    antenna_I = add(load3(flight.r), apply_transposed(R_BI, load3(p.antenna)))
    noise_I = (s[0] * normals[0], s[1] * normals[1], s[2] * normals[2])
    noise_I = add(noise_I, load3(flight.gnss_drift))
    keep3(flight.gnss_position, mask, apply_transposed(load33(p.R_IG), add(antenna_I, noise_I)))


@kernel
def drift_gnss(flight, p, mask, share):
    """Step the slow error of GNSS positions from one measurement to the next, where `mask`.

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
def _center(flight, p, work, k, has, R_BI, slow):
    """Fill the rows of what is expected, of what was measured, and of the noise."""
    antenna_I = add(load3(flight.r_hat), apply_transposed(R_BI, load3(p.antenna)))
    if slow is not None:
        if slow.estimates_drift:
            antenna_I = add(antenna_I, load3(flight.slow_hat))
    put_three(work.h, k, has, antenna_I)
    put_three(work.z, k, has, apply(load33(p.R_IG), load3(flight.gnss_position)))
    s = load3(p.gnss_sigma)
    zero = 0.0 * s[0]
    noise = ((s[0] * s[0], zero, zero), (zero, s[1] * s[1], zero), (zero, zero, s[2] * s[2]))
    put_noise(work, k, has, noise)


@kernel
def expect(flight, p, work, settings, slow, k):
    """Fill the rows from k on, if any lane has a position; return the row behind them."""
    if not any_of(flight.position_valid > 0.0):
        return k
    L, last, has = flight.L, columns_of(slow) - 1, flight.position_valid > 0.0
    R_BI, antenna, inverse_c = load33(flight.R_hat), load3(p.antenna), work.inverse_spread
    _center(flight, p, work, k, has, R_BI, slow)
    clear_slow_columns(work, k, slow)
    for j in range(9):
        A, S = work.A[last - j], work.E[8 - j]
        dr = load_column3(L, R, j)
        if (settings.form & _EKF) != 0:
            lever = cross(load_column3(L, E, j), antenna)
            put_three(A, k, has, add(dr, apply_transposed(R_BI, lever)))
            put_three(S, k, has, scale(0.0, dr))
        else:
            lever_odd = scale(inverse_c, apply_transposed(load33(work.odd[j]), antenna))
            lever_even = scale(inverse_c, apply_transposed(load33(work.even[j]), antenna))
            put_three(A, k, has, add(dr, apply_transposed(R_BI, lever_odd)))
            put_three(S, k, has, apply_transposed(R_BI, lever_even))
    if slow is not None:
        if slow.estimates_drift:
            for j in range(last + 1):
                row = work.A[last - j]
                for i in range(3):
                    row[k + i] = row[k + i] + select(has, flight.L_slow[i, j], 0.0)
    return k + 3


@kernel
def judge(flight, p, work, settings, slow, k):
    """Keep the innovation in the rows from k on, and mask it beyond the gate."""
    if not any_of(flight.position_valid > 0.0):
        return k
    has, columns = (work.taking > 0.0) & (flight.position_valid > 0.0), columns_of(slow)
    rejected, nis = judge_triple(flight, p, work, settings, k, POSITION_BLOCK, has, columns)
    # a fix that is rejected while the camera fits tells of GNSS, not of the filter
    counts = select(has & logical_not(rejected & camera_fits(flight, p)), 1.0, 0.0)
    work.judged_nis = work.judged_nis + counts * nis
    work.judged_freedoms = work.judged_freedoms + 3.0 * counts
    leave_out(flight, work, settings, k, POSITION_BLOCK, has, rejected, columns, 3.0)
    return k + 3


# ---- doubts ----------------------------------------------------------------------------------


@kernel
def suspect(flight, p, work, settings, slow, k):
    """Note whether positions make the filter doubt itself; not against a camera that fits."""
    suspect_group(flight, p, work, POSITION_BLOCK, logical_not(camera_fits(flight, p)))
    return k


@kernel
def doubt(flight, p, work, settings, slow, k):
    """Raise the variances of what may be wrong, where positions are doubted.

    That is the position itself, or its slow error; accelerometer and tilt may have led there. Where
    positions drift, a jump may be three times the innovation, as the drift has followed it in part;
    but an innovation beyond `MOST_POSITION` counts in full, so that any jump is followed.
    """
    nu, doubted, P = load3(flight.innovation[POSITION_BLOCK]), work.doubted[POSITION_BLOCK], work.P
    T, elsewhere = time_of(flight, p, POSITION_BLOCK), doubted > 0.0
    if slow is not None:
        if slow.estimates_drift:
            elsewhere = _is_elsewhere(flight, p, work)
    for i in range(3):
        own = nu[i] * nu[i]
        square = select(elsewhere, own, 0.0)
        if slow is not None:
            if slow.estimates_drift:
                square = select(elsewhere, maximum(enlarge(own, MOST_POSITION), own), 0.0)
                P[D + i, D + i] = maximum(P[D + i, D + i], square)
        P[R + i, R + i] = maximum(P[R + i, R + i], square)
    doubt_acceleration(p, P, 2.0 * norm(nu) / (T * T), doubted)
    return k


@kernel
def _is_elsewhere(flight, p, work):
    """Where the vehicle, or GNSS, is likely to be elsewhere.

    Positions are doubted; or the filter doubts itself for another sensor while at least two fixes
    in a row are rejected, as one may be an outlier; or innovations of fixes drift. A jump shows in
    these as often as in the sum of the drift's corrections (`filter/jumps.py`). While the camera
    fits, it speaks for the estimate.
    """
    doubted = work.drifting
    for group in range(SENSOR_GROUPS):
        doubted = maximum(doubted, work.doubted[group])
    elsewhere = (doubted > 0.0) & (flight.rejected_in_row[POSITION_BLOCK] > 1.0)
    elsewhere = (elsewhere | drifts(flight, POSITION_BLOCK)) & logical_not(camera_fits(flight, p))
    return (work.taking > 0.0) & (elsewhere | (work.doubted[POSITION_BLOCK] > 0.0))

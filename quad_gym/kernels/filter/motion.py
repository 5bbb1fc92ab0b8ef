"""The heading by motion: from IMU and GNSS velocity alone, linear in a complex number.

A second attitude W = R_BN follows the gyro. N is level, but its heading is unknown. With horizontal
vectors as complex numbers (east + i north), u = exp(i psi) turns N to I. The velocity v in I, with
the specific force f and the error d of leveling times g, follows from

    v' = u a + d,   a = (W^T (f - b_a))_east,north,   u' = 0,   d' = -d / tau,

which is linear in v, u and d, whatever the heading is. A Kalman filter of three complex states with
circular noise therefore needs no first heading. Between two fixes with the sums A = sum a dt and T,

    v <- v + A u + T d,   d <- k d,   k = exp(-T / tau),

and its covariance P_xy = E[x conj(y)] follows likewise. A fix z of the GNSS velocity with the noise
sigma_v per axis has

    nu = z - v,   S = P_vv + 2 sigma_v^2,
    v += P_vv nu / S,   u += conj(P_vu) nu / S,   d += conj(P_vd) nu / S.

v is the velocity of the antenna: A has the change of W^T (w x l) with the lever arm l, too. It
starts from u = 0 with P_uu = 1, so nothing is invented: without motion the heading stays unknown.
Its angle has the variance P_uu / (2 |u|^2), and |u| far from one shows that the model does not
hold.

N begins with the filter's tilt. Where that is uncertain, the vertical of N is corrected by d as
soon as u is known, and variances and limits are larger until then.

N is leveled by the force that the change of velocity does not explain. Leveling by the whole force
would follow a steady turn with a lag that looks like a heading. What leveling leaves is d.

Where no baseline and no camera measures the heading, too, four rules compare the filter with it:

* **Support.** Where the headings agree, the heading counts as measured: a refused compass stays
  out. Both turn with the gyro. If the fields have left the gate gradually, its bias may have
  changed, so that u has the variance of a gyro that drifts: only fixes in motion confirm it then.
* **Contradiction.** Where they differ by more than four standard deviations in three fixes in a
  row, attitude and heading become those of the motion. The compass is left out until it agrees.
* **Hard iron.** GNSS turns the filter's heading toward that of the motion, but the filter's
  variance still comes from the compass. The error of a wrong compass then appears as hard iron.
  Where this exceeds five standard deviations of the suite in three fixes in a row, and the motion
  shows the heading, the filter is reset as after a contradiction.
* **Lean.** Where no motion has confirmed the heading, and the filter's vertical leaves that of N, a
  wrong heading has made it attribute changes of velocity to its tilt. Then the tilt becomes that of
  N, and the heading counts as unknown until the motion shows it. A vertical that is off by more
  than 8 degrees is reset at once, also between two fixes. Meanwhile no measurement of
  position or velocity corrects the attitude: a filter that linearizes about a heading that is wrong
  by more than a radian would turn the wrong way. A start without any heading begins like this.

Sources: P. Riseborough, yaw recovery from IMU and GPS data alone, ArduPilot, pull request 13603: a
bank of filters that linearize about one heading each, for resets of the yaw by GNSS velocity; L.
Kang et al., Mathematical Problems in Engineering 2014, 593692, for alignment in motion as a linear
problem.
"""

import math

from quad_gym.kernels.compiling import kernel, stage
from quad_gym.kernels.filter.error_state import (
    BA,
    BG,
    MAX_ANGLE,
    D,
    E,
    R,
    V,
    keep_covariance,
    load_covariance,
    reset_variances,
)
from quad_gym.kernels.filter.measurements import RECENT, forget_corrections
from quad_gym.kernels.filter.slow import stages_of
from quad_gym.kernels.numbers.blocks import reset
from quad_gym.kernels.numbers.elementary import approached, clip, exp, maximum, minimum
from quad_gym.kernels.numbers.factors import eliminate
from quad_gym.kernels.numbers.lanes import any_of, logical_not, no_lane, select, zero_like
from quad_gym.kernels.numbers.linalg import (
    cross,
    diagonal,
    dot,
    keep,
    load3,
    load33,
    load_block,
    load_symmetric,
    outer,
    store,
    store_block,
    vector,
)
from quad_gym.kernels.numbers.rotation import level_attitude, vector_to_dcm
from quad_gym.records import (
    AID_BLOCK,
    AID_GROUPS,
    AID_NUMBERS,
    BASELINE_BLOCK,
    SENSOR_GROUPS,
    VELOCITY_BLOCK,
    Aid,
    FilterForm,
)

_MAGNETOMETER = int(Aid["MAGNETOMETER"])
_COMPASS = AID_GROUPS + _MAGNETOMETER
_FIELD, _FIELD_BLOCK = AID_NUMBERS[_MAGNETOMETER], AID_BLOCK[_MAGNETOMETER]

# the model
_LEVELING, _FIRST_LEVELING = 0.1, 0.06
"""Rates at which N is leveled, while its heading is known and before [1/s]."""
_TILT, _TILT_TIME = 0.3, 5.0  #: standard deviation of d per axis [m/s^2], its correlation time [s]
_GYRO_OFFSET = 0.12  #: largest bias of a gyro that N takes from the filter [rad/s]
_WALK = 0.01  #: random walk of the heading of N [rad/sqrt(s)]
_LOOSE = 0.1  #: the same, if the gyro's bias may have changed [rad/sqrt(s)]
_VIBRATION = 0.05  #: of the velocity [m/s/sqrt(s)]
_GATE, _MISSES = (
    20.0,
    3.0,
)  #: on the NIS; fixes left out in a row, after a step, that begin it again
_GAP = 2.0  #: time without a fix after which the velocity begins again [s]

# the rules
_SETTLED = 0.5  #: time since the filter's start after which the heading counts [s]
_KNOWN = 0.26  #: standard deviation below which the heading by motion is known [rad]
_RESOLVED = 0.16  #: the same, below which it replaces a heading that is unknown [rad]
_SHORT, _LONG = 0.6, 1.5  #: lengths of u beyond which the model does not hold
_ROUGH = 0.35  #: the same, below which it may contradict the filter [rad]
_AGAINST, _DOUBT, _AGREES = 16.0, 10.24, 4.0
"""Squares of the numbers of standard deviations that are a contradiction, in a long row, and up to
which headings agree."""
_LEAST = 0.03  #: least square of one, and largest variance of the filter's heading [rad^2]
_LEAN, _MOST_LEAN, _LARGE_LEAN = 0.087, 0.12, 0.14
"""Angles between the verticals beyond which a tilt is wrong [rad]: at least and at most without a
confirmed heading, and with one."""
_IRON, _MORE_IRON = 25.0, 1.1
"""Normalized square of an estimated hard iron beyond which the compass is wrong, and a factor on
the variance at the start, so that no variance is zero."""
_START = 0.06  #: standard deviation of a first tilt beyond which it may lean further [rad]
_LEANS, _LEANS_IN_ROW = 12.0, 2.0
"""Ratio of its square and the variance of N's tilt between these, and times in a row."""
_IN_ROW, _SERIES = 3.0, 10.0  #: contradictions in a row that reset the attitude, and smaller ones
_TILT_RESET, _SPEED_RESET, _PLACE_RESET = 0.05, 1.0, 1.0  #: [rad], [m/s], [m]
_VAGUE = 0.7  #: standard deviation above which a heading counts as unknown [rad]
_ALIGNED, _MOST_ALIGNED = 0.35, 0.6
"""Standard deviation of an unknown heading turned to a sensor's, and with a large tilt [rad]."""
_PROBATION, _TURNED, _LONG_PROBATION = 10.0, 0.87, 60.0
"""A compass is used again when it has agreed for this time [s] while the cosine of the heading's
change fell below that, or for the longer time [s]."""


@kernel
def begin_motion(flight, mask):
    """Reset the heading by motion at the start of an episode, in the lanes `mask`."""
    reset(
        flight, mask, 0.0, "level_phase level_force level_sum level_last level_misses level_fresh"
    )
    reset(
        flight,
        mask,
        0.0,
        "level_against level_doubts level_lean compass_out compass_agrees heading_lost",
    )
    reset(flight, mask, 0.0, "level_apart level_sigma level_first level_loose compass_leapt")
    flight.level_tick = select(mask, -1e9, flight.level_tick)


@kernel
def forget_heading(flight, lanes):
    """Begin v, u and d again at the next fix, in these lanes; N keeps its vertical."""
    flight.level_misses = select(lanes, _MISSES, flight.level_misses)


@kernel
def loosen_heading(flight, lanes):
    """Give u the variance that it has if the gyro's bias has changed, in these lanes."""
    P = flight.level_P
    P[1] = select(lanes, maximum(P[1], flight.level_loose), P[1])


@kernel
def _times(a, b):
    return (a[0] * b[0] - a[1] * b[1], a[0] * b[1] + a[1] * b[0])


@kernel
def _times_conjugate(a, b):
    """A conj(b)."""
    return (a[0] * b[0] + a[1] * b[1], a[1] * b[0] - a[0] * b[1])


@kernel
def _keep_all(values, lanes, numbers):
    for i in range(len(numbers)):
        values[i] = select(lanes, numbers[i], values[i])


@kernel
def _plausible(bias, most):
    """An estimated bias within its bounds: more shows a wrong attitude."""
    return vector(
        clip(bias[0], -most, most), clip(bias[1], -most, most), clip(bias[2], -most, most)
    )


@kernel
def turn_level(flight, p, force, half):
    """Propagate N over a tick and add the `force` in B to the sums; begin N where it has not begun.

    The antenna's velocity relative to the center of mass is part of the sums that fixes read.
    """
    begins, W = flight.level_phase < 1.0, load33(flight.level_turn)
    W = half @ select(begins, load33(flight.R_hat), W)
    b_a = _plausible(load3(flight.b_a_hat), 2.0 * p.accel_bias_sigma)
    a, one = W.T @ (force - b_a), zero_like(p.dt) + 1.0
    W = half @ W
    b_g = load3(flight.b_g_hat)
    # a wrong compass shows biases that are none until the motion has once confirmed the heading
    most = select(flight.level_tick > -1e8, _GYRO_OFFSET, 5.0 * p.gyro_bias_sigma)
    more = p.dt * (b_g - _plausible(b_g, most))
    if any_of(dot(more, more) > 0.0):
        W = vector_to_dcm(more) @ W
    store(flight.level_turn, W)
    first = 0.5 * _tilt_of(flight) - _START * _START
    flight.level_first = select(begins, maximum(first, 0.0), flight.level_first)
    sums = load3(flight.level_force) + p.dt * vector(a[0], a[1], one)
    store(flight.level_force, sums)
    arm = W.T @ cross(load3(flight.w_meas) - load3(flight.b_g_hat), load3(p.antenna))
    store(flight.level_sum, sums + vector(arm[0], arm[1], zero_like(one)))
    last = flight.level_last
    last[2] = select(begins, sums[2], last[2])  # earlier velocities do not count
    flight.level_phase = maximum(flight.level_phase, 1.0)


@kernel
def _is_known(uu, square):
    """Lanes in which u, with this variance and square, gives a heading."""
    holds = (square > _SHORT * _SHORT) & (square < _LONG * _LONG)
    return (uu < 2.0 * square * _KNOWN * _KNOWN) & holds


@kernel
def _tilt_of(flight):
    """Sum of the variances of the filter's roll and pitch."""
    k = load33(flight.R_hat).T[2]
    P_ee = load_symmetric(flight.P, E)
    whole = P_ee[0][0] + P_ee[1][1] + P_ee[2][2]
    return maximum(whole - dot(k, P_ee @ k), 0.0)


@kernel
def _first_tilt(flight):
    """Variance of the tilt with which N began, as leveling has left it, beyond the usual."""
    return exp(-2.0 * _FIRST_LEVELING * flight.level_force[2]) * flight.level_first


@kernel
def _lean_of(flight, p):
    """Variance of d at the beginning: by the filter's tilt, or by N's."""
    tilt = maximum(_tilt_of(flight), 2.0 * _first_tilt(flight))
    bias = maximum(p.accel_bias_sigma, _TILT)
    return p.gravity * p.gravity * tilt + 2.0 * bias * bias


@kernel
def _measure_motion(flight, p, work, mask):
    """Update v, u and d with the GNSS velocity, where there is one."""
    fix = mask & (flight.block_valid[VELOCITY_BLOCK] > 0.0) & (flight.level_phase > 0.0)
    if not any_of(fix):
        return
    z, zero = load33(p.R_IG) @ load3(flight.measurement[VELOCITY_BLOCK]), zero_like(p.dt)
    sums, last, x, P = (
        load3(work.since_level),
        flight.level_last,
        flight.level_state,
        flight.level_P,
    )
    fix = fix & (sums[2] >= last[2])
    r = 2.0 * p.velocity_sigma * p.velocity_sigma * flight.noise_factor[VELOCITY_BLOCK]
    A, T = (sums[0] - last[0], sums[1] - last[1]), sums[2] - last[2]
    begins = fix & ((flight.level_phase < 2.0) | (flight.level_misses >= _MISSES))
    gap = fix & logical_not(begins) & (T > _GAP)
    flight.level_phase = select(fix, 2.0, flight.level_phase)
    # predict
    v, u, d = (x[0], x[1]), (x[2], x[3]), (x[4], x[5])
    before, row = v, flight.rejected_in_row[_COMPASS]
    vv, uu, dd, vu, vd, ud = P[0], P[1], P[2], (P[3], P[4]), (P[5], P[6]), (P[7], P[8])
    keeps = exp(-T / _TILT_TIME)
    moved, Aud = _times(A, u), _times(A, ud)
    v = (v[0] + moved[0] + T * d[0], v[1] + moved[1] + T * d[1])
    Avu = _times_conjugate(vu, A)
    vv = vv + (A[0] * A[0] + A[1] * A[1]) * uu + T * T * dd
    vv = vv + 2.0 * Avu[0] + 2.0 * T * (vd[0] + Aud[0]) + 2.0 * _VIBRATION * _VIBRATION * T
    vu = (vu[0] + A[0] * uu + T * ud[0], vu[1] + A[1] * uu - T * ud[1])
    vd = (keeps * (vd[0] + Aud[0] + T * dd), keeps * (vd[1] + Aud[1]))
    ud, d = (keeps * ud[0], keeps * ud[1]), (keeps * d[0], keeps * d[1])
    uu = uu + 2.0 * _WALK * _WALK * T
    # either the compass is wrong, or the gyro's bias has changed: then only later fixes count
    loose = minimum(flight.level_loose + 2.0 * _LOOSE * _LOOSE * T, 1.0)
    either = (row >= 2.0) & (flight.compass_out <= 0.0) & (flight.compass_leapt <= 0.0)
    either = either & (flight.tick - flight.level_tick < RECENT / p.dt)
    uu = select(either, maximum(uu, loose), uu)
    dd = keeps * keeps * dd + 2.0 * _TILT * _TILT * approached(2.0 * T / _TILT_TIME)
    # update
    nu, S = (z[0] - v[0], z[1] - v[1]), vv + r
    nis, g = 2.0 * (nu[0] * nu[0] + nu[1] * nu[1]) / S, 1.0 / S
    used = fix & (nis < _GATE) & logical_not(begins | gap)
    misses = select(used | begins | gap, 0.0, flight.level_misses + 1.0)
    flight.level_misses = select(fix, misses, flight.level_misses)
    Ku, Kd = _times_conjugate(nu, vu), _times_conjugate(nu, vd)  # conj(vu) nu
    v = (v[0] + vv * g * nu[0], v[1] + vv * g * nu[1])
    turned, leaned = (u[0] + g * Ku[0], u[1] + g * Ku[1]), (d[0] + g * Kd[0], d[1] + g * Kd[1])
    both, share = _times_conjugate(vd, vu), r * g
    gained = uu - g * (vu[0] * vu[0] + vu[1] * vu[1])
    _keep_all(x, used, (v[0], v[1], turned[0], turned[1], leaned[0], leaned[1]))
    others = (share * vu[0], share * vu[1], share * vd[0], share * vd[1])
    crossed = (ud[0] - g * both[0], ud[1] - g * both[1])
    loose = loose / (1.0 + loose * (uu - gained) / (uu * gained))
    flight.level_loose = select(used, loose, select(begins | gap, 1.0, flight.level_loose))
    own = dd - g * (vd[0] * vd[0] + vd[1] * vd[1])
    _keep_all(P, used, (share * vv, gained, own, *others, *crossed))
    # begin again: all of it, or after a gap the velocity alone
    _keep_all(x, begins, (z[0], z[1], zero, zero, zero, zero))
    first = (r, zero + 1.0, _lean_of(flight, p), zero, zero, zero, zero, zero, zero)
    _keep_all(P, begins, first)
    drift = load_symmetric(flight.P, BG)
    lost = T * T * (drift[0][0] + drift[1][1] + drift[2][2])
    square = x[2] * x[2] + x[3] * x[3]
    _keep_all(x, gap, (z[0], z[1], u[0], u[1], d[0], d[1]))
    after = (r, minimum(uu + 2.0 * lost * square, 1.0), dd, zero, zero, zero, zero, zero, zero)
    _keep_all(P, gap, after)
    keep(last, used | begins | gap, sums)
    # level N by the force since the last fix that the change of velocity does not explain
    square = maximum(turned[0] * turned[0] + turned[1] * turned[1], 1e-9)
    known = _is_known(gained, square)
    there = _times_conjugate((v[0] - before[0], v[1] - before[1]), turned)
    share = select(known, 1.0 / square, 0.0)
    turn = select(known, _LEVELING, _FIRST_LEVELING) / p.gravity
    turn = select(used, 1.0, minimum(T, _GAP) / maximum(T, 1e-9)) * turn
    W = load33(flight.level_turn)
    more = (turn * (A[1] - share * there[1]), -turn * (A[0] - share * there[0]), zero)
    keep(flight.level_turn, used, W @ vector_to_dcm(more))
    flight.level_fresh = select(used | begins | gap, 1.0, flight.level_fresh)


@kernel
def _turn_of(c, s):
    """The rotation about the vertical with this cosine and sine."""
    zero = zero_like(c)
    return ((c, s, zero), (-s, c, zero), (zero, zero, zero + 1.0))


@kernel
def _uprighted(flight, p):
    """N, and the variance of its tilt beyond the usual one.

    N may have begun with a large tilt. Once the motion shows u, it shows d, and so the tilt, too.
    """
    W, x, first = load33(flight.level_turn), flight.level_state, _first_tilt(flight)
    square = maximum(x[2] * x[2] + x[3] * x[3], 1e-9)
    shown = (first > 0.0) & _is_known(flight.level_P[1], square)
    if any_of(shown):
        force, n = _times_conjugate((x[4], x[5]), (x[2], x[3])), 1.0 / (p.gravity * square)
        turn = vector_to_dcm((-n * force[1], n * force[0], zero_like(n)))
        upright = W @ turn
        W = (
            _chosen(shown, upright[0], W[0]),
            _chosen(shown, upright[1], W[1]),
            _chosen(shown, upright[2], W[2]),
        )
        first = select(shown, 0.0, first)
    return W, first


@kernel
def _chosen(lanes, a, b):
    """A vector, or another in the other lanes."""
    return (select(lanes, a[0], b[0]), select(lanes, a[1], b[1]), select(lanes, a[2], b[2]))


@kernel
def _wrong_iron(flight, p, slow):
    """Lanes in which the estimated hard iron is too large for the suite.

    In a consistent filter, the variances of an estimate and of its error add up to the variance at
    the start.
    """
    none = no_lane(p.dt)
    if slow is None:
        return none
    iron = slow.aid_vector[_MAGNETOMETER]
    if iron < 0:
        return none
    sigma = maximum(p.slow_sigma[iron], 1e-12)
    scale, own = 1.0 / (sigma * sigma), flight.P_slow[:, D:]
    b, rest = load3(flight.slow_hat[iron : iron + 3]), scale * load_symmetric(own, iron)
    one = zero_like(p.dt) + _MORE_IRON
    x, y, z = diagonal((one, one, one)) - rest
    across, determinant = cross(y, z), dot(x, cross(y, z))
    least = minimum(x[0], minimum(y[1], z[2]))
    nis = dot(b, across) * b[0] + dot(b, cross(z, x)) * b[1] + dot(b, cross(x, y)) * b[2]
    proper = (least > 0.0) & (determinant > 1e-4)
    return proper & (scale * nis > _IRON * determinant) & (flight.compass_out <= 0.0)


@kernel
def _judge_heading(flight, p, work, settings, stages, slow):
    """Compare the filter's attitude with that of the motion, and reset it where they contradict."""
    fresh, R_BI = flight.level_fresh > 0.0, load33(flight.R_hat)
    lean = R_BI.T[2] - load33(flight.level_turn).T[2]
    far = (dot(lean, lean) > _LARGE_LEAN * _LARGE_LEAN) & (flight.level_phase > 1.0)
    if not any_of(fresh | far):
        return
    W, first = _uprighted(flight, p)
    flight.level_fresh = zero_like(p.dt)
    x, M, k = flight.level_state, R_BI.T @ W, R_BI.T[2]
    u, square = (x[2], x[3]), maximum(x[2] * x[2] + x[3] * x[3], 1e-9)
    variance, length = flight.level_P[1] / (2.0 * square), math.sqrt(square)
    # the filter's heading of N, and the chord between it and u
    c, s = M[0][0] + M[1][1], M[1][0] - M[0][1]
    n = 1.0 / math.sqrt(maximum(c * c + s * s, 1e-9))
    c, s = n * c, n * s
    apart = 2.0 - 2.0 * (u[0] * c + u[1] * s) / length
    own = dot(k, load_symmetric(flight.P, E) @ k)
    lost = flight.heading_lost > 0.0
    holds = fresh & (square > _SHORT * _SHORT) & (square < _LONG * _LONG)
    holds = holds & (flight.level_force[2] > _SETTLED)
    known = holds & (variance < _KNOWN * _KNOWN)
    ruled = logical_not(lost)
    if settings.by_motion > 1:
        ruled = no_lane(p.dt)
    holds = holds & (variance < _ROUGH * _ROUGH) & ruled
    both = variance + minimum(own, _LEAST)
    iron = known & ruled & _wrong_iron(flight, p, slow)
    against = iron | (holds & (apart > maximum(_AGAINST * both, _LEAST)))
    doubts = holds & (apart > maximum(_DOUBT * both, _LEAST))
    agrees = known & ruled & (apart <= maximum(_AGREES * both, _LEAST))
    flight.level_tick = select(agrees, flight.tick, flight.level_tick)
    either = fresh & ruled & logical_not(known) & (flight.rejected_in_row[_COMPASS] >= 2.0)
    either = either & (flight.compass_out <= 0.0) & (flight.compass_leapt <= 0.0)
    old = minimum(flight.level_tick, flight.tick - RECENT / p.dt)
    flight.level_tick = select(either, old, flight.level_tick)
    side = select(u[1] * c - u[0] * s > 0.0, 1.0, -1.0)
    flight.level_apart = select(fresh, side * math.sqrt(maximum(apart, 0.0)), flight.level_apart)
    sigma = select(_is_known(flight.level_P[1], square), math.sqrt(variance), MAX_ANGLE)
    flight.level_sigma = select(fresh, sigma, flight.level_sigma)
    row = select(fresh, select(against, flight.level_against + 1.0, 0.0), flight.level_against)
    sharp = variance < _RESOLVED * _RESOLVED
    series = select(fresh, select(doubts, flight.level_doubts + 1.0, 0.0), flight.level_doubts)
    found = known & lost & sharp
    wrong = (against & (row >= _IN_ROW)) | (doubts & (series >= _SERIES))
    flight.level_against = select(wrong, 0.0, row)
    flight.level_doubts = select(wrong, 0.0, series)
    # the filter's vertical against that of N
    lean = k - W.T[2]
    unconfirmed = (flight.tick - flight.level_tick) * p.dt > RECENT
    tilt = flight.level_P[2] / (2.0 * p.gravity * p.gravity)  # variance of that of N, per axis
    limit = clip(_LEANS * tilt, _LEAN * _LEAN, _MOST_LEAN * _MOST_LEAN)
    limit = select(unconfirmed, limit, _LARGE_LEAN * _LARGE_LEAN)
    # a large first tilt is only as well known as d and the filter say
    both = _AGAINST * (tilt + 0.5 * _tilt_of(flight))
    limit = select(flight.level_first > 0.0, maximum(limit, both), limit) + _LEANS * first
    leans = (fresh | far) & (dot(lean, lean) > limit) & ruled
    leans = leans & (flight.level_phase > 1.0)
    row = select(fresh, select(leans, flight.level_lean + 1.0, 0.0), flight.level_lean)
    least = maximum(limit, _LARGE_LEAN * _LARGE_LEAN)
    row = select(leans & (dot(lean, lean) > least), _LEANS_IN_ROW, row)
    wrong = wrong | (leans & (row >= _LEANS_IN_ROW))
    flight.level_lean = select(wrong, 0.0, row)
    certain = known & (sharp | iron)
    loses, wrong = wrong & logical_not(certain), wrong & certain
    if any_of(wrong | found):
        turn = _turn_of(u[0] / length, u[1] / length)
        _reset_attitude(flight, p, work, slow, wrong | found, W @ turn, variance, first, True)
        flight.heading_lost = select(wrong | found, 0.0, flight.heading_lost)
        flight.level_tick = select(wrong | found, flight.tick, flight.level_tick)
    if any_of(loses):
        unknown = MAX_ANGLE * MAX_ANGLE + zero_like(variance)
        _reset_attitude(flight, p, work, slow, loses, W @ _turn_of(c, s), unknown, first, False)
        flight.heading_lost = select(loses, 1.0, flight.heading_lost)
    out = wrong | loses
    flight.compass_out = select(out, 1.0, flight.compass_out)
    flight.compass_agrees = select(out, 0.0, flight.compass_agrees)
    if any_of(fresh & lost):  # the vertical is that of N
        keep(flight.R_hat, fresh & lost & logical_not(found), W @ _turn_of(c, s))


@kernel
def _put_attitude(P, k, states, lanes, variance, first):
    """Give the attitude the tilt's variance of N and this one about the vertical k, alone.

    The tilt's is larger by the variance `first`.
    """
    tilt = _TILT_RESET * _TILT_RESET + first
    reset_variances(P, E, states, lanes, (tilt, tilt, tilt))
    own = diagonal((tilt, tilt, tilt)) + outer((variance - tilt) * k, k)
    store_block(P, E, E, select(lanes, own, load_block(P, E, E)))


@kernel
def _reset_attitude(flight, p, work, slow, lanes, R_BI, variance, first, moves):
    """Replace the attitude, with this variance of its heading, and widen what it has spoiled.

    Where it `moves`, the velocity becomes that of the motion, too.
    """
    zero, P, states = zero_like(p.dt), work.P, 15
    load_covariance(P, flight, slow)
    if slow is not None:
        states = 15 + slow.slow_states
        iron = slow.aid_vector[_MAGNETOMETER]
        if iron >= 0:
            own = p.slow_sigma[iron] * p.slow_sigma[iron]
            reset_variances(P, D + iron, states, lanes, (own, own, own))
            for i in range(3):
                hat = flight.slow_hat[iron + i]
                flight.slow_hat[iron + i] = select(lanes, 0.0, hat)
                P[D + iron + i, D + iron + i] = select(lanes, own, P[D + iron + i, D + iron + i])
    k = R_BI.T[2]
    place, speed = _PLACE_RESET * _PLACE_RESET + zero, _SPEED_RESET * _SPEED_RESET + zero
    ba, bg = p.accel_bias_sigma, p.gyro_bias_sigma
    reset_variances(P, R, states, lanes, (place, place, place))
    reset_variances(P, V, states, lanes, (speed, speed, speed))
    _put_attitude(P, k, states, lanes, variance, first)
    reset_variances(P, BA, states, lanes, (ba * ba, ba * ba, ba * ba))
    reset_variances(P, BG, states, lanes, (bg * bg, bg * bg, bg * bg))
    for i in range(3):
        a, g = flight.b_a_hat[i], flight.b_g_hat[i]
        flight.b_a_hat[i] = select(lanes, 0.0, a)
        flight.b_g_hat[i] = select(lanes, clip(g, -3.0 * bg, 3.0 * bg), g)
    ok = lanes & (eliminate(P, work.L, states, states) >= 0.0)
    keep_covariance(flight, slow, P, ok)
    keep(flight.R_hat, ok, R_BI)
    if moves:
        x, last, sums = flight.level_state, flight.level_last, load3(flight.level_sum)
        A, T = (sums[0] - last[0], sums[1] - last[1]), sums[2] - last[2]
        arm = (
            flight.level_sum[0] - flight.level_force[0],
            flight.level_sum[1] - flight.level_force[1],
        )
        now = _times((A[0] - arm[0], A[1] - arm[1]), (x[2], x[3]))
        for i in range(2):
            v = x[i] + now[i] + T * x[4 + i]
            flight.v_hat[i] = select(ok, v, flight.v_hat[i])
    for group in range(SENSOR_GROUPS):  # the estimate was wrong, not they
        row, step = flight.rejected_in_row[group], flight.stepped[group]
        flight.rejected_in_row[group] = select(ok, 0.0, row)
        flight.stepped[group] = select(ok, 0.0, step)
    flight.alarm_tick = select(ok, flight.tick, flight.alarm_tick)
    forget_corrections(flight, ok)


@kernel
def watch_compass(flight, p, first, agrees, far):
    """Follow a compass that is left out; return the lanes in which its fields are refused.

    The first field of a series of refused ones may be `far` beyond the gate. The compass is used
    again when it has agreed for long with a heading that the motion confirms.
    """
    out, known = flight.compass_out > 0.0, (flight.tick - flight.level_tick) * p.dt < RECENT
    R_BI, zero = load33(flight.R_hat), zero_like(p.dt)
    c, s = R_BI[0][0], R_BI[0][1]
    n = 1.0 / math.sqrt(maximum(c * c + s * s, 1e-9))
    good = first & out & agrees & known
    begins = good & (flight.compass_agrees <= 0.0)
    flight.compass_tick = select(begins, flight.tick, flight.compass_tick)
    _keep_all(flight.compass_from, begins, (n * c, n * s))
    along = n * (c * flight.compass_from[0] + s * flight.compass_from[1])
    least = select(begins, 1.0, minimum(along, flight.compass_least))
    flight.compass_least = select(good, least, flight.compass_least)
    flight.compass_agrees = select(first & out, select(good, 1.0, 0.0), flight.compass_agrees)
    time = (flight.tick - flight.compass_tick) * p.dt
    back = (time > _PROBATION) & (flight.compass_least < _TURNED)
    back = good & (back | (time > _LONG_PROBATION))
    flight.compass_out = select(back, zero, flight.compass_out)
    begins = first & (flight.rejected_in_row[_COMPASS] < 1.0)
    flight.compass_leapt = select(begins, select(far, 1.0, 0.0), flight.compass_leapt)
    return first & (flight.compass_out > 0.0)


@kernel
def _hold_attitude(flight, p, work, settings, slow, mask, pushed):
    """Cut all that ties the attitude to position and velocity, where the heading is unknown.

    The measurements of this update then correct only the latter. Where a sensor shows the heading
    itself, the attitude is turned to it first, so that the update is linear; that is the heading.
    """
    k = load33(flight.R_hat).T[2]
    vague = mask & (dot(k, load_symmetric(flight.P, E) @ k) > _VAGUE * _VAGUE)
    if settings.by_motion < 2:  # otherwise a baseline or a camera shows it again
        flight.heading_lost = select(vague, 1.0, flight.heading_lost)
    lanes = mask & (flight.heading_lost > 0.0)
    work.held = zero_like(p.dt)
    if not any_of(lanes):
        return
    P, zero, states = work.P, zero_like(p.dt), 15
    load_covariance(P, flight, slow)
    iron, delta = -1, -1
    if slow is not None:
        states = 15 + slow.slow_states
        if slow.aid_vector[_MAGNETOMETER] >= 0:
            iron = D + slow.aid_vector[_MAGNETOMETER]
            delta = D + slow.aid_scalar[_MAGNETOMETER]
    for i in range(states):
        for j in range(i):
            if _of_attitude(i, iron, delta) != _of_attitude(j, iron, delta):
                P[i, j] = select(lanes, 0.0, P[i, j])
    if (settings.form & FilterForm.EKF.value) != 0:
        # sigma points contain the second order of a force with any heading, derivatives do not
        square = select(lanes, pushed[0] * pushed[0] + pushed[1] * pushed[1], 0.0)
        for i in range(2):
            P[V + i, V + i] = P[V + i, V + i] + square
    R_BI, shown, steep = load33(flight.R_hat), no_lane(p.dt), zero
    turn = _turn_of(zero + 1.0, zero)
    paired = lanes & (flight.block_valid[BASELINE_BLOCK] > 0.0)
    if any_of(paired):
        b_B, b_I = load3(p.baseline), load33(p.R_IG) @ load3(flight.measurement[BASELINE_BLOCK])
        turn, shown = select(paired, level_attitude(R_BI.T @ b_B, b_I), turn), paired
    if iron >= 0:
        field = lanes & (flight.block_valid[_FIELD_BLOCK] > 0.0) & (flight.compass_out <= 0.0)
        level = level_attitude(
            R_BI.T @ load3(flight.measurement[_FIELD_BLOCK]), load3(p.aid_numbers[_FIELD])
        )
        turn, shown = select(field, level, turn), shown | field
        m = load3(p.aid_numbers[_FIELD])
        steep = m[2] * m[2] / (m[0] * m[0] + m[1] * m[1])
    _, first = _uprighted(flight, p)
    variance = minimum(_ALIGNED * _ALIGNED + steep * first, _MOST_ALIGNED * _MOST_ALIGNED)
    variance = select(shown, variance, MAX_ANGLE * MAX_ANGLE)
    _put_attitude(P, k, states, lanes, variance, first)
    ok = lanes & (eliminate(P, work.L, states, states) >= 0.0)
    keep_covariance(flight, slow, P, ok)
    keep(flight.R_hat, ok & shown, R_BI @ turn)
    flight.heading_lost = select(ok & shown, 0.0, flight.heading_lost)
    lanes = lanes & (flight.heading_lost > 0.0)
    work.held, R_BI = select(lanes, 1.0, 0.0), load33(flight.R_hat)
    for i in range(3):
        store(work.held_attitude[i], R_BI[i])


@kernel
def _release_attitude(flight, p, work, slow):
    """Restore the attitude that the measurements of an update must not correct.

    The lever arm of the antenna would relate the position to the heading, but not linearly: the
    position is off by as much as that.
    """
    lanes = work.held > 0.0
    if not any_of(lanes):
        return
    P, states = work.P, 15
    load_covariance(P, flight, slow)
    if slow is not None:
        states = 15 + slow.slow_states
    keep(flight.R_hat, lanes, load33(work.held_attitude))
    k = load33(flight.R_hat).T[2]
    _, first = _uprighted(flight, p)
    unknown = MAX_ANGLE * MAX_ANGLE + zero_like(work.held)
    _put_attitude(P, k, states, lanes, unknown, first)
    arm = load3(p.antenna)
    for i in range(R, R + 2):
        P[i, i] = P[i, i] + select(lanes, dot(arm, arm), 0.0)
    ok = lanes & (eliminate(P, work.L, states, states) >= 0.0)
    keep_covariance(flight, slow, P, ok)


@kernel
def _of_attitude(row, iron, delta):
    """True for a state that is tied to the attitude: its error, biases, errors of the compass."""
    if row < D:
        return not (R <= row < R + 3 or V <= row < V + 3)
    return (iron >= 0 and iron <= row < iron + 3) or row == delta


@kernel
def _follow_motion(flight, p, work, settings, slow, after):
    """Update the heading by motion before an update of the filter, and finish this `after` it."""
    if after:
        _release_attitude(flight, p, work, slow)
    else:
        mask = work.mask > 0.0
        if settings.late == 0 or settings.rewinds == 0:
            store(work.since_level, load3(flight.level_sum))
        pushed = load3(work.since_level) - load3(flight.level_last)
        _measure_motion(flight, p, work, mask)
        measured = flight.block_valid[0]
        for block in range(1, len(flight.block_valid)):
            measured = maximum(measured, flight.block_valid[block])
        # a lane must not depend on the instants at which others are measured
        _hold_attitude(flight, p, work, settings, slow, mask & (measured > 0.0), pushed)


@stage
def motion_stage(flight, world, model, settings, work, stages, flag):
    """Follow the motion in a filter without slow errors; `flag` is 1 after its update."""
    _follow_motion(flight, model, work, settings, None, flag > 0)


@stage
def motion_with_slow_stage(flight, world, model, settings, work, stages, flag):
    """Follow the motion in a filter that estimates slow errors."""
    _follow_motion(flight, model, work, settings, settings, flag > 0)


heading_stage, heading_with_slow_stage = stages_of("heading", _judge_heading)

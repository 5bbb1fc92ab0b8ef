"""Two tests for a step of the gyro's bias, which innovations sensor by sensor may not show.

* **Corrections.** What the updates of a right filter add to an estimate is white, and each has the
  variance by which it reduces that of the estimate. Their discounted sum, of each axis of both
  biases, tells in B what innovations in I do not while the vehicle turns, and weighs all sensors as
  the filter does. In a steady turn a bias of the gyro tilts the attitude by a constant angle in B,
  which looks like a bias of the accelerometer: its estimate moves then, and hides the other.
* **The trend of the heading.** A filter that hardly believes its headings, as they may have a
  constant error, learns little from them. Yet they show changes: the innovation of the heading,
  plus what updates have turned the estimate by, is a constant plus white noise less the integral of
  the error of the gyro bias about the vertical. A straight line through the last ones, by least
  squares that forget, has that error as its slope s, with a variance M known from white noise.

Neither takes the filter for lost at once, but makes it honest. Sums that are too large add `STEP`
deviations of the suite's gyros to what is claimed of the bias, and begin anew. Where s^2 exceeds
what M and the covariance claim, the variance of the bias about the vertical grows until s is
`_HONEST` deviations. The variance of the attitude grows with both, and with sums that of the
accelerometer bias. The filter is lost where this goes beyond what any gyro of its suite has.

Source: for the sum of corrections, the innovations' cumulative sum of M. Basseville and I. V.
Nikiforov, Detection of Abrupt Changes, 1993; for the line, R. G. Brown, Smoothing, Forecasting and
Prediction of Discrete Time Series, 1963 (discounted least squares); how they are joined is ours.
"""

import math

from quad_gym.kernels.compiling import kernel
from quad_gym.kernels.filter.error_state import BA, BG, E
from quad_gym.kernels.maths.elementary import maximum, minimum
from quad_gym.kernels.maths.linalg import dot, load33
from quad_gym.kernels.simd.lanes import select

_SUM_MEMORY = 10.0
"""For how long a correction counts [s]."""
_SUM_LIMIT, _SUM_ALARM = 12.0, 27.0
"""Squares of a sum over its variance, chi-square in a right filter: beyond the first, once in 300
times for the worst of six, variances grow; beyond the second, once in 800,000 times, the filter is
lost."""
STEP = 4.0
"""Size of a step of the gyro bias, in deviations that gyros of the suite have."""
TURNED_FOR = 3.0
"""How long a gyro bias has turned the attitude when sums show it [s]."""
TREND_MEMORY = 2.8
"""For how long an innovation of the heading counts [s]."""
_TREND_LIMIT, _HONEST = 2.5, 2.0
"""Deviations of a slope beyond which variances grow, and what they grow to."""
TREND_ALARM = 5.0
"""Deviations of a slope beyond which the filter is lost, by what gyros of its suite have."""
_VAGUE = math.radians(0.15)
"""A slope whose own deviation is larger is not judged [rad/s]."""
_FLATTEST = 0.5
"""Horizontal part of a direction that tells the heading, at least."""
_LEAST_VARIANCE = 1e-30
"""Of a sum of corrections [rad^2/s^2]."""
_FIRST_OFFSET, _FIRST_SLOPE = 100.0, 0.01
"""Variances of the line before the first heading [rad^2], [rad^2/s^2]."""


@kernel
def begin_gyro_tests(flight, mask):
    """Forget all corrections and headings at the start of an episode, where `mask`."""
    for i in range(6):
        flight.correction_sum[i] = select(mask, 0.0, flight.correction_sum[i])
        flight.correction_variance[i] = select(mask, 0.0, flight.correction_variance[i])
    flight.correction_tick = select(mask, 0.0, flight.correction_tick)
    flight.trend_tick = select(mask, 0.0, flight.trend_tick)
    first = (_FIRST_OFFSET, 0.0, _FIRST_SLOPE)
    for i in range(2):
        flight.heading_trend[i] = select(mask, 0.0, flight.heading_trend[i])
    for i in range(3):
        flight.trend_gain[i] = select(mask, first[i], flight.trend_gain[i])
        flight.trend_variance[i] = select(mask, first[i], flight.trend_variance[i])


@kernel
def vertical_of(flight):
    """The estimated vertical in B."""
    R_BI = load33(flight.R_hat)
    return (R_BI[0][2], R_BI[1][2], R_BI[2][2])


@kernel
def _advanced(P, dt):
    """Covariance (P00, P01, P11) of a line's offset and slope, dt later."""
    return (P[0] + dt * (2.0 * P[1] + dt * P[2]), P[1] + dt * P[2], P[2])


@kernel
def follow_heading(flight, p, u, side, has):
    """Draw the line through innovations of the heading on to the present one, where `has`.

    Args:
        flight: Record.
        p: Parameters as the filter believes them.
        u: The predicted direction in I.
        side: The innovation's horizontal part across it.
        has: Which lanes have measured it.
    """
    flat = math.sqrt(u[0] * u[0] + u[1] * u[1])
    has = has & (flat > _FLATTEST)
    flat = maximum(flat, _FLATTEST)
    noise = p.baseline_sigma / flat
    noise = noise * noise
    dt = (flight.tick - flight.trend_tick) * p.dt
    forget = 1.0 + minimum(dt / TREND_MEMORY, 1.0)
    G, M = flight.trend_gain, flight.trend_variance
    G0, G1, G2 = _advanced((forget * G[0], forget * G[1], forget * G[2]), dt)
    M0, M1, M2 = _advanced((M[0], M[1], M[2]), dt)
    slope = flight.heading_trend[1]
    offset = flight.heading_trend[0] + dt * slope
    K0, K1 = G0 / (G0 + noise), G1 / (G0 + noise)
    off = side / flat - offset
    line = (offset + K0 * off, slope + K1 * off)
    gain = (G0 - K0 * G0, G1 - K0 * G1, G2 - K1 * G1)
    # (I - K H) M (I - K H)^T + K noise K^T: what white noise makes of the line
    rest = 1.0 - K0
    variance = (
        rest * rest * M0 + K0 * K0 * noise,
        rest * (M1 - K1 * M0) + K0 * K1 * noise,
        M2 - 2.0 * K1 * M1 + K1 * K1 * (M0 + noise),
    )
    for i in range(2):
        flight.heading_trend[i] = select(has, line[i], flight.heading_trend[i])
    for i in range(3):
        G[i] = select(has, gain[i], G[i])
        M[i] = select(has, variance[i], M[i])
    flight.trend_tick = select(has, flight.tick, flight.trend_tick)


@kernel
def follow_corrections(flight, p, dx, L9, columns, last, ok):
    """Take an update into both tests, before the factor in the record is replaced.

    Args:
        flight: Record, with the factor before.
        p: Parameters as the filter believes them.
        dx: What the update adds to the state.
        L9: The factor after it, last column first.
        columns: Columns that it has changed.
        last: The last of them.
        ok: Where it took place.
    """
    dt = (flight.tick - flight.correction_tick) * p.dt
    keep = 1.0 / (1.0 + dt / _SUM_MEMORY)
    L = flight.L
    for i in range(6):
        row = BA + i
        gained = 0.0 * dt
        for j in range(min(columns, row + 1)):
            before, after = L[row, j], L9[row, last - j]
            gained = gained + (before - after) * (before + after)
        for j in range(row + 1, columns):
            gained = gained - L9[row, last - j] * L9[row, last - j]
        total, variance = flight.correction_sum[i], flight.correction_variance[i]
        flight.correction_sum[i] = select(ok, keep * total + dx[row], total)
        summed = keep * keep * variance + maximum(gained, 0.0)
        flight.correction_variance[i] = select(ok, summed, variance)
    flight.correction_tick = select(ok, flight.tick, flight.correction_tick)
    up, line = vertical_of(flight), flight.heading_trend
    turned = dot(up, (dx[E], dx[E + 1], dx[E + 2]))
    shifted = dot(up, (dx[BG], dx[BG + 1], dx[BG + 2]))
    line[0] = select(ok, line[0] - turned, line[0])
    line[1] = select(ok, line[1] + shifted, line[1])


@kernel
def judge_sums(flight, p, variance, mask):
    """Where corrections add up to too much, and where the filter is lost by that.

    Args:
        flight: Record.
        p: Parameters as the filter believes them.
        variance: Of the gyro bias, as the filter claims it, per axis.
        mask: Which lanes.
    """
    score = 0.0 * flight.tick
    for i in range(6):
        total = flight.correction_sum[i]
        own = maximum(flight.correction_variance[i], _LEAST_VARIANCE)
        score = maximum(score, total * total / own)
    beyond = mask & (score > _SUM_LIMIT)
    unlikely = variance > p.gyro_bias_sigma * p.gyro_bias_sigma
    return beyond, beyond & ((score > _SUM_ALARM) | unlikely)


@kernel
def forget_corrections(flight, mask):
    """Begin to sum up corrections anew, where `mask`."""
    for i in range(6):
        flight.correction_sum[i] = select(mask, 0.0, flight.correction_sum[i])
        flight.correction_variance[i] = select(mask, 0.0, flight.correction_variance[i])


@kernel
def judge_trend(flight, p, mask):
    """What the variance of the gyro bias about the vertical lacks, and where the filter is lost."""
    up, L = vertical_of(flight), flight.L
    claimed = 0.0 * flight.tick
    for j in range(BG + 3):
        part = 0.0 * flight.tick
        for i in range(3):
            if j <= BG + i:
                part = part + up[i] * L[BG + i, j]
        claimed = claimed + part * part
    slope, own = flight.heading_trend[1], flight.trend_variance[2]
    square = slope * slope
    beyond = mask & (own < _VAGUE * _VAGUE)
    beyond = beyond & (square > _TREND_LIMIT * _TREND_LIMIT * (claimed + own))
    lacking = select(beyond, maximum((square - own) / (_HONEST * _HONEST) - claimed, 0.0), 0.0)
    known = p.gyro_bias_sigma * p.gyro_bias_sigma + own
    return lacking, beyond & (square > TREND_ALARM * TREND_ALARM * known)

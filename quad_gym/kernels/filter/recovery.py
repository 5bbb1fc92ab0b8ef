"""Consistency monitoring: alarms, and the flag of a diverged filter.

Four signs show that the covariance does not explain the measurements; three are detected here.

* **Rejections.** A group of measurements was rejected `max_rejections` times in a row. Then the
  filter is more likely wrong than the sensor - unless GNSS is rejected while the camera's features
  fit, which supports the estimate: GNSS stays out as long as they do.
* **Drifts.** Innovations of a consistent filter are white. Their mean over the last 50 or so, in
  standard deviations, exceeds `DRIFT_ALARM` in a consistent filter about once in a million times.
* **Corrections that go one way.** Corrections of the IMU biases are white in a consistent filter,
  too, each with the variance that its update removes, P- minus P+. This is no more than the biases'
  driving noise adds, so their sum over some seconds shows a bias that has changed long before
  innovations do, in which attitude and position may compensate each other.
* **Jumps of the drift** of GNSS positions, see `jumps.py`.

`inflation.py` then inflates the covariance.

Source: for the drift of innovations R. K. Mehra and J. Peschon, Automatica 7, 1971. That
corrections are white with these variances follows from the whiteness of innovations.
"""

import math

from quad_gym.kernels.compiling import kernel
from quad_gym.kernels.filter.error_state import BA, BG, E
from quad_gym.kernels.maths.elementary import clip, maximum, minimum
from quad_gym.kernels.maths.linalg import dot, outer
from quad_gym.kernels.maths.matrices import load_block, store_block
from quad_gym.kernels.simd.blocks import reset
from quad_gym.kernels.simd.lanes import any_of, select
from quad_gym.records import SENSOR_GROUPS

DRIFT_ALARM = 0.55  #: mean of the last innovations, in standard deviations, above which they drift
_MEMORY = 0.02
"""Weight of the latest innovation in the mean, of standard deviation sqrt(0.02 / 1.98) = 0.1."""
_CORRECTION_TIME = 3.0  #: time over which corrections of the biases are summed [s]
_LONG_TIME = 12.0
"""Time of the long sums, for errors that are small compared with the noise [s]: corrections of a
bias compensate its error within P/Q, ten seconds or more, and show all of it only by then."""
_ONE_WAY = 5.0  #: standard deviations of their sum above which they go one way
_ONE_WAY_LONG = 24.0
"""Normalized square of three long sums, chi-square, above which they go one way: exceeded with a
probability of 2e-5, and, as these sums change slowly, once in many hours."""
_HARMLESS = 1.0 / _ONE_WAY**2
"""Share of the bias's variance in the test: the sum must also exceed its standard deviation."""
LARGEST = 3.0  #: limit on each innovation in the mean, in standard deviations, because of outliers
DIVERGED_RATIO, CONVERGED_RATIO = 2.1, 1.5
"""Mean NIS over degrees of freedom at which a filter is flagged as diverged, and no longer is."""
_RATIO_MEMORY, _LARGEST_RATIO = 0.05, 10.0
ALARM_TIME = 1.0  #: shortest time for which a filter is flagged as diverged after an alarm [s]
_LONGEST_MEMORY = 60.0
"""Longest such time where no variance is inflated [s]: by then the effect of a bias that is barely
observable shows again."""
FITTING_FEATURES = 3  #: fitting features of an image that support the estimate against GNSS
_FIT_TIME = 1.0  #: time for which they support it [s]
MOST_ACCEL_BIAS, MOST_GYRO_BIAS, MOST_TILT = 2.0, 0.1, 0.2
"""Largest standard deviations after an inflation [m/s^2], [rad/s], [rad]."""
MOST_POSITION, MOST_VELOCITY = 100.0, 20.0
"""Largest standard deviations after an inflation [m], [m/s]. A rejected position counts in full."""
_REMAINING = 9.0
"""Square of the ratio of a possible error to its visible part: corrections or the drift of GNSS may
have followed in part."""
MOST_ANGLE = math.pi / math.sqrt(3.0)
"""Largest standard deviation of an angle [rad], when it is unknown."""


@kernel
def follow_drift(flight, group, valid, nu):
    """Average the innovation of a group, in standard deviations, in the lanes `valid`."""
    for i in range(3):
        value = clip(nu[i], -LARGEST, LARGEST)
        mean = flight.innovation_drift[group, i]
        mean = mean + _MEMORY * (value - mean)
        flight.innovation_drift[group, i] = select(valid, mean, flight.innovation_drift[group, i])


@kernel
def follow_corrections(flight, p, L, L9, dx, columns, ok):
    """Add up an update's corrections dx of the biases, and their variances, where `ok`.

    L is the factor before the update, L9 has the `columns` that the update has changed.
    """
    passed = (flight.tick - flight.corrected_tick) * p.dt
    kept = maximum(1.0 - passed / _CORRECTION_TIME, 0.0)
    kept_long = maximum(1.0 - passed / _LONG_TIME, 0.0)
    for i in range(6):
        removed = 0.0 * kept
        for j in range(columns):
            if j < 15:
                removed = removed + L[BA + i, j] * L[BA + i, j]
            removed = removed - L9[BA + i, j] * L9[BA + i, j]
        removed, shift = maximum(removed, 0.0), dx[BA + i]
        add_correction(flight.corrected, flight.corrected_variance, i, ok, kept, shift, removed)
        sums, variances = flight.corrected_long, flight.corrected_long_variance
        add_correction(sums, variances, i, ok, kept_long, shift, removed)
    flight.corrected_tick = select(ok, flight.tick, flight.corrected_tick)


@kernel
def add_correction(sums, variances, i, ok, kept, shift, variance):
    """Add a correction and its variance to sums of which a share is `kept`, where `ok`."""
    sums[i] = select(ok, kept * sums[i] + shift, sums[i])
    variances[i] = select(ok, kept * kept * variances[i] + variance, variances[i])


@kernel
def variance_of(flight, row):
    """Variance of a state, from its row of the factor."""
    variance = 0.0 * flight.tick
    for j in range(15):
        if j <= row:
            variance = variance + flight.L[row, j] * flight.L[row, j]
    return variance


@kernel
def one_way(flight, first):
    """Lanes in which corrections of three biases from `first` on go one way; how far, squared.

    Their sum must exceed the standard deviation of the bias: a smaller one is harmless, and may be
    a rounding error of corrections by measurements that do not observe biases yet.
    """
    largest, square = -1.0 + 0.0 * flight.tick, 0.0 * flight.tick
    together = square
    for i in range(first, first + 3):
        own = _HARMLESS * variance_of(flight, BA + i)
        total = flight.corrected[i] * flight.corrected[i]
        variance = own + flight.corrected_variance[i]
        largest = maximum(largest, total - _ONE_WAY * _ONE_WAY * variance)
        slow = flight.corrected_long[i] * flight.corrected_long[i]
        together = together + slow / (own + flight.corrected_long_variance[i])
        square = maximum(square, maximum(total, slow))
    return (largest > 0.0) | (together > _ONE_WAY_LONG), square


@kernel
def follow_ratio(flight, p, nis, freedoms, mask):
    """Average NIS over its degrees of freedom, and flag divergence, in the lanes `mask`."""
    ratio = minimum(nis / maximum(freedoms, 1.0), _LARGEST_RATIO)
    measured = mask & (freedoms > 0.0)
    mean = flight.nis_ratio + _RATIO_MEMORY * (ratio - flight.nis_ratio)
    flight.nis_ratio = select(measured, mean, flight.nis_ratio)
    limit = select(flight.diverged > 0.0, CONVERGED_RATIO, DIVERGED_RATIO)
    alarmed = (flight.tick - flight.alarm_tick) * p.dt < ALARM_TIME
    diverged = (flight.nis_ratio > limit) | alarmed
    flight.diverged = select(mask, select(diverged, 1.0, 0.0), flight.diverged)


@kernel
def camera_fits(flight, p):
    """Lanes whose features have fitted lately, which supports the estimate against GNSS."""
    return (flight.tick - flight.fit_tick) * p.dt <= _FIT_TIME


@kernel
def forget_corrections(flight, mask):
    """Reset the sums of corrections, in the lanes `mask`."""
    names = "corrected corrected_variance corrected_long corrected_long_variance"
    reset(flight, mask, 0.0, names)
    flight.corrected_tick = select(mask, flight.tick, flight.corrected_tick)


@kernel
def begin_recovery(flight, mask):
    """Reset the monitoring at the start of an episode, in the lanes `mask`."""
    reset(flight, mask, 0.0, "accepted_tick innovation_drift diverged")
    reset(flight, mask, -1e9, "alarm_tick fit_tick")
    flight.nis_ratio = select(mask, 1.0, flight.nis_ratio)


@kernel
def drifts(flight, group):
    """Lanes in which the innovations of a group of measurements drift."""
    largest = abs(flight.innovation_drift[group, 0])
    largest = maximum(largest, abs(flight.innovation_drift[group, 1]))
    largest = maximum(largest, abs(flight.innovation_drift[group, 2]))
    return largest > DRIFT_ALARM


@kernel
def raise_alarm(flight, p, work, group, free):
    """Set work.alarm of a group of measurements, and work.drifting, in the lanes `free`."""
    alarm = free & (flight.rejected_in_row[group] >= p.max_rejections)
    work.alarm[group] = select(alarm, 1.0, 0.0)
    work.drifting = select(free & drifts(flight, group), 1.0, work.drifting)


@kernel
def time_of(flight, p, group):
    """Seconds since a measurement of a group was last accepted."""
    return maximum(flight.tick - flight.accepted_tick[group], 1.0) * p.dt


@kernel
def enlarge(square, most):
    """Variance of an error whose visible part has the `square`, at most `most` squared."""
    return minimum(_REMAINING * square, most * most)


@kernel
def raise_variance(P, i, alarm, least):
    """Raise a variance of P to at least `least` in the lanes `alarm`."""
    P[i, i] = maximum(P[i, i], select(alarm, least, 0.0))


@kernel
def raise_variances(P, first, alarm, least):
    """Raise three variances of P from the row `first` on to at least `least`, where `alarm`."""
    for i in range(first, first + 3):
        raise_variance(P, i, alarm, least)


@kernel
def inflate_accel_bias(p, P, acceleration, alarm):
    """Raise the standard deviations of accelerometer biases, and of the tilt in proportion."""
    bounded = minimum(acceleration, MOST_ACCEL_BIAS)
    raise_variances(P, BA, alarm, bounded * bounded)
    tilt = minimum(acceleration / p.gravity, MOST_TILT)
    raise_variances(P, E, alarm, tilt * tilt)


@kernel
def inflate_gyro_bias(P, rate, alarm):
    """Raise the standard deviations of gyro biases."""
    bounded = minimum(rate, MOST_GYRO_BIAS)
    raise_variances(P, BG, alarm, bounded * bounded)


@kernel
def inflate_heading(P, R_BI, square, alarm):
    """Raise the variance of the heading, the angle about the vertical."""
    P_ee, vertical = load_block(P, E, E), R_BI.T[2]
    heading = dot(vertical, P_ee @ vertical)
    wanted = select(alarm, minimum(square, MOST_ANGLE * MOST_ANGLE), 0.0)
    more = maximum(wanted - heading, 0.0)
    store_block(P, E, E, P_ee + outer(more * vertical, vertical))


@kernel
def _memory(flight, p, i, drive):
    """Time in which corrections reduce the error of a bias to a third [s].

    Updates reduce its variance P at the recent rate, so an error decays at this rate over P. In the
    long run the rate is the Q that drives the bias; while P is still larger after a start, it is
    higher. All innovations together show an error of n standard deviations as n over the root of
    two: when they no longer show it, up to about seven may remain.
    """
    variance = variance_of(flight, BA + i)
    taken = flight.corrected_long_variance[i] / (0.5 * _LONG_TIME)
    driven = drive * drive / p.dt
    return minimum(variance / maximum(taken, driven), _LONGEST_MEMORY)


@kernel
def flag_drifts(flight, p, mask):
    """Flag a filter without a gate as diverged while innovations drift, in the lanes `mask`.

    The mean of a sensor that no longer measures is outdated and does not count. As nothing is
    inflated, the flag stays until the biases have been corrected.
    """
    drifting = flight.nis_ratio > DIVERGED_RATIO
    for group in range(SENSOR_GROUPS):
        recent = (flight.tick - flight.accepted_tick[group]) * p.dt <= ALARM_TIME
        drifting = drifting | (recent & drifts(flight, group))
    accel, _ = one_way(flight, 0)
    gyro, _ = one_way(flight, 3)
    drifting = mask & (drifting | accel | gyro)
    if any_of(drifting):
        memory = ALARM_TIME + 0.0 * p.dt
        for i in range(3):
            memory = maximum(memory, _memory(flight, p, i, p.accel_bias_drive))
            memory = maximum(memory, _memory(flight, p, 3 + i, p.gyro_bias_drive))
        held = maximum(flight.alarm_tick, flight.tick + (memory - ALARM_TIME) / p.dt)
        flight.alarm_tick = select(drifting, held, flight.alarm_tick)

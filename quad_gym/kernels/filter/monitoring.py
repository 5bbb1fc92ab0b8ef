"""Tests of a filter's consistency, and the flag of a diverged one.

Innovations of a consistent filter are white, and so are the corrections of its states, each with
the variance that its update removes, P- minus P+. Four tests show that the covariance does not
explain the measurements:

* the mean of NIS over its degrees of freedom;
* the mean of the last innovations of a sensor, in standard deviations;
* sums of the corrections of the IMU biases over some seconds, which show a bias that has changed
  long before innovations do, as attitude and position may compensate each other;
* the sum of the corrections of the drift of GNSS positions, which shows a jump that the drift has
  absorbed.

Source: R. K. Mehra and J. Peschon, Automatica 7, 1971. That corrections are white with these
variances follows from the whiteness of innovations.
"""

from quad_gym.kernels.compiling import kernel
from quad_gym.kernels.filter.error_state import BA, D, R, variance_of
from quad_gym.kernels.maths.elementary import clip, maximum, minimum
from quad_gym.kernels.simd.blocks import reset
from quad_gym.kernels.simd.lanes import any_of, select, zero_like
from quad_gym.records import SENSOR_GROUPS

RECENT = 1.0  #: time within which a measurement still counts [s]
LARGEST = 3.0  #: limit on each innovation in the mean, in standard deviations, because of outliers
_MEMORY, _BIASED = 0.02, 0.55
"""Weight of the latest innovation in their mean, of standard deviation sqrt(0.02 / 1.98) = 0.1, and
the mean beyond which they are not white: once in a million times by chance."""
CORRECTION_TIME, _ONE_WAY = 3.0, 5.0
"""Time over which corrections of the biases are summed [s], and the standard deviations of their
sum above which they go one way."""
_LONG_TIME, _ONE_WAY_LONG = 12.0, 24.0
"""The same for errors that are small compared with the noise; the normalized square of three sums,
chi-square, exceeds the limit with a probability of 2e-5."""
_HARMLESS = 1.0 / _ONE_WAY**2
"""Share of the bias's variance in the test: the sum must also exceed its standard deviation."""
_JUMP_TIME, _SUDDEN, _LIKELY = 1.5, 24.0, 12.0
"""Time over which corrections of the drift are summed [s], and the limits on the normalized square
of their sum, the second where the filter is already flagged as diverged."""
DIVERGED_RATIO, CONVERGED_RATIO = 2.1, 1.5
"""Mean NIS over degrees of freedom at which a filter is flagged as diverged, and no longer is."""
_RATIO_MEMORY, _LARGEST_RATIO = 0.05, 10.0
ALARM_TIME = 1.0  #: shortest time for which a filter is flagged as diverged after an alarm [s]
_LONGEST_MEMORY = 60.0
"""Longest such time where no state is reset [s]: by then the effect of a bias that is barely
observable shows again."""


@kernel
def follow_mean(flight, group, valid, nu):
    """Average the accepted innovations of a group, in standard deviations, where `valid`."""
    for i in range(3):
        value, mean = clip(nu[i], -LARGEST, LARGEST), flight.innovation_mean[group, i]
        mean = mean + _MEMORY * (value - mean)
        flight.innovation_mean[group, i] = select(valid, mean, flight.innovation_mean[group, i])


@kernel
def biased(flight, p, group):
    """Lanes in which a group that still measures has innovations that are not white."""
    mean = flight.innovation_mean[group]
    largest = maximum(maximum(abs(mean[0]), abs(mean[1])), abs(mean[2]))
    return (largest > _BIASED) & ((flight.tick - flight.accepted_tick[group]) * p.dt < RECENT)


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
def follow_corrections(flight, p, L, L9, dx, columns, ok):
    """Add up an update's corrections dx of the biases, and their variances, where `ok`.

    L is the factor before the update, L9 has the `columns` that the update has changed.
    """
    passed = (flight.tick - flight.corrected_tick) * p.dt
    kept = maximum(1.0 - passed / CORRECTION_TIME, 0.0)
    kept_long = maximum(1.0 - passed / _LONG_TIME, 0.0)
    for i in range(6):
        removed = zero_like(kept)
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
def one_way(flight, first):
    """Lanes in which corrections of three biases from `first` on go one way; how far, squared.

    Their sum must exceed the standard deviation of the bias: a smaller one is harmless, and may be
    a rounding error of corrections by measurements that do not observe biases yet.
    """
    largest, square = -1.0 + zero_like(flight.tick), zero_like(flight.tick)
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
def forget_corrections(flight, mask):
    """Reset the sums of corrections, in the lanes `mask`."""
    names = "corrected corrected_variance corrected_long corrected_long_variance"
    reset(flight, mask, 0.0, names)
    flight.corrected_tick = select(mask, flight.tick, flight.corrected_tick)


@kernel
def follow_drift_corrections(flight, p, L9, dx, columns, ok):
    """Add up an update's corrections dx of the drift, and their variances, where `ok`.

    L9 is the updated factor, last column first; the record still has the factor before.
    """
    kept = maximum(1.0 - (flight.tick - flight.corrected_tick) * p.dt / _JUMP_TIME, 0.0)
    sums, variances = flight.drift_corrected, flight.drift_corrected_variance
    for i in range(3):
        removed = zero_like(kept)
        for j in range(columns):
            before, after = flight.L_slow[i, j], L9[D + i, j]
            removed = removed + before * before - after * after
        add_correction(sums, variances, i, ok, kept, dx[D + i], maximum(removed, 0.0))


@kernel
def drifts_suddenly(flight):
    """Lanes whose corrections exceed the drift and the standard deviation of the position.

    Corrections below that standard deviation are harmless.
    """
    square, limit = zero_like(flight.tick), select(flight.diverged > 0.0, _LIKELY, _SUDDEN)
    for i in range(3):
        own = variance_of(flight, R + i)
        total, variance = flight.drift_corrected[i], flight.drift_corrected_variance[i]
        square = square + total * total / (own / limit + variance)
    return square > limit


@kernel
def forget_drift_corrections(flight, mask):
    """Reset the sum of corrections of the drift, in the lanes `mask`."""
    reset(flight, mask, 0.0, "drift_corrected drift_corrected_variance")


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
def flag_biased(flight, p, mask):
    """Flag a filter without a gate as diverged while innovations drift, in the lanes `mask`.

    The mean of a sensor that no longer measures is outdated and does not count. As nothing is
    inflated, the flag stays until the biases have been corrected.
    """
    drifting = flight.nis_ratio > DIVERGED_RATIO
    for group in range(SENSOR_GROUPS):
        drifting = drifting | biased(flight, p, group)
    accel, _ = one_way(flight, 0)
    gyro, _ = one_way(flight, 3)
    drifting = mask & (drifting | accel | gyro)
    if any_of(drifting):
        memory = ALARM_TIME + zero_like(p.dt)
        for i in range(3):
            memory = maximum(memory, _memory(flight, p, i, p.accel_bias_drive))
            memory = maximum(memory, _memory(flight, p, 3 + i, p.gyro_bias_drive))
        held = maximum(flight.alarm_tick, flight.tick + (memory - ALARM_TIME) / p.dt)
        flight.alarm_tick = select(drifting, held, flight.alarm_tick)

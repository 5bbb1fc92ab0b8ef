"""Tests of a filter's consistency, and the flag of a diverged one.

Innovations of a consistent filter are white, and so are the corrections of its states, each with
the variance that its update removes, P- minus P+. Two tests show that the covariance does not
explain the measurements:

* the mean of NIS over its degrees of freedom;
* sums of the corrections of the IMU biases and of the drift of GNSS positions over some seconds,
  whose normalized squares are chi-square. They show a bias that has changed long before innovations
  do, as attitude and position may compensate each other, and a jump that the drift has absorbed.

Source: R. K. Mehra and J. Peschon, Automatica 7, 1971. That corrections are white with these
variances follows from the whiteness of innovations.
"""

from quad_gym.kernels.compiling import kernel
from quad_gym.kernels.filter.error_state import BA, BG, D, variance_of
from quad_gym.kernels.maths.elementary import maximum, minimum
from quad_gym.kernels.maths.linalg import load3
from quad_gym.kernels.simd.blocks import reset
from quad_gym.kernels.simd.lanes import any_of, select, zero_like

RECENT = 1.0  #: time within which a measurement still counts [s]
CORRECTION_TIME, _JUMP_TIME = 6.0, 1.5
"""Times over which corrections of the biases and of the drift are summed [s]."""
SHIFTED, LIKELY = 24.0, 12.0
"""Limits on the normalized square of three sums, chi-square: the first is exceeded with a
probability of 2e-5, the second is for filters that are already flagged as diverged."""
DIVERGED_RATIO, CONVERGED_RATIO = 2.1, 1.5
"""Mean NIS over degrees of freedom at which a filter is flagged as diverged, and no longer is."""
_RATIO_MEMORY, _LARGEST_RATIO = 0.05, 10.0
ALARM_TIME = 1.0  #: shortest time for which a filter is flagged as diverged after an alarm [s]
_LONGEST_MEMORY = 60.0
"""Longest such time where no state is reset [s]: by then the effect of a bias that is barely
observable shows again."""


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
def follow_corrections(flight, p, L9, dx, columns, ok, slow):
    """Add up an update's corrections dx of the biases and the drift, and their variances.

    In the lanes `ok`. L9 is the updated factor, last column first; the record still has the factor
    before.
    """
    passed = (flight.tick - flight.corrected_tick) * p.dt
    kept = maximum(1.0 - passed / CORRECTION_TIME, 0.0)
    for i in range(6):
        before, shift = flight.L[BA + i], dx[BA + i]
        _follow(flight, i, before, L9[BA + i], shift, min(columns, 15), columns, kept, ok)
    if slow is not None:
        if slow.estimates_drift:
            kept = maximum(1.0 - passed / _JUMP_TIME, 0.0)
            for i in range(3):
                before, shift = flight.L_slow[i], dx[D + i]
                _follow(flight, 6 + i, before, L9[D + i], shift, columns, columns, kept, ok)
    flight.corrected_tick = select(ok, flight.tick, flight.corrected_tick)


@kernel
def _follow(flight, i, before, after, shift, filled, columns, kept, ok):
    """Add a state's correction and its variance to sums of which a share is `kept`, where `ok`.

    Rows of the factor `before`, of which the first `filled` numbers are not zero, and `after`.
    """
    removed, sums, variances = zero_like(kept), flight.corrected, flight.corrected_variance
    for j in range(columns):
        if j < filled:
            removed = removed + before[j] * before[j]
        removed = removed - after[j] * after[j]
    variance = kept * kept * variances[i] + maximum(removed, 0.0)
    sums[i] = select(ok, kept * sums[i] + shift, sums[i])
    variances[i] = select(ok, variance, variances[i])


@kernel
def shifted(flight, first, own, limit):
    """Lanes in which three sums of corrections, from `first` on, exceed a limit.

    They must also exceed the standard deviations of the states from row `own` on: smaller ones are
    harmless, and may be rounding errors while a state is not observed yet.
    """
    together = zero_like(flight.tick)
    for i in range(3):
        total = flight.corrected[first + i] * flight.corrected[first + i]
        harmless = variance_of(flight, own + i) / limit
        together = together + total / (harmless + flight.corrected_variance[first + i])
    return together > limit


@kernel
def largest_square(flight, first):
    """Square of the largest of three sums of corrections, from `first` on."""
    x, y, z = load3(flight.corrected[first : first + 3])
    return maximum(maximum(x * x, y * y), z * z)


@kernel
def forget_corrections(flight, mask):
    """Reset the sums of corrections, in the lanes `mask`."""
    reset(flight, mask, 0.0, "corrected corrected_variance")
    flight.corrected_tick = select(mask, flight.tick, flight.corrected_tick)


@kernel
def _memory(flight, p, i, drive):
    """Time in which corrections reduce the error of a bias to a third [s].

    Updates reduce its variance P at the recent rate, so an error decays at this rate over P. In the
    long run the rate is the Q that drives the bias; while P is still larger after a start, it is
    higher. All innovations together show an error of n standard deviations as n over the root of
    two: when they no longer show it, up to about seven may remain.
    """
    variance = variance_of(flight, BA + i)
    taken = flight.corrected_variance[i] / (0.5 * CORRECTION_TIME)
    driven = drive * drive / p.dt
    return minimum(variance / maximum(taken, driven), _LONGEST_MEMORY)


@kernel
def flag_shifted(flight, p, mask):
    """Flag a filter without a gate as diverged while its biases drift, in the lanes `mask`.

    As no state is reset, the flag stays until the biases have been corrected.
    """
    drifting = shifted(flight, 0, BA, SHIFTED) | shifted(flight, 3, BG, SHIFTED)
    drifting = mask & (drifting | (flight.nis_ratio > DIVERGED_RATIO))
    if any_of(drifting):
        memory = ALARM_TIME + zero_like(p.dt)
        for i in range(3):
            memory = maximum(memory, _memory(flight, p, i, p.accel_bias_drive))
            memory = maximum(memory, _memory(flight, p, 3 + i, p.gyro_bias_drive))
        held = maximum(flight.alarm_tick, flight.tick + (memory - ALARM_TIME) / p.dt)
        flight.alarm_tick = select(drifting, held, flight.alarm_tick)

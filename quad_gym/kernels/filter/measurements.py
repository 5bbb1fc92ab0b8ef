"""The stacked measurement: valid blocks, their rows, directions, and tests of consistency.

The stacked measurement has three rows for each block that any lane has measured, in the order of
`Sensor`; each sensor fills its own rows (`kernels/sensors/`). A sensor is a stage that is called
with an `Act` and an argument. The filter accesses sensors by these calls only.
"""

import math

import numpy as np

from quad_gym.kernels.compiling import Stage, call_stage, kernel
from quad_gym.kernels.filter.columns import columns_of, row_of
from quad_gym.kernels.filter.error_state import BA, BG, E, variance_of
from quad_gym.kernels.numbers.blocks import reset
from quad_gym.kernels.numbers.elementary import maximum, minimum
from quad_gym.kernels.numbers.lanes import any_of, logical_not, no_lane, select, zero_like
from quad_gym.kernels.numbers.linalg import (
    add_to_diagonal,
    cross,
    dot,
    load3,
    load33,
    load_block,
    load_column3,
    outer,
    polynomial,
    rounded,
    store,
)
from quad_gym.records import (
    BASELINE_BLOCK,
    BLOCK_NUMBERS,
    DIRECTION_BLOCKS,
    FIRST_BLOCK,
    MAX_BLOCKS,
    MAX_STATES,
    MAX_TOGETHER,
    SENSORS,
    Act,
    FilterForm,
    FilterStatus,
    GateDecision,
    Sensor,
)

# --------------------------------------------------------------------------------------------------
# Bookkeeping of measurements for an update: which are valid, and the calls of their sensors.
# --------------------------------------------------------------------------------------------------

ACTS = len(Act)
_FIRST = Stage[Sensor(0).name].value
_NUMBERS = tuple(map(float, BLOCK_NUMBERS))

for _sensor in Sensor:  # their stages are in the same order
    assert Stage[_sensor.name] == _FIRST + _sensor


@kernel
def call_sensor(flight, world, model, settings, work, stages, sensor, act, argument):
    """Call a sensor for an `Act`.

    The argument is the sensor's first row in the stacked measurement; for `Act.SAMPLE`, 1 at the
    start of an episode.
    """
    flag = act + ACTS * argument
    call_stage(stages, _FIRST + sensor, flight, world, model, settings, work, flag)


@kernel
def call_sensors(flight, world, model, settings, work, stages, act, argument):
    """Call all sensors for an `Act`."""
    for sensor in range(SENSORS):
        call_sensor(flight, world, model, settings, work, stages, sensor, act, argument)


@kernel
def call_measured(flight, p, work, settings, stages, act):
    """Call the sensors with a measurement in any lane, each with its first row."""
    k = 0
    for sensor in range(SENSORS):
        rows = rows_of(flight, settings, sensor)
        if rows > 0:
            call_sensor(flight, p, p, settings, work, stages, sensor, act, k)
            k += rows


@kernel
def rows_of(flight, settings, sensor):
    """Count the rows of a sensor in the stacked measurement."""
    return rows_of_blocks(flight, FIRST_BLOCK[sensor], settings.sensor_blocks[sensor])


@kernel
def rows_of_blocks(flight, first, count):
    """Count the rows of blocks from `first` on in the stacked measurement."""
    rows = 0
    for block in range(first, first + count):
        if any_of(flight.block_valid[block] > 0.0):
            rows += 3
    return rows


@kernel
def count_measured(flight, work, settings):
    """Count the measured numbers of each lane in work.measured; return the rows of all sensors."""
    work.measured = zero_like(flight.tick)
    k = 0
    for sensor in range(SENSORS):
        first = FIRST_BLOCK[sensor]
        for block in range(first, first + settings.sensor_blocks[sensor]):
            valid = flight.block_valid[block]
            if any_of(valid > 0.0):
                work.measured = work.measured + _NUMBERS[sensor] * valid
                k += 3
    return k


@kernel
def choose_valid(flight, work, settings, turn):
    """Leave only one delayed sensor's blocks valid; if `turn` is SENSORS, all that are not delayed.

    Returns:
        Ticks of the sensor's delay.
    """
    delay = 0
    for sensor in range(SENSORS):
        latency = settings.sensor_delay[sensor]
        if turn == sensor:
            delay = latency
        share = 1.0 if turn == (sensor if latency > 0 else SENSORS) else 0.0
        first = FIRST_BLOCK[sensor]
        for block in range(first, first + settings.sensor_blocks[sensor]):
            flight.block_valid[block] = share * work.kept_block_valid[block]
    return delay


@kernel
def mark_failed(flight, failed):
    """Mark the valid blocks of an update that failed."""
    for block in range(MAX_BLOCKS):
        lost = failed & (flight.block_valid[block] > 0.0)
        flight.gate[block] = select(lost, GateDecision.FAILED, flight.gate[block])


@kernel
def count_failure(flight, failed):
    """Flag and count an update that failed."""
    status = flight.filter_status
    failure = np.uint64(FilterStatus.UPDATE_FAILED.value)
    flight.filter_status = select(failed, status | failure, status)
    flight.update_failures = flight.update_failures + select(failed, 1.0, 0.0)


# --------------------------------------------------------------------------------------------------
# Rows of a block in the stacked measurement: zero, with noise one, where it is not measured.
#
# Column j of the factor L is row `last - j` of work.A, and row 8 - j of work.E.
# --------------------------------------------------------------------------------------------------


@kernel
def put_three(row, k, valid, values):
    """Write three numbers, in the lanes `valid`."""
    for i in range(3):
        row[k + i] = select(valid, values[i], 0.0)


@kernel
def put_block(work, settings, k, valid, z, z_hat, noise):
    """Write measurement, prediction and noise, in the lanes `valid`; slow errors add nothing."""
    put_three(work.z, k, valid, z)
    put_three(work.z_hat, k, valid, z_hat)
    for i in range(3):
        for j in range(3):
            work.Rz[k + i, k + j] = select(valid, noise[i][j], 1.0 if i == j else 0.0)
    for row in range(settings.slow_states):
        for i in range(3):
            work.A[row, k + i] = zero_like(work.spread)


@kernel
def put_column(work, settings, k, j, valid, a, s):
    """Write half-difference and half-sum of a column j of motion, over c, in the lanes `valid`."""
    put_three(work.A[columns_of(settings) - 1 - j], k, valid, a)
    put_three(work.E[j], k, valid, s)


@kernel
def by_derivative(settings):
    """True in an EKF, whose columns are derivatives."""
    return (settings.form & FilterForm.EKF.value) != 0


@kernel
def with_pairs(settings):
    """True if pairs of sigma points are needed: in a UKF, and in an EKF for their half-sums."""
    return not by_derivative(settings) or (settings.form & FilterForm.GRADUAL.value) != 0


@kernel
def lever_column(work, settings, j, R_BI, l_B):
    """Half-difference and half-sum of R^T l along column j; in an EKF derivative and half-sum."""
    if j >= 3:  # these columns do not change the attitude
        zero = zero_like(work.spread)
        return (zero, zero, zero), (zero, zero, zero)
    odd, even, inverse_c = load33(work.odd[j]), load33(work.even[j]), work.inverse_spread
    a = R_BI.T @ (inverse_c * (odd.T @ l_B))
    s = R_BI.T @ (inverse_c * (even.T @ l_B))
    if by_derivative(settings):
        a = R_BI.T @ cross(load_column3(work.L, E, j), l_B)
        if not with_pairs(settings):
            s = zero_like(a)
    return a, s


# --------------------------------------------------------------------------------------------------
# Unit vectors as measurements: their noise, and pairs of them without cancellation.
# --------------------------------------------------------------------------------------------------

_SERIES = (
    -1.0 / 2.0,
    3.0 / 8.0,
    -5.0 / 16.0,
    35.0 / 128.0,
    -63.0 / 256.0,
    231.0 / 1024.0,
    -429.0 / 2048.0,
)


_FLOOR = 1e-5  #: share of a direction's variance along it, which changes no estimate measurably


@kernel
def direction_noise(direction, variance, floor):
    """Variance (I - u u^T) + floor I: noise of a direction u, of rank 2 except for the floor.

    The floor is at least `_FLOOR` times the variance, which rounding errors do not use up.
    """
    floor = maximum(floor, _FLOOR * variance)
    return add_to_diagonal(outer(-variance * direction, direction), variance + floor)


@kernel
def _inverse_root_minus_one(d):
    """(1 + d)^(-1/2) - 1 by its binomial series, exact to float64 for |d| < 0.01."""
    return d * polynomial(d, _SERIES)


@kernel
def _shrinkage(d):
    """(1 + d)^(-1/2) - 1 for d > -1."""
    value = _inverse_root_minus_one(d)
    if any_of(abs(d) >= 0.01):
        root = math.sqrt(1.0 + d)
        value = select(abs(d) < 0.01, value, -d / (root * (1.0 + root)))
    return value


@kernel
def direction_pair(v, inverse_norm, v_even, v_odd):
    """Half-difference, and half-sum minus unit(v), of the pair unit(v + v_even +- v_odd).

    |v + v_even +- v_odd|^2 = |v|^2 (1 + d): the small d gives the lengths without cancellation.
    """
    center = v + v_even
    inverse_square = inverse_norm * inverse_norm
    d_even = inverse_square * (dot(v_even, v + center) + dot(v_odd, v_odd))
    d_odd = inverse_square * (2.0 * dot(center, v_odd))
    plus, minus = _shrinkage(d_even + d_odd), _shrinkage(d_even - d_odd)
    both, gap = 0.5 * (plus + minus), 0.5 * (plus - minus)
    difference = v_odd + both * v_odd + gap * center
    half_sum = v_even + both * center + gap * v_odd
    return inverse_norm * difference, inverse_norm * half_sum


@kernel
def direction_shift(v, inverse_norm, v_odd):
    """As `direction_pair` without an even part."""
    inverse_square = inverse_norm * inverse_norm
    d_even = inverse_square * dot(v_odd, v_odd)
    d_odd = inverse_square * (2.0 * dot(v, v_odd))
    plus, minus = _shrinkage(d_even + d_odd), _shrinkage(d_even - d_odd)
    both, gap = 0.5 * (plus + minus), 0.5 * (plus - minus)
    difference = v_odd + both * v_odd + gap * v
    half_sum = both * v + rounded(gap * v_odd)
    return inverse_norm * difference, inverse_norm * half_sum


# --------------------------------------------------------------------------------------------------
# Degrees of freedom of an update, and the share of its NIS that belongs to none.
#
# A direction is a unit vector of three numbers with two degrees of freedom. Noise n across it
# shortens its component along it by |n|^2 / 2, with a variance of `direction_variance_floor` in the
# filter, so the square of the innovation along it may be a thousand times this variance. No state
# depends on it to first order, so the update is right, but its share is removed from the NIS.
#
# The components along several directions have the second order of the prior in common, and are
# otherwise independent. Up to that order they do not depend on other measurements.
# --------------------------------------------------------------------------------------------------

_SMALL = 0.01  #: share of a variance that may be neglected
assert MAX_TOGETHER <= MAX_STATES  # work.M has room for a number of each block


@kernel
def _left_out(flight, settings, block):
    """Lanes in which the gate has left out a block of the present measurements."""
    out = no_lane(flight.tick)
    if (settings.form & FilterForm.GATE.value) != 0:
        gate = flight.gate[block]
        out = (gate == GateDecision.REJECTED) | (gate == GateDecision.UNSURE)
    return out


@kernel
def without_directions(flight, p, work, settings):
    """The NIS along directions, and how many numbers of the measurement are no degrees of freedom.

    From work.nu and work.Rz before whitening; uses work.M and work.y. Where the second order of
    the prior is small, the components along directions are independent. A heading alone is a
    baseline with noise above pi along two axes, see `gnss.py`.
    """
    k, numbers = 0, zero_like(work.spread)
    nis, wide = numbers, no_lane(numbers)
    for sensor in range(SENSORS):
        first = FIRST_BLOCK[sensor]
        for block in range(first, first + settings.sensor_blocks[sensor]):
            valid = flight.block_valid[block] > 0.0
            if any_of(valid):
                if is_direction(block):
                    used = valid & logical_not(_left_out(flight, settings, block))
                    u, nu = load3(work.z_hat[k : k + 3]), load3(work.nu[k : k + 3])
                    variance, length = dot(u, load_block(work.Rz, k, k) @ u), dot(u, nu)
                    shift = dot(u, load3(work.mu[k : k + 3]))
                    wide = wide | (used & (p.sigma_beta * shift * shift > _SMALL * variance))
                    nis = nis + select(used, length * length / variance, 0.0)
                    numbers = numbers + select(used, 1.0, 0.0)
                    if block == BASELINE_BLOCK:
                        alone = used & (p.baseline_sigma > math.pi)
                        numbers = numbers + select(alone, 1.0, 0.0)
                k += 3
    if any_of(wide):
        _find_directions(flight, work, settings)
        nis = select(wide, _joint_nis(work, k // 3), nis)
    return nis, numbers


@kernel
def is_direction(block):
    """True if a block is a unit vector: a baseline or a feature."""
    found = False
    for first, end in DIRECTION_BLOCKS:
        found = found | (first <= block < end)
    return found


@kernel
def _find_directions(flight, work, settings):
    """Fill work.along."""
    k = 0
    for sensor in range(SENSORS):
        first = FIRST_BLOCK[sensor]
        for block in range(first, first + settings.sensor_blocks[sensor]):
            valid = flight.block_valid[block] > 0.0
            if any_of(valid):
                used = no_lane(work.spread)
                if is_direction(block):
                    used = valid & logical_not(_left_out(flight, settings, block))
                store(work.along[k : k + 3], select(used, 1.0, 0.0) * load3(work.z_hat[k : k + 3]))
                k += 3


@kernel
def _joint_nis(work, blocks):
    """The NIS along directions whose components are not independent.

    A block has a single number here, so its place among three depends on the blocks of other lanes.
    The factor is therefore computed number by number: numbers that a lane lacks change no bit of
    it. In blocks of three, as in `cholesky`, two numbers would be rounded by their place.
    """
    M, y, inverse = work.M, work.y, work.inverse_diagonal
    nis = zero_like(work.spread)
    for i in range(blocks):
        u = load3(work.along[3 * i : 3 * i + 3])
        rest = dot(u, load3(work.nu[3 * i : 3 * i + 3]))
        for j in range(i):
            other = load3(work.along[3 * j : 3 * j + 3])
            entry = dot(u, load_block(work.Rz, 3 * i, 3 * j) @ other)
            for k in range(j):
                entry = entry - M[i, k] * M[j, k]
            M[i, j] = entry * inverse[j]
            rest = rest - M[i, j] * y[j]
        pivot = dot(u, load_block(work.Rz, 3 * i, 3 * i) @ u)
        pivot = select(pivot > 0.0, pivot, 1.0)
        for k in range(i):
            pivot = pivot - M[i, k] * M[i, k]
        inverse[i] = 1.0 / math.sqrt(pivot)
        y[i] = rest * inverse[i]
        nis = nis + y[i] * y[i]
    return nis


# --------------------------------------------------------------------------------------------------
# Tests of a filter's consistency, and the flag of a diverged one.
#
# Innovations of a consistent filter are white, and so are the corrections of its states, each with
# the variance that its update removes, P- minus P+. Two tests show that the covariance does not
# explain the measurements:
#
# * the mean of NIS over its degrees of freedom;
# * sums of the corrections of the IMU biases and of the drift of GNSS positions over some seconds,
#   whose normalized squares are chi-square. They show a bias that has changed long before
#   innovations do, as attitude and position may compensate each other, and a jump that the drift
#   has absorbed.
#
# Source: R. K. Mehra and J. Peschon, Automatica 7, 1971. That corrections are white with these
# variances follows from the whiteness of innovations.
# --------------------------------------------------------------------------------------------------

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
def follow_corrections(flight, p, work, columns, ok, slow):
    """Add up an update's corrections work.dx of the biases and the drift, and their variances.

    In the lanes `ok`. A variance falls by the difference of the squares of its rows in work.L and
    work.L9.
    """
    passed = (flight.tick - flight.corrected_tick) * p.dt
    kept = maximum(1.0 - passed / CORRECTION_TIME, 0.0)
    for i in range(6):
        _follow(flight, work, i, row_of(slow, BA + i), columns, kept, ok)
    if slow is not None:
        if slow.estimates_drift:
            kept = maximum(1.0 - passed / _JUMP_TIME, 0.0)
            for i in range(3):
                _follow(flight, work, 6 + i, slow.motion_columns + i, columns, kept, ok)
    flight.corrected_tick = select(ok, flight.tick, flight.corrected_tick)


@kernel
def _follow(flight, work, i, row, columns, kept, ok):
    """Add a state's correction and its variance to sums of which a share is `kept`, where `ok`."""
    removed, sums, variances = zero_like(kept), flight.corrected, flight.corrected_variance
    before, after = work.L[row], work.L9[row]
    for j in range(columns):
        removed = removed + before[j] * before[j]
        removed = removed - after[j] * after[j]
    variance = kept * kept * variances[i] + maximum(removed, 0.0)
    sums[i] = select(ok, kept * sums[i] + work.dx[row], sums[i])
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

"""A filter that notices that it is wrong: what it doubts then, and when it counts as lost.

Two things tell a filter that its covariance does not explain what is measured.

* **Rejections.** A kind of measurement was rejected `gate_patience` times in a row. Then the filter
  is likelier wrong than the sensor - unless GNSS is rejected while the camera's features fit, which
  then speak for the estimate: GNSS stays out as long as they do.
* **Drifts.** Innovations of a right filter are white. Their mean over the last 50 or so, in
  deviations, exceeds `DRIFT_ALARM` in a right filter about once in a million times.

What may be wrong is not only what the sensor measures. An innovation that has grown for a time T
since the last acceptance may come from biases, so their variances grow likewise: nu / T of an angle
for the gyro; nu / T of a velocity, or 2 nu / T^2 of a position, for the accelerometer, and 1/g of
that for the tilt. A drift multiplies the deviations of the biases by four.

Source: for the drift of innovations R. K. Mehra and J. Peschon, Automatica 7, 1971; what is
inflated is ours.
"""

import math

import numpy as np

from quad_gym.kernels.compiling import Stage, call_stage, kernel
from quad_gym.kernels.filter.error_state import BA, BG, E, R, V
from quad_gym.kernels.filter.slow import add_to_slow, keep_slow_factor
from quad_gym.kernels.maths.elementary import clip, maximum, minimum
from quad_gym.kernels.maths.factors import cholesky
from quad_gym.kernels.maths.linalg import (
    add33,
    add_outer,
    add_to_diagonal,
    load3,
    load33,
    load_block,
    norm,
    scale,
    scale33,
    store_block,
    sub,
    sum_of_outers,
)
from quad_gym.kernels.simd.lanes import any_of, logical_not, select
from quad_gym.records import (
    AID_GROUPS,
    AIDS,
    BASELINE_BLOCK,
    FEATURE_BLOCKS,
    POSITION_BLOCK,
    SENSOR_GROUPS,
    VELOCITY_BLOCK,
    Act,
    Aid,
    FilterStatus,
)

_FIRST_AID, _DOUBT = int(Stage[Aid(0).name]), int(Act.DOUBT)
_UPDATE_FAILED = np.uint64(FilterStatus.UPDATE_FAILED)
DRIFT_ALARM = 0.55
"""Mean of the last innovations, in deviations, from which on they drift."""
_MEMORY = 0.02
"""Weight of the latest innovation in the mean: it deviates by sqrt(0.02 / 1.98) = 0.1."""
_CORRECTION_TIME = 2.0
"""How long corrections of the biases are added up [s]."""
_ONE_WAY = 6.0
"""Deviations of their sum from which on they go one way."""
_REMAINING = 9.0
"""Square of how many times that sum may still be missing."""
DRIFT_FACTOR, BIAS_FACTOR = 16.0, 240.0
LARGEST = 3.0
"""Innovations count as no more deviations than that in the mean, for the sake of outliers."""
LOST_RATIO, FOUND_RATIO = 2.0, 1.5
"""Mean NIS over its degrees of freedom at which a filter counts as lost, and as found again."""
_RATIO_MEMORY, _LARGEST_RATIO = 0.05, 10.0
DOUBT_TIME = 1.0
"""How long a filter counts as lost after a doubt, at least [s]."""
FITTING_FEATURES = 3
"""Features of an image that speak for the estimate against GNSS."""
_FIT_TIME = 1.0
"""How long they do [s]."""
_MOST_ACCEL_BIAS, _MOST_GYRO_BIAS, _MOST_TILT = 2.0, 0.1, 0.2
"""Largest deviations that a doubt adds [m/s^2], [rad/s], [rad]."""


@kernel
def follow_drift(flight, group, has, first, second, third):
    """Follow the mean innovation of a group, in deviations, where a lane `has` one."""
    values = (first, second, third)
    for i in range(3):
        value = clip(values[i], -LARGEST, LARGEST)
        mean = flight.innovation_drift[group, i]
        mean = mean + _MEMORY * (value - mean)
        flight.innovation_drift[group, i] = select(has, mean, flight.innovation_drift[group, i])


@kernel
def follow_corrections(flight, p, L, L9, dx, columns, ok):
    """Add up an update's corrections of the biases, and their variances, where `ok`.

    Args:
        flight: Record.
        p: Parameters as the filter believes them.
        L: The factor before the update.
        L9: The columns of the factor that the update has changed.
        dx: The correction of the state.
        columns: How many columns these are.
        ok: Which lanes.
    """
    kept = maximum(1.0 - (flight.tick - flight.corrected_tick) * p.dt / _CORRECTION_TIME, 0.0)
    for i in range(6):
        variance = 0.0 * kept
        for j in range(columns):
            if j < 15:
                variance = variance + L[BA + i, j] * L[BA + i, j]
            variance = variance - L9[BA + i, j] * L9[BA + i, j]
        total = kept * flight.corrected[i] + dx[BA + i]
        flight.corrected[i] = select(ok, total, flight.corrected[i])
        variance = kept * kept * flight.corrected_variance[i] + maximum(variance, 0.0)
        before = flight.corrected_variance[i]
        flight.corrected_variance[i] = select(ok, variance, before)
    flight.corrected_tick = select(ok, flight.tick, flight.corrected_tick)


@kernel
def _one_way(flight, first):
    """Where the corrections of three biases from `first` on go one way, and how far [squared]."""
    largest, square = -1.0 + 0.0 * flight.tick, 0.0 * flight.tick
    for i in range(3):
        total, variance = flight.corrected[first + i], flight.corrected_variance[first + i]
        largest = maximum(largest, total * total - _ONE_WAY * _ONE_WAY * variance)
        square = maximum(square, total * total)
    return largest > 0.0, square


@kernel
def follow_ratio(flight, p, nis, freedoms, mask):
    """Follow NIS over its degrees of freedom, and say whether the filter is lost, where `mask`."""
    ratio = minimum(nis / maximum(freedoms, 1.0), _LARGEST_RATIO)
    measured = mask & (freedoms > 0.0)
    mean = flight.nis_ratio + _RATIO_MEMORY * (ratio - flight.nis_ratio)
    flight.nis_ratio = select(measured, mean, flight.nis_ratio)
    limit = select(flight.lost > 0.0, FOUND_RATIO, LOST_RATIO)
    in_doubt = (flight.tick - flight.doubt_tick) * p.dt < DOUBT_TIME
    lost = (flight.nis_ratio > limit) | in_doubt
    flight.lost = select(mask, select(lost, 1.0, 0.0), flight.lost)


@kernel
def camera_fits(flight, p):
    """Where features have fitted lately, so that they speak for the estimate against GNSS."""
    return (flight.tick - flight.fit_tick) * p.dt <= _FIT_TIME


@kernel
def _forget_corrections(flight, mask):
    for i in range(6):
        flight.corrected[i] = select(mask, 0.0, flight.corrected[i])
        flight.corrected_variance[i] = select(mask, 0.0, flight.corrected_variance[i])
    flight.corrected_tick = select(mask, flight.tick, flight.corrected_tick)


@kernel
def begin_recovery(flight, mask):
    """Forget all doubts at the start of an episode, where `mask`."""
    for group in range(SENSOR_GROUPS):
        flight.accepted_tick[group] = select(mask, 0.0, flight.accepted_tick[group])
        for i in range(3):
            drift = flight.innovation_drift[group, i]
            flight.innovation_drift[group, i] = select(mask, 0.0, drift)
    _forget_corrections(flight, mask)
    flight.nis_ratio = select(mask, 1.0, flight.nis_ratio)
    flight.lost = select(mask, 0.0, flight.lost)
    flight.doubt_tick = select(mask, -1e9, flight.doubt_tick)
    flight.fit_tick = select(mask, -1e9, flight.fit_tick)


@kernel
def _squares(nu, mask):
    """The squares of an innovation on a diagonal, where `mask`, else zeros."""
    x, y, z = select(mask, nu[0], 0.0), select(mask, nu[1], 0.0), select(mask, nu[2], 0.0)
    zero = 0.0 * x
    return ((x * x, zero, zero), (zero, y * y, zero), (zero, zero, z * z))


@kernel
def drifts(flight, group):
    """Where the innovations of a group of measurements drift."""
    largest = abs(flight.innovation_drift[group, 0])
    largest = maximum(largest, abs(flight.innovation_drift[group, 1]))
    largest = maximum(largest, abs(flight.innovation_drift[group, 2]))
    return largest > DRIFT_ALARM


@kernel
def _time_of(flight, p, group):
    """Seconds since a measurement of a group was last accepted."""
    return maximum(flight.tick - flight.accepted_tick[group], 1.0) * p.dt


@kernel
def _square_of(value, most, mask):
    """The square of a deviation, at most that of `most`, where `mask`, else zero."""
    bounded = minimum(abs(value), most)
    return select(mask, bounded * bounded, 0.0)


@kernel
def _doubt_attitude(flight, baseline):
    """The square of a baseline's innovation about the vertical and about the horizontal."""
    zero = 0.0 * flight.tick
    nothing = (zero, zero, zero)
    R_BI = load33(flight.R_hat)
    vertical = (R_BI[0][2], R_BI[1][2], R_BI[2][2])
    side = select(baseline, flight.innovation[BASELINE_BLOCK, 0], 0.0)
    up = select(baseline, flight.innovation[BASELINE_BLOCK, 1], 0.0)
    D_e = add_to_diagonal((nothing, nothing, nothing), up * up)
    return add_outer(D_e, scale(side * side - up * up, vertical), vertical), maximum(
        abs(side), abs(up)
    )


@kernel
def _doubt_features(flight, p, feature_count, camera):
    """The largest square of a feature's innovation, as an angle and as an offset of position."""
    angle, offset = 0.0 * flight.tick, 0.0 * flight.tick
    for i in range(feature_count):
        s = FEATURE_BLOCKS + i
        seen = camera & (flight.feature_valid[i] > 0.0)
        nu = flight.innovation
        square = select(seen, nu[s, 0] * nu[s, 0] + nu[s, 1] * nu[s, 1], 0.0)
        distance = norm(sub(load3(p.features[i]), load3(flight.r_hat)))
        angle = maximum(angle, square)
        offset = maximum(offset, square * distance * distance)
    return angle, offset


@kernel
def _add_to_covariance(flight, work, D_r, D_v, D_e, D_a, D_g, mask, slow, D_d, p, stages, factor):
    """P + D, with D of all parts of the state, where `mask`; return where it failed.

    There the covariance stays as it was.
    """
    L, P = flight.L, work.P
    for i in range(0, 15, 3):
        for j in range(0, i + 3, 3):
            store_block(P, i, j, scale33(factor, sum_of_outers(L, i, L, j, j + 3)))
    store_block(P, R, R, add33(load_block(P, R, R), D_r))
    store_block(P, V, V, add33(load_block(P, V, V), D_v))
    store_block(P, E, E, add33(load_block(P, E, E), D_e))
    store_block(P, BA, BA, add_to_diagonal(load_block(P, BA, BA), D_a))
    store_block(P, BG, BG, add_to_diagonal(load_block(P, BG, BG), D_g))
    states = 15
    if slow is not None:
        states = 15 + slow.slow_states
        add_to_slow(flight, slow, P, D_d)
    if slow is not None:
        if slow.aids > 0:
            work.taking = select(mask, 1.0, 0.0)
            for s in range(AIDS):
                if slow.aid_on[s] > 0:
                    call_stage(stages, _FIRST_AID + s, flight, p, p, slow, work, _DOUBT)
    ok = mask & (cholesky(P, states, work.inverse_diagonal) > 0.0)
    for i in range(15):
        for j in range(i + 1):
            L[i, j] = select(ok, P[i, j], L[i, j])
    if slow is not None:
        keep_slow_factor(flight, slow, work, ok)
    return mask & logical_not(ok)


@kernel
def _variance_of(flight, row):
    """Mean variance of the three states from a row of the covariance on."""
    total = 0.0 * flight.tick
    for i in range(3):
        for j in range(15):
            if j <= row + i:
                total = total + flight.L[row + i, j] * flight.L[row + i, j]
    return total / 3.0


@kernel
def tell_drifts(flight, mask):
    """Count a filter that only watches its innovations as lost while they drift, where `mask`."""
    drifting = drifts(flight, 0)
    for group in range(1, SENSOR_GROUPS):
        drifting = drifting | drifts(flight, group)
    accel, _ = _one_way(flight, 0)
    gyro, _ = _one_way(flight, 3)
    drifting = drifting | accel | gyro
    flight.doubt_tick = select(mask & drifting, flight.tick, flight.doubt_tick)


@kernel
def raise_doubts(flight, p, work, feature_count, mask, slow, stages):
    """Inflate the covariance of what may be wrong, where the filter is, and `mask`.

    Args:
        flight: Record; reads innovations, rejections and drifts, changes the covariance.
        p: Parameters as the filter believes them.
        work: Workspace.
        feature_count: Features in use.
        mask: Which lanes.
        slow: The settings, where sensors have slow errors, see `slow.py`, or None.
        stages: The table of stages, which has those of aiding sensors; None without slow errors.
    """
    row, patience = flight.rejected_in_row, p.gate_patience
    free = logical_not(camera_fits(flight, p))
    position = mask & (row[POSITION_BLOCK] >= patience) & free
    baseline = mask & (row[BASELINE_BLOCK] >= patience) & free
    velocity = mask & (row[VELOCITY_BLOCK] >= patience)
    camera = mask & (row[FEATURE_BLOCKS] >= patience)
    drifting = (drifts(flight, POSITION_BLOCK) | drifts(flight, BASELINE_BLOCK)) & free
    drifting = drifting | drifts(flight, VELOCITY_BLOCK) | drifts(flight, FEATURE_BLOCKS)
    rejecting = position | baseline | velocity | camera
    if slow is not None:
        if slow.aids > 0:
            for s in range(AIDS):
                drifting = drifting | drifts(flight, AID_GROUPS + s)
                rejecting = rejecting | (mask & (row[AID_GROUPS + s] >= patience))
    accel, more_a = _one_way(flight, 0)
    gyro, more_g = _one_way(flight, 3)
    drifting = drifting & mask
    accel, gyro = mask & accel, mask & gyro
    doubtful = rejecting | drifting | accel | gyro
    if not any_of(doubtful):
        return
    nu = flight.innovation
    D_r, D_v = _squares(nu[POSITION_BLOCK], position), _squares(nu[VELOCITY_BLOCK], velocity)
    D_d = D_r  # fixes that are off may be so by their slow error
    D_e, turned = _doubt_attitude(flight, baseline)
    angle, offset = _doubt_features(flight, p, feature_count, camera)
    D_e, D_r = add_to_diagonal(D_e, angle), add_to_diagonal(D_r, offset)

    T_r, T_v = _time_of(flight, p, POSITION_BLOCK), _time_of(flight, p, VELOCITY_BLOCK)
    pushed = 2.0 * norm(load3(nu[POSITION_BLOCK])) / (T_r * T_r)
    pushed_v = norm(load3(nu[VELOCITY_BLOCK])) / T_v
    D_a = _square_of(pushed, _MOST_ACCEL_BIAS, position)
    D_a = D_a + _square_of(pushed_v, _MOST_ACCEL_BIAS, velocity)
    tilt = _square_of(pushed / p.gravity, _MOST_TILT, position)
    tilt = tilt + _square_of(pushed_v / p.gravity, _MOST_TILT, velocity)
    D_e = add_to_diagonal(D_e, tilt)
    D_g = _square_of(turned / _time_of(flight, p, BASELINE_BLOCK), _MOST_GYRO_BIAS, baseline)
    T_c = _time_of(flight, p, FEATURE_BLOCKS)
    D_g = D_g + _square_of(math.sqrt(angle) / T_c, _MOST_GYRO_BIAS, camera)

    # a drift alone: four times the deviations of the biases
    D_a = D_a + select(accel, minimum(_REMAINING * more_a, _MOST_ACCEL_BIAS * _MOST_ACCEL_BIAS), 0.0)
    D_g = D_g + select(gyro, minimum(_REMAINING * more_g, _MOST_GYRO_BIAS * _MOST_GYRO_BIAS), 0.0)
    factor = select(drifting | accel | gyro, DRIFT_FACTOR, 1.0)
    more_a, more_g = BIAS_FACTOR * _variance_of(flight, BA), BIAS_FACTOR * _variance_of(flight, BG)
    D_a = D_a + select(drifting, minimum(more_a, _MOST_ACCEL_BIAS * _MOST_ACCEL_BIAS), 0.0)
    D_g = D_g + select(drifting, minimum(more_g, _MOST_GYRO_BIAS * _MOST_GYRO_BIAS), 0.0)

    failed = _add_to_covariance(
        flight, work, D_r, D_v, D_e, D_a, D_g, doubtful, slow, D_d, p, stages, factor
    )
    status = flight.filter_status
    flight.filter_status = select(failed, status | _UPDATE_FAILED, status)
    flight.update_failures = flight.update_failures + select(failed, 1.0, 0.0)
    flight.doubt_tick = select(doubtful, flight.tick, flight.doubt_tick)
    for group in range(SENSOR_GROUPS):
        blocked = camera_fits(flight, p) & (group < VELOCITY_BLOCK)
        done = mask & (row[group] >= patience) & logical_not(blocked)
        flight.reopened[group] = select(done, flight.reopened[group] + 1.0, flight.reopened[group])
        flight.rejected_in_row[group] = select(done, 0.0, row[group])
        for i in range(3):
            mean = flight.innovation_drift[group, i]
            flight.innovation_drift[group, i] = select(doubtful, 0.0, mean)
    _forget_corrections(flight, doubtful)

"""What a filter doubts that notices that it is wrong: what becomes of its covariance.

What may be wrong is not only what the sensor measures. An innovation that has grown for a time T
since the last acceptance may come from biases, so their deviations become: nu / T of an angle
for the gyro; nu / T of a velocity, or 2 nu / T^2 of a position, for the accelerometer, and 1/g of
that for the tilt. What each measurement doubts is in its file in `kernels/measurements/`. Variances
are raised to the square of these, not increased by it, so that doubts that repeat do not add up.
Where GNSS positions drift, position and drift are raised to the square of three times an innovation
or a sum of corrections, as the drift may have followed the error in part.

Where innovations drift, or corrections of the biases go one way, the covariance of the fifteen
states is multiplied by `_FACTOR`: what went wrong with the biases is in attitude, velocity and
position, too, and correlations say how. So is the variance of the drift of GNSS positions, for
which an error of the position may have been taken; to no more than drift can be. Slow errors of
aiding sensors keep theirs: a constant one that has become uncertain may stay so, such as hard iron,
and the heading with it. The biases get more than that: sixteen times their deviation for a drift,
three times the corrections that go one way, at most `MOST_ACCEL_BIAS` and `MOST_GYRO_BIAS`.

No alarm inflates a deviation beyond `MOST_POSITION` and its like. What nothing measures for a
time, such as the heading in hover without a baseline, or the position in an outage of GNSS, would
otherwise grow fourfold with each alarm, until sigma points mean nothing. The bounds act as a
congruence P -> M P M with M diagonal in the position, velocity and biases, and in tilt and heading,
so that P stays positive definite.

Source: ours.
"""

import math

import numpy as np

from quad_gym.kernels.compiling import Stage, call_stage, kernel
from quad_gym.kernels.filter.error_state import BA, BG, D, E, R, V
from quad_gym.kernels.filter.jumps import (
    doubt_position_and_drift,
    drifts_suddenly,
    forget_drift_corrections,
)
from quad_gym.kernels.filter.recovery import (
    MOST_ACCEL_BIAS,
    MOST_ANGLE,
    MOST_GYRO_BIAS,
    MOST_POSITION,
    MOST_TILT,
    MOST_VELOCITY,
    camera_fits,
    enlarge,
    forget_corrections,
    one_way,
    suspect_group,
    variance_of,
)
from quad_gym.kernels.filter.slow import fill_slow, keep_slow_factor
from quad_gym.kernels.maths.elementary import clip, maximum, minimum
from quad_gym.kernels.maths.factors import cholesky
from quad_gym.kernels.maths.linalg import (
    add_outer,
    apply,
    dot,
    load33,
    load_block,
    multiply,
    scale,
    scale33,
    store_block,
    sum_of_outers,
)
from quad_gym.kernels.measurements.blocks import doubt, suspect
from quad_gym.kernels.simd.lanes import any_of, logical_not, select
from quad_gym.records import AID_GROUPS, AIDS, SENSOR_GROUPS, Act, Aid, FilterStatus

_FIRST_AID, _DOUBT = int(Stage[Aid(0).name]), int(Act.DOUBT)
_UPDATE_FAILED = np.uint64(FilterStatus.UPDATE_FAILED)
_FACTOR, _BIAS_FACTOR = 16.0, 240.0
"""Of the covariance, and what is added of the biases' variances, where innovations drift."""
_BAROMETER_GROUP = AID_GROUPS + int(Aid.BAROMETER)


@kernel
def _mean_variance(flight, row):
    """Mean variance of the three states from a row of the covariance on."""
    total = variance_of(flight, row) + variance_of(flight, row + 1)
    return (total + variance_of(flight, row + 2)) / 3.0


@kernel
def _doubt_biases(flight, P, row, drifting, going, square, most):
    """Add to the variances of three biases from a row on, up to `most`."""
    more = select(drifting, minimum(_BIAS_FACTOR * _mean_variance(flight, row), most * most), 0.0)
    more = more + select(going, enlarge(square, most), 0.0)
    for i in range(row, row + 3):
        P[i, i] = P[i, i] + minimum(more, maximum(most * most - P[i, i], 0.0))


@kernel
def _share(variance, most, inflated):
    """What an inflated deviation keeps so as not to exceed `most`; at least that of before."""
    return select(inflated, math.sqrt(clip(most * most / variance, 1.0 / _FACTOR, 1.0)), 1.0)


@kernel
def _shrink_block(P, row, M, states):
    """Multiply the three rows and the three columns from `row` on by a symmetric M."""
    for j in range(0, row, 3):
        store_block(P, row, j, multiply(M, load_block(P, row, j)))
    store_block(P, row, row, multiply(multiply(M, load_block(P, row, row)), M))
    for i in range(row + 3, states, 3):
        store_block(P, i, row, multiply(load_block(P, i, row), M))


@kernel
def _shrink_axes(P, row, most, inflated, states):
    """Bound the inflation of three states, each by itself."""
    a = _share(P[row, row], most, inflated)
    b = _share(P[row + 1, row + 1], most, inflated)
    c = _share(P[row + 2, row + 2], most, inflated)
    zero = 0.0 * a
    _shrink_block(P, row, ((a, zero, zero), (zero, b, zero), (zero, zero, c)), states)


@kernel
def _inflate_drift(p, P, inflated):
    """Inflate the drift of GNSS positions, to no more than its stationary deviation.

    Its covariances with the other states stay as they are, so that correlations become weaker:
    with the same ones, the fix that tells the sum of position and drift would tell unequally
    inflated ones apart.
    """
    for i in range(3):
        a, s = p.slow_decay[i], p.slow_drive[i]
        most = s * s / ((1.0 - a) * (1.0 + a))
        wanted = select(inflated, minimum(_FACTOR * P[D + i, D + i], most), 0.0)
        P[D + i, D + i] = maximum(P[D + i, D + i], wanted)


@kernel
def bound_inflation(flight, P, inflated, states):
    """Take back from P what inflation by `_FACTOR` has put beyond the largest deviations.

    Args:
        flight: Record; reads R_hat, for the vertical.
        P: The inflated covariance, its lower triangle by blocks.
        inflated: Which lanes are.
        states: How many states there are, slow errors included.
    """
    R_BI, P_ee = load33(flight.R_hat), load_block(P, E, E)
    k = (R_BI[0][2], R_BI[1][2], R_BI[2][2])
    heading = dot(k, apply(P_ee, k))
    both = 0.5 * (P_ee[0][0] + P_ee[1][1] + P_ee[2][2] - heading)
    tilted = _share(both, MOST_TILT, inflated)
    turned = _share(heading, MOST_ANGLE, inflated) - tilted
    zero = 0.0 * tilted
    M = ((tilted, zero, zero), (zero, tilted, zero), (zero, zero, tilted))
    _shrink_block(P, E, add_outer(M, scale(turned, k), k), states)
    for row, most in (
        (R, MOST_POSITION),
        (V, MOST_VELOCITY),
        (BA, MOST_ACCEL_BIAS),
        (BG, MOST_GYRO_BIAS),
    ):
        _shrink_axes(P, row, most, inflated, states)


@kernel
def raise_doubts(flight, p, work, settings, mask, slow, stages):
    """Inflate the covariance of what may be wrong, where the filter is, and `mask`.

    Args:
        flight: Record; reads innovations, rejections and drifts, changes the covariance.
        p: Parameters as the filter believes them.
        work: Workspace.
        settings: What the batch does.
        mask: Which lanes.
        slow: The settings, where sensors have slow errors, see `slow.py`, or None.
        stages: The table of stages, which has those of aiding sensors; None without slow errors.
    """
    work.taking, work.drifting = select(mask, 1.0, 0.0), 0.0 * flight.tick
    for group in range(SENSOR_GROUPS):
        work.doubted[group] = 0.0 * flight.tick
    suspect(flight, p, work, settings, slow, 0)
    if slow is not None:
        if slow.aids > 0:
            for s in range(AIDS):
                suspect_group(flight, p, work, AID_GROUPS + s, mask)
    accel, corrected_a = one_way(flight, 0)
    gyro, corrected_g = one_way(flight, 3)
    drifting, accel, gyro = work.drifting > 0.0, mask & accel, mask & gyro
    inflated = drifting | accel | gyro
    moved = mask & (flight.tick < 0.0)  # nobody
    if slow is not None:
        if slow.estimates_drift:
            climbed = work.doubted[_BAROMETER_GROUP] > 0.0
            moved = mask & (drifts_suddenly(flight) | climbed)
            moved = moved & logical_not(camera_fits(flight, p))
    doubtful = inflated | moved
    for group in range(SENSOR_GROUPS):
        doubtful = doubtful | (work.doubted[group] > 0.0)
    if not any_of(doubtful):
        return

    L, P, factor = flight.L, work.P, select(inflated, _FACTOR, 1.0)
    for i in range(0, 15, 3):
        for j in range(0, i + 3, 3):
            store_block(P, i, j, scale33(factor, sum_of_outers(L, i, L, j, j + 3)))
    states = 15
    if slow is not None:
        states = 15 + slow.slow_states
        fill_slow(flight, slow, P)
        if slow.estimates_drift:
            _inflate_drift(p, P, inflated)
    bound_inflation(flight, P, inflated, states)
    _doubt_biases(flight, P, BA, drifting, accel, corrected_a, MOST_ACCEL_BIAS)
    _doubt_biases(flight, P, BG, drifting, gyro, corrected_g, MOST_GYRO_BIAS)
    doubt(flight, p, work, settings, slow, 0)
    if slow is not None:
        if slow.estimates_drift:
            doubt_position_and_drift(flight, P, moved)
        if slow.aids > 0:
            work.taking = select(doubtful, 1.0, 0.0)
            for s in range(AIDS):
                if slow.aid_on[s] > 0:
                    call_stage(stages, _FIRST_AID + s, flight, p, p, slow, work, _DOUBT)

    ok = doubtful & (cholesky(P, states, work.inverse_diagonal) > 0.0)
    for i in range(15):
        for j in range(i + 1):
            L[i, j] = select(ok, P[i, j], L[i, j])
    if slow is not None:
        keep_slow_factor(flight, slow, work, ok)
    failed, status = doubtful & logical_not(ok), flight.filter_status
    flight.filter_status = select(failed, status | _UPDATE_FAILED, status)
    flight.update_failures = flight.update_failures + select(failed, 1.0, 0.0)
    flight.doubt_tick = select(doubtful, flight.tick, flight.doubt_tick)
    for group in range(SENSOR_GROUPS):
        flight.reopened[group] = flight.reopened[group] + work.doubted[group]
        row = flight.rejected_in_row[group]
        flight.rejected_in_row[group] = select(work.doubted[group] > 0.0, 0.0, row)
        for i in range(3):
            mean = flight.innovation_drift[group, i]
            flight.innovation_drift[group, i] = select(doubtful, 0.0, mean)
    forget_corrections(flight, doubtful)
    if slow is not None:
        if slow.estimates_drift:
            forget_drift_corrections(flight, moved)

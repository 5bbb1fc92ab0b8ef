"""Covariance inflation after the filter detects that it is inconsistent.

The error need not be in the measured quantity. An innovation that has grown for a time T since the
last acceptance may come from biases, so their standard deviations become: nu / T of an angle for
the gyro; nu / T of a velocity, or 2 nu / T^2 of a position, for the accelerometer, and 1/g times
this for the tilt. Each sensor inflates the states that it may have corrupted (`kernels/sensors/`).
Variances are raised to the square of these numbers, not increased by it, so repeated alarms do not
add up. Where GNSS positions drift, position and drift are raised to the square of three times an
innovation or a sum of corrections, as the drift may have followed the error in part.

Where innovations drift, or corrections of the biases go one way, the covariance of the fifteen
states is multiplied by `_FACTOR`: the error of the biases has reached attitude, velocity and
position, too, as the correlations describe. The variance of the drift of GNSS positions, which may
have absorbed an error of the position, is also multiplied, up to its stationary value. Slow errors
of other sensors keep their variances: a constant one, such as hard iron, might remain uncertain
after an inflation, and with it the heading. The biases are inflated more: sixteen times their
standard deviation for a drift, three times the corrections that go one way, at most
`MOST_ACCEL_BIAS` and `MOST_GYRO_BIAS`.

No alarm inflates a standard deviation beyond its bound, such as `MOST_POSITION`. States that are
not observed for a time, such as the heading in hover without a baseline, or the position in an
outage of GNSS, would otherwise grow fourfold with each alarm, until sigma points are meaningless.
The bounds act as a congruence P -> M P M with M diagonal in the position, velocity and biases, and
in tilt and heading, so that P stays positive definite.

Source: ours.
"""

import math

from quad_gym.kernels.compiling import kernel
from quad_gym.kernels.filter.error_state import BA, BG, D, E, R, V, put_covariance
from quad_gym.kernels.filter.jumps import (
    drifts_suddenly,
    forget_drift_corrections,
    inflate_position_and_drift,
)
from quad_gym.kernels.filter.measurements import call_sensors, flag_failure
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
    raise_alarm,
    raise_variance,
    variance_of,
)
from quad_gym.kernels.filter.slow import fill_slow, keep_factor
from quad_gym.kernels.maths.elementary import clip, maximum, minimum
from quad_gym.kernels.maths.factors import cholesky
from quad_gym.kernels.maths.linalg import diagonal, dot, load33, outer
from quad_gym.kernels.maths.matrices import load_block, store_block
from quad_gym.kernels.simd.blocks import reset
from quad_gym.kernels.simd.lanes import any_of, logical_not, select
from quad_gym.records import (
    AID_GROUPS,
    BASELINE_BLOCK,
    FIRST_GROUP,
    GROUP_COUNT,
    POSITION_BLOCK,
    SENSOR_GROUPS,
    SENSORS,
    Act,
    Aid,
)

_FACTOR, _BIAS_FACTOR = 16.0, 240.0
"""Factor on the covariance, and the share of the biases' variances that is added, after a drift."""


@kernel
def _mean_variance(flight, row):
    """Mean variance of the three states that begin at a row of the covariance."""
    total = variance_of(flight, row) + variance_of(flight, row + 1)
    return (total + variance_of(flight, row + 2)) / 3.0


@kernel
def _inflate_biases(flight, P, row, drifting, going, square, most):
    """Add to the variances of the three biases that begin at a row, up to `most`."""
    more = select(drifting, minimum(_BIAS_FACTOR * _mean_variance(flight, row), most * most), 0.0)
    more = more + select(going, enlarge(square, most), 0.0)
    for i in range(row, row + 3):
        P[i, i] = P[i, i] + minimum(more, maximum(most * most - P[i, i], 0.0))


@kernel
def _share(variance, most, inflated):
    """Factor that limits an inflated standard deviation to `most`, or to its former value."""
    return select(inflated, math.sqrt(clip(most * most / variance, 1.0 / _FACTOR, 1.0)), 1.0)


@kernel
def _shrink_block(P, row, M, states):
    """Multiply the three rows and the three columns from `row` on by a symmetric M."""
    for j in range(0, row, 3):
        store_block(P, row, j, M @ load_block(P, row, j))
    store_block(P, row, row, M @ load_block(P, row, row) @ M)
    for i in range(row + 3, states, 3):
        store_block(P, i, row, load_block(P, i, row) @ M)


@kernel
def _inflate_drift(p, P, inflated):
    """Inflate the drift of GNSS positions, at most to its stationary standard deviation.

    Its covariances with the other states stay as they are, so that correlations become weaker: with
    unchanged ones, a fix, which observes the sum of position and drift, would separate them where
    they are inflated unequally.
    """
    for i in range(3):
        a, s = p.slow_decay[i], p.slow_drive[i]
        most = s * s / ((1.0 - a) * (1.0 + a))
        raise_variance(P, D + i, inflated, minimum(_FACTOR * P[D + i, D + i], most))


@kernel
def bound_inflation(flight, P, inflated, states):
    """Reduce P where inflation by `_FACTOR` has exceeded the largest standard deviations.

    P is the inflated covariance of all `states`, its lower triangle by blocks; `inflated` are the
    lanes in which it was inflated.
    """
    R_BI, P_ee = load33(flight.R_hat), load_block(P, E, E)
    k = R_BI.T[2]
    heading = dot(k, P_ee @ k)
    both = 0.5 * (P_ee[0][0] + P_ee[1][1] + P_ee[2][2] - heading)
    tilted = _share(both, MOST_TILT, inflated)
    turned = _share(heading, MOST_ANGLE, inflated) - tilted
    M = diagonal((tilted, tilted, tilted)) + outer(turned * k, k)
    _shrink_block(P, E, M, states)
    bounds = ((R, MOST_POSITION), (V, MOST_VELOCITY), (BA, MOST_ACCEL_BIAS), (BG, MOST_GYRO_BIAS))
    for row, most in bounds:
        x = _share(P[row, row], most, inflated)
        y = _share(P[row + 1, row + 1], most, inflated)
        z = _share(P[row + 2, row + 2], most, inflated)
        _shrink_block(P, row, diagonal((x, y, z)), states)


@kernel
def _raise_alarms(flight, p, work, settings, mask):
    """Fill work.alarm and work.drifting, in the lanes `mask`.

    Positions and baselines raise no alarm while the camera fits.
    """
    work.taking, work.drifting = select(mask, 1.0, 0.0), 0.0 * flight.tick
    contradicted = camera_fits(flight, p)
    for sensor in range(SENSORS):
        first = FIRST_GROUP[sensor]
        for group in range(first, first + GROUP_COUNT[sensor]):
            free = mask
            if group in (POSITION_BLOCK, BASELINE_BLOCK):
                free = mask & logical_not(contradicted)
            work.alarm[group] = 0.0 * flight.tick
            if settings.sensor_blocks[sensor] > 0:
                raise_alarm(flight, p, work, group, free)


@kernel
def inflate(flight, p, work, settings, mask, slow, stages):
    """Raise alarms and inflate the covariance of states that may be wrong, in the lanes `mask`."""
    _raise_alarms(flight, p, work, settings, mask)
    accel, corrected_a = one_way(flight, 0)
    gyro, corrected_g = one_way(flight, 3)
    drifting, accel, gyro = work.drifting > 0.0, mask & accel, mask & gyro
    inflated = drifting | accel | gyro
    moved = mask & (flight.tick < 0.0)  # all false
    if slow is not None:
        if slow.estimates_drift:
            moved = mask & (
                drifts_suddenly(flight) | (work.alarm[AID_GROUPS + Aid.BAROMETER] > 0.0)
            )
            moved = moved & logical_not(camera_fits(flight, p))
    alarmed = inflated | moved
    for group in range(SENSOR_GROUPS):
        alarmed = alarmed | (work.alarm[group] > 0.0)
    if not any_of(alarmed):
        return

    P = work.P
    put_covariance(P, flight.L, select(inflated, _FACTOR, 1.0))
    states = 15
    if slow is not None:
        states = 15 + slow.slow_states
        fill_slow(flight, slow, P)
        if slow.estimates_drift:
            _inflate_drift(p, P, inflated)
    bound_inflation(flight, P, inflated, states)
    _inflate_biases(flight, P, BA, drifting, accel, corrected_a, MOST_ACCEL_BIAS)
    _inflate_biases(flight, P, BG, drifting, gyro, corrected_g, MOST_GYRO_BIAS)
    call_sensors(flight, p, p, settings, work, stages, Act.INFLATE, 0)
    if slow is not None:
        if slow.estimates_drift:
            inflate_position_and_drift(flight, P, moved)

    ok = alarmed & (cholesky(P, states, work.inverse_diagonal) > 0.0)
    keep_factor(flight, slow, work, ok)
    failed = alarmed & logical_not(ok)
    flag_failure(flight, failed)
    flight.update_failures = flight.update_failures + select(failed, 1.0, 0.0)
    flight.alarm_tick = select(alarmed, flight.tick, flight.alarm_tick)
    for group in range(SENSOR_GROUPS):
        flight.reopened[group] = flight.reopened[group] + work.alarm[group]
        row = flight.rejected_in_row[group]
        flight.rejected_in_row[group] = select(work.alarm[group] > 0.0, 0.0, row)
    reset(flight, alarmed, 0.0, "innovation_drift")
    forget_corrections(flight, alarmed)
    if slow is not None:
        if slow.estimates_drift:
            forget_drift_corrections(flight, moved)

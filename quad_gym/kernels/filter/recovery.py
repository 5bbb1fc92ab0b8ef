"""Fault isolation and resets: what a filter does when its gate refuses a sensor for long.

An innovation that is too large for its gate has one of two causes: the sensor is wrong, or the
estimate is. Four known rules decide.

* **Support.** Where sensors that have been accepted within `RECENT` observe all that the refused
  sensor observes, the sensor is wrong and stays out. An error state of its own (the bias of a
  barometer, hard iron) is reset to it instead. An image of several features supports itself.
* **Agreement.** Where two sensors are refused at the same time, the estimate is wrong.
* **Glitch.** An IMU is right from one measurement to the next, so errors of an estimate grow
  gradually. A first refusal far beyond the gate is thus a step of the sensor, as in the GPS glitch
  protection of ArduPilot; the filter waits `glitch_timeout` for its end.
* **Time limit.** Otherwise, after `reset_timeout`, the states that the sensor measures are reset
  to it: their covariances with other states are cut and their variances are the square of the
  innovation, so that the next measurement determines them. If the error grew gradually, the IMU is
  to blame: velocity, tilt and biases, too, get no more than the variances of their start. The
  filter is flagged as diverged.

Where innovations are not white although none is refused, a bias has jumped, or noise is colored.
The reset is as large as the corrections of the biases explain, so that colored noise does no harm.

Source: the time limits and resets of PX4 EKF2 and ArduPilot NavEKF3; J. R. Carpenter and C. N.
D'Souza (editors), Navigation Filter Best Practices, NASA/TP-2018-219822.
"""

import math

import numpy as np

from quad_gym.kernels.compiling import kernel
from quad_gym.kernels.filter.error_state import BA, BG, D, E, R, V, put_covariance
from quad_gym.kernels.filter.measurements import call_sensors, flag_failure
from quad_gym.kernels.filter.monitoring import (
    CORRECTION_TIME,
    RECENT,
    biased,
    drifts_suddenly,
    forget_corrections,
    forget_drift_corrections,
    one_way,
)
from quad_gym.kernels.filter.slow import fill_slow, keep_factor, stationary
from quad_gym.kernels.maths.elementary import maximum, minimum
from quad_gym.kernels.maths.factors import cholesky
from quad_gym.kernels.maths.linalg import diagonal, dot, load33, outer
from quad_gym.kernels.maths.matrices import load_block, store_block
from quad_gym.kernels.simd.blocks import reset
from quad_gym.kernels.simd.lanes import any_of, logical_not, no_lane, select, zero_like
from quad_gym.records import (
    AID_GROUPS,
    FIRST_GROUP,
    GROUP_COUNT,
    GROUP_OBSERVES,
    POSITION_BLOCK,
    QUANTITIES,
    SENSOR_GROUPS,
    SENSORS,
    SEVERAL,
    VELOCITY_BLOCK,
    WITH_OWN_ERROR,
    Act,
    Aid,
    Observes,
)

_BAROMETER = AID_GROUPS + int(Aid["BAROMETER"])
_MAGNETOMETER = int(Aid["MAGNETOMETER"])
_NO_GLITCH = (*WITH_OWN_ERROR, *SEVERAL)
"""Groups whose steps do not lengthen the time limit: an image of several features is redundant."""
VELOCITY_BIT = int(Observes.VELOCITY).bit_length() - 1
OUTLIER = 4.0
"""Ratio of NIS and gate beyond which a first refusal is a step of the sensor: an innovation of
twice the largest one that the gate explains."""
_STRICT = 0.5
"""Ratio of the limits for a receiver that is used again and the gate: its false-alarm probability,
for position and velocity, is about the root of the gate's."""
_ACCEL_OFFSET, _GYRO_OFFSET = 0.5, 0.09
"""Largest offsets of cheap sensors in data sheets [m/s^2], [rad/s]: TDK ICM-20948."""
MAX_ANGLE = math.pi / math.sqrt(3.0)
"""Largest standard deviation of an angle [rad], when it is unknown."""


@kernel
def begin_recovery(flight, mask):
    """Reset the monitoring at the start of an episode, in the lanes `mask`."""
    reset(
        flight, mask, 0.0, "accepted_tick refused_tick refused_nis stepped innovation_mean diverged"
    )
    reset(flight, mask, 1.0, "noise_factor nis_ratio")
    flight.alarm_tick = select(mask, -1e9, flight.alarm_tick)


@kernel
def count_rejections(flight, group, first, beyond, glitch, nis):
    """Count the consecutive innovations of a group beyond its gate, and find steps of its sensor.

    A step back, toward the estimate, begins another time limit.
    """
    row, last = flight.rejected_in_row[group], flight.refused_nis[group]
    new, closer = first & beyond & (row < 1.0), first & beyond & (OUTLIER * nis < last)
    again = closer & logical_not(new)
    step = select(glitch & logical_not(again), 1.0, 0.0)
    flight.stepped[group] = select(first & beyond, step, flight.stepped[group])
    flight.refused_tick[group] = select(new | again, flight.tick, flight.refused_tick[group])
    flight.refused_nis[group] = select(first & beyond, nis, last)
    flight.rejected_in_row[group] = select(first, select(beyond, row + 1.0, 0.0), row)
    accept_group(flight, group, first & logical_not(beyond))


@kernel
def accept_group(flight, group, accepted):
    """Store the time of a group's last accepted measurement."""
    before = flight.accepted_tick[group]
    flight.accepted_tick[group] = select(accepted, flight.tick, before)


@kernel
def _confirmed(flight, p, settings, refused, bit):
    """Lanes in which another group than `refused` has lately measured a quantity of `Observes`."""
    found = no_lane(flight.tick)
    for sensor in range(SENSORS):
        if settings.sensor_blocks[sensor] > 0:
            first = FIRST_GROUP[sensor]
            for group in range(first, first + GROUP_COUNT[sensor]):
                shifted = (
                    group == POSITION_BLOCK and settings.estimates_drift and bit != VELOCITY_BIT
                )
                if group != refused and not shifted and (GROUP_OBSERVES[group] >> bit) & 1:
                    since = (flight.tick - flight.accepted_tick[group]) * p.dt
                    found = found | (since < RECENT)
    return found


@kernel
def supported(flight, p, settings, refused):
    """Lanes in which other sensors confirm all that the group `refused` measures.

    Several blocks, as of an image, support themselves, so nothing overrules them.
    """
    if refused in SEVERAL:
        return no_lane(flight.tick)
    found = logical_not(no_lane(flight.tick))
    for bit in range(QUANTITIES):
        if (GROUP_OBSERVES[refused] >> bit) & 1:
            found = found & _confirmed(flight, p, settings, refused, bit)
    return found


@kernel
def limit_of(flight, group, limit):
    """Gate of a group, from its usual `limit`; zero if all its measurements are beyond it.

    A receiver whose velocity has stepped is wrong, its positions too, which integrate the velocity.
    It is used again when both pass a stricter test, as the uncertainty of dead reckoning grows.
    """
    if group in (POSITION_BLOCK, VELOCITY_BLOCK):
        v, strict = VELOCITY_BLOCK, _STRICT * limit
        wrong = (flight.stepped[v] > 0.0) & (flight.rejected_in_row[v] >= 2.0)
        if group == POSITION_BLOCK:
            strict = zero_like(limit)
        row, nis = flight.rejected_in_row[POSITION_BLOCK], flight.refused_nis[POSITION_BLOCK]
        bound = select((row > 0.0) & (nis > strict), 0.0, strict)
        limit = select(wrong, bound, limit)
    return limit


@kernel
def glitches(flight, p, settings, group, nis, limit):
    """Lanes in which an innovation beyond the gate is an error of the sensor, not of the IMU.

    The series of such innovations has begun with a step since the last accepted one, beyond what
    the last ones explain.
    """
    row = flight.rejected_in_row[group]
    since = (flight.tick - flight.accepted_tick[group]) * p.dt
    step = (nis > OUTLIER * maximum(flight.nis_ratio, 1.0) * limit) & (since < RECENT)
    found = ((row < 1.0) & step) | ((row > 0.0) & (flight.stepped[group] > 0.0))
    if group in SEVERAL:  # most features of an image, for example, have no error in common
        found = no_lane(flight.tick)
    if group in (POSITION_BLOCK, VELOCITY_BLOCK):  # of one receiver
        other = POSITION_BLOCK + VELOCITY_BLOCK - group
        found = found | ((flight.stepped[other] > 0.0) & (flight.rejected_in_row[other] > 0.0))
    if group in WITH_OWN_ERROR:
        found = logical_not(no_lane(flight.tick))  # their error state would take up the error
    if group == POSITION_BLOCK:
        found = found | _dead_reckons(flight, p, settings)
    return found


@kernel
def _dead_reckons(flight, p, settings):
    """Lanes in which accepted velocities predict positions over `RECENT` better than fixes."""
    precise = p.velocity_sigma * RECENT < p.position_sigma_I[0]
    precise = precise & (flight.tick * p.dt >= RECENT)
    return precise & _confirmed(flight, p, settings, POSITION_BLOCK, VELOCITY_BIT)


@kernel
def time_of(flight, p, group):
    """Seconds since a measurement of a group was last accepted."""
    return maximum(flight.tick - flight.accepted_tick[group], 1.0) * p.dt


@kernel
def reset_rows(P, first, last, states, lanes):
    """Set the covariances in rows and columns from `first` until `last` to zero, where `lanes`."""
    for i in range(first, states):
        for j in range(i // 3 * 3 + 3):
            if i != j and ((first <= i and i < last) or (first <= j and j < last)):
                P[i, j] = select(lanes, 0.0, P[i, j])


@kernel
def reset_variances(P, first, states, lanes, variances):
    """Cut the covariances of three states from the row `first` on, and set their variances.

    No variance becomes smaller.
    """
    reset_rows(P, first, first + 3, states, lanes)
    for i in range(3):
        k = first + i
        P[k, k] = maximum(P[k, k], select(lanes, variances[i], 0.0))


@kernel
def reset_variance(P, row, states, lanes, variance):
    """Do the same for one state."""
    reset_rows(P, row, row + 1, states, lanes)
    P[row, row] = maximum(P[row, row], select(lanes, variance, 0.0))


@kernel
def reset_heading(P, R_BI, states, lanes, variance):
    """Cut the covariances of the heading, the angle about the vertical, and set its variance."""
    k = R_BI.T[2]
    cut, P_ee = select(lanes, 1.0, 0.0), load_block(P, E, E)
    one = zero_like(cut) + 1.0
    M = diagonal((one, one, one)) + outer(-cut * k, k)
    for j in range(0, E, 3):
        store_block(P, E, j, M @ load_block(P, E, j))
    heading = cut * maximum(minimum(variance, MAX_ANGLE * MAX_ANGLE), dot(k, P_ee @ k))
    store_block(P, E, E, M @ P_ee @ M + outer(heading * k, k))
    for i in range(E + 3, states, 3):
        store_block(P, i, E, load_block(P, i, E) @ M)


@kernel
def _reset_motion(flight, p, slow, P, drifted, jumped, accel, gyro):
    """Reset attitude and biases, and what follows from them: velocity, position and its drift.

    Where the estimate has `drifted` off, attitude and biases get the variances of their start.
    Where corrections show that a bias has `jumped`, their sum, of the squares `accel` and `gyro`,
    may be a third of the jump. No sensor has larger offsets than `_ACCEL_OFFSET` and
    `_GYRO_OFFSET`. The attitude has turned by the jump for the time of the sum, but by no more than
    at the start.
    """
    k, lanes, P_ee = load33(flight.R_hat).T[2], drifted | jumped, load_block(P, E, E)
    T, states = select(drifted, p.reset_timeout, CORRECTION_TIME), 15
    accel = minimum(9.0 * accel, _ACCEL_OFFSET * _ACCEL_OFFSET)
    gyro = minimum(9.0 * gyro, _GYRO_OFFSET * _GYRO_OFFSET)
    turned = select(drifted, np.inf, T * T * gyro)
    leaned = accel / (p.gravity * p.gravity) + turned
    tilt = select(p.initial_tilt_sigma > 0.0, p.initial_tilt_sigma, p.first_baseline_sigma)
    tilt = minimum(tilt * tilt, leaned)
    heading = minimum(p.heading_sigma * p.heading_sigma, turned)
    heading = select(lanes, maximum(dot(k, P_ee @ k), heading), 0.0)
    accel = maximum(accel, select(drifted, p.accel_bias_sigma * p.accel_bias_sigma, 0.0))
    gyro = maximum(gyro, select(drifted, p.gyro_bias_sigma * p.gyro_bias_sigma, 0.0))
    speed = (p.gravity * p.gravity * tilt + accel) * T * T
    place = 0.25 * T * T * speed
    if slow is not None:
        states = 15 + slow.slow_states
        if slow.estimates_drift:
            for i in range(3):
                drift = minimum(place, stationary(p, i))
                reset_variance(P, D + i, states, lanes, drift)
    reset_variances(P, R, states, lanes, (place, place, place))
    reset_variances(P, V, states, lanes, (speed, speed, speed))
    reset_variances(P, E, states, lanes, (tilt, tilt, tilt))
    P_ee = load_block(P, E, E)
    more = maximum(heading - dot(k, P_ee @ k), 0.0)
    store_block(P, E, E, P_ee + outer(more * k, k))
    reset_variances(P, BA, states, lanes, (accel, accel, accel))
    reset_variances(P, BG, states, lanes, (gyro, gyro, gyro))


@kernel
def _reset_drift(flight, p, P, states, lanes):
    """Reset position and drift after a jump, by the square of the drift's corrections."""
    mean = zero_like(flight.tick)
    for i in range(3):
        mean = mean + flight.drift_corrected[i] * flight.drift_corrected[i] / 3.0
    for i in range(3):
        total = flight.drift_corrected[i]
        square = 9.0 * maximum(total * total, mean)
        reset_variance(P, R + i, states, lanes, square)
        reset_variance(P, D + i, states, lanes, square)


@kernel
def _colored(flight, p, settings):
    """Lanes in which innovations of a sensor that no other supports are not white."""
    found = no_lane(flight.tick)
    for group in range(SENSOR_GROUPS):
        colored = biased(flight, p, group)
        if any_of(colored):
            found = found | (colored & logical_not(supported(flight, p, settings, group)))
    return found


@kernel
def _choose(flight, p, work, settings, mask):
    """Fill work.reset and work.drifted; return the lanes in which states are reset to a sensor."""
    none = no_lane(flight.tick)
    sensors, late = zero_like(flight.tick), none
    for sensor in range(SENSORS):
        first, refused = FIRST_GROUP[sensor], none
        for group in range(first, first + GROUP_COUNT[sensor]):
            refused = refused | (flight.rejected_in_row[group] >= 2.0)
        sensors = sensors + select(refused, 1.0, 0.0)
    work.drifted, drifted = zero_like(flight.tick), none
    if not any_of(mask & (sensors > 0.0)):
        for group in range(SENSOR_GROUPS):
            work.reset[group] = zero_like(flight.tick)
            work.alone[group] = zero_like(flight.tick)
        return none
    for group in range(SENSOR_GROUPS):
        row, stepped = flight.rejected_in_row[group], flight.stepped[group] > 0.0
        alone = logical_not(supported(flight, p, settings, group))
        waited = (flight.tick - flight.refused_tick[group]) * p.dt
        long = mask & (row >= 2.0) & (waited >= p.reset_timeout)
        flight.alarm_tick = select(long & alone, flight.tick, flight.alarm_tick)
        due = long & (row >= p.max_rejections)
        if group not in _NO_GLITCH:
            glitch = stepped & (sensors < 2.0) & (waited < p.glitch_timeout)
            due = due & logical_not(glitch)
        late = late | (due & alone)
        drifted = drifted | (due & alone & logical_not(stepped))
        work.alone[group] = select(alone, 1.0, 0.0)
        work.reset[group] = select(due, 1.0, 0.0)
    work.drifted = select(drifted, 1.0, 0.0)
    alarmed = drifted
    for group in range(SENSOR_GROUPS):
        alone, refused = work.alone[group] > 0.0, mask & (flight.rejected_in_row[group] >= 2.0)
        chosen = refused & late & alone
        if group in WITH_OWN_ERROR:
            chosen = chosen | (work.reset[group] > 0.0)
        work.reset[group] = select(chosen, 1.0, 0.0)
        alarmed = alarmed | chosen
    return alarmed


@kernel
def reset_states(flight, p, work, settings, mask, slow, stages):
    """Reset states to sensors that were refused for too long, in the lanes `mask`."""
    accel, corrected_a = one_way(flight, 0)
    gyro, corrected_g = one_way(flight, 3)
    jumped = mask & (accel | gyro | _colored(flight, p, settings))
    alarmed = jumped | _choose(flight, p, work, settings, mask)
    moved = no_lane(flight.tick)
    if slow is not None:
        if slow.estimates_drift:
            altered = (work.reset[_BAROMETER] > 0.0) & (work.alone[_BAROMETER] > 0.0)
            moved = mask & (drifts_suddenly(flight) | altered)
            moved = moved & logical_not(supported(flight, p, settings, POSITION_BLOCK))
            alarmed = alarmed | moved
    if not any_of(alarmed):
        return
    P, states = work.P, 15
    put_covariance(P, flight.L, 1.0 + zero_like(flight.tick))
    if slow is not None:
        states = 15 + slow.slow_states
        fill_slow(flight, slow, P)
    drifted = work.drifted > 0.0
    _reset_motion(flight, p, slow, P, drifted, jumped, corrected_a, corrected_g)
    if slow is not None:
        iron = slow.aid_vector[_MAGNETOMETER]
        if iron >= 0:  # it was estimated with the attitude
            own = p.slow_sigma[iron] * p.slow_sigma[iron]
            reset_variances(P, D + iron, states, drifted | jumped, (own, own, own))
        if slow.estimates_drift:
            _reset_drift(flight, p, P, states, moved)
    call_sensors(flight, p, p, settings, work, stages, Act.RESET, 0)
    ok = alarmed & (cholesky(P, states, work.inverse_diagonal) > 0.0)
    keep_factor(flight, slow, work, ok)
    failed = alarmed & logical_not(ok)
    flag_failure(flight, failed)
    flight.update_failures = flight.update_failures + select(failed, 1.0, 0.0)
    flight.alarm_tick = select(alarmed, flight.tick, flight.alarm_tick)
    for group in range(SENSOR_GROUPS):
        flight.resets[group] = flight.resets[group] + work.reset[group]
        row = flight.rejected_in_row[group]
        flight.rejected_in_row[group] = select(work.reset[group] > 0.0, 0.0, row)
    reset(flight, drifted | jumped, 0.0, "innovation_mean")
    forget_corrections(flight, drifted | jumped)
    if slow is not None:
        if slow.estimates_drift:
            forget_drift_corrections(flight, alarmed)

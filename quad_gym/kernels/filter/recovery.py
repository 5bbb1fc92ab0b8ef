"""Fault isolation and resets: what a filter does when its gate refuses a sensor for long.

An innovation that is too large for its gate has one of two causes: the sensor is wrong, or the
estimate is. Four known rules decide.

* **Support.** Where sensors accepted within `RECENT` observe all that the refused one observes, it
  is wrong and stays out. Only its own error state (bias of a barometer, hard iron) is reset to it.
* **Agreement.** Where two sensors are refused at the same time, the estimate is wrong.
* **Glitch.** An IMU is right from one measurement to the next, so errors of an estimate grow
  gradually. A first refusal far beyond the gate is thus a step of the sensor, as in the GPS glitch
  protection of ArduPilot; the filter waits `glitch_timeout` for its end.
* **Time limit.** Otherwise, after `reset_timeout`, the states that the sensor measures are reset
  to it: covariances with other states are cut, and variances are the square of the innovation, so
  that the next measurement determines them. If the error grew gradually, the IMU is to blame:
  velocity, tilt and biases, too, get the variances of their start. If the heading is reset, the
  gyro's bias may be as large as the turn since the last accepted measurement explains.

Corrections that are not white show that a bias has jumped, or that noise is colored. The reset is
as large as they explain, so that colored noise does no harm.

Source: the time limits and resets of PX4 EKF2 and ArduPilot NavEKF3; J. R. Carpenter and C. N.
D'Souza (editors), Navigation Filter Best Practices, NASA/TP-2018-219822.
"""

import numpy as np

from quad_gym.kernels.compiling import kernel
from quad_gym.kernels.filter.error_state import (
    BA,
    BG,
    D,
    E,
    R,
    V,
    keep_covariance,
    load_covariance,
    reset_variance,
    reset_variances,
)
from quad_gym.kernels.filter.measurements import (
    CORRECTION_TIME,
    LIKELY,
    RECENT,
    SHIFTED,
    call_sensors,
    count_failure,
    forget_corrections,
    largest_square,
    shifted,
)
from quad_gym.kernels.filter.motion import begin_motion, forget_heading, loosen_heading
from quad_gym.kernels.filter.slow import stages_of, stationary
from quad_gym.kernels.numbers.blocks import reset
from quad_gym.kernels.numbers.elementary import maximum, minimum
from quad_gym.kernels.numbers.factors import eliminate
from quad_gym.kernels.numbers.lanes import any_of, logical_not, no_lane, select, zero_like
from quad_gym.kernels.numbers.linalg import (
    dot,
    load33,
    load_block,
    load_symmetric,
    outer,
    store_block,
)
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
_HEADING_BIT = int(Observes.HEADING).bit_length() - 1
_COMPASS = AID_GROUPS + _MAGNETOMETER
_VELOCITY_BIT = int(Observes.VELOCITY).bit_length() - 1
OUTLIER = 4.0
"""Ratio of NIS and gate beyond which a first refusal is a step of the sensor: an innovation of
twice the largest one that the gate explains."""
_ACCEL_OFFSET, _GYRO_OFFSET = 0.5, 0.09
"""Largest offsets of cheap sensors in data sheets [m/s^2], [rad/s]: TDK ICM-20948."""


@kernel
def begin_recovery(flight, mask):
    """Reset the monitoring at the start of an episode, in the lanes `mask`."""
    reset(flight, mask, 0.0, "accepted_tick refused_tick stepped diverged")
    begin_motion(flight, mask)
    reset(flight, mask, 1.0, "noise_factor nis_ratio")
    flight.alarm_tick = select(mask, -1e9, flight.alarm_tick)


@kernel
def count_rejections(flight, group, first, beyond, glitch):
    """Count the consecutive rejections of a group, and find steps of its sensor."""
    row, refused = flight.rejected_in_row[group], first & beyond
    began = select(row < 1.0, flight.tick, flight.refused_tick[group])
    flight.refused_tick[group] = select(refused, began, flight.refused_tick[group])
    step = select(glitch, 1.0, 0.0)
    flight.stepped[group] = select(refused, step, flight.stepped[group])
    flight.rejected_in_row[group] = select(first, select(beyond, row + 1.0, 0.0), row)
    accepted, before = first & logical_not(beyond), flight.accepted_tick[group]
    flight.accepted_tick[group] = select(accepted, flight.tick, before)


@kernel
def _confirmed(flight, p, settings, refused, bit):
    """Lanes in which another group than `refused` has lately measured a quantity of `Observes`."""
    found = no_lane(flight.tick)
    if bit == _HEADING_BIT:
        found = found | ((flight.tick - flight.level_tick) * p.dt < RECENT)
    for sensor in range(SENSORS):
        if settings.sensor_blocks[sensor] > 0:
            first = FIRST_GROUP[sensor]
            for group in range(first, first + GROUP_COUNT[sensor]):
                drifting = group == POSITION_BLOCK and settings.estimates_drift
                drifting = drifting and bit != _VELOCITY_BIT
                if group != refused and not drifting and (GROUP_OBSERVES[group] >> bit) & 1:
                    since = (flight.tick - flight.accepted_tick[group]) * p.dt
                    found = found | (since < RECENT)
    return found


@kernel
def supported(flight, p, settings, refused):
    """Lanes in which other sensors confirm all that the group `refused` measures.

    Several blocks, as of an image, support themselves, so nothing overrules them. Blocks with a
    common error state do not: the error is in all of them.
    """
    if refused in SEVERAL and refused not in WITH_OWN_ERROR:
        return no_lane(flight.tick)
    return confirmed(flight, p, settings, refused)


@kernel
def confirmed(flight, p, settings, refused):
    """Lanes in which other groups have lately measured all that the group `refused` measures."""
    found = logical_not(no_lane(flight.tick))
    for bit in range(QUANTITIES):
        if (GROUP_OBSERVES[refused] >> bit) & 1:
            found = found & _confirmed(flight, p, settings, refused, bit)
    return found


@kernel
def _wrong_receiver(flight, group):
    """Lanes in which a group is of a receiver whose velocities are refused after a step.

    Its positions, which integrate the velocities, are wrong, too.
    """
    if group in (POSITION_BLOCK, VELOCITY_BLOCK):
        v = VELOCITY_BLOCK
        return (flight.stepped[v] > 0.0) & (flight.rejected_in_row[v] > 0.0)
    return no_lane(flight.tick)


@kernel
def limit_of(flight, group, limit):
    """Gate of a group, from its usual `limit`.

    A wrong receiver is used again when the sum of the NIS of position and velocity is below the
    gate of one of them, as the uncertainty of dead reckoning grows.
    """
    other = limit
    if group == VELOCITY_BLOCK:
        other = maximum(flight.block_nis[POSITION_BLOCK], 0.0)
    return select(_wrong_receiver(flight, group), limit - other, limit)


@kernel
def glitches(flight, p, group, nis, limit):
    """Lanes in which an innovation beyond the gate is an error of the sensor, not of the IMU.

    The series of such innovations has begun with a step since the last accepted one, beyond what
    the last ones explain.
    """
    if group in WITH_OWN_ERROR:
        return logical_not(no_lane(flight.tick))  # their error state would take up the error
    if group in SEVERAL:  # most features of an image, for example, have no error in common
        return no_lane(flight.tick)
    row = flight.rejected_in_row[group]
    since = (flight.tick - flight.accepted_tick[group]) * p.dt
    least = OUTLIER * maximum(flight.nis_ratio, 1.0) * limit
    step = (row < 1.0) & (nis > least) & (since < RECENT)
    found = step | ((row > 0.0) & (flight.stepped[group] > 0.0))
    return found | _wrong_receiver(flight, group)


@kernel
def reset_drifted_velocity(flight, p, work, states, group, lanes, square):
    """Reset the velocity where the estimate has drifted off and no other sensor measures it.

    It has changed as the position, by a distance with this square, in the time since the last
    accepted measurement of the group.
    """
    T = maximum(flight.tick - flight.accepted_tick[group], 1.0) * p.dt
    speed = 4.0 * square / (T * T)
    drifted = lanes & (work.drifted > 0.0) & (work.alone[VELOCITY_BLOCK] > 0.0)
    reset_variances(work.P, V, states, drifted, (speed, speed, speed))


@kernel
def reset_drifted_heading(flight, p, work, group, lanes, square):
    """Make the gyro's bias uncertain about the vertical where the heading has drifted off.

    It has turned by an angle with this square in the time since the last accepted measurement of
    the group. The variance of a bias at the start may be too small to explain that, and would then
    let the heading drift off again after each reset.
    """
    T = maximum(flight.tick - flight.accepted_tick[group], 1.0) * p.dt
    rate = minimum(square / (T * T), _GYRO_OFFSET * _GYRO_OFFSET)
    k, P_gg = load33(flight.R_hat).T[2], load_symmetric(work.P, BG)
    more = select(lanes, maximum(rate - dot(k, P_gg @ k), 0.0), 0.0)
    store_block(work.P, BG, BG, P_gg + outer(more * k, k))


@kernel
def _reset_motion(flight, p, work, slow, states, jumped, moved):
    """Reset attitude and biases, and what follows from them: velocity, position and its drift.

    Where the estimate has drifted off, attitude and biases get the variances of their start. Where
    corrections show that a bias has `jumped`, their sum may be a third of the jump. No sensor has
    larger offsets than `_ACCEL_OFFSET` and `_GYRO_OFFSET`. The attitude has turned by the jump for
    the time of the sum, but by no more than at the start. Where the position has `moved`, it and
    its drift are reset by the sum of the drift's corrections in the same way.
    """
    P, drifted, k = work.P, work.drifted > 0.0, load33(flight.R_hat).T[2]
    lanes, P_ee = drifted | jumped, load_block(P, E, E)
    T = select(drifted, p.reset_timeout, 0.5 * CORRECTION_TIME)
    accel = minimum(9.0 * largest_square(flight, 0), _ACCEL_OFFSET * _ACCEL_OFFSET)
    gyro = minimum(9.0 * largest_square(flight, 3), _GYRO_OFFSET * _GYRO_OFFSET)
    turned = select(drifted, np.inf, T * T * gyro)
    leaned = accel / (p.gravity * p.gravity) + turned
    tilt = select(p.initial_tilt_sigma > 0.0, p.initial_tilt_sigma, p.first_baseline_sigma)
    tilt = minimum(tilt * tilt, leaned)
    heading = minimum(p.heading_sigma * p.heading_sigma, turned)
    heading = select(lanes, maximum(dot(k, P_ee @ k), heading), 0.0)
    accel = maximum(accel, select(drifted, p.accel_bias_sigma * p.accel_bias_sigma, 0.0))
    gyro = maximum(gyro, select(drifted, p.gyro_bias_sigma * p.gyro_bias_sigma, 0.0))
    speed = (p.gravity * p.gravity * tilt + accel) * T * T
    place = select(lanes, 0.25 * T * T * speed, 0.0)
    if slow is not None:
        if slow.estimates_drift:
            place = maximum(place, select(moved, 9.0 * largest_square(flight, 6), 0.0))
            for i in range(3):
                reset_variance(P, D + i, states, lanes | moved, minimum(place, stationary(p, i)))
        iron = slow.aid_vector[_MAGNETOMETER]
        if iron >= 0:  # it was estimated with the attitude
            own = p.slow_sigma[iron] * p.slow_sigma[iron]
            reset_variances(P, D + iron, states, lanes, (own, own, own))
    reset_variances(P, R, states, lanes | moved, (place, place, place))
    reset_variances(P, V, states, lanes, (speed, speed, speed))
    reset_variances(P, E, states, lanes, (tilt, tilt, tilt))
    P_ee = load_block(P, E, E)
    more = maximum(heading - dot(k, P_ee @ k), 0.0)
    store_block(P, E, E, P_ee + outer(more * k, k))
    reset_variances(P, BA, states, lanes, (accel, accel, accel))
    reset_variances(P, BG, states, lanes, (gyro, gyro, gyro))


@kernel
def _choose(flight, p, work, settings, mask):
    """Fill work.reset, alone and drifted; return the lanes in which a sensor resets states."""
    none, sensors = no_lane(flight.tick), zero_like(flight.tick)
    late, drifted, alarmed = none, none, none
    for sensor in range(SENSORS):
        first, refused = FIRST_GROUP[sensor], none
        for group in range(first, first + GROUP_COUNT[sensor]):
            many = flight.rejected_in_row[group] >= 2.0
            if group == _COMPASS:
                many = many & (flight.compass_out <= 0.0)
            refused = refused | many
            work.reset[group], work.alone[group] = zero_like(sensors), zero_like(sensors)
        sensors = sensors + select(refused, 1.0, 0.0)
    work.drifted = zero_like(sensors)
    if not any_of(mask & (sensors > 0.0)):
        return none
    for group in range(SENSOR_GROUPS):
        row, stepped = flight.rejected_in_row[group], flight.stepped[group] > 0.0
        alone = logical_not(supported(flight, p, settings, group))
        waited = (flight.tick - flight.refused_tick[group]) * p.dt
        long = mask & (row >= 2.0) & (waited >= p.reset_timeout)
        flight.alarm_tick = select(long & alone, flight.tick, flight.alarm_tick)
        due = long & (row >= p.max_rejections)
        if group == _COMPASS:
            # hard iron that explains a wrong field at one heading is wrong at the next one
            known = (flight.tick - flight.level_tick) * p.dt < RECENT
            flight.compass_out = select(due & known, 1.0, flight.compass_out)
            flight.compass_agrees = select(due & known, 0.0, flight.compass_agrees)
            due = due & (flight.compass_out <= 0.0) & (flight.level_against <= 0.0)
        if group not in WITH_OWN_ERROR:
            due = due & logical_not(stepped & (sensors < 2.0) & (waited < p.glitch_timeout))
        late = late | (due & alone)
        drifted = drifted | (due & alone & logical_not(stepped))
        work.alone[group], work.reset[group] = select(alone, 1.0, 0.0), select(due, 1.0, 0.0)
    for group in range(SENSOR_GROUPS):
        refused = mask & (flight.rejected_in_row[group] >= 2.0)
        if group == _COMPASS:
            refused = refused & (flight.compass_out <= 0.0)
        chosen = refused & late & (work.alone[group] > 0.0)
        if group in WITH_OWN_ERROR:
            chosen = chosen | (work.reset[group] > 0.0)
        work.reset[group] = select(chosen, 1.0, 0.0)
        alarmed = alarmed | chosen
    work.drifted = select(drifted, 1.0, 0.0)
    return alarmed | drifted


@kernel
def reset_states(flight, p, work, settings, stages, slow):
    """Reset states to sensors that were refused for too long, in the lanes work.taking."""
    mask = work.taking > 0.0
    jumped = mask & (shifted(flight, 0, BA, SHIFTED) | shifted(flight, 3, BG, SHIFTED))
    alarmed, moved, states = _choose(flight, p, work, settings, mask), no_lane(flight.tick), 15
    if slow is not None:
        states = 15 + slow.slow_states
        if slow.estimates_drift:
            altered = (work.reset[_BAROMETER] > 0.0) & (work.alone[_BAROMETER] > 0.0)
            limit = select(flight.diverged > 0.0, LIKELY, SHIFTED)
            moved = mask & (shifted(flight, 6, R, limit) | altered)
            moved = moved & logical_not(supported(flight, p, settings, POSITION_BLOCK))
    if settings.by_motion:  # N has turned, too
        turned = mask & shifted(flight, 3, BG, SHIFTED)
        forget_heading(flight, turned & (flight.level_doubts <= 0.0))
        blamed = (work.reset[_COMPASS] > 0.0) & (work.alone[_COMPASS] > 0.0)
        loosen_heading(flight, mask & blamed & (flight.level_doubts <= 0.0))
    alarmed = alarmed | jumped | moved
    if not any_of(alarmed):
        return
    load_covariance(work.P, flight, slow)
    _reset_motion(flight, p, work, slow, states, jumped, moved)
    call_sensors(flight, p, p, settings, work, stages, Act.RESET, 0)
    ok = alarmed & (eliminate(work.P, work.L, states, states) >= 0.0)
    keep_covariance(flight, slow, work.P, ok)
    failed = alarmed & logical_not(ok)
    count_failure(flight, failed)
    flight.alarm_tick = select(alarmed, flight.tick, flight.alarm_tick)
    for group in range(SENSOR_GROUPS):
        flight.resets[group] = flight.resets[group] + work.reset[group]
        row = flight.rejected_in_row[group]
        flight.rejected_in_row[group] = select(work.reset[group] > 0.0, 0.0, row)
    forget_corrections(flight, alarmed)


recover_stage, recover_with_slow_stage = stages_of("recover", reset_states)

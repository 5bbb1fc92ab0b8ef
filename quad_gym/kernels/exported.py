"""Functions of a filter's library for other processors (`baselines/exporting/filter_library.py`).

They do what `single.start_filter`, `window.take_inputs` and `tape.run_tape` do, one input a call.
"""

import math

import numpy as np
from numba import types
from numba.np.numpy_support import from_dtype

from quad_gym.kernels.compiling import entry, kernel
from quad_gym.kernels.filter.error_state import V
from quad_gym.kernels.filter.starts import set_heading, start_still, turned
from quad_gym.kernels.numbers.blocks import array_at, lanes_of, store_lanes
from quad_gym.kernels.numbers.elementary import sin_cos
from quad_gym.kernels.numbers.linalg import load3, store
from quad_gym.kernels.single import begin_filter
from quad_gym.kernels.stages import STAGE_TABLE
from quad_gym.kernels.tape import (
    check,
    is_all_finite,
    keep_estimate,
    predict_sample,
    scale_baseline,
    take_input,
    update_with,
)
from quad_gym.records import (
    AID_BLOCK,
    BASELINE_BLOCK,
    FLIGHT_BLOCK,
    KEPT,
    MEASUREMENT,
    OPERATION,
    PARAMS_BLOCK,
    POSITION_BLOCK,
    REAL_BYTES,
    SAMPLE,
    SETTINGS,
    START,
    STEP_BLOCK,
    WORK_BLOCK,
    Aid,
    Operation,
)
from quad_gym.records.inputs import (
    ESTIMATE,
    EVENT,
    FARTHEST_FIX,
    FIX,
    INPUT,
    MEMORY,
    MOUNTING,
    PENDING,
    WINDOW,
    Outcome,
)
from quad_gym.records.states import ROWS

_FLIGHT, _PARAMS, _STEPS, _SETTINGS, _WORK, _TABLE, _MEASUREMENT, _START = map(
    from_dtype,
    (
        FLIGHT_BLOCK,
        PARAMS_BLOCK,
        STEP_BLOCK,
        SETTINGS,
        WORK_BLOCK,
        STAGE_TABLE,
        MEASUREMENT,
        START,
    ),
)
_WINDOW, _INPUT, _FIX, _MEMORY, _ESTIMATE, _MOUNTING = map(
    from_dtype, (WINDOW, INPUT, FIX, MEMORY, ESTIMATE, MOUNTING)
)
_FIELD_BLOCK = AID_BLOCK[Aid["MAGNETOMETER"]]
_PREDICT, _UPDATE, _, _RESTORE, _ = map(int, Operation)
_OK, _, _NOT_FINITE, _RANGE, _, _, _, _NO_HEADING, _CONTRADICTION = map(int, Outcome)
_NOTHING = (0.0, 0.0, 0.0)
_events_at, _samples_at, _waits_at, _operations_at, _measurements_at = map(
    array_at, (EVENT, SAMPLE, PENDING, OPERATION, MEASUREMENT)
)
_words_at, _numbers_at, _reals_at, _singles_at = map(
    array_at, (np.dtype(f"u{REAL_BYTES}"), np.int64, np.float64, np.float32)
)
_NUMBERS = (_FLIGHT, _PARAMS, _PARAMS, _STEPS, _SETTINGS, _WORK, _TABLE)


@kernel
def _copy(memory, parts, number, restores):
    """Copy the used parts of the filter's memory, or restore them from a copy."""
    words = _words_at(memory.flight, parts[1] + parts[2 * parts[0] - 1])
    place = memory.copies + REAL_BYTES * number * memory.copy_words
    copy = _words_at(place, memory.copy_words)
    k = 0
    for part in range(parts[0]):
        for i in range(parts[2 * part + 1], parts[2 * part + 1] + parts[2 * part + 2]):
            if restores:
                words[i] = copy[k]
            else:
                copy[k] = words[i]
            k += 1


@kernel
def _run(flight, params, ticks, steps, settings, work, table, window, memory, parts):
    """Run the operations that the window has written."""
    block, mask = lanes_of(flight), lanes_of(work).mask
    operations = _operations_at(memory.operations, window.operations)
    samples = _samples_at(memory.samples, window.room[0])
    measurements = _measurements_at(memory.measurements, window.room[1])
    for k in range(window.operations):
        code, i = operations[k].code, operations[k].index
        if code == _PREDICT:
            predict_sample(block, params, ticks, steps, settings, work, table, mask, samples[i])
        elif code == _UPDATE:
            update_with(block, params, ticks, steps, settings, work, table, mask, measurements[i])
        else:
            _copy(memory, parts, operations[k].target, code == _RESTORE)
    window.operations = 0


@kernel
def _correct(mounting, given, m):
    """Rotate a sample or the measurement m to B, as `Log.corrected` does."""
    if given.rank > 0:
        if mounting.compass_turns:
            field = m.measurement[_FIELD_BLOCK]
            store(field, turned(mounting.R_compass, load3(field)))
    elif mounting.imu_turns:
        store(given.gyro, turned(mounting.R_imu, load3(given.gyro) - load3(mounting.gyro_bias)))
        store(given.accel, turned(mounting.R_imu, load3(given.accel) - load3(mounting.accel_bias)))


@entry(
    signature=types.none(*_NUMBERS, _WINDOW, _MEMORY, types.int64, _MOUNTING, _INPUT, _MEASUREMENT)
)
def take(
    flight, params, ticks, steps, settings, work, table, window, memory, parts, mounting, given, m
):
    """Process a sample or the measurement m, in the axes of its sensor.

    `parts` is the address of the number of parts of the filter's memory that copies have, and of
    the place and length of each, in words as long as a number of the filter.
    """
    _correct(mounting, given, m)
    known = math.isfinite(given.time) and math.isfinite(given.dt)
    if not (known and is_all_finite(given.gyro) and is_all_finite(given.accel)):
        given.outcome = _NOT_FINITE
    elif given.rank > 0:
        check(m)
        given.outcome = m.outcome
    if given.outcome == _OK:
        given.outcome = take_input(
            window,
            _events_at(memory.events, window.event_room),
            _samples_at(memory.samples, window.room[0]),
            _waits_at(memory.waits, window.waiting_room),
            _operations_at(memory.operations, 0),
            given,
        )
    if given.outcome == _OK:
        if given.rank > 0:
            _measurements_at(memory.measurements, window.room[1])[given.index] = m
        count = _numbers_at(parts, 1)[0]
        numbers = _numbers_at(parts, 1 + 2 * count)
        _run(flight, params, ticks, steps, settings, work, table, window, memory, numbers)


@kernel
def _check_fix(fix):
    """Check the numbers of a FIX, and scale its baseline; return the outcome."""
    if not (fix.has_position and is_all_finite(fix.position) and math.isfinite(fix.time)):
        return _NOT_FINITE
    if (fix.has_heading and not math.isfinite(fix.heading)) or not is_all_finite(fix.sigma):
        return _NOT_FINITE
    if not (is_all_finite(fix.velocity) and is_all_finite(fix.field_B)):
        return _NOT_FINITE
    for i in range(3):
        if abs(fix.position[i]) > FARTHEST_FIX and not fix.rest:
            return _RANGE
        if fix.sigma[i] < 1e-9:
            return _RANGE
    if not (0.0 <= fix.tilt_sigma <= 1.0 and 0.0 <= fix.rest_sigma < math.inf):
        return _RANGE
    if (fix.has_velocity and not fix.velocity_sigma > 0.0) or not fix.field_sigma >= 0.0:
        return _RANGE
    if fix.has_baseline:
        return scale_baseline(fix.baseline)
    return _OK


@kernel
def _prepared(s, fix):
    outcome = _check_fix(fix)
    if outcome != _OK:
        return outcome
    if fix.tilt_sigma > 0.0:
        s.tilt_sigma = fix.tilt_sigma
    store(fix.velocity_I, turned(fix.R_IG, load3(fix.velocity)))
    store(s.antenna_I, load3(fix.position) if fix.rest else turned(fix.R_IG, load3(fix.position)))
    for i in range(3):
        s.position_root[i, i] = fix.place_sigma if fix.rest else fix.scale * fix.sigma[i]
        if fix.has_velocity:
            s.velocity_sigma[i] = fix.velocity_sigma
        elif fix.rest_sigma > 0.0:
            s.velocity_sigma[i] = fix.rest_sigma
        if fix.rest:
            s.lever_B[i] = 0.0
    fix.levels = 0 if fix.has_baseline else 1
    if fix.has_baseline:
        if fix.has_field or fix.course or not fix.takes_baseline:
            return _CONTRADICTION
        if fix.has_heading:
            sine, cosine = sin_cos(fix.heading)
            s.x_I[0], s.x_I[1] = cosine, sine
        return _OK
    sources = int(fix.has_heading != 0) + int(fix.has_field != 0) + int(fix.course != 0)
    if sources == 0:
        return _NO_HEADING
    without = (fix.has_field and load3(fix.field_I) == _NOTHING) or (
        fix.course and not fix.has_velocity
    )
    if sources > 1 or without:
        return _CONTRADICTION
    outcome = set_heading(s, fix)
    if outcome == _OK:
        start_still(s)
    return outcome


@entry(signature=types.none(_START, _FIX, _MOUNTING))
def prepare(first, fix, mounting):
    """Compute the first estimate that follows from a fix, with the suite's numbers in `first`."""
    if mounting.compass_turns:
        store(fix.field_B, turned(mounting.R_compass, load3(fix.field_B)))
    fix.outcome = _prepared(first, fix)


@entry(signature=types.none(_FLIGHT, _PARAMS, _SETTINGS, _WORK, _START, _FIX))
def start(block, params, settings, work, first, fix):
    """Start the filter from a fix that `prepare` has accepted."""
    flight, p = lanes_of(block), lanes_of(params)
    work.mask[0] = 1.0
    noise, tilt, speed = (
        load3(p.position_sigma_I),
        p.initial_tilt_sigma,
        p.initial_velocity_variance,
    )
    for i in range(3):
        flight.w_before[i] = math.nan
        flight.measurement[POSITION_BLOCK, i] = 0.0 if fix.rest else fix.position[i]
        flight.measurement[BASELINE_BLOCK, i] = 0.0 if fix.rest else fix.baseline[i]
        p.position_sigma_I[i] = fix.sigma[i]
    if fix.tilt_sigma > 0.0:
        p.initial_tilt_sigma = fix.tilt_sigma
    if fix.rest_sigma > 0.0:
        p.initial_velocity_variance = fix.rest_sigma * fix.rest_sigma
    begin_filter(block, params, settings, work, load3(first.x_I))
    store(p.position_sigma_I, noise)
    p.initial_tilt_sigma, p.initial_velocity_variance = tilt, speed
    if fix.levels:
        n = 15 if fix.rest else 15 + first.slow_states
        for i in range(3):
            flight.r_hat[i] = first.position[i]
            for j in range(3):
                flight.R_hat[i, j] = first.R_BI[i, j]
        for i in range(n):
            for j in range(i + 1):
                if i >= 15:
                    flight.P_slow[i - 15, j] = first.P[i, j]
                else:
                    flight.P[i, j] = first.P[i, j]
    if fix.levels or fix.has_velocity:
        for i in range(3):
            flight.v_hat[i] = fix.velocity_I[i]
            if not fix.levels:
                flight.P[V + i, V + i] = fix.velocity_sigma * fix.velocity_sigma


@kernel
def _quaternion(R):
    """The quaternion of R_BI, as `quad_gym.rotations.dcm_to_quaternion` rounds it."""
    a, b, c, d, e, f, g, h, i = R[0], R[1], R[2], R[3], R[4], R[5], R[6], R[7], R[8]
    q = (1.0 + a + e + i, f - h, g - c, b - d)
    largest = q[0]
    if 1.0 + a - e - i > largest:
        largest = 1.0 + a - e - i
        q = (f - h, largest, b + d, g + c)
    if 1.0 - a + e - i > largest:
        largest = 1.0 - a + e - i
        q = (g - c, b + d, largest, f + h)
    if 1.0 - a - e + i > largest:
        q = (b - d, g + c, f + h, 1.0 - a - e + i)
    return q, math.sqrt(q[0] * q[0] + q[1] * q[1] + q[2] * q[2] + q[3] * q[3])


@entry(signature=types.none(_FLIGHT, _WINDOW, types.int64, _ESTIMATE))
def state(flight, window, address, e):
    """Write the estimate; a row of KEPT numbers is at the address."""
    keep_estimate(lanes_of(flight), address)
    row = _reals_at(address, KEPT)
    q, size = _quaternion(row[6:15])
    for i in range(3):
        e.position[i], e.velocity[i] = row[i], row[3 + i]
        e.accel_bias[i], e.gyro_bias[i] = row[15 + i], row[18 + i]
        for j in range(3):
            e.R_BI[i, j] = row[6 + 3 * i + j]
    for i in range(4):
        e.quaternion[i] = q[i] / size
    for i in range(15):
        e.sigma[i] = math.sqrt(row[21 + i])
    e.time, e.diverged = window.time, int(row[36] > 0.0)


@entry(signature=types.none(_FLIGHT, types.int64))
def covariance(flight, address):
    """Write the covariance, row by row."""
    lanes = lanes_of(flight)
    P, arc = lanes.P, lanes.arc
    for i in range(15):
        for j in range(15):
            row, column = max(ROWS[i], ROWS[j]), min(ROWS[i], ROWS[j])
            total = P[row, column] + 0.0
            if max(i, j) < 6:
                total = total + arc[i] * arc[j]
            store_lanes(address + 8 * (15 * i + j), total)


@entry(signature=types.none(*[types.int64] * 4))
def seen(observation, attitude, x, y):
    """Write R (x - y) as three numbers of an observation."""
    o, R, a, b = (
        _singles_at(observation, 3),
        _reals_at(attitude, 9),
        _reals_at(x, 3),
        _reals_at(y, 3),
    )
    for i in range(3):
        o[i] = np.float32(
            R[3 * i] * (a[0] - b[0]) + R[3 * i + 1] * (a[1] - b[1]) + R[3 * i + 2] * (a[2] - b[2])
        )

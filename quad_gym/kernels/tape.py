"""Entries that run a filter over a tape of inputs, and sort late inputs into its past.

Every lane is a filter of its own, with its own parameters, on the same measurements.
"""

import math

import numpy as np

from quad_gym.kernels import entries
from quad_gym.kernels.compiling import Stage, call_stage, entry, kernel, routine
from quad_gym.kernels.compiling.signatures import signature_of
from quad_gym.kernels.filter.error_state import variance_of
from quad_gym.kernels.numbers.blocks import lanes_of, store_lanes
from quad_gym.kernels.numbers.elementary import approached, exp
from quad_gym.kernels.numbers.lanes import select
from quad_gym.records import (
    AID_BLOCK,
    AID_GROUPS,
    AIDS,
    BASELINE_BLOCK,
    GROUP_BLOCK,
    LEAST_SIGMA,
    MAX_BLOCKS,
    MOST_BLOCKS,
    REAL,
    SENSOR_GROUPS,
    WIDTH,
    Aid,
)
from quad_gym.records.inputs import KEPT, REPORTED, SAME_TIME, Kept, Operation, Outcome
from quad_gym.records.states import ROWS

# --------------------------------------------------------------------------------------------------
# Checks of the numbers of a measurement, for Python and for exported filters.
# --------------------------------------------------------------------------------------------------

_OK, _NOT_FINITE, _RANGE = int(Outcome.OK), int(Outcome.NOT_FINITE), int(Outcome.OUT_OF_RANGE)
_CONTRADICTION = int(Outcome.CONTRADICTION)
_POSITIONS, _BASELINES, _VELOCITIES, _IMAGES = range(AID_GROUPS)
_in_precision = np.dtype(REAL).type  #: the number in the precision of lanes
_LEAST = tuple(float(_in_precision(least)) for least in LEAST_SIGMA)
_LARGEST = float(_in_precision(1e15))  #: largest standard deviation
_PI = float(_in_precision(math.pi))


@kernel
def is_all_finite(values):
    """True if all numbers are finite."""
    found = True
    for i in range(len(values)):
        found &= math.isfinite(values[i])
    return found


@kernel
def scale_baseline(v):
    """Scale a baseline by a power of two: its length is not used; return the outcome."""
    if not is_all_finite(v):
        return _NOT_FINITE
    largest = max(abs(v[0]), abs(v[1]), abs(v[2]))
    if largest == 0.0:
        return _RANGE
    while largest >= 1.0 or largest < 0.5:
        factor = 0.5 if largest >= 1.0 else 2.0
        largest = factor * largest
        for i in range(3):
            v[i] = factor * v[i]
    return _OK


@kernel
def _check_block(block, z):
    """Check the numbers of a measured block; a baseline is scaled."""
    if block == BASELINE_BLOCK:
        return scale_baseline(z)
    return _OK if is_all_finite(z) else _NOT_FINITE


@kernel
def _check_sigmas(sigma, group, measured):
    """Check the standard deviations of a reading; 0, for those of the parameters, becomes NaN."""
    outcome = _OK
    for i in range(3):
        if sigma[i] == 0.0:
            sigma[i] = math.nan
        elif not measured:
            outcome = _CONTRADICTION
        elif not math.isfinite(sigma[i]):
            outcome = _NOT_FINITE
        elif not _LEAST[group] <= sigma[i] <= _LARGEST:
            outcome = _RANGE
    if group == _BASELINES and sigma[0] > _PI:
        sigma[0] = _PI
    return outcome


@kernel
def check(m):
    """Check a MEASUREMENT, and complete it; the outcome is the first one that is not OK."""
    m.outcome, m.culprit = _OK, 0
    for group in range(SENSOR_GROUPS):
        measured, first = False, GROUP_BLOCK[group]
        for block in range(first, first + MOST_BLOCKS[group]):
            z = m.measurement[block]
            if MOST_BLOCKS[group] > 1 and (z[0] != z[0] or z[1] != z[1] or z[2] != z[2]):
                m.valid[block] = 0.0  # one of several was not measured
            if m.valid[block] > 0.0:
                measured, found = True, _check_block(block, z)
                if found != _OK and m.outcome == _OK:
                    m.outcome, m.culprit = found, group
        found = _check_sigmas(m.sigma[group], group, measured)
        if found != _OK and m.outcome == _OK:
            m.outcome, m.culprit = found, group + SENSOR_GROUPS


@entry(signature=signature_of(entries.check_measurement))
def check_measurement(measurements):
    """Check measurements[0], see `check`."""
    check(measurements[0])


# --------------------------------------------------------------------------------------------------
# Entry that runs a filter over a tape: predictions, updates and copies, in their order.
# --------------------------------------------------------------------------------------------------

_PREDICT_STAGE, _UPDATE_STAGE = int(Stage.PREDICT), int(Stage.UPDATE)
_PREDICT, _UPDATE, _COPY, _RESTORE, _KEEP = map(int, Operation)
_HEIGHT = AID_BLOCK[Aid["BAROMETER"]]
_LANES = 8 * WIDTH  #: bytes


@kernel
def _set_step(p, tick, step, slow_states, dt):
    """Set the parameters that depend on the duration of a prediction.

    White noise is given as a density: the mean over a longer time has a smaller sigma.

    Args:
        p: Parameters assumed by the filter; changed.
        tick: The same for the suite's tick.
        step: Rates and standard deviations of slow errors.
        slow_states: Number of slow errors among the states.
        dt: Duration of the prediction [s].
    """
    fewer = math.sqrt(tick.dt / dt)
    p.dt = dt
    p.accel_error_noise = tick.accel_error_noise * fewer
    p.accel_noise, p.gyro_noise = tick.accel_noise * fewer, tick.gyro_noise * fewer
    p.accel_thrust_noise = tick.accel_thrust_noise * fewer
    p.gyro_thrust_noise = tick.gyro_thrust_noise * fewer
    p.accel_bias_decay, p.accel_bias_drive = _decay_and_drive(step, 0, dt)
    p.gyro_bias_decay, p.gyro_bias_drive = _decay_and_drive(step, 1, dt)
    for k in range(slow_states):
        p.slow_decay[k], p.slow_drive[k] = _decay_and_drive(step, 2 + k, dt)


@kernel
def _decay_and_drive(step, k, dt):
    """The decay of a slow error, and the standard deviation of its driving noise."""
    x = dt * step.rate[k]
    return exp(-x), step.sigma[k] * math.sqrt(approached(2.0 * x))


@kernel
def _set_tick(p, tick, slow_states):
    """Set these parameters for the suite's tick."""
    p.dt, p.accel_error_noise = tick.dt, tick.accel_error_noise
    p.accel_noise, p.gyro_noise = tick.accel_noise, tick.gyro_noise
    p.accel_thrust_noise, p.gyro_thrust_noise = tick.accel_thrust_noise, tick.gyro_thrust_noise
    p.accel_bias_decay, p.accel_bias_drive = tick.accel_bias_decay, tick.accel_bias_drive
    p.gyro_bias_decay, p.gyro_bias_drive = tick.gyro_bias_decay, tick.gyro_bias_drive
    for k in range(slow_states):
        p.slow_decay[k], p.slow_drive[k] = tick.slow_decay[k], tick.slow_drive[k]


@kernel
def _write_sample(flight, tick, sample):
    """Write a sample into the record."""
    flight.tick = flight.tick + sample.dt / tick.dt  # a clock, independent of the steps
    for i in range(3):
        flight.gyro[i], flight.accel[i] = sample.gyro[i], sample.accel[i]
        # for the lever arms of a velocity and of the accelerometer
        flight.w_before[i], flight.w_meas[i] = sample.gyro_before[i], sample.gyro[i]


@kernel
def _write_measurement(flight, step, m):
    """Write the measurements of one instant into the record."""
    for k in range(MAX_BLOCKS):
        flight.block_valid[k] = m.valid[k]
        if m.valid[k] > 0.0:
            for i in range(3):
                flight.measurement[k, i] = m.measurement[k, i]
    if m.valid[_HEIGHT] > 0.0:
        height, level = m.measurement[_HEIGHT, 0], step.level
        step.level = select(level == level, level, height - flight.r_hat[2])
        flight.measurement[_HEIGHT, 0] = height - step.level


@kernel
def _chosen(sigma, own):
    """The measurement's standard deviation, or the suite's where it has none."""
    if sigma == sigma:
        own = own * 0.0 + sigma
    return own


@kernel
def _replace_noise(p, m, own):
    """Set the noise of a measurement where it has its own, or else the suite's."""
    for i in range(3):
        p.position_sigma_I[i] = _chosen(m.sigma[_POSITIONS, i], own.position_sigma_I[i])
    p.baseline_noise, p.baseline_sigma = own.baseline_noise, own.baseline_sigma
    sigma = m.sigma[_BASELINES, 0]
    if sigma == sigma:
        p.baseline_sigma = sigma
        if sigma <= _PI:  # otherwise only the heading is used, with the suite's noise
            p.baseline_noise = sigma
    p.velocity_sigma = _chosen(m.sigma[_VELOCITIES, 0], own.velocity_sigma)
    p.pixel_sigma = _chosen(m.sigma[_IMAGES, 0], own.pixel_sigma)
    for aid in range(AIDS):
        p.aid_sigma[aid] = _chosen(m.sigma[AID_GROUPS + aid, 0], own.aid_sigma[aid])


@kernel
def predict_sample(flight, params, ticks, steps, settings, work, table, mask, sample):
    """Propagate the filters of a block over the time of a sample; see `run_tape`."""
    p, tick, scratch = lanes_of(params), lanes_of(ticks), lanes_of(work)
    if _in_precision(sample.dt) == ticks.dt[0]:
        _set_tick(p, tick, settings.slow_states)
    else:
        _set_step(p, tick, lanes_of(steps), settings.slow_states, sample.dt)
    _write_sample(flight, tick, sample)
    scratch.mask = mask
    features = settings.feature_count
    call_stage(table, _PREDICT_STAGE, flight, p, p, settings, scratch, features)


@kernel
def update_with(flight, params, ticks, steps, settings, work, table, mask, measurement):
    """Update the filters of a block with the measurements of an instant; see `run_tape`."""
    p, tick, scratch = lanes_of(params), lanes_of(ticks), lanes_of(work)
    features = settings.feature_count
    _set_tick(p, tick, settings.slow_states)
    _write_measurement(flight, lanes_of(steps), measurement)
    _replace_noise(p, measurement, tick)
    scratch.mask = mask
    call_stage(table, _UPDATE_STAGE, flight, p, p, settings, scratch, features)


@kernel
def _store3(address, place, v):
    """Write three lanes from a place of a row on; return the next place."""
    for i in range(3):
        store_lanes(address + (place + i) * _LANES, v[i] + 0.0)
    return place + 3


@kernel
def keep_estimate(flight, address):
    """Store the estimate in a row, see KEPT."""
    place = _store3(address, 0, flight.r_hat)
    place = _store3(address, place, flight.v_hat)
    for i in range(3):
        place = _store3(address, place, flight.R_hat[i])
    place = _store3(address, place, flight.b_a_hat)
    place = _store3(address, place, flight.b_g_hat)
    for i in range(15):
        store_lanes(address + (place + i) * _LANES, variance_of(flight, ROWS[i]))
    store_lanes(address + (place + 15) * _LANES, flight.diverged + 0.0)
    store_lanes(address + (place + 16) * _LANES, flight.level_apart + 0.0)
    store_lanes(address + (place + 17) * _LANES, flight.level_sigma + 0.0)
    store_lanes(address + (place + 18) * _LANES, flight.compass_out + 0.0)
    store_lanes(address + (place + 19) * _LANES, flight.heading_lost + 0.0)


@kernel
def _report(flight, blocks, address):
    """Store innovations in a row, see REPORTED."""
    place = 0
    for k in range(len(blocks)):
        s = blocks[k]
        place = _store3(address, place, flight.innovation[s])
        place = _store3(address, place, flight.innovation_sigma[s])
        store_lanes(address + place * _LANES, flight.block_nis[s] + 0.0)
        store_lanes(address + (place + 1) * _LANES, flight.gate[s] + 0.0)
        place += 2


@entry(signature=signature_of(entries.run_tape))
def run_tape(
    flights,
    params,
    ticks,
    steps,
    settings,
    work,
    table,
    samples,
    measurements,
    operations,
    blocks,
    memory,
    slots,
    kept,
    reported,
):
    """Run the operations of a tape on the filters of a block.

    Args:
        flights: (1,) the block.
        params: (1,) parameters that its filters assume.
        ticks: (1,) the same, with the suite's tick and noise.
        steps: (1,) further numbers, see STEP_BLOCK.
        settings: (1,) configuration.
        work: (1,) scratch memory, with the lanes to work on as `mask`.
        table: (1,) stages.
        samples: (n,) SAMPLE.
        measurements: (n,) MEASUREMENT.
        operations: (n,) OPERATION.
        blocks: Blocks of innovations to report.
        memory: (words,) memory of the filters, as a part of the block.
        slots: (n, words) room for copies of it.
        kept: Address of the rows of estimates.
        reported: Address of the rows of innovations.
    """
    flight, mask = lanes_of(flights[0]), lanes_of(work[0]).mask
    row = REPORTED * len(blocks) * _LANES
    for k in range(len(operations)):
        code, index, target = operations[k].code, operations[k].index, operations[k].target
        if code == _PREDICT:
            predict_sample(
                flight,
                params[0],
                ticks[0],
                steps[0],
                settings[0],
                work[0],
                table[0],
                mask,
                samples[index],
            )
        elif code == _UPDATE:
            update_with(
                flight,
                params[0],
                ticks[0],
                steps[0],
                settings[0],
                work[0],
                table[0],
                mask,
                measurements[index],
            )
            if target >= 0:
                _report(flight, blocks, reported + target * row)
        elif code == _COPY:
            for i in range(len(memory)):
                slots[target, i] = memory[i]
        elif code == _RESTORE:
            for i in range(len(memory)):
                memory[i] = slots[target, i]
        elif code == _KEEP:
            keep_estimate(flight, kept + target * KEPT * _LANES)


# --------------------------------------------------------------------------------------------------
# Inputs of a filter within a window of time, for the processing of delayed measurements.
#
# A delayed measurement is inserted at its time stamp, and everything since then is filtered again:
# the result is bitwise the result with the same samples and measurements in the order of their
# stamps. An IMU sample whose interval contains the stamp is split there, with the same sample on
# both sides. A measurement ahead of the filter waits for the sample of its time.
#
# Nothing is filtered here: an input becomes operations of a tape (`records/inputs.py`), which the
# caller runs. Classes for one vehicle, the replay of logs and exported filters share this code.
#
# Flights in an environment use another method, `filter/delayed.py`: they keep sums of the IMU
# samples, and retrodict estimate and covariance over them. That costs less, but requires stamps on
# ticks and sensors whose measurements arrive in order, and is exact to first order only.
# --------------------------------------------------------------------------------------------------

_A_SAMPLE, _A_MEASUREMENT, _A_COPY = map(int, Kept)
_OK, _RANGE = int(Outcome.OK), int(Outcome.OUT_OF_RANGE)
_OLD, _NEW, _FULL = int(Outcome.TOO_OLD), int(Outcome.TOO_NEW), int(Outcome.FULL)
_SHORTEST = 1e-9  #: shortest sample [s]


@kernel
def _emit(w, operations, code, index, target):
    """Append an operation."""
    o = operations[w.operations]
    o.code, o.index, o.target = code, index, target
    w.operations += 1


@kernel
def _emit_event(w, operations, e, is_new):
    """Append the operation of an event; the innovations of a new measurement are reported."""
    if e.kind == _A_SAMPLE:
        _emit(w, operations, _PREDICT, e.index, -1)
    elif is_new:
        _emit(w, operations, _UPDATE, e.index, w.reported)
        w.reported += 1
    else:
        _emit(w, operations, _UPDATE, e.index, -1)


@routine
def _is_used(w, events, waits, kind, number):
    """Return True if an event or a waiting measurement refers to a number."""
    for k in range(w.events):
        found = events[k].copy if kind == _A_COPY else events[k].index
        if found == number and (kind == _A_COPY or events[k].kind == kind):
            return True
    found = False
    for k in range(w.waiting):
        found |= kind == _A_MEASUREMENT and waits[k].index == number
    return found


@routine
def _new_number(w, events, waits, kind):
    """Return a number that nothing refers to; -1: there is none."""
    room = w.room[kind]
    for _ in range(max(room, 1)):
        number = w.next[kind]
        w.next[kind] += 1
        if room == 0:
            return number
        if not _is_used(w, events, waits, kind, number % room):
            return number % room
    return -1


@routine
def _drop(w, events, count):
    """Drop the first events."""
    if count > 0:
        w.events -= count
        for k in range(w.events):
            events[k] = events[k + count]


@routine
def _shrink(w, events):
    """Drop the events before the second copy, where memory is short: the window shrinks."""
    k = 1
    while k < w.events and events[k].copy < 0:
        k += 1
    _drop(w, events, k)


@kernel
def _make_room(w, events):
    """Make room for two more events."""
    while w.events > len(events) - 2:
        _shrink(w, events)


@routine
def _add(w, events, waits, operations, kind, index, dt):
    """Process the next event."""
    start = w.time
    w.time = start + dt
    _make_room(w, events)
    e = events[w.events]
    e.start, e.time, e.kind, e.index, e.copy = start, w.time, kind, index, -1
    if w.length > 0.0:
        w.since_copy += 1
        if w.events == 0 or w.since_copy >= w.copy_every:
            e.copy, w.since_copy = _new_number(w, events, waits, _A_COPY), 0
            _emit(w, operations, _COPY, 0, e.copy)
        w.events += 1
    _emit_event(w, operations, e, True)
    keep = 0  # the last copy that is older than the window
    for k in range(w.events):
        if events[k].start > w.time - w.length:
            break
        if events[k].copy >= 0:
            keep = k
    _drop(w, events, keep)


@routine
def _split(w, events, samples, waits, whole, first):
    """Split a sample after a time; return the numbers of both parts.

    The gyro's rate of change is the whole sample's in both.
    """
    s = samples[whole]
    dt = s.dt
    one = _new_number(w, events, waits, _A_SAMPLE)
    two = _new_number(w, events, waits, _A_SAMPLE)
    for number, duration in ((one, first), (two, dt - first)):
        part = samples[number]
        part.dt = duration
        for i in range(3):
            change = (s.gyro[i] - s.gyro_before[i]) / dt
            part.gyro[i], part.accel[i] = s.gyro[i], s.accel[i]
            part.gyro_before[i] = s.gyro[i] - duration * change
    return one, two


@routine
def _insert(w, events, samples, waits, operations, index, time):
    """Insert a measurement at an earlier time, and filter again all inputs after it."""
    i = w.events - 1  # the first event that ends later
    while i > 0 and events[i - 1].time > time + SAME_TIME:
        i -= 1
    first = i
    while events[first].copy < 0:
        first -= 1
    elapsed = time - events[i].start
    more = 2 if elapsed > SAME_TIME else 1
    for k in range(w.events - 1, i - 1, -1):
        events[k + more] = events[k]
    w.events += more
    new = i + more - 1
    if more == 2:
        one, two = _split(w, events, samples, waits, events[i].index, elapsed)
        events[i].index, events[i].time = one, time
        events[new].start, events[new].copy = time, -1
        events[i + 2].index, events[i + 2].start, events[i + 2].copy = two, time, -1
    else:
        events[i + 1].copy = -1
    e = events[new]
    e.time, e.kind, e.index = e.start, _A_MEASUREMENT, index
    _emit(w, operations, _RESTORE, 0, events[first].copy)
    for k in range(first, w.events):
        if k > first and events[k].copy >= 0:
            _emit(w, operations, _COPY, 0, events[k].copy)
        _emit_event(w, operations, events[k], k == new)


@routine
def _take_first_waiting(w, events, waits, operations):
    """Process the measurement that has waited for the filter's time."""
    index = waits[0].index
    w.waiting -= 1
    for k in range(w.waiting):
        waits[k] = waits[k + 1]
    _add(w, events, waits, operations, _A_MEASUREMENT, index, 0.0)


@kernel
def _take_sample(w, events, samples, waits, operations, given):
    if given.keeps:
        _emit(w, operations, _KEEP, 0, w.kept)
        w.kept += 1
    dt = given.dt if given.dt == given.dt else given.time - w.time
    if given.gyro[0] != given.gyro[0] or (given.dt != given.dt and dt <= SAME_TIME):
        return _OK
    if not (_SHORTEST <= dt <= w.longest):
        return _RANGE
    index, end = _new_number(w, events, waits, _A_SAMPLE), w.time + dt
    s = samples[index]
    for i in range(3):
        s.gyro[i], s.accel[i] = given.gyro[i], given.accel[i]
        s.gyro_before[i] = w.gyro[i] if w.has_gyro else given.gyro[i]
        w.gyro[i] = given.gyro[i]
    s.dt, w.has_gyro = dt, 1
    while w.waiting > 0 and waits[0].time < end - SAME_TIME:
        elapsed = waits[0].time - w.time
        if elapsed > SAME_TIME:
            first, index = _split(w, events, samples, waits, index, elapsed)
            _add(w, events, waits, operations, _A_SAMPLE, first, elapsed)
        _take_first_waiting(w, events, waits, operations)
    _add(w, events, waits, operations, _A_SAMPLE, index, samples[index].dt)
    while w.waiting > 0 and waits[0].time <= w.time + SAME_TIME:
        _take_first_waiting(w, events, waits, operations)
    return _OK


@kernel
def _take_measurement(w, events, samples, waits, operations, given):
    if given.time < w.oldest - SAME_TIME:
        return _OLD
    if given.time > w.time + w.ahead:
        return _NEW
    waits_for = given.time > w.time + SAME_TIME
    if waits_for and w.waiting == len(waits):
        return _FULL
    _make_room(w, events)
    index = _new_number(w, events, waits, _A_MEASUREMENT)
    while index < 0:
        _shrink(w, events)
        index = _new_number(w, events, waits, _A_MEASUREMENT)
    given.index = index
    if waits_for:
        k = w.waiting
        while k > 0 and (
            waits[k - 1].time > given.time
            or (waits[k - 1].time == given.time and waits[k - 1].rank > given.rank)
        ):
            waits[k] = waits[k - 1]
            k -= 1
        waits[k].time, waits[k].rank, waits[k].index = given.time, given.rank, index
        w.waiting += 1
    elif given.time >= w.time - SAME_TIME or w.events == 0:
        _add(w, events, waits, operations, _A_MEASUREMENT, index, 0.0)
    else:
        _insert(w, events, samples, waits, operations, index, given.time)
    return _OK


@routine
def take_input(w, events, samples, waits, operations, given):
    """Append the operations that process an input; return the outcome."""
    given.now = w.time
    if given.rank == 0:
        outcome = _take_sample(w, events, samples, waits, operations, given)
    else:
        outcome = _take_measurement(w, events, samples, waits, operations, given)
    w.oldest = max(w.time - w.length, events[0].start) if w.events > 0 else w.time
    return outcome


@kernel
def _shortage(w, events, samples, waits, operations):
    """Return the place of the memory that may be too short for the next input; -1: none."""
    more = 2 * w.waiting + 4
    if w.events + more > len(events):
        return 0
    if w.room[_A_SAMPLE] == 0 and w.next[_A_SAMPLE] + more > len(samples):
        return 1
    if w.waiting == len(waits):
        return 2
    return 3 if w.operations + 3 * (w.events + more) > len(operations) else -1


@entry(signature=signature_of(entries.take_inputs))
def take_inputs(windows, events, samples, waits, operations, inputs):
    """Write the operations that process inputs, until one has an error or memory is short.

    Args:
        windows: (1,) WINDOW.
        events: (n,) EVENT.
        samples: (n,) SAMPLE.
        waits: (n,) PENDING.
        operations: (n,) OPERATION.
        inputs: (n,) INPUT.
    """
    w = windows[0]
    w.operations = w.taken = 0
    w.shortage = _shortage(w, events, samples, waits, operations)
    while w.shortage < 0 and w.taken < len(inputs):
        given = inputs[w.taken]
        given.outcome = take_input(w, events, samples, waits, operations, given)
        if given.outcome == _RANGE:
            break
        w.taken += 1
        w.shortage = _shortage(w, events, samples, waits, operations)

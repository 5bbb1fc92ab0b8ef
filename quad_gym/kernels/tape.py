"""Entry that runs a filter over a tape: predictions, updates and copies, in their order.

Every lane is a filter of its own, with its own parameters, on the same measurements.
"""

import math

from quad_gym.kernels import entries
from quad_gym.kernels.compiling import Stage, call_stage, entry, kernel
from quad_gym.kernels.compiling.signatures import signature_of
from quad_gym.kernels.filter.error_state import variance_of
from quad_gym.kernels.maths.elementary import exp
from quad_gym.kernels.simd.addresses import store_lanes
from quad_gym.kernels.simd.blocks import lanes_of
from quad_gym.kernels.simd.lanes import select
from quad_gym.records import (
    AID_BLOCKS,
    AID_ROW,
    AID_ROWS,
    AIDS,
    BASELINE_BLOCK,
    FEATURE_BLOCKS,
    MAX_BLOCKS,
    POSITION_BLOCK,
    VELOCITY_BLOCK,
    WIDTH,
    Aid,
)
from quad_gym.records.tape import (
    KEPT,
    REPORTED,
    Operation,
)

_PREDICT_STAGE, _UPDATE_STAGE = int(Stage.PREDICT), int(Stage.UPDATE)
_PREDICT, _UPDATE, _COPY, _RESTORE, _KEEP = map(int, Operation)
_HEIGHT = AID_ROW[Aid["BAROMETER"]]
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
    a = exp(-dt * step.rate[k])
    return a, step.sigma[k] * math.sqrt((1.0 - a) * (1.0 + a))


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
def _take_sample(flight, tick, sample):
    """Write a sample into the record."""
    flight.tick = flight.tick + sample.dt / tick.dt  # a clock, independent of the steps
    for i in range(3):
        flight.gyro[i], flight.accel[i] = sample.gyro[i], sample.accel[i]
        # for the lever arms of a velocity and of the accelerometer
        flight.w_before[i], flight.w_meas[i] = sample.gyro_before[i], sample.gyro[i]


@kernel
def _take_triple(values, measured, valid):
    """Write three numbers if they were measured."""
    if valid > 0.0:
        for i in range(3):
            values[i] = measured[i]


@kernel
def _take_measurement(flight, step, m, features):
    """Write the measurements of one instant into the record."""
    for k in range(MAX_BLOCKS):
        flight.block_valid[k] = m.valid[k]
    _take_triple(flight.gnss_position, m.gnss_position, m.valid[POSITION_BLOCK])
    _take_triple(flight.gnss_baseline, m.gnss_baseline, m.valid[BASELINE_BLOCK])
    _take_triple(flight.gnss_velocity, m.gnss_velocity, m.valid[VELOCITY_BLOCK])
    for k in range(features):
        if m.valid[FEATURE_BLOCKS + k] > 0.0:
            for i in range(2):
                flight.pixels[k, i] = m.pixels[k, i]
    for row in range(AID_ROWS):
        _take_triple(flight.aid_measurement[row], m.aid_measurement[row], m.valid[AID_BLOCKS + row])
    if m.valid[AID_BLOCKS + _HEIGHT] > 0.0:
        height, level = m.aid_measurement[_HEIGHT, 0], step.level
        step.level = select(level == level, level, height - flight.r_hat[2])
        flight.aid_measurement[_HEIGHT, 0] = height - step.level


@kernel
def _replace_noise(p, m, own):
    """Set the noise of a measurement where it has its own, or else the suite's."""
    for i in range(3):
        p.position_sigma_I[i] = own.position_sigma_I[i]
        if m.position_sigma_I[i] == m.position_sigma_I[i]:
            p.position_sigma_I[i] = m.position_sigma_I[i]
    p.baseline_noise, p.baseline_sigma = own.baseline_noise, own.baseline_sigma
    if m.baseline_noise == m.baseline_noise:
        p.baseline_noise = m.baseline_noise
    if m.baseline_sigma == m.baseline_sigma:
        p.baseline_sigma = m.baseline_sigma
    p.velocity_sigma, p.pixel_sigma = own.velocity_sigma, own.pixel_sigma
    if m.velocity_sigma == m.velocity_sigma:
        p.velocity_sigma = m.velocity_sigma
    if m.pixel_sigma == m.pixel_sigma:
        p.pixel_sigma = m.pixel_sigma
    for aid in range(AIDS):
        p.aid_sigma[aid] = own.aid_sigma[aid]
        if m.aid_sigma[aid] == m.aid_sigma[aid]:
            p.aid_sigma[aid] = m.aid_sigma[aid]


@kernel
def predict_sample(flight, params, ticks, steps, settings, work, table, mask, sample):
    """Propagate the filters of a block over the time of a sample; see `run_tape`."""
    p, tick, scratch = lanes_of(params), lanes_of(ticks), lanes_of(work)
    if sample.dt == ticks.dt[0]:
        _set_tick(p, tick, settings.slow_states)
    else:
        _set_step(p, tick, lanes_of(steps), settings.slow_states, sample.dt)
    _take_sample(flight, tick, sample)
    scratch.mask = mask
    features = settings.feature_count
    call_stage(table, _PREDICT_STAGE, flight, p, p, settings, scratch, features)


@kernel
def update_with(flight, params, ticks, steps, settings, work, table, mask, measurement):
    """Update the filters of a block with the measurements of an instant; see `run_tape`."""
    p, tick, scratch = lanes_of(params), lanes_of(ticks), lanes_of(work)
    features = settings.feature_count
    _set_tick(p, tick, settings.slow_states)
    _take_measurement(flight, lanes_of(steps), measurement, features)
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
        store_lanes(address + (place + i) * _LANES, variance_of(flight, i))
    store_lanes(address + (place + 15) * _LANES, flight.diverged + 0.0)


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

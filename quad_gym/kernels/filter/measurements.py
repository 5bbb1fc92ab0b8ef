"""Bookkeeping of measurements for an update: which are valid, and the calls of their sensors.

The stacked measurement has three rows for each block that any lane has measured, in the order of
`Sensor`; each sensor fills its own rows (`kernels/sensors/`). A sensor is a stage that is called
with an `Act` and an argument. The filter accesses sensors by these calls only.
"""

import numpy as np

from quad_gym.kernels.compiling import Stage, call_stage, kernel
from quad_gym.kernels.simd.lanes import any_of, select, zero_like
from quad_gym.records import (
    BLOCK_NUMBERS,
    FIRST_BLOCK,
    MAX_BLOCKS,
    SENSORS,
    Act,
    FilterStatus,
    GateDecision,
    Sensor,
)

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

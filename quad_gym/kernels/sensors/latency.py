"""Clocks of sensors, and their latency: measurements in transit wait in a flight's record.

A clock has the ticks of a sensor's first and next measurement. A measurement in transit is stored
with its time stamp: the sums of the IMU when it was taken, with which `filter/delayed.py`
retrodicts the estimate to that instant.
"""

import numpy as np

from quad_gym.kernels.compiling import kernel
from quad_gym.kernels.simd.lanes import any_of, no_lane, select, zero_like
from quad_gym.records import DELAY_SLOTS, FIRST_BLOCK, STAMP


@kernel
def _first_wait(phase, period, share):
    """Ticks to a sensor's first measurement: its phase, or random within its period."""
    ticks = zero_like(share)
    for k in range(1, period):
        ticks = ticks + select(share * period >= 1.0 * k, 1.0, 0.0)
    if phase >= 0:
        ticks = zero_like(share) + phase
    return ticks


@kernel
def begin_clock(flight, settings, sensor, share, mask):
    """Begin an episode of a sensor, in the lanes `mask`: nothing is measured yet.

    A random phase is a `share` of the period.
    """
    wait = _first_wait(settings.sensor_phase[sensor], settings.sensor_ticks[sensor], share)
    flight.wait[sensor] = select(mask, wait, flight.wait[sensor])
    first = FIRST_BLOCK[sensor]
    for block in range(first, first + settings.sensor_blocks[sensor]):
        flight.block_fresh[block] = select(mask, 0.0, flight.block_fresh[block])
        flight.block_valid[block] = select(mask, 0.0, flight.block_valid[block])
    if settings.sensor_delay[sensor] > 0:
        for slot in range(DELAY_SLOTS):
            row = flight.stamps[sensor, slot]
            row[0] = select(mask, np.nan, row[0])


@kernel
def tick_clock(flight, settings, sensor, mask):
    """Advance a sensor's clock by a tick; return the lanes in which it measures now."""
    wait, period = flight.wait[sensor], settings.sensor_ticks[sensor]
    due = mask & (wait <= 0.0) & (period > 0)
    flight.wait[sensor] = select(mask, select(due, 1.0 * period, wait) - 1.0, wait)
    return due


@kernel
def _put_stamp(stamps, flight, under_way, taken):
    """Shift the stamps of a sensor, (DELAY_SLOTS, STAMP), and stamp the first with the present."""
    for slot in range(under_way, 0, -1):
        for i in range(STAMP):
            stamps[slot, i] = select(taken, stamps[slot - 1, i], stamps[slot, i])
    row = stamps[0]
    row[0] = select(taken, flight.tick, row[0])
    for i in range(3):
        for j in range(3):
            k = 1 + 3 * i + j
            row[k] = select(taken, flight.imu_turn[i, j], row[k])
            row[k + 15] = select(taken, flight.imu_bias_gain[i, j], row[k + 15])
        row[10 + i] = select(taken, flight.imu_velocity[i], row[10 + i])
        row[13 + i] = select(taken, flight.imu_position[i], row[13 + i])
        row[25 + i] = select(taken, flight.w_meas[i], row[25 + i])


@kernel
def find_arrivals(flight, work, settings, sensor, mask):
    """Fill work.arrives with the slot that arrives now; return the lanes in which one does."""
    stamps, delay = flight.stamps[sensor], settings.sensor_delay[sensor]
    some = no_lane(flight.tick)
    for slot in range(settings.under_way[sensor]):
        here = mask & (stamps[slot, 0] == flight.tick - delay)
        work.arrives[slot] = select(here, 1.0, 0.0)
        some = some | here
    return some


@kernel
def stamp(flight, settings, sensor, mask):
    """Stamp the measurements just taken; return the lanes that have any."""
    first, valid = FIRST_BLOCK[sensor], zero_like(flight.tick)
    for block in range(first, first + settings.sensor_blocks[sensor]):
        valid = valid + flight.block_valid[block]
    taken = mask & (valid > 0.0)
    if any_of(taken):
        _put_stamp(flight.stamps[sensor], flight, settings.under_way[sensor], taken)
    return taken


@kernel
def exchange(flight, work, block, values, numbers, under_way, mask, taken):
    """Hold back the block that has just been measured, and deliver the one that arrives.

    Args:
        flight: Record.
        work: Workspace; reads the results of `begin_sample` and `find_arrivals`.
        block: Number of the block.
        values: Its numbers in the record.
        numbers: Count of these numbers.
        under_way: Largest number of measurements in transit.
        mask: Lanes to work on.
        taken: Lanes in which the sensor has measured.
    """
    waiting, flags = flight.waiting[block], flight.waiting_valid[block]
    valid, arrived = flight.block_valid[block], zero_like(flight.tick)
    for slot in range(under_way):
        here = work.arrives[slot] > 0.0
        for i in range(numbers):
            kept = work.arrived[block, i]
            work.arrived[block, i] = select(here, waiting[slot, i], kept)
        arrived = select(here, flags[slot], arrived)
    if any_of(taken):
        for slot in range(under_way - 1, 0, -1):
            for i in range(numbers):
                waiting[slot, i] = select(taken, waiting[slot - 1, i], waiting[slot, i])
            flags[slot] = select(taken, flags[slot - 1], flags[slot])
        for i in range(numbers):
            waiting[0, i] = select(taken, values[i], waiting[0, i])
        flags[0] = select(taken, valid, flags[0])
    flight.block_valid[block] = select(mask, arrived, valid)
    fresh = flight.block_fresh[block]
    flight.block_fresh[block] = select(mask & (arrived > 0.0), 1.0, fresh)


@kernel
def deliver_arrived(work, block, values, numbers, mask):
    """Replace the numbers that have just been measured by those that arrived last."""
    for i in range(numbers):
        values[i] = select(mask, work.arrived[block, i], values[i])


@kernel
def begin_sample(flight, work, settings, sensor, values, numbers, mask):
    """Invalidate the blocks of the last sample, and keep their numbers if there are delays.

    `values` (blocks, numbers): those of the sensor in the record.
    """
    first = FIRST_BLOCK[sensor]
    for i in range(settings.sensor_blocks[sensor]):
        flight.block_valid[first + i] = select(mask, 0.0, flight.block_valid[first + i])
        if settings.sensor_delay[sensor] > 0:
            for n in range(numbers):
                work.arrived[first + i, n] = values[i][n]


@kernel
def deliver(flight, work, settings, sensor, values, numbers, mask, due):
    """Deliver the measurement of a sensor in the lanes `due`, now or after its latency."""
    first, count = FIRST_BLOCK[sensor], settings.sensor_blocks[sensor]
    if settings.sensor_delay[sensor] == 0:
        for block in range(first, first + count):
            new = due & (flight.block_valid[block] > 0.0)
            flight.block_fresh[block] = select(new, 1.0, flight.block_fresh[block])
    elif any_of(due | find_arrivals(flight, work, settings, sensor, mask)):
        taken, under_way = stamp(flight, settings, sensor, mask), settings.under_way[sensor]
        for i in range(count):
            exchange(flight, work, first + i, values[i], numbers, under_way, mask, taken)
            deliver_arrived(work, first + i, values[i], numbers, mask)

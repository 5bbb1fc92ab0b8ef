"""Clocks of sensors: the ticks of their first and next measurements."""

from quad_gym.kernels.compiling import kernel
from quad_gym.kernels.sensors.latency import forget_stamps
from quad_gym.kernels.simd.lanes import select, zero_like
from quad_gym.records import FIRST_BLOCK


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
        forget_stamps(flight.stamps[sensor], mask)


@kernel
def tick_clock(flight, settings, sensor, mask):
    """Advance a sensor's clock by a tick; return the lanes in which it measures now."""
    wait, period = flight.wait[sensor], settings.sensor_ticks[sensor]
    due = mask & (wait <= 0.0) & (period > 0)
    flight.wait[sensor] = select(mask, select(due, 1.0 * period, wait) - 1.0, wait)
    return due

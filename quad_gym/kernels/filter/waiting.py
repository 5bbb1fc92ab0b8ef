"""Late measurements in transit: GNSS fixes and images wait in a flight's record until they arrive.

With each waits its time stamp: what the IMU had summed up when it was taken. `late.py` updates the
filter with those that arrive. Aiding sensors do the same by themselves (`measurements/aid.py`).
"""

from quad_gym.kernels.compiling import kernel, stage
from quad_gym.kernels.filter.preintegration import add_increment, begin_increments
from quad_gym.kernels.measurements import blocks
from quad_gym.kernels.measurements.stamps import forget_stamps, put_stamp
from quad_gym.kernels.simd.blocks import lanes_of
from quad_gym.kernels.simd.lanes import any_of, select
from quad_gym.records import DELAY_SLOTS, SENSORS, Sensor

_GNSS = int(Sensor.GNSS)


@kernel
def begin_without_waiting(flight, mask):
    """Begin an episode with nothing in transit, where `mask`."""
    begin_increments(flight, mask)
    for sensor in range(SENSORS):
        forget_stamps(flight.stamps[sensor], mask)


@kernel
def delay_of(settings, sensor):
    """Ticks until what a sensor measures reaches the filter."""
    return settings.gnss_delay if sensor == _GNSS else settings.camera_delay


def _exchange_of(sensor):
    """A kernel that exchanges what a sensor measures now for what it measured before."""
    count, exchange = (blocks.in_turn(name, sensor) for name in ("count", "exchange"))
    number = int(sensor)

    @kernel
    def exchange_with_stamps(flight, p, work, settings, starting):
        stamps, mask = flight.stamps[number], work.mask > 0.0
        for slot in range(DELAY_SLOTS):
            here = mask & (stamps[slot, 0] == flight.tick - delay_of(settings, number))
            work.here[slot] = select(here, 1.0, 0.0)
        work.measured = 0.0 * flight.tick
        count(flight, p, work, settings, None, 0)
        taken = mask & (work.measured > 0.0)
        work.taken = select(taken, 1.0, 0.0)
        if any_of(taken):
            put_stamp(stamps, flight, taken)
        exchange(flight, p, work, settings, None, starting)

    return exchange_with_stamps


_exchange_gnss, _exchange_camera = _exchange_of(Sensor.GNSS), _exchange_of(Sensor.CAMERA)

# ---- stages ----------------------------------------------------------------------------------


@stage
def begin_late_stage(flight, world, model, settings, work, stages, flag):
    """Begin an episode with no measurement in transit."""
    begin_without_waiting(lanes_of(flight), lanes_of(work).mask > 0.0)


@stage
def increment_stage(flight, world, model, settings, work, stages, flag):
    """Add the tick's IMU sample to the sums that late measurements go back by."""
    add_increment(lanes_of(flight), lanes_of(model), settings.form)


@stage
def set_aside_stage(flight, world, model, settings, work, stages, flag):
    """Keep what has arrived so far, before something new is measured."""
    blocks.set_aside(lanes_of(flight), lanes_of(model), lanes_of(work), settings, None, 0)


@stage
def exchange_stage(flight, world, model, settings, work, stages, flag):
    """Let new measurements wait and old ones arrive; `flag`: whether an episode begins.

    The measurements and flags of validity in the record become those that arrive.
    """
    flying, p, scratch = lanes_of(flight), lanes_of(model), lanes_of(work)
    if settings.gnss_delay > 0:
        _exchange_gnss(flying, p, scratch, settings, flag > 0)
    if settings.camera_delay > 0:
        _exchange_camera(flying, p, scratch, settings, flag > 0)

"""The parts that sensors share: clock, latency, delivery, errors, and the stage itself."""

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from quad_gym.kernels.compiling import kernel, stage
from quad_gym.kernels.filter.error_state import D
from quad_gym.kernels.filter.measurements import ACTS
from quad_gym.kernels.numbers.elementary import maximum
from quad_gym.kernels.numbers.lanes import any_of, no_lane, select, zero_like
from quad_gym.kernels.numbers.linalg import keep, load3
from quad_gym.kernels.numbers.random import normal_pair, stream_of, uniform_pair
from quad_gym.records import (
    AID_BLOCK,
    DELAY_SLOTS,
    DRAW_AID_DRIFT,
    DRAW_AID_MATRIX,
    DRAW_AID_PHASE,
    DRAW_AID_VECTOR,
    DRAW_SLOW,
    FIRST_AID,
    FIRST_BLOCK,
    FIRST_GROUP,
    GROUP_BLOCK,
    GROUP_COUNT,
    LOSSES,
    MOST_BLOCKS,
    STAMP,
    Act,
    Aid,
    Sensor,
)

# --------------------------------------------------------------------------------------------------
# Clocks of sensors, and their latency: measurements in transit wait in a flight's record.
#
# A clock has the ticks of a sensor's first and next measurement. A measurement in transit is stored
# with its time stamp: the sums of the IMU when it was taken, with which `filter/delayed.py`
# retrodicts the estimate to that instant.
# --------------------------------------------------------------------------------------------------


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
        row[28 + i] = select(taken, flight.level_sum[i], row[28 + i])


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
def exchange(flight, work, block, under_way, mask, taken):
    """Hold back the block that has just been measured, and deliver the one that arrives.

    Args:
        flight: Record.
        work: Workspace; reads the results of `begin_sample` and `find_arrivals`.
        block: Number of the block.
        under_way: Largest number of measurements in transit.
        mask: Lanes to work on.
        taken: Lanes in which the sensor has measured.
    """
    waiting, flags = flight.waiting[block], flight.waiting_valid[block]
    values = flight.measurement[block]
    valid, arrived = flight.block_valid[block], zero_like(flight.tick)
    for slot in range(under_way):
        here = work.arrives[slot] > 0.0
        for i in range(3):
            kept = work.arrived[block, i]
            work.arrived[block, i] = select(here, waiting[slot, i], kept)
        arrived = select(here, flags[slot], arrived)
    if any_of(taken):
        for slot in range(under_way - 1, 0, -1):
            for i in range(3):
                waiting[slot, i] = select(taken, waiting[slot - 1, i], waiting[slot, i])
            flags[slot] = select(taken, flags[slot - 1], flags[slot])
        for i in range(3):
            waiting[0, i] = select(taken, values[i], waiting[0, i])
        flags[0] = select(taken, valid, flags[0])
    flight.block_valid[block] = select(mask, arrived, valid)
    fresh = flight.block_fresh[block]
    flight.block_fresh[block] = select(mask & (arrived > 0.0), 1.0, fresh)


@kernel
def deliver_arrived(flight, work, block, mask):
    """Replace the numbers that have just been measured by those that arrived last."""
    values = flight.measurement[block]
    for i in range(3):
        values[i] = select(mask, work.arrived[block, i], values[i])


@kernel
def begin_sample(flight, work, settings, sensor, mask):
    """Invalidate the blocks of the last sample, and keep their numbers if there are delays."""
    first = FIRST_BLOCK[sensor]
    for i in range(settings.sensor_blocks[sensor]):
        flight.block_valid[first + i] = select(mask, 0.0, flight.block_valid[first + i])
        if settings.sensor_delay[sensor] > 0:
            for n in range(3):
                work.arrived[first + i, n] = flight.measurement[first + i, n]


@kernel
def deliver(flight, work, settings, sensor, mask, due):
    """Deliver the measurement of a sensor in the lanes `due`, now or after its latency."""
    first, count = FIRST_BLOCK[sensor], settings.sensor_blocks[sensor]
    if settings.sensor_delay[sensor] == 0:
        for block in range(first, first + count):
            new = due & (flight.block_valid[block] > 0.0)
            flight.block_fresh[block] = select(new, 1.0, flight.block_fresh[block])
    elif any_of(due | find_arrivals(flight, work, settings, sensor, mask)):
        taken, under_way = stamp(flight, settings, sensor, mask), settings.under_way[sensor]
        for i in range(count):
            exchange(flight, work, first + i, under_way, mask, taken)
            deliver_arrived(flight, work, first + i, mask)


# --------------------------------------------------------------------------------------------------
# The stage of a sensor, composed of the sensor's kernels.
# --------------------------------------------------------------------------------------------------


class ReadingModel(NamedTuple):
    """How a filter uses a reading of a sensor."""

    expect: Any
    """`(flight, p, work, settings, i, k, valid)`: fill the rows of block i, from k on, in these
    lanes"""
    reset: Any
    """`(flight, p, work, settings, states, lanes, alone, nu)`: reset states to the reading in
    `lanes`, those of the vehicle where it is `alone`, by the innovation nu; of several blocks, by
    the largest ones"""


@kernel
def _cannot_align(flight, p, work, settings, mask):
    """Placeholder for sensors that observe no heading; never called."""


@kernel
def _expect_nothing(flight, p, work, settings, k):
    """End of a sensor's readings."""


@kernel
def _reset_nothing(flight, p, work, settings):
    """End of a sensor's readings."""


def _of_readings(sensor: int, readings: Sequence[ReadingModel]) -> tuple[Any, Any]:
    """Return kernels that fill the rows of all readings, and that reset states to them."""
    expect_rest, reset_rest = _expect_nothing, _reset_nothing
    for number, reading in reversed(list(enumerate(readings))):
        group = FIRST_GROUP[sensor] + number
        expect_rest = _expecting(sensor, group, reading.expect, expect_rest)
        reset_rest = _resetting(sensor, group, reading.reset, reset_rest)
    return expect_rest, reset_rest


def _expecting(sensor: int, group: int, expect: Any, rest: Any) -> Any:
    """Return a kernel that fills the rows of a reading and of the rest, from k on."""
    first, alone = GROUP_BLOCK[group], GROUP_COUNT[sensor] == 1

    @kernel
    def expect_valid(flight, p, work, settings, k):  # type: ignore[no-untyped-def]
        for i in range(settings.sensor_blocks[sensor] if alone else 1):
            valid = flight.block_valid[first + i] > 0.0
            if any_of(valid):
                expect(flight, p, work, settings, i, k, valid)
                k += 3
        rest(flight, p, work, settings, k)

    return expect_valid


def _resetting(sensor: int, group: int, reset: Any, rest: Any) -> Any:
    """Return a kernel that resets states to a reading and to the rest."""
    first, several = GROUP_BLOCK[group], MOST_BLOCKS[group] > 1

    @kernel
    def reset_states(flight, p, work, settings):  # type: ignore[no-untyped-def]
        lanes, alone, states = work.reset[group], work.alone[group], D + settings.slow_states
        nu = load3(flight.innovation[first])
        if several:
            nu = _largest(flight, first, settings.sensor_blocks[sensor])
        reset(flight, p, work, settings, states, lanes > 0.0, alone > 0.0, nu)
        rest(flight, p, work, settings)

    return reset_states


@kernel
def _largest(flight, first, count):
    """Magnitudes of the largest innovations among the valid blocks of a sensor."""
    zero = zero_like(flight.tick)
    largest = (zero, zero, zero)
    for block in range(first, first + count):
        nu, valid = load3(flight.innovation[block]), flight.block_valid[block] > 0.0
        size = (abs(nu[0]), abs(nu[1]), abs(nu[2]))
        largest = (
            maximum(largest[0], select(valid, size[0], zero)),
            maximum(largest[1], select(valid, size[1], zero)),
            maximum(largest[2], select(valid, size[2], zero)),
        )
    return largest


def sensor_stage(
    sensor: Sensor, begin: Any, sample: Any, *readings: ReadingModel, align: Any = _cannot_align
) -> Any:
    """Make the stage of a sensor; its flag is an `Act`, and an argument times `ACTS`.

    Args:
        sensor: The sensor.
        begin: `(flight, p, settings, mask)`: begin an episode: clock and constant errors.
        sample: `(flight, world, settings, work, stages, mask, starting)`: measure when due, and
            deliver; see `sample_of`.
        readings: What the filter does with its readings, in their order.
        align: `(flight, p, work, settings, mask)`: initialize the heading.
    """
    expect, reset = _of_readings(int(sensor), readings)

    def call(flight, world, model, settings, work, stages, flag):  # type: ignore[no-untyped-def]
        act, argument, mask = flag % ACTS, flag // ACTS, work.mask > 0.0
        if act == Act.BEGIN:
            begin(flight, world, settings, mask)
        elif act == Act.SAMPLE:
            sample(flight, world, settings, work, stages, mask, argument > 0)
            work.mask = select(mask, 1.0, 0.0)
        elif act == Act.EXPECT:
            expect(flight, model, work, settings, argument)
        elif act == Act.RESET:
            reset(flight, model, work, settings)
        else:
            align(flight, model, work, settings, mask)

    call.__name__ = call.__qualname__ = f"{sensor.name.lower()}_stage"  # for caches and messages
    return stage(call)


@kernel
def _never_first(flight, p, settings, mask):
    """Sensors that do not initialize a filter: return False."""
    return False


@kernel
def _change_nothing(flight, p, settings, work, stages, due):
    """Sensors without further limits and faults."""


@kernel
def _disturb_nothing(flight, settings, numbers, due):
    """Sensors without a fault of their numbers."""
    return numbers


def sample_of(
    sensor: Sensor,
    measure: Any,
    when: Any,
    first: Any = _never_first,
    change: Any = _change_nothing,
    disturb: Any = _disturb_nothing,
) -> Any:
    """Return the kernel of a sensor of one reading that measures when due, and delivers.

    Args:
        sensor: The sensor.
        measure: `(flight, p, i) -> numbers, within`: three numbers that block i measures now, zero
            beyond its own, and the lanes in which it can measure.
        when: `(flight, p, settings, mask, starting) -> due`: advance clock and errors; return the
            lanes in which it measures now.
        first: `(flight, p, settings, mask) -> bool`: measure for a filter's start; return False if
            the filter does not start with this sensor.
        change: `(flight, p, settings, work, stages, due)`: limits and faults of what was measured.
        disturb: `(flight, settings, numbers, due) -> numbers`: a fault of the numbers.
    """
    number, block = int(sensor), FIRST_BLOCK[sensor]

    @kernel
    def sample(flight, p, settings, work, stages, mask, starting):  # type: ignore[no-untyped-def]
        due = when(flight, p, settings, mask, starting)
        if starting and first(flight, p, settings, mask):
            return
        begin_sample(flight, work, settings, number, mask)
        if any_of(due):
            for i in range(settings.sensor_blocks[number]):
                (x, y, z), within = measure(flight, p, i)
                taken = due & within
                if settings.faults:
                    x, y, z = disturb(flight, settings, (x, y, z), taken)
                valid = flight.block_valid[block + i]
                keep(flight.measurement[block + i], taken, (x, y, z))
                flight.block_valid[block + i] = select(taken, 1.0, valid)
            change(flight, p, settings, work, stages, due)
        deliver(flight, work, settings, number, mask, due)

    return sample


# --------------------------------------------------------------------------------------------------
# Errors and stages of the sensors with parameters in the fields `aid_...`.
#
# A sensor has one block of up to three numbers, or several. It may have Gauss-Markov errors of
# three numbers and of one, and constant errors of scale and alignment.
# --------------------------------------------------------------------------------------------------


@kernel
def _begin(flight, p, settings, s, mask):
    """Begin an episode of sensor s of `Aid`, in the lanes `mask`: draw its errors, set its clock.

    A warm start uses the normals of slow errors, too, see `filter/starts.py`.
    """
    stream = stream_of(flight)
    k = settings.aid_vector[s]
    if k >= 0:
        for i in range(3):
            _, n = normal_pair(stream, DRAW_SLOW + k + i)
            error = p.aid_vector_sigma[s] * n
            flight.aid_vector[s, i] = select(mask, error, flight.aid_vector[s, i])
    k = settings.aid_scalar[s]
    if k >= 0:
        _, n = normal_pair(stream, DRAW_SLOW + k)
        flight.aid_scalar[s] = select(mask, p.aid_scalar_sigma[s] * n, flight.aid_scalar[s])
    share, _ = uniform_pair(stream, DRAW_AID_PHASE[s])
    begin_clock(flight, settings, FIRST_AID + s, share, mask)


@kernel
def draw_matrix(flight, p, s, mask):
    """Draw the errors of scale and alignment of sensor s, in the lanes `mask`."""
    stream, z = stream_of(flight), p.aid_matrix_sigma[s]
    a, b = normal_pair(stream, DRAW_AID_MATRIX[s])
    c, d = normal_pair(stream, DRAW_AID_MATRIX[s] + 1)
    e, f = normal_pair(stream, DRAW_AID_MATRIX[s] + 2)
    g, h = normal_pair(stream, DRAW_AID_MATRIX[s] + 3)
    i, _ = normal_pair(stream, DRAW_AID_MATRIX[s] + 4)
    keep(flight.aid_matrix[s], mask, z * ((a, b, c), (d, e, f), (g, h, i)))


@kernel
def _due(flight, p, settings, s, mask, starting):
    """Lanes in which sensor s measures now; advances its clock and its Gauss-Markov errors."""
    due = tick_clock(flight, settings, FIRST_AID + s, mask)
    if not starting and any_of(due):
        n, _ = normal_pair(stream_of(flight), DRAW_AID_DRIFT[s])
        error = p.aid_scalar_decay[s] * flight.aid_scalar[s] + p.aid_scalar_drive[s] * n
        flight.aid_scalar[s] = select(due, error, flight.aid_scalar[s])
        if any_of(p.aid_vector_drive[s] > 0.0):
            for i in range(3):
                n, _ = normal_pair(stream_of(flight), DRAW_AID_VECTOR[s] + i)
                last = flight.aid_vector[s, i]
                error = p.aid_vector_decay[s] * last + p.aid_vector_drive[s] * n
                flight.aid_vector[s, i] = select(due, error, last)
    return due


def aid_stage(
    aid: Aid,
    measure: Any,
    expect: Any,
    reset: Any,
    draw: Any = None,
    align: Any = _cannot_align,
    disturb: Any = None,
) -> Any:
    """Make the stage of a sensor with parameters in the fields `aid_...`.

    Args:
        aid: The sensor.
        measure: As in `sample_of`.
        expect: As in `ReadingModel`.
        reset: As in `ReadingModel`.
        draw: `(flight, p, mask)`: draw further constant errors of an episode; optional.
        align: As in `sensor_stage`; optional.
        disturb: As in `sample_of`; optional.
    """
    s, sensor, loss = int(aid), FIRST_AID + int(aid), int(LOSSES[aid])
    first, draw, disturb = AID_BLOCK[s], draw or _draw_nothing, disturb or _disturb_nothing

    @kernel
    def begin(flight, p, settings, mask):  # type: ignore[no-untyped-def]
        _begin(flight, p, settings, s, mask)
        draw(flight, p, mask)

    @kernel
    def when(flight, p, settings, mask, starting):  # type: ignore[no-untyped-def]
        due = _due(flight, p, settings, s, mask, starting)
        if settings.faults:
            due = due & (flight.fault_active[loss] <= 0.0)
        return due

    @kernel
    def measure_first(flight, p, settings, mask):  # type: ignore[no-untyped-def]
        if settings.heading_sensor != sensor or settings.warm != 0:
            return False
        # it initializes the filter, which uses it only once
        (x, y, z), _ = measure(flight, p, 0)
        keep(flight.measurement[first], mask, (x, y, z))
        flight.block_fresh[first] = select(mask, 1.0, flight.block_fresh[first])
        return True

    sample = sample_of(Sensor[aid.name], measure, when, first=measure_first, disturb=disturb)
    return sensor_stage(Sensor[aid.name], begin, sample, ReadingModel(expect, reset), align=align)


@kernel
def _draw_nothing(flight, p, mask):
    """Placeholder for sensors without further constant errors."""

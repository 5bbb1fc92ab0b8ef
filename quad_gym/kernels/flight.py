"""One flight: the stages of a tick and of an episode's beginning, and gathered updates.

A tick is one IMU sample: control on the observed state, motion of the true state, prediction with
the tick's sample (taken at its start or, if samples are averages, over the tick), drift of the
biases, then measurements and the update at its end.

The lists name slots of the table of stages. The settings determine the function in each slot, or
leave it empty, see `SOURCES` in `kernels/stages.py`.
"""

import numpy as np

from quad_gym.kernels.compiling import Stage, call_stage, kernel, routine
from quad_gym.kernels.filter.measurements import call_sensor, call_sensors
from quad_gym.kernels.numbers.blocks import (
    array_at,
    gather_lanes,
    lanes_at,
    numbers_of,
    record_at,
    scatter_lanes,
)
from quad_gym.kernels.numbers.lanes import any_of, select, zero_like
from quad_gym.kernels.numbers.linalg import load3, norm
from quad_gym.kernels.task.reference import evaluate_reference
from quad_gym.records import (
    DELAY_SLOTS,
    FIRST_BLOCK,
    FLIGHT_BLOCK,
    KINDS,
    MAX_BLOCKS,
    REAL_BYTES,
    SENSORS,
    STAMP,
    WIDTH,
    WORK_BLOCK,
    Act,
    Call,
)

# --------------------------------------------------------------------------------------------------
# One flight: the stages of a tick, and the stages of an episode's beginning.
# --------------------------------------------------------------------------------------------------

_ONE, _TICKS_OF_EPISODE = np.uint64(1), np.uint64(2**32 - 1)


@kernel
def run(stage, here, flag=0):
    """Run a stage on a flight; `here` holds the arguments of all stages except `flag`."""
    flight, world, model, settings, work, stages = here
    call_stage(stages, stage, flight, world, model, settings, work, flag)


@kernel
def move_and_measure(flight, world, model, settings, work, stages, within):
    """Fly a tick up to its measurements, before `update` and `look`.

    Args:
        flight: Record.
        world: True parameters.
        model: Parameters that filter and controller assume.
        settings: Options of the batch.
        work: Workspace.
        stages: Table of stages.
        within: 1 if the tick ends within a control period, where only inner loops observe; else 0.
    """
    here = (flight, world, model, settings, work, stages)
    work.mask = 1.0
    run(Stage.DELAY_ACTION, here)
    run(Stage.CONTROL, here)
    run(Stage.SUPPLY, here)
    flight.instant = flight.instant + _ONE
    run(Stage.KEEP_START, here)
    run(Stage.MOVE, here)
    run(Stage.REST_ON_PAD, here)
    run(Stage.STAND, here)
    run(Stage.TOUCH, here)
    if settings.run_filter:
        run(Stage.AVERAGE_IMU, here)
        run(Stage.PREDICT, here)
        run(Stage.INCREMENT, here)
        run(Stage.DRIFT_BIASES, here)
    flight.tick = flight.tick + 1.0
    run(Stage.FOLLOW, here, within)
    run(Stage.ADVANCE_FAULTS, here)
    if settings.run_filter:
        run(Stage.SAMPLE, here)
        call_sensors(flight, world, model, settings, work, stages, Act.SAMPLE, 0)


@kernel
def update(here):
    """Update the filter with the measurements of a tick, where `work.mask`."""
    _, _, _, settings, _, _ = here
    if settings.late and settings.rewinds:
        run(Stage.LATE_UPDATE, here)
    else:
        run(Stage.UPDATE, here)


@kernel
def look(flight, world, model, settings, work, stages, within):
    """Set the observed state at the end of a tick; `within` as for `move_and_measure`."""
    here = (flight, world, model, settings, work, stages)
    work.mask = 1.0
    run(Stage.LOOK, here, within)
    run(Stage.SUM_IMU, here)


@kernel
def begin_episode(flight, nominal, world, model, settings, work, stages, mask):
    """Begin a new episode, where `mask`: reference, true state, first measurements, filter.

    The flights' own parameters, in `world`, are drawn around the `nominal` ones according to the
    settings. Each episode has its own instants, so that its draws do not depend on the length of
    the previous one.
    """
    here = (flight, world, model, settings, work, stages)
    instant = (flight.instant | _TICKS_OF_EPISODE) + _ONE
    flight.instant = select(mask, instant, flight.instant)
    flight.tick = select(mask, 0.0, flight.tick)
    work.mask = select(mask, 1.0, 0.0)
    run(Stage.DRAW, (flight, world, nominal, settings, work, stages))
    run(Stage.IMPOSE, (flight, world, nominal, settings, work, stages))
    run(Stage.PLACE_FEATURES, here, 1)
    run(Stage.DELAY_ACTION, here, 1)
    run(Stage.BEGIN_LATE, here)
    run(Stage.BEGIN, here)
    run(Stage.BEGIN_IMPERFECT, here)
    call_sensors(flight, world, model, settings, work, stages, Act.BEGIN, 0)
    run(Stage.BEGIN_FAULTS, here)
    run(Stage.BEGIN_IN_AIR, here)  # after the faults, which restore a rotor lost before
    run(Stage.BEGIN_GROUND, here)
    run(Stage.BEGIN_CONTACTS, here)
    run(Stage.SAMPLE, here, 1)
    call_sensors(flight, world, model, settings, work, stages, Act.SAMPLE, 1)
    run(Stage.ALIGN, here)
    run(Stage.WARM, here)
    if not settings.warm and settings.heading_sensor >= 0:
        sensor = settings.heading_sensor
        call_sensor(flight, world, model, settings, work, stages, sensor, Act.ALIGN, 0)
    run(Stage.UPDATE, here)
    run(Stage.LOOK, here)
    r_ref, _, _, _ = evaluate_reference(flight, zero_like(flight.tick), settings.harmonics)
    error = norm(r_ref - load3(flight.r))
    flight.position_error = select(mask, error, flight.position_error)


# --------------------------------------------------------------------------------------------------
# Filter updates of several blocks, only for lanes with a measurement.
#
# Sensors of different flights measure at different instants, so that at most ticks few lanes of a
# block have a measurement, while an update costs the same for one lane as for all. Lanes of several
# blocks are therefore gathered into one: the words that an update reads (`records/layout.py`) are
# copied to a block of scratch memory, and the words that it writes are copied back. Lanes do not
# affect each other, so results are unchanged.
#
# A queue, `kind`, has the addresses of its lanes' first words (`source`) and of their blocks
# (`source_block`). `plain` is a record whose fields have an axis of lanes, to read one lane of it:
# other code sees the same memory as lanes.
# --------------------------------------------------------------------------------------------------

_MANY = 6 * WIDTH // 8
"""Smallest number of lanes with a measurement for which a block is updated in place."""

QUEUE_ORDER = (*range(2, KINDS, 2), *range(1, KINDS, 2))
"""Sets of sensors in the order of the updates of their waiting lanes: the first sensor's last."""

_flight_at, _plain_flight_at = lanes_at(FLIGHT_BLOCK), record_at(FLIGHT_BLOCK)
_plain_work_at = record_at(WORK_BLOCK)
_words_at = array_at("u8")


@kernel
def block_address(call, index):
    """The address of a block."""
    return call[Call.BLOCKS] + index * call[Call.PITCH]


@kernel
def _kind(flight, settings):
    """Return the sensors with a measurement in each lane: a bit for each; 0: none."""
    kind, bit = zero_like(flight.tick), 1.0
    for sensor in range(SENSORS):
        first, valid = FIRST_BLOCK[sensor], zero_like(kind)
        for block in range(first, first + settings.sensor_blocks[sensor]):
            valid = valid + flight.block_valid[block]
        kind = kind + select(valid > 0.0, bit, 0.0)
        bit = 2.0 * bit
    return kind


@kernel
def _gather_stamps(gathered, k, flight, lane, settings):
    """Copy the time stamps of one lane's arriving measurements to lane k."""
    for sensor in range(SENSORS):
        if settings.sensor_delay[sensor] > 0:
            tick = flight.tick[lane] - settings.sensor_delay[sensor]
            gathered.stamps[sensor, 0, 0, k] = np.nan
            for slot in range(DELAY_SLOTS):
                if flight.stamps[sensor, slot, 0, lane] == tick:
                    for i in range(STAMP):
                        value = flight.stamps[sensor, slot, i, lane]
                        gathered.stamps[sensor, 0, i, k] = value


@routine
def _update_gathered(call, kind, model, settings, work, stages):
    """Update the lanes of a queue, in place if all are in one block, and empty the queue."""
    plain = _plain_work_at(call[Call.WORK])
    source, block, count = plain.source[kind], plain.source_block[kind], plain.queued[kind, 0]
    plain.queued[kind, 0] = 0
    together = 0
    for k in range(count):
        together += int(block[k] == block[0])
    if together == count:
        work.mask = 0.0
        for k in range(count):
            plain.mask[(source[k] - block[0]) // REAL_BYTES] = 1.0
        update((_flight_at(block[0]), model, model, settings, work, stages))
        return
    words = _words_at(call[Call.WORDS], call[Call.WORD_COUNT])
    gathered = _plain_flight_at(call[Call.GATHERED])
    for k in range(WIDTH):
        if k >= count:  # copied from and to itself
            source[k] = call[Call.GATHERED] + REAL_BYTES * k
            for i in range(MAX_BLOCKS):
                gathered.block_valid[i, k] = 0.0
        else:
            lane = (source[k] - block[k]) // REAL_BYTES
            gathered.filter_status[k] = _plain_flight_at(block[k]).filter_status[lane]
            if settings.late:
                _gather_stamps(gathered, k, _plain_flight_at(block[k]), lane, settings)
        plain.mask[k] = 1.0 if k < count else 0.0
    sources, inside = work.source[kind], numbers_of(_flight_at(call[Call.GATHERED]))
    for i in range(call[Call.WORD_COUNT]):
        inside[words[i] // WIDTH] = gather_lanes(sources, REAL_BYTES * words[i])
    update((_flight_at(call[Call.GATHERED]), model, model, settings, work, stages))
    for i in range(call[Call.WRITTEN_COUNT]):
        scatter_lanes(sources, REAL_BYTES * words[i], inside[words[i] // WIDTH])
    for k in range(count):
        lane = (source[k] - block[k]) // REAL_BYTES
        _plain_flight_at(block[k]).filter_status[lane] = gathered.filter_status[k]


@kernel
def _put(call, kind, address, block, model, settings, work, stages):
    """Append a lane to a queue, whose lanes are updated when it is full."""
    plain = _plain_work_at(call[Call.WORK])
    count = plain.queued[kind, 0]
    plain.source[kind, count], plain.source_block[kind, count] = address, block
    plain.queued[kind, 0] = count + 1
    if count + 1 == WIDTH:
        _update_gathered(call, kind, model, settings, work, stages)


@routine
def update_soon(call, index, model, settings, work, stages):
    """Update a block that has flown a tick, or let its lanes wait until their queues are full.

    The cost of an update grows with the number of sensors that any of its lanes has measurements
    from. Lanes with equal sets of sensors therefore share a queue. The blocks of a full queue have
    flown shortly before, so that their records are still in the cache.
    """
    plain, block = _plain_work_at(call[Call.WORK]), block_address(call, index)
    flight = _flight_at(block)
    work.kind = _kind(flight, settings)
    if any_of(work.kind > 0.0):
        same = 0
        for lane in range(WIDTH):
            same += int(plain.kind[lane] > 0.0)
        if same >= _MANY:
            work.mask = 1.0
            update((flight, model, model, settings, work, stages))
        else:
            for lane in range(WIDTH):
                kind = int(plain.kind[lane])
                if kind > 0:
                    _put(
                        call, kind, block + REAL_BYTES * lane, block, model, settings, work, stages
                    )


@routine
def update_waiting(call, model, settings, work, stages):
    """Update the lanes that wait, those of different queues together."""
    plain = _plain_work_at(call[Call.WORK])
    for kind in QUEUE_ORDER:
        for k in range(plain.queued[kind, 0]):
            source, block = plain.source[kind, k], plain.source_block[kind, k]
            _put(call, 0, source, block, model, settings, work, stages)
        plain.queued[kind, 0] = 0
    if plain.queued[0, 0] > 0:
        _update_gathered(call, 0, model, settings, work, stages)

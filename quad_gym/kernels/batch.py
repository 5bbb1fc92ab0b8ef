"""Compiled entry that steps or resets the blocks of a batch."""

import numpy as np

from quad_gym.kernels import entries
from quad_gym.kernels.board import add_shared, comes, finished, post, read_shared, take
from quad_gym.kernels.compiling import Stage, call_stage, entry, kernel
from quad_gym.kernels.compiling.signatures import signature_of
from quad_gym.kernels.flight import (
    begin_episode,
    block_address,
    look,
    move_and_measure,
    run,
    update,
    update_soon,
    update_waiting,
)
from quad_gym.kernels.numbers.blocks import (
    array_at,
    lanes_at,
    prefetch,
    record_at,
    store_lanes,
    store_tile,
)
from quad_gym.kernels.numbers.lanes import all_of, any_of, logical_not, no_lane, select
from quad_gym.kernels.stages import STAGE_TABLE
from quad_gym.records import (
    EXCHANGE_BLOCK,
    FIRST_BLOCK,
    FLIGHT_BLOCK,
    PARAMS_BLOCK,
    REGISTER,
    SENSORS,
    SETTINGS,
    SHOWN_SIZE,
    WIDTH,
    WORK_BLOCK,
    Autoreset,
    Call,
    Command,
    Layout,
    Result,
    RewardTerm,
    offset_of,
)
from quad_gym.records.call import COMMAND, FINISHED, TICKET

_TERMS, _FIRST_TERM, _EXCHANGE_PITCH = len(RewardTerm), len(Result), EXCHANGE_BLOCK.itemsize
_CALL_WORDS = len(Call)
_CORE = offset_of(FLIGHT_BLOCK, "r")
_TICKED = offset_of(FLIGHT_BLOCK, "ref_cos") - _CORE
"""Bytes of the fields that every step needs, which come first in a record's core."""

_flight_at, _plain_flight_at = lanes_at(FLIGHT_BLOCK), record_at(FLIGHT_BLOCK)
_exchange_at, _params_at = lanes_at(EXCHANGE_BLOCK), lanes_at(PARAMS_BLOCK)
_work_at, _plain_work_at = lanes_at(WORK_BLOCK), record_at(WORK_BLOCK)
_settings_at, _stages_at = record_at(SETTINGS), record_at(STAGE_TABLE)
_floats_at, _singles_at, _bytes_at = array_at("f8"), array_at("f4"), array_at("u1")
_words_at = array_at("i8")


@kernel
def _observe(call, flight, world, model, settings, work, stages):
    """Compute the observation of the present instant, clipped to the bounds of the space."""
    call_stage(stages, Stage.OBSERVE, flight, world, model, settings, work, 0)
    size = call[Call.SIZE]
    low, high, row = (
        _floats_at(call[Call.LOW], size),
        _floats_at(call[Call.HIGH], size),
        work.observation,
    )
    for k in range(size):
        value = row[k]
        value = select(value > low[k], value, low[k])  # also where it is NaN
        row[k] = select(value < high[k], value, high[k])


@kernel
def _write_rows(call, address, index, work, chosen):
    """Copy observations from the workspace to the rows of an array, where `chosen`."""
    size, first = call[Call.SIZE], index * WIDTH + call[Call.LANE]
    pitch = 4 * size
    address = address + first * pitch
    if all_of(chosen) and first + REGISTER <= call[Call.COUNT] and size >= REGISTER:
        for k in range(0, size - REGISTER, REGISTER):
            store_tile(address + 4 * k, pitch, work.observation, k)
        k = size - REGISTER
        store_tile(address + 4 * k, pitch, work.observation, k)
    else:
        work.begins = select(chosen, 1.0, 0.0)
        plain = _plain_work_at(call[Call.WORK])
        for lane in range(min(REGISTER, call[Call.COUNT] - first)):
            if plain.begins[lane] > 0.0:
                row = _singles_at(address + lane * pitch, size)
                for k in range(size):
                    row[k] = plain.observation[k, lane]


@kernel
def _load_actions(call, flight, index):
    """Store the present actions as the last ones, and the caller's actions as the present ones."""
    block = _plain_flight_at(block_address(call, index))
    rows = _floats_at(call[Call.ACTIONS] + index * (32 * WIDTH), 4 * WIDTH)
    for i in range(4):
        flight.last_action[i] = flight.action[i]
    for i in range(4):
        for lane in range(REGISTER):
            block.action[i, lane] = rows[4 * lane + i]


@kernel
def _write_results(call, flight, work, index):
    """Write the results of a step for the caller.

    They belong to the episode that ends, if one ends and the next begins in this step; in a step
    that only begins an episode, to its start.
    """
    here, pitch = call[Call.RESULTS] + index * (8 * WIDTH), call[Call.RESULT_PITCH]
    store_lanes(here + Result.REWARD * pitch, flight.reward)
    store_lanes(here + Result.TERMINATED * pitch, flight.terminated)
    store_lanes(here + Result.TRUNCATED * pitch, flight.truncated)
    store_lanes(here + Result.ENDING * pitch, flight.ending)
    store_lanes(here + Result.POSITION_ERROR * pitch, flight.position_error)
    store_lanes(here + Result.ESTIMATION_ERROR * pitch, flight.estimation_error)
    store_lanes(here + Result.EPISODE_STEPS * pitch, flight.step)
    store_lanes(here + Result.EPISODE_RETURN * pitch, flight.episode_return)
    store_lanes(here + Result.EPISODE_ERROR_SUM * pitch, flight.episode_error)
    store_lanes(here + Result.GATES_PASSED * pitch, flight.gate_next)
    store_lanes(here + Result.FAULTS * pitch, flight.faults)
    store_lanes(here + Result.FILTER_DIVERGED * pitch, flight.diverged)
    for k in range(_TERMS):
        store_lanes(here + (_FIRST_TERM + k) * pitch, work.reward_term[k])
    store_lanes(here + Result.FILTER_STATUS * pitch, flight.filter_status)


@kernel
def _show(call, index, flight, world, model, settings, work, stages):
    """Write the numbers of the present instant that a user's task reads."""
    call_stage(stages, Stage.SHOW, flight, world, model, settings, work, 0)
    here, pitch = call[Call.SHOWN] + index * (8 * WIDTH), call[Call.SHOWN_PITCH]
    for k in range(SHOWN_SIZE):
        store_lanes(here + k * pitch, work.observation[k])


@kernel
def _fetch_ahead(call, index, settings, left):
    """Prefetch a tick's share of the next block, which is not in the cache in large batches."""
    ticks, line = settings.ticks_per_step, 8 * WIDTH
    share = (_TICKED // line + ticks) // ticks * line
    begin = block_address(call, index + 1) + _CORE + left * share
    for k in range(0, share, line):
        prefetch(begin + k)


@kernel
def _begin_step(call, index, settings):
    """Load the actions of a step, and clear the flags and sums of the last step's measurements."""
    flight = _flight_at(block_address(call, index))
    _load_actions(call, flight, index)
    for sensor in range(SENSORS):
        for k in range(settings.sensor_blocks[sensor]):
            flight.block_fresh[FIRST_BLOCK[sensor] + k] = 0.0
    if settings.run_filter and settings.layout == Layout.MEASUREMENTS:
        for i in range(3):
            flight.gyro_sum[i] = flight.accel_sum[i] = 0.0


@kernel
def _fly_ticks(call, first, last, world, model, settings, work, stages):
    """Fly the ticks of a step, tick by tick for the blocks from `first` to before `last`."""
    for left in range(settings.ticks_per_step - 1, -1, -1):
        within = min(left, 1)
        for index in range(first, last):
            flight = _flight_at(block_address(call, index))
            _fetch_ahead(call, index, settings, left)
            move_and_measure(flight, world, model, settings, work, stages, within)
            if call[Call.GROUP] > 1:
                update_soon(call, index, model, settings, work, stages)
            elif settings.run_filter:
                update((flight, world, model, settings, work, stages))
        if call[Call.GROUP] > 1:
            update_waiting(call, model, settings, work, stages)
        for index in range(first, last):
            flight = _flight_at(block_address(call, index))
            look(flight, world, model, settings, work, stages, within)


@kernel
def _give_samples(call, index, flight):
    """Copy the IMU sample of a block for the user's estimator."""
    exchange = _exchange_at(call[Call.EXCHANGE] + index * _EXCHANGE_PITCH)
    for i in range(3):
        exchange.gyro[i], exchange.accel[i] = flight.gyro[i], flight.accel[i]
        exchange.w_meas[i] = flight.w_meas[i]


@kernel
def _copy_estimate(of, to):
    """Copy the estimate of a block between its record and the exchange with a user's estimator."""
    for i in range(3):
        to.r_hat[i], to.v_hat[i] = of.r_hat[i], of.v_hat[i]
        to.b_a_hat[i], to.b_g_hat[i] = of.b_a_hat[i], of.b_g_hat[i]
        to.w_hat[i] = of.w_hat[i]
        for j in range(3):
            to.R_hat[i, j] = of.R_hat[i, j]


@kernel
def _take_estimate(call, index, flight):
    """Copy the estimate of a block from the user's estimator."""
    _copy_estimate(_exchange_at(call[Call.EXCHANGE] + index * _EXCHANGE_PITCH), flight)


@kernel
def _fly_tick(call, first, last, left, world, model, settings, work, stages):
    """Observe the user's estimate of the last tick, then fly one up to its measurements.

    `left`: number of ticks after it in the control period.
    """
    for index in range(first, last):
        flight = _flight_at(block_address(call, index))
        if left < settings.ticks_per_step - 1:
            _take_estimate(call, index, flight)
            look(flight, world, model, settings, work, stages, 1)
        move_and_measure(flight, world, model, settings, work, stages, min(left, 1))
        _give_samples(call, index, flight)


@kernel
def _judge_step(call, flight, world, model, settings, work, stages):
    """Set reward and endings of a step; return masks of lanes that begin and end an episode."""
    resetting = (flight.needs_reset > 0.0) & (call[Call.AUTORESET] == Autoreset.NEXT_STEP)
    # a step that only begins an episode uses no earlier draws
    before = flight.instant + np.uint64(-settings.ticks_per_step)
    flight.instant = select(resetting, before, flight.instant)
    work.mask = select(resetting, 0.0, 1.0)
    here = (flight, world, model, settings, work, stages)
    run(Stage.JUDGE, here)
    run(Stage.JUDGE_LANDING, here)
    run(Stage.JUDGE_CONTACTS, here)
    done = (flight.terminated + flight.truncated) > 0.0
    flight.needs_reset = select(done, 1.0, flight.needs_reset)
    same_step = call[Call.AUTORESET] == Autoreset.SAME_STEP
    return resetting | (done & (same_step | (flight.idle > 0.0))), done


@kernel
def _end_block(call, index, command, nominal, true, believed, settings, work, stages):
    """Reset the flights of one block, or set the results of the step that they have flown.

    `Command.LOOK` only observes again.
    """
    flight = _flight_at(block_address(call, index))
    observing, written = call[Call.SIZE] > 0, False
    begins = work.mask < 0.0  # none
    if command == Command.LOOK:
        _take_estimate(call, index, flight)
        work.mask = 1.0
        run(Stage.LOOK, (flight, true, believed, settings, work, stages))
    elif command == Command.RESET:
        resets, plain = (
            _bytes_at(call[Call.RESETS], call[Call.COUNT]),
            _plain_work_at(call[Call.WORK]),
        )
        first = index * WIDTH + call[Call.LANE]
        for lane in range(REGISTER):
            known = first + lane < call[Call.COUNT]
            plain.begins[lane] = resets[first + lane] if known else 1.0
        begins = work.begins > 0.0
    else:
        if command == Command.FINISH:
            _take_estimate(call, index, flight)
            look(flight, true, believed, settings, work, stages, 0)
        begins, done = _judge_step(call, flight, true, believed, settings, work, stages)
        if call[Call.AUTORESET] == Autoreset.SAME_STEP and any_of(begins):
            _write_results(call, flight, work, index)  # of the episodes that end
            written = True
        if observing and any_of(begins & done):
            _observe(call, flight, true, believed, settings, work, stages)
            _write_rows(call, call[Call.FINAL_OBSERVATIONS], index, work, begins & done)
    if any_of(begins):
        begin_episode(flight, nominal, true, believed, settings, work, stages, begins)
        if settings.own_estimator:
            _give_samples(call, index, flight)
            # the user's estimator begins some of its episodes with the built-in estimate
            exchange = _exchange_at(call[Call.EXCHANGE] + index * _EXCHANGE_PITCH)
            _copy_estimate(flight, exchange)
    if command != Command.RESET and command != Command.LOOK and not written:
        _write_results(call, flight, work, index)
    if observing:
        _observe(call, flight, true, believed, settings, work, stages)
        _write_rows(call, call[Call.OBSERVATIONS], index, work, logical_not(no_lane(flight.tick)))
    if settings.shown:
        _show(call, index, flight, true, believed, settings, work, stages)


@kernel
def _fly_group(call, first, last, command, nominal, true, believed, settings, work, stages):
    """Step or reset the flights of the blocks from `first` to before `last`.

    If flights have their own parameters, this is a single block.
    """
    left = command - Command.TICK
    for index in range(first, last):
        flight = _flight_at(block_address(call, index))
        run(Stage.IMPOSE, (flight, true, nominal, settings, work, stages))
        run(Stage.PLACE_FEATURES, (flight, true, believed, settings, work, stages))
        run(Stage.MEET_ROTORS, (flight, true, believed, settings, work, stages))
        if command == Command.STEP or left == settings.ticks_per_step - 1:
            _begin_step(call, index, settings)
    if command == Command.STEP:
        _fly_ticks(call, first, last, true, believed, settings, work, stages)
    if left >= 0:
        _fly_tick(call, first, last, left, true, believed, settings, work, stages)
        return
    for index in range(first, last):
        _end_block(call, index, command, nominal, true, believed, settings, work, stages)


@entry(signature=signature_of(entries.fly))
def fly(call_at, board_at, size, number, command, serving):
    """Step or reset the flights of a batch, together with the other threads of a board.

    Args:
        call_at: Address of the (len(Call),) arguments of this thread.
        board_at: Address of the words that the threads share, see `board.py`.
        size: Number of these words.
        number: Index of this thread; thread 0 posts steps.
        command: A `Command` to post (TICK: plus a number), unless `serving`; if negative, nothing
            is posted, and the thread waits for the last command.
        serving: True: fly the steps that thread 0 posts, until none comes for a while.

    Returns:
        True if all blocks are finished; False if another thread is still flying.
    """
    call, board = _words_at(call_at, _CALL_WORDS), _words_at(board_at, size)
    settings, work = _settings_at(call[Call.SETTINGS]), _work_at(call[Call.WORK])
    stages, nominal = _stages_at(call[Call.STAGES]), _params_at(call[Call.WORLD])
    differ = settings.randomized > 0 or settings.faults > 0
    true = _params_at(call[Call.OWN] if differ else call[Call.WORLD])
    model = call[Call.BELIEVED] if settings.features_drawn else call[Call.MODEL]
    believed = true if settings.known else _params_at(model)
    if not serving and command >= 0:
        post(board, command)
    while True:  # a single pass unless serving
        seen = read_shared(board, TICKET)
        while True:
            first, last = take(board, number)
            if first == last:
                break
            posted = read_shared(board, COMMAND)
            groups = (last - first - 1) // call[Call.GROUP] + 1
            group = (last - first - 1) // groups + 1
            for one in range(first, last, group):
                end = min(one + group, last)
                _fly_group(call, one, end, posted, nominal, true, believed, settings, work, stages)
            add_shared(board, FINISHED, last - first)
        if not serving:
            return finished(board)
        if not comes(board, number, seen):
            return True

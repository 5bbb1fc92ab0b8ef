"""The one entry that flies: a step, or a reset, of a range of blocks."""

import numpy as np
from numba import types
from numba.np.numpy_support import from_dtype

from quad_gym.kernels.compiling import Stage, call_stage, entry, kernel
from quad_gym.kernels.compiling.stages import STAGE_TABLE
from quad_gym.kernels.flight import begin_episode, tick
from quad_gym.kernels.mailbox import COMMAND, DONE, next_ticket
from quad_gym.kernels.simd.atomics import read_shared, write_shared
from quad_gym.kernels.simd.blocks import lanes_of
from quad_gym.kernels.simd.lanes import any_of, select
from quad_gym.records import (
    FLIGHT_BLOCK,
    PARAMS_BLOCK,
    SETTINGS,
    WIDTH,
    WORK_BLOCK,
    Autoreset,
    Command,
    Result,
)

_IMPOSE, _MEET_ROTORS = int(Stage.IMPOSE), int(Stage.MEET_ROTORS)
_JUDGE, _OBSERVE = int(Stage.JUDGE), int(Stage.OBSERVE)
_REWARD = int(Result.REWARD)
_TERMINATED = int(Result.TERMINATED)
_TRUNCATED = int(Result.TRUNCATED)
_ENDING = int(Result.ENDING)
_POSITION_ERROR = int(Result.POSITION_ERROR)
_ESTIMATION_ERROR = int(Result.ESTIMATION_ERROR)
_FILTER_STATUS = int(Result.FILTER_STATUS)
_EPISODE_STEPS = int(Result.EPISODE_STEPS)
_EPISODE_RETURN = int(Result.EPISODE_RETURN)
_EPISODE_ERROR_SUM = int(Result.EPISODE_ERROR_SUM)
_GATES_PASSED = int(Result.GATES_PASSED)
_FAULTS = int(Result.FAULTS)
_FILTER_LOST = int(Result.FILTER_LOST)


@kernel
def _write_rows(source, low, high, out, block, begins):
    """Copy observations from lanes to the rows of an array, held within the space's bounds."""
    first = block * WIDTH
    for lane in range(min(WIDTH, out.shape[0] - first)):
        if begins[lane] > 0.0:
            row = out[first + lane]
            for k in range(out.shape[1]):
                value = source[k, lane]
                value = value if value > low[k] else low[k]  # also where it is NaN
                row[k] = value if value < high[k] else high[k]


@kernel
def _load_actions(block, actions, index):
    """Make the caller's actions the present ones, and the present ones the last."""
    first = index * WIDTH
    for i in range(4):
        for lane in range(WIDTH):
            block.last_action[i, lane] = block.action[i, lane]
            known = first + lane < actions.shape[0]
            block.action[i, lane] = actions[first + lane, i] if known else 0.0


@kernel
def _write_results(block, results, index):
    """What the caller wants to know of a step, before a new episode overwrites it."""
    first = index * WIDTH
    for lane in range(min(WIDTH, results.shape[1] - first)):
        flight = first + lane
        results[_REWARD, flight] = block.reward[lane]
        results[_TERMINATED, flight] = block.terminated[lane]
        results[_TRUNCATED, flight] = block.truncated[lane]
        results[_ENDING, flight] = block.ending[lane]
        results[_POSITION_ERROR, flight] = block.position_error[lane]
        results[_ESTIMATION_ERROR, flight] = block.estimation_error[lane]
        results[_FILTER_STATUS, flight] = block.filter_status[lane]
        results[_EPISODE_STEPS, flight] = block.step[lane]
        results[_EPISODE_RETURN, flight] = block.episode_return[lane]
        results[_EPISODE_ERROR_SUM, flight] = block.episode_error[lane]
        results[_GATES_PASSED, flight] = block.gate_next[lane]
        results[_FAULTS, flight] = block.faults[lane]
        results[_FILTER_LOST, flight] = block.lost[lane]


@kernel
def _fly_step(flight, world, model, settings, work, stages):
    """Fly a control period and judge it; return which lanes begin and which ended an episode."""
    resetting = (flight.needs_reset > 0.0) & (settings.autoreset == Autoreset.NEXT_STEP)
    flight.position_fresh = 0.0
    flight.baseline_fresh = 0.0
    for i in range(settings.feature_count):
        flight.feature_fresh[i] = 0.0
    instant = flight.instant
    for _ in range(settings.ticks_per_step):
        tick(flight, world, model, settings, work, stages)
    # a step that begins an episode draws nothing before it
    flight.instant = select(resetting, instant, flight.instant)
    work.mask = select(resetting, 0.0, 1.0)
    call_stage(stages, _JUDGE, flight, world, model, settings, work, 0)
    done = (flight.terminated + flight.truncated) > 0.0
    flight.needs_reset = select(done, 1.0, flight.needs_reset)
    same_step = settings.autoreset == Autoreset.SAME_STEP
    return resetting | (done & (same_step | (flight.idle > 0.0))), done


def _array(kind, dimensions=1):
    return types.Array(from_dtype(np.dtype(kind)), dimensions, "C")


_ARGUMENTS = (
    _array(FLIGHT_BLOCK),
    types.int64,
    types.int64,
    _array(np.uint8),
    _array(PARAMS_BLOCK),
    _array(PARAMS_BLOCK),
    _array(PARAMS_BLOCK),
    _array(SETTINGS),
    _array(WORK_BLOCK),
    _array(STAGE_TABLE),
    _array(np.float64, 2),
    _array(np.float64),
    _array(np.float64),
    _array(np.float32, 2),
    _array(np.float32, 2),
    _array(np.float64, 2),
    _array(np.int64),
    types.int64,
)


@entry(signature=types.none(*_ARGUMENTS))
def fly(
    blocks,
    first_block,
    last_block,
    resets,
    world,
    own,
    model,
    settings,
    work,
    stage_table,
    actions,
    low,
    high,
    observations,
    final_observations,
    results,
    mailbox,
    serving,
):
    """Step or reset the flights of a range of blocks: once, or whenever a mailbox says so.

    Args:
        blocks: (n_blocks,) FLIGHT_BLOCK.
        first_block, last_block: The range, without its end.
        resets: (n,) uint8; for RESET, which flights begin an episode.
        world: (1,) PARAMS_BLOCK: parameters as they are.
        own: (1,) PARAMS_BLOCK, used by no other thread: a copy of `world`, where the parameters of
            the flights at hand are put together if they draw some, or if their rotors can fail.
        model: (1,) PARAMS_BLOCK: parameters as the filter and the controller believe them.
        settings: (1,) SETTINGS.
        work: (1,) WORK_BLOCK, used by no other thread.
        stage_table: (1,) STAGE_TABLE, which has the stages that the settings need.
        actions: (n, 4); for STEP.
        low, high: (n_observation,) bounds of the observation space.
        observations: (n, n_observation), written; with no columns nothing is observed.
        final_observations: Likewise, written where one episode ends and the next begins in this
            step.
        results: (len(RESULTS), n), written in a STEP: a row for each of `quad_gym.records.RESULTS`.
        mailbox: (WORDS,) of the thread that calls, see `mailbox.py`; has the `Command`.
        serving: 0: fly once; 1: fly the commands of the mailbox until it stays empty.
    """
    scratch, todo, nominal = lanes_of(work[0]), settings[0], lanes_of(world[0])
    stages = stage_table[0]
    differ = todo.randomized > 0 or todo.faults > 0
    true = lanes_of(own[0]) if differ else nominal
    believed = true if todo.known else lanes_of(model[0])
    observing = observations.shape[1] > 0
    while True:  # once, where nobody serves
        ticket = 0
        if serving:
            ticket = next_ticket(mailbox)
            if ticket == 0:
                return
        command = read_shared(mailbox, COMMAND)
        for index in range(first_block, last_block):
            block, flight = blocks[index], lanes_of(blocks[index])
            if todo.randomized:
                call_stage(stages, _IMPOSE, flight, true, nominal, todo, scratch, 0)
            if todo.faults:
                call_stage(stages, _MEET_ROTORS, flight, true, believed, todo, scratch, 0)
            if command == Command.RESET:
                for lane in range(WIDTH):
                    known = index * WIDTH + lane < resets.shape[0]
                    work[0].begins[lane] = resets[index * WIDTH + lane] if known else 1.0
                begins = scratch.begins > 0.0
            else:
                _load_actions(block, actions, index)
                begins, done = _fly_step(flight, true, believed, todo, scratch, stages)
                _write_results(block, results, index)
                if observing:
                    call_stage(stages, _OBSERVE, flight, true, believed, todo, scratch, 0)
                    scratch.begins = select(begins & done, 1.0, 0.0)
                    _write_rows(
                        work[0].observation, low, high, final_observations, index, work[0].begins
                    )
            beginning = any_of(begins)
            if beginning:
                begin_episode(flight, nominal, true, believed, todo, scratch, stages, begins)
            if observing:
                if beginning or command == Command.RESET:
                    call_stage(stages, _OBSERVE, flight, true, believed, todo, scratch, 0)
                scratch.begins = select(flight.tick >= 0.0, 1.0, 0.0)
                _write_rows(work[0].observation, low, high, observations, index, work[0].begins)
        if not serving:
            return
        write_shared(mailbox, DONE, ticket)

"""Rewards and endings of a user's task: written to results and records, over the built-in ones."""

import math
from enum import IntEnum, auto

from numba import types

from quad_gym.kernels.compiling import entry, kernel
from quad_gym.kernels.simd.addresses import array_at, record_at
from quad_gym.records import FLIGHT_BLOCK, SETTINGS, WIDTH, Call, Ending, Result

LARGEST_REWARD = 1e30
"""A larger one is a mistake; learning algorithms hold rewards in single precision."""


class Verdict(IntEnum):
    """The words that `settle` is called with: addresses of what a task has said of a step."""

    REWARDS = 0
    """(COUNT,) float64, changed; 0: the built-in rewards stay."""
    RETURNS = auto()
    """(COUNT,) float64: sums of rewards in the present episodes, written with the rewards."""
    TERMINATED = auto()
    """(COUNT,) bool; 0: the built-in judgment stays."""
    TRUNCATED = auto()
    """Likewise."""
    BEGAN = auto()
    """(COUNT,) bool: episodes that have just begun, which nobody is asked about."""


_REWARD, _EPISODE_RETURN = int(Result.REWARD), int(Result.EPISODE_RETURN)
_TERMINATED, _TRUNCATED = int(Result.TERMINATED), int(Result.TRUNCATED)
_ENDING = int(Result.ENDING)
_FILTER_STATUS, _FILTER_DIVERGED = int(Result.FILTER_STATUS), int(Result.FILTER_DIVERGED)
_TASK, _TIME_LIMIT = float(Ending.TASK), float(Ending.TIME_LIMIT)
_FAILED, _LOST = float(Ending.FILTER_FAILED), float(Ending.FILTER_DIVERGED)

_BLOCKS, _PITCH, _COUNT = int(Call.BLOCKS), int(Call.PITCH), int(Call.COUNT)
_RESULTS, _RESULT_PITCH, _SETTINGS = int(Call.RESULTS), int(Call.RESULT_PITCH), int(Call.SETTINGS)
_REWARDS, _RETURNS = int(Verdict.REWARDS), int(Verdict.RETURNS)
_TERMINATES, _TRUNCATES = int(Verdict.TERMINATED), int(Verdict.TRUNCATED)
_BEGAN = int(Verdict.BEGAN)

_flight_at, _settings_at = record_at(FLIGHT_BLOCK), record_at(SETTINGS)
_floats_at, _bytes_at = array_at("f8"), array_at("u1")


@kernel
def _block(call, flight):
    """The record of the block that a flight is in."""
    return _flight_at(call[_BLOCKS] + flight // WIDTH * call[_PITCH])


@kernel
def _is_finite(block, lane):
    """Whether the true state of a flight is finite."""
    total = 0.0
    for i in range(3):
        total += block.r[i, lane] + block.v[i, lane] + block.w[i, lane]
    for i in range(4):
        total += block.q[i, lane]
    return math.isfinite(total)


@kernel
def _result(call, row):
    """One row of the results."""
    return _floats_at(call[_RESULTS] + row * call[_RESULT_PITCH], call[_COUNT])


@kernel
def _write_rewards(call, verdict, scale):
    """Write rewards and returns, if all rewards are sound; return how many are not.

    A flight that begins an episode, or whose state is no longer finite, has no reward.
    """
    count, wrong = call[_COUNT], 0
    rewards, began = _floats_at(verdict[_REWARDS], count), _bytes_at(verdict[_BEGAN], count)
    for flight in range(count):
        sound = abs(rewards[flight]) <= LARGEST_REWARD  # NaN is not
        if began[flight] or not (sound or _is_finite(_block(call, flight), flight % WIDTH)):
            rewards[flight] = 0.0
        elif not sound:
            wrong += 1
    if wrong > 0:
        return wrong
    returns = _floats_at(verdict[_RETURNS], count)
    reward, episode_return = _result(call, _REWARD), _result(call, _EPISODE_RETURN)
    for flight in range(count):
        block, lane = _block(call, flight), flight % WIDTH
        paid = scale * rewards[flight]
        returns[flight] = 0.0 if began[flight] else returns[flight] + paid
        block.reward[lane] = reward[flight] = paid
        block.episode_return[lane] = episode_return[flight] = returns[flight]
    return 0


@kernel
def _write_endings(call, verdict, settings):
    """Write which flights are terminated and truncated, and why; return how many are."""
    count, ended = call[_COUNT], 0
    terminates, truncates = verdict[_TERMINATES], verdict[_TRUNCATES]
    terminating, truncating = _bytes_at(terminates, count), _bytes_at(truncates, count)
    terminated, truncated = _result(call, _TERMINATED), _result(call, _TRUNCATED)
    ending, began = _result(call, _ENDING), _bytes_at(verdict[_BEGAN], count)
    status, lost = _result(call, _FILTER_STATUS), _result(call, _FILTER_DIVERGED)
    for flight in range(count):
        crashed, built_in_cut = terminated[flight] > 0.0, truncated[flight] > 0.0
        done, flies = crashed or built_in_cut, began[flight] == 0
        ends, is_cut = crashed, built_in_cut
        if terminates:
            ends = terminating[flight] > 0
            if crashed and not ends:  # but nobody flies on in a state that is not finite
                ends = not _is_finite(_block(call, flight), flight % WIDTH)
        if truncates:
            is_cut = truncating[flight] > 0
        ends = ends and flies
        is_cut = is_cut and flies
        if not (done or ends or is_cut):
            continue  # almost always
        why = _TASK if ends or is_cut else 0.0
        if ends and crashed:
            why = ending[flight]
        elif is_cut and built_in_cut and not ends:
            is_lost = settings.truncate_when_diverged > 0.0 and lost[flight] > 0.0
            why = _FAILED if status[flight] > 0.0 else _LOST if is_lost else _TIME_LIMIT
        block, lane = _block(call, flight), flight % WIDTH
        block.terminated[lane] = terminated[flight] = 1.0 if ends else 0.0
        block.truncated[lane] = truncated[flight] = 1.0 if is_cut else 0.0
        block.ending[lane] = ending[flight] = why
        block.needs_reset[lane] = 1.0 if ends or is_cut else 0.0
        if ends or is_cut:
            ended += 1
    return ended


_WORDS = types.Array(types.int64, 1, "C")


@entry(signature=types.int64(_WORDS, _WORDS, types.float64))
def settle(call, verdict, scale):
    """Let results and records say what a user's task has judged.

    Args:
        call: (len(Call),) as of `quad_gym.kernels.batch.fly`.
        verdict: (len(Verdict),).
        scale: What rewards are multiplied by.

    Returns:
        How many episodes have ended; or minus the number of unsound rewards: nothing has been
        written then.
    """
    if verdict[_REWARDS]:
        wrong = _write_rewards(call, verdict, scale)
        if wrong > 0:
            return -wrong
    return _write_endings(call, verdict, _settings_at(call[_SETTINGS]))

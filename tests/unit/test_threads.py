"""Helper threads of a batch: equal flights with any number of threads, forks, errors and ends."""

import gc
import multiprocessing
import threading
import time

import numpy as np
import pytest

from quad_gym.batch.threads import MIN_BLOCKS_PER_THREAD, POSTED_BEFORE, Crew, board_of
from quad_gym.records import WIDTH, Control, Source, call
from tests.builders import batch

COUNT = 3 * MIN_BLOCKS_PER_THREAD * WIDTH + 3


def batch_of(threads, count=COUNT):
    options = {"source": Source.TRUTH, "control": Control.CTBR, "control_rate": 50.0}
    return batch(count, threads=threads, **options)


def flown(batch, steps=20, pause=0.0):
    rng = np.random.default_rng(0)
    for _ in range(steps):
        batch.step(rng.uniform(-0.3, 0.3, (batch.count, 4)))
        if pause:
            time.sleep(pause)
    return batch.snapshot().tobytes()


def helpers():
    return [thread for thread in threading.enumerate() if thread.name == "quad_gym"]


@pytest.mark.parametrize("pause", [0.0, 0.003])
@pytest.mark.parametrize("threads", [2, 3])
def test_flights_are_equal_with_busy_or_sleeping_helper_threads(threads, pause):
    assert flown(batch_of(threads), pause=pause) == flown(batch_of(1))


def test_two_batches_stepped_in_turn_equal_single_thread():
    one, other = batch_of(2), batch_of(3)
    rng = np.random.default_rng(0)
    for _ in range(20):
        actions = rng.uniform(-0.3, 0.3, (COUNT, 4))
        one.step(actions)
        other.step(actions)
    assert one.snapshot().tobytes() == other.snapshot().tobytes() == flown(batch_of(1))


def child(parent, pipe):
    pipe.send(flown(parent))


@pytest.mark.skipif("fork" not in multiprocessing.get_all_start_methods(), reason="no fork here")
@pytest.mark.filterwarnings("ignore::DeprecationWarning")
def test_forked_child_flies_with_new_threads_like_parent():
    parent = batch_of(2)
    flown(parent, 3)
    context = multiprocessing.get_context("fork")
    here, there = context.Pipe()
    process = context.Process(target=child, args=(parent, there))
    process.start()
    assert here.poll(60.0)
    assert here.recv() == flown(parent)
    process.join(10.0)
    assert process.exitcode == 0


def test_helpers_end_with_their_batch():
    gc.collect()
    before = len(helpers())
    threaded = batch_of(3)
    flown(threaded, 3)
    assert len(helpers()) == before + 2
    del threaded
    gc.collect()
    deadline = time.monotonic() + 10.0
    while len(helpers()) > before and time.monotonic() < deadline:
        time.sleep(0.01)
    assert len(helpers()) == before


def test_few_flights_need_no_helpers():
    before = len(helpers())
    flown(batch_of(8, count=WIDTH), 3)
    assert len(helpers()) == before


def crew_of(fly):
    return Crew(fly, 2 * MIN_BLOCKS_PER_THREAD, 2)


def post(words):
    """Post a step of which no block is finished, as a caller does first in compiled code."""
    words[call.FINISHED] = 0
    words[call.TICKET] += 1


def finish(words):
    words[call.FINISHED] = 2 * MIN_BLOCKS_PER_THREAD


def test_exception_in_helper_thread_is_raised_in_caller():
    def fly(words, number, command, serving):
        if serving:
            raise MemoryError("no more")
        if command != POSTED_BEFORE:
            post(words)
        return False  # some blocks are left to the helper

    crew = crew_of(fly)
    crew.gather()
    for _ in range(2):  # the second run has no helper
        with pytest.raises(MemoryError, match="no more"):
            crew.run(0)


def test_step_after_an_interrupted_one_waits_for_it():
    seen = []

    def fly(words, number, command, serving):
        if serving:
            time.sleep(0.05)
            finish(words)
            seen.append("helper")
            words[call.RANGES + call.WORDS_OF_RANGE + call.PRESENT] = 0
        elif not seen:
            post(words)
            raise KeyboardInterrupt
        else:
            seen.append(command)
        return bool(seen)

    crew = crew_of(fly)
    crew.gather()
    with pytest.raises(KeyboardInterrupt):
        crew.run(7)
    while not seen:
        time.sleep(0.01)
    crew.gather()
    crew.run(8)
    assert [entry for entry in seen if entry != "helper"] == [8]


@pytest.mark.parametrize("blocks", [1, 7, 64, 1000])
@pytest.mark.parametrize("parts", [1, 2, 5])
def test_the_ranges_of_a_board_hold_every_block_once(blocks, parts):
    words = board_of(blocks, parts)
    ranges = words[call.RANGES :].reshape(parts, call.WORDS_OF_RANGE)
    flown = [i for row in ranges for i in range(row[call.FIRST], row[call.LAST])]
    assert flown == list(range(blocks))
    assert words[call.FINISHED] == blocks  # nothing is posted
    assert 1 <= words[call.CHUNK] <= blocks


def test_run_during_another_run_raises_runtime_error():
    crew = None

    def fly(words, number, command, serving):
        crew.run(0)

    crew = Crew(fly, 1, 1)
    with pytest.raises(RuntimeError, match="already being stepped by another thread"):
        crew.run(0)

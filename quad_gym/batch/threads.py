"""Threads, which share the blocks of a batch. No other module deals with threads.

Kernels release the GIL, so plain threads run them in parallel. A crew of threads belongs to the
process that made it: after a fork the child makes its own, and a batch that is pickled or copied
takes none along.
"""

import os
import threading
import time
import weakref
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from quad_gym.kernels.library import available_cores
from quad_gym.params import checks as check
from quad_gym.records import call

MIN_BLOCKS_PER_THREAD = 4  #: smallest number of blocks that is worth a hand-over to another thread

CHUNKS_OF_RANGE = 16
"""Number of chunks into which a thread's range is cut: each costs some tens of nanoseconds."""

MAX_THREADS = 1024  #: largest number of threads: each has its own memory, so more are a mistake


def resolve_threads(threads: int | None) -> int:
    """Return `threads`, from 1 to MAX_THREADS, or the number of available cores for None."""
    if threads is None:
        return available_cores()
    return check.whole("threads", threads, most=MAX_THREADS)


Fly = Callable[[NDArray[np.int64], int, int, bool], bool]
"""Function that flies blocks of a board: board, number of the thread, command, True if it
serves."""

POSTED_BEFORE = -1  #: value instead of a command: wait for the command that was posted before


class Crew:
    """The threads that fly the blocks of one batch: the calling one, and helpers.

    A helper stays in compiled code while steps follow each other fast, and sleeps otherwise; see
    `kernels/board.py`. It ends with the crew. A single thread needs no crew, but has its board.
    """

    def __init__(self, fly: Fly, blocks: int, threads: int, group: int = 1) -> None:
        parts = max(1, min(threads, blocks // MIN_BLOCKS_PER_THREAD))
        self.process = os.getpid()
        self._fly = fly
        self._board = board_of(blocks, parts, group)
        places = call.RANGES + call.WORDS_OF_RANGE * np.arange(1, parts) + call.PRESENT
        self._alarms = [(int(place), threading.Semaphore(0)) for place in places]
        self._errors: list[BaseException] = []
        self._flying = False
        for number, alarm in enumerate(self._alarms, 1):
            shared = (fly, self._board, number, *alarm, self._errors)
            threading.Thread(target=_help, args=shared, name="quad_gym", daemon=True).start()
        weakref.finalize(self, _dismiss, self._board, self._alarms)

    def run(self, command: int) -> None:
        """Fly all blocks; one thread at a time may step a batch."""
        if self._flying:
            raise RuntimeError("this batch is already being stepped by another thread")
        self._flying = True
        try:
            if not self._fly(self._board, 0, command, False):
                self._wait()
        except Exception as error:
            self._errors.append(error)  # its blocks will never be finished
            raise
        finally:
            self._flying = False

    def gather(self) -> None:
        """Wait for the rest of an interrupted step, if any, and wake the helpers that sleep."""
        if not self._alarms:
            return
        words = self._board
        if words[call.FINISHED] != words[call.LAST - call.WORDS_OF_RANGE]:
            self._wait()
        for place, alarm in self._alarms:
            if words[place] == 0:
                words[place] = 1
                alarm.release()

    def _wait(self) -> None:
        """Wait until all blocks are finished."""
        while True:
            if self._errors:
                raise self._errors[-1]
            if self._fly(self._board, 0, POSTED_BEFORE, False):
                return
            time.sleep(0.0)


def board_of(blocks: int, parts: int, group: int = 1) -> NDArray[np.int64]:
    """A board with the blocks cut into ranges and chunks, and nothing posted."""
    words = np.zeros(call.RANGES + parts * call.WORDS_OF_RANGE, np.int64)
    ranges = words[call.RANGES :].reshape(parts, call.WORDS_OF_RANGE)
    cuts = [blocks * part // parts for part in range(parts + 1)]
    ranges[:, call.FIRST], ranges[:, call.LAST] = cuts[:-1], cuts[1:]
    ranges[:, call.NEXT] = cuts[1:]
    words[call.FINISHED] = blocks
    # gathering lanes from half of a range makes up for the wait of a thread for the other's half
    chunk = max(1 + blocks // (CHUNKS_OF_RANGE * parts), min(group, blocks // (2 * parts)))
    words[call.CHUNK] = chunk if parts > 1 else blocks
    return words


def _help(
    fly: Fly,
    words: NDArray[np.int64],
    number: int,
    place: int,
    alarm: threading.Semaphore,
    errors: list[BaseException],
) -> None:
    """Run a helper thread: sleep until it is woken, then serve the board."""
    while True:
        alarm.acquire()
        if words[call.STOP]:
            return
        words[place] = 1
        try:
            fly(words, number, POSTED_BEFORE, True)
        except BaseException as error:
            errors.append(error)
            return


def _dismiss(words: NDArray[np.int64], alarms: list[tuple[int, threading.Semaphore]]) -> None:
    """End the helpers of a crew that is no longer needed."""
    words[call.STOP] = 1
    for _, alarm in alarms:
        alarm.release()

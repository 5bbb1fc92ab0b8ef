"""The one place that knows of threads: shares a range of blocks among the cores.

Kernels release the GIL, so plain threads run them side by side. A crew of threads belongs to the
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

from quad_gym.kernels import mailbox
from quad_gym.kernels.compiling.cores import available_cores
from quad_gym.params import checks as check

MIN_BLOCKS_PER_THREAD = 4
"""Fewer blocks than this are not worth a hand-over to another thread."""

MAX_THREADS = 1024
"""More than this is a mistake: each thread has memory of its own."""


def resolve_threads(threads: int | None) -> int:
    """`threads` checked, or the available cores where it is None.

    Raises:
        ValueError: If `threads` is not a whole number from 1 to MAX_THREADS.
    """
    if threads is None:
        return available_cores()
    return check.whole("threads", threads, most=MAX_THREADS)


Fly = Callable[[int, int, int, NDArray[np.int64], int], None]
"""Flies a range: its number, first block, last block, mailbox, and whether to serve that."""


class Crew:
    """Helper threads of one batch, each of which flies a range of its blocks.

    A helper lives in compiled code while steps follow each other fast, and sleeps otherwise; see
    `kernels/mailbox.py`. It ends with the crew.

    Args:
        fly: Flies a range: once with serving 0, and with 1 until its mailbox stays empty.
        blocks: How many blocks there are.
        threads: The most ranges to cut; the first is the calling thread's.
    """

    def __init__(self, fly: Fly, blocks: int, threads: int) -> None:
        parts = max(1, min(threads, blocks // MIN_BLOCKS_PER_THREAD))
        cuts = [blocks * part // parts for part in range(parts + 1)]
        self.process = os.getpid()
        self._fly, self._own = fly, (0, cuts[0], cuts[1])
        self._mailboxes = np.zeros((parts - 1, mailbox.WORDS), np.int64)
        self._words = np.zeros(mailbox.WORDS, np.int64)
        self._alarms = [threading.Semaphore(0) for _ in range(parts - 1)]
        self._errors: list[BaseException] = []
        self._flying = False
        for i in range(parts - 1):
            part = (i + 1, cuts[i + 1], cuts[i + 2])
            shared = (self._mailboxes[i], self._alarms[i], self._errors)
            threading.Thread(
                target=_help, args=(fly, *part, *shared), name="quad_gym", daemon=True
            ).start()
        weakref.finalize(self, _dismiss, self._mailboxes, self._alarms)

    def run(self, command: int) -> None:
        """Fly all ranges, the first of them in the calling thread.

        Raises:
            RuntimeError: If another thread is flying this batch at the same time.
        """
        if self._flying:
            raise RuntimeError("a batch can be flown by one thread at a time")
        self._flying = True
        try:
            self._words[mailbox.COMMAND] = command
            if len(self._mailboxes):
                self._wait()  # for what an interrupted step may have left
                if mailbox.post(self._mailboxes, command):
                    self._wake()
            self._fly(*self._own, self._words, 0)
            if len(self._mailboxes):
                self._wait()
        finally:
            self._flying = False

    def _wait(self) -> None:
        """Wait until all helpers are done."""
        while not mailbox.wait(self._mailboxes):
            if self._errors:
                raise self._errors.pop()
            time.sleep(0.0)

    def _wake(self) -> None:
        """Wake the helpers that sleep."""
        for words, alarm in zip(self._mailboxes, self._alarms, strict=True):
            if words[mailbox.PRESENT] == 0:
                alarm.release()


def _help(
    fly: Fly,
    number: int,
    first: int,
    last: int,
    words: NDArray[np.int64],
    alarm: threading.Semaphore,
    errors: list[BaseException],
) -> None:
    """What a helper thread does: sleep until it is woken, then serve its mailbox."""
    while True:
        alarm.acquire()
        if words[mailbox.STOP]:
            return
        words[mailbox.PRESENT] = 1
        try:
            fly(number, first, last, words, 1)
        except BaseException as error:
            errors.append(error)
            return


def _dismiss(mailboxes: NDArray[np.int64], alarms: list[threading.Semaphore]) -> None:
    """End the helpers of a crew that nobody needs any more."""
    mailboxes[:, mailbox.STOP] = 1
    for alarm in alarms:
        alarm.release()

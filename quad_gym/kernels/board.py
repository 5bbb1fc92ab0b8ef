"""Distribution of a batch's blocks among threads, without Python and its lock.

All threads share one board of words. The caller divides the blocks into ranges, one per thread, and
posts a step. A thread takes a few blocks at a time, first from its own range, then from the others.
No thread has to wait for one that sleeps or has been preempted, and blocks mostly stay in the cache
of one core. A step is over when all blocks are finished.

Waking a thread takes longer than a step of some hundred flights. A helper without work therefore
polls the board for a while before it sleeps; Python wakes it (`quad_gym.batch.threads`).

COMMAND and the arguments of the step are written before NEXT, so that any thread that takes a block
sees them.
"""

from quad_gym.kernels.compiling import kernel
from quad_gym.kernels.simd.atomics import add_shared, pause, read_shared, write_shared
from quad_gym.records.board import (
    CHUNK,
    COMMAND,
    FINISHED,
    FIRST,
    LAST,
    NEXT,
    PRESENT,
    RANGES,
    STOP,
    TICKET,
    WORDS_OF_RANGE,
)

WATCH = 4_000  #: polls of the board before a helper sleeps, about 100 us
PATIENCE = 100 * WATCH  #: polls of the caller before Python checks the other threads for errors


@kernel
def post(board, command):
    """Post a step."""
    write_shared(board, COMMAND, command)
    write_shared(board, FINISHED, 0)
    for place in range(RANGES, len(board), WORDS_OF_RANGE):
        write_shared(board, place + NEXT, board[place + FIRST])
    write_shared(board, TICKET, read_shared(board, TICKET) + 1)


@kernel
def take(board, number):
    """Take the next blocks for a thread; return first and end, which are equal if none is left."""
    ranges = (len(board) - RANGES) // WORDS_OF_RANGE
    for k in range(ranges):
        place = RANGES + (number + k) % ranges * WORDS_OF_RANGE
        last = board[place + LAST]
        if read_shared(board, place + NEXT) < last:
            first = add_shared(board, place + NEXT, board[CHUNK])
            if first < last:
                return first, min(first + board[CHUNK], last)
    return 0, 0


@kernel
def comes(board, number, seen):
    """Wait for a step after the last one `seen`; return False if the helper is to leave."""
    present = RANGES + number * WORDS_OF_RANGE + PRESENT
    while True:
        for _ in range(WATCH):
            if read_shared(board, TICKET) != seen:
                return True
            if read_shared(board, STOP) != 0:
                break
            pause()
        write_shared(board, present, 0)
        if read_shared(board, TICKET) == seen:
            return False
        write_shared(board, present, 1)


@kernel
def finished(board):
    """Wait for the end of the step, for a limited time; return True if all blocks are finished."""
    blocks = board[len(board) - WORDS_OF_RANGE + LAST]
    for _ in range(PATIENCE):
        if read_shared(board, FINISHED) == blocks:
            return True
        pause()
    return False

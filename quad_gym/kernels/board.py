"""How threads share the blocks of a batch among them, without Python and its lock.

All look at one board of words. The caller cuts the blocks into ranges, one for each thread, and
posts a step. A thread takes some blocks at a time, from its own range as long as there are any,
then from the others': nobody waits for a thread that sleeps or that another process holds up, and
blocks mostly stay in the cache of one core. A step is over when all blocks are finished.

Waking a thread takes longer than a step of some hundred flights. So a helper without work watches
the board for a while, and sleeps only then; Python wakes it (`quad_gym.batch.threads`).

COMMAND and what the step is about are written before NEXT, so that whoever takes a block finds
them.
"""

from quad_gym.kernels.compiling import kernel
from quad_gym.kernels.simd.atomics import add_shared, pause, read_shared, write_shared

LINE = 8
"""Words of a cache line; what different threads write lies in different ones."""
TICKET, FINISHED, COMMAND, STOP, CHUNK = 0, LINE, 2 * LINE, 3 * LINE, 3 * LINE + 1
RANGES, WORDS_OF_RANGE = 4 * LINE, 2 * LINE
NEXT, FIRST, LAST, PRESENT = 0, 1, 2, LINE
"""Words of a range: the next block to take; its first, and its end; whether its thread watches."""
WATCH = 4_000
"""Looks at the board before a helper sleeps, some 100 us."""
PATIENCE = 100 * WATCH
"""Looks of the caller before it asks Python whether something went wrong."""


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
    """The next blocks for a thread to fly: first and end; the same where there are none."""
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
    """Watch for another step than the last `seen`; False where the helper is to leave."""
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
    """Wait a while for the step; returns whether all blocks are finished."""
    blocks = board[len(board) - WORDS_OF_RANGE + LAST]
    for _ in range(PATIENCE):
        if read_shared(board, FINISHED) == blocks:
            return True
        pause()
    return False

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

import platform

from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.extending import intrinsic

from quad_gym.kernels.compiling import kernel
from quad_gym.records.call import (
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

# --------------------------------------------------------------------------------------------------
# Words shared by threads: atomic reads and writes, and a pause for waiting.
# --------------------------------------------------------------------------------------------------

_MACHINE = platform.machine().lower()


def _pointer(context, builder, signature, args):  # type: ignore[no-untyped-def]
    array = context.make_array(signature.args[0])(context, builder, args[0])
    index = context.cast(builder, args[1], signature.args[1], types.intp)
    return cgutils.get_item_pointer(context, builder, signature.args[0], array, [index])


@intrinsic
def read_shared(typing_context, words, index):  # type: ignore[no-untyped-def]
    """Return the word `words[index]` (int64) that a thread wrote last."""

    def lower(context, builder, signature, args):  # type: ignore[no-untyped-def]
        pointer = _pointer(context, builder, signature, args)
        return builder.load_atomic(pointer, "seq_cst", 8)

    return types.int64(words, index), lower


@intrinsic
def write_shared(typing_context, words, index, value):  # type: ignore[no-untyped-def]
    """Write `words[index]` (int64), after all earlier writes of this thread."""

    def lower(context, builder, signature, args):  # type: ignore[no-untyped-def]
        pointer = _pointer(context, builder, signature, args)
        word = context.cast(builder, args[2], signature.args[2], types.int64)
        builder.store_atomic(word, pointer, "seq_cst", 8)
        return context.get_dummy_value()

    return types.none(words, index, value), lower


@intrinsic
def add_shared(typing_context, words, index, number):  # type: ignore[no-untyped-def]
    """Add to `words[index]` (int64) atomically; return the value before."""

    def lower(context, builder, signature, args):  # type: ignore[no-untyped-def]
        pointer = _pointer(context, builder, signature, args)
        word = context.cast(builder, args[2], signature.args[2], types.int64)
        return builder.atomic_rmw("add", pointer, word, "seq_cst")

    return types.int64(words, index, number), lower


@intrinsic
def pause(typing_context):  # type: ignore[no-untyped-def]
    """Hint to the processor that this thread waits for another."""

    def lower(context, builder, signature, args):  # type: ignore[no-untyped-def]
        if _MACHINE in ("x86_64", "amd64"):
            kind = ir.FunctionType(ir.VoidType(), [])
            hint = cgutils.get_or_insert_function(builder.module, kind, "llvm.x86.sse2.pause")
            builder.call(hint, [])
        elif _MACHINE in ("aarch64", "arm64"):
            number = ir.IntType(32)
            kind = ir.FunctionType(ir.VoidType(), [number])
            hint = cgutils.get_or_insert_function(builder.module, kind, "llvm.aarch64.hint")
            builder.call(hint, [ir.Constant(number, 1)])  # yield
        return context.get_dummy_value()

    return types.none(), lower


# --------------------------------------------------------------------------------------------------
# Distribution of a batch's blocks among threads, without Python and its lock.
# --------------------------------------------------------------------------------------------------

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

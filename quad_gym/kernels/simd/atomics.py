"""Words shared by threads: atomic reads and writes, and a pause for waiting."""

import platform

from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.extending import intrinsic

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

"""Primitives of the elementary functions: bit patterns, rounding and the C library.

Each accepts a plain number or lanes, because LLVM's instructions do.
"""

from typing import Any

from llvmlite import ir
from numba import types
from numba.extending import intrinsic

from quad_gym.kernels.simd.lanes import call_llvm, lanes, splat, words
from quad_gym.records import WIDTH

_FLOAT = ir.DoubleType()
_INT = ir.IntType(64)


def _like(value: ir.Value, scalar: ir.Type) -> ir.Type:
    """Return `scalar`, or a vector of it if `value` is a vector."""
    return ir.VectorType(scalar, WIDTH) if isinstance(value.type, ir.VectorType) else scalar


def _constant(builder: ir.IRBuilder, like: ir.Value, scalar: ir.Type, number: Any) -> ir.Value:
    constant = ir.Constant(scalar, number)
    return splat(builder, constant) if isinstance(like.type, ir.VectorType) else constant


def _is_float(numba_type: Any) -> bool:
    return bool(numba_type == lanes or isinstance(numba_type, types.Float))


def _is_word(numba_type: Any) -> bool:
    return bool(numba_type == words or numba_type == types.uint64)


@intrinsic
def round_to_even(typing_context, x):  # type: ignore[no-untyped-def]
    """Return the nearest integer, ties to even, as a float."""
    if not _is_float(x):
        return None
    return x(x), lambda context, builder, sig, args: call_llvm(builder, "llvm.rint", args[0])


@intrinsic
def fused_multiply_add(typing_context, a, b, c):  # type: ignore[no-untyped-def]
    """Return `a b + c`, rounded once."""
    kind = lanes if lanes in (a, b, c) else types.float64

    def lower(context, builder, sig, args):  # type: ignore[no-untyped-def]
        operands = [context.cast(builder, v, t, kind) for v, t in zip(args, sig.args, strict=True)]
        return call_llvm(builder, "llvm.fma", *operands)

    return kind(a, b, c), lower


def _library_call(name: str) -> Any:
    @intrinsic
    def call(typing_context, x):  # type: ignore[no-untyped-def]
        if not _is_float(x):
            return None
        return x(x), lambda context, builder, sig, args: call_llvm(builder, name, args[0])

    return call


library_sin = _library_call("llvm.sin")
"""Sine from the C library, lane by lane: slow, for arguments too large to reduce."""
library_cos = _library_call("llvm.cos")
"""Cosine from the C library, lane by lane: slow, for arguments too large to reduce."""


@intrinsic
def power_of_two(typing_context, exponent):  # type: ignore[no-untyped-def]
    """Return 2 ** exponent, exact, for an integer-valued float in [-1022, 1023]."""
    if not _is_float(exponent):
        return None

    def lower(context, builder, sig, args):  # type: ignore[no-untyped-def]
        value = args[0]
        biased = builder.fptosi(
            builder.fadd(value, _constant(builder, value, _FLOAT, 1023.0)), _like(value, _INT)
        )
        shifted = builder.shl(biased, _constant(builder, value, _INT, 52))
        return builder.bitcast(shifted, _like(value, _FLOAT))

    return exponent(exponent), lower


@intrinsic
def exponent_of(typing_context, x):  # type: ignore[no-untyped-def]
    """Return e of x = m 2**e with m in [1, 2), as a float, for positive normal x."""
    if not _is_float(x):
        return None

    def lower(context, builder, sig, args):  # type: ignore[no-untyped-def]
        value = args[0]
        pattern = builder.bitcast(value, _like(value, _INT))
        biased = builder.lshr(pattern, _constant(builder, value, _INT, 52))
        unbiased = builder.sub(biased, _constant(builder, value, _INT, 1023))
        return builder.sitofp(unbiased, _like(value, _FLOAT))

    return x(x), lower


@intrinsic
def mantissa_of(typing_context, x):  # type: ignore[no-untyped-def]
    """Return m of x = m 2**e with m in [1, 2), for positive normal x."""
    if not _is_float(x):
        return None

    def lower(context, builder, sig, args):  # type: ignore[no-untyped-def]
        value = args[0]
        pattern = builder.bitcast(value, _like(value, _INT))
        kept = builder.and_(pattern, _constant(builder, value, _INT, (1 << 52) - 1))
        one = builder.or_(kept, _constant(builder, value, _INT, 1023 << 52))
        return builder.bitcast(one, _like(value, _FLOAT))

    return x(x), lower


@intrinsic
def one_to_two(typing_context, word):  # type: ignore[no-untyped-def]
    """Return the top 52 bits of a word as a float in [1, 2)."""
    if not _is_word(word):
        return None

    def lower(context, builder, sig, args):  # type: ignore[no-untyped-def]
        value = args[0]
        kept = builder.lshr(value, _constant(builder, value, _INT, 12))
        one = builder.or_(kept, _constant(builder, value, _INT, 1023 << 52))
        return builder.bitcast(one, _like(value, _FLOAT))

    return (lanes if word == words else types.float64)(word), lower


@intrinsic
def rotate_left(typing_context, word, places):  # type: ignore[no-untyped-def]
    """Rotate the 64 bits of a word left by a literal number of places."""
    if not _is_word(word) or not isinstance(places, types.IntegerLiteral):
        return None
    by = places.literal_value

    def lower(context, builder, sig, args):  # type: ignore[no-untyped-def]
        value = args[0]
        return call_llvm(builder, "llvm.fshl", value, value, _constant(builder, value, _INT, by))

    return word(word, places), lower

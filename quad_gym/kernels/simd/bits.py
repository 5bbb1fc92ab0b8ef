"""Primitives of the elementary functions: bit patterns, rounding and fused multiply-adds.

Each accepts a plain number or lanes, because LLVM's instructions do.
"""

from collections.abc import Callable
from typing import Any

from llvmlite import ir
from numba import types
from numba.extending import intrinsic

from quad_gym.kernels.simd.lanes import call_llvm, lanes, splat, words
from quad_gym.records import REGISTER

_FLOAT = ir.DoubleType()
_INT = ir.IntType(64)


def _like(value: ir.Value, scalar: ir.Type) -> ir.Type:
    """Return `scalar`, or a vector of it if `value` is a vector."""
    return ir.VectorType(scalar, REGISTER) if isinstance(value.type, ir.VectorType) else scalar


def _constant(builder: ir.IRBuilder, like: ir.Value, number: Any, scalar: ir.Type = _INT) -> Any:
    constant = ir.Constant(scalar, number)
    return splat(builder, constant) if isinstance(like.type, ir.VectorType) else constant


def _is_float(numba_type: Any) -> bool:
    return bool(numba_type == lanes or isinstance(numba_type, types.Float))


def _is_word(numba_type: Any) -> bool:
    return bool(numba_type == words or numba_type == types.uint64)


def _of_float(emit: Callable[[ir.IRBuilder, ir.Value], ir.Value]) -> Any:
    """Make a function of one number, and with a number as its result."""

    @intrinsic
    def call(typing_context, x):  # type: ignore[no-untyped-def]
        if not _is_float(x):
            return None
        return x(x), lambda context, builder, sig, args: emit(builder, args[0])

    return call


def _power_of_two(builder: ir.IRBuilder, x: ir.Value) -> ir.Value:
    biased = builder.fadd(x, _constant(builder, x, 1023.0, _FLOAT))
    shifted = builder.shl(builder.fptosi(biased, _like(x, _INT)), _constant(builder, x, 52))
    return builder.bitcast(shifted, _like(x, _FLOAT))


def _exponent_of(builder: ir.IRBuilder, x: ir.Value) -> ir.Value:
    pattern = builder.bitcast(x, _like(x, _INT))
    biased = builder.lshr(pattern, _constant(builder, x, 52))
    return builder.sitofp(builder.sub(biased, _constant(builder, x, 1023)), _like(x, _FLOAT))


def _with_exponent_zero(builder: ir.IRBuilder, mantissa: ir.Value) -> ir.Value:
    """The number from 1 to 2 whose mantissa has these 52 bits."""
    one = builder.or_(mantissa, _constant(builder, mantissa, 1023 << 52))
    return builder.bitcast(one, _like(mantissa, _FLOAT))


def _mantissa_of(builder: ir.IRBuilder, x: ir.Value) -> ir.Value:
    pattern = builder.bitcast(x, _like(x, _INT))
    return _with_exponent_zero(builder, builder.and_(pattern, _constant(builder, x, (1 << 52) - 1)))


round_to_even = _of_float(lambda builder, x: call_llvm(builder, "llvm.rint", x))
"""Nearest integer, ties to even, as a float."""
power_of_two = _of_float(_power_of_two)
"""2 ** x, exact, for an integer-valued float in [-1022, 1023]."""
exponent_of = _of_float(_exponent_of)
"""The e of x = m 2**e with m in [1, 2), as a float, for positive normal x."""
mantissa_of = _of_float(_mantissa_of)
"""The m of x = m 2**e with m in [1, 2), for positive normal x."""


@intrinsic
def fused_multiply_add(typing_context, a, b, c):  # type: ignore[no-untyped-def]
    """Return `a b + c`, rounded once."""
    kind = lanes if lanes in (a, b, c) else types.float64

    def lower(context, builder, sig, args):  # type: ignore[no-untyped-def]
        operands = [context.cast(builder, v, t, kind) for v, t in zip(args, sig.args, strict=True)]
        return call_llvm(builder, "llvm.fma", *operands)

    return kind(a, b, c), lower


@intrinsic
def one_to_two(typing_context, word):  # type: ignore[no-untyped-def]
    """Return the top 52 bits of a word as a float in [1, 2)."""
    if not _is_word(word):
        return None

    def lower(context, builder, sig, args):  # type: ignore[no-untyped-def]
        kept = builder.lshr(args[0], _constant(builder, args[0], 12))
        return _with_exponent_zero(builder, kept)

    return (lanes if word == words else types.float64)(word), lower


@intrinsic
def rotate_left(typing_context, word, places):  # type: ignore[no-untyped-def]
    """Rotate the 64 bits of a word left by a literal number of places."""
    if not _is_word(word) or not isinstance(places, types.IntegerLiteral):
        return None
    by = places.literal_value

    def lower(context, builder, sig, args):  # type: ignore[no-untyped-def]
        value = args[0]
        return call_llvm(builder, "llvm.fshl", value, value, _constant(builder, value, by))

    return word(word, places), lower

"""Number type of the kernels: one number for each of several flights; its primitives."""

import math
import operator
from collections.abc import Callable
from typing import Any, NamedTuple

from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.core.datamodel import models
from numba.core.imputils import lower_cast
from numba.core.typeconv.castgraph import Conversion
from numba.core.typeconv.rules import default_type_manager
from numba.core.typing.templates import AbstractTemplate, infer_global, signature
from numba.extending import intrinsic, lower_builtin, overload, register_model

from quad_gym.records import REGISTER, SINGLE

# --------------------------------------------------------------------------------------------------
# Number type of the kernels: one float64 for each of several flights.
#
# A kernel is written once, for one flight, as if its numbers were floats. Compiled for floats, it
# serves the classes for one vehicle and the tests; compiled for `Lanes`, it computes REGISTER
# flights on the SIMD unit. This file defines three value types for Numba, and the operations on
# them:
#
# | type      | REGISTER of | plain counterpart | operations                                  |
# |-----------|-------------|-------------------|---------------------------------------------|
# | `Lanes`   | float64     | `float64`         | `+ - * / neg abs`, comparisons, `math.sqrt` |
# | `Mask`    | bool        | `boolean`         | `& \|`, `logical_not`, `any_of`, `all_of`   |
# | `Words`   | uint64      | `uint64`          | `+ ^ & \\|`, `==`, primitives below          |
#
# There are no branches on data in a kernel: `select(mask, a, b)` chooses lane by lane. Lanes do not
# affect each other, so a flight does not depend on the other flights in its block, even if they are
# NaN.
#
# Results are defined by the source alone. A product that is added or subtracted in the same
# expression is always fused into a multiply-add, and no other operation is: no fast-math flag lets
# LLVM decide. Results depend neither on REGISTER nor on inlining, nor on the processor: if it has
# no fused multiply-add, LLVM calls the C library's, which is slow but bitwise identical.
# --------------------------------------------------------------------------------------------------

REAL = types.float32 if SINGLE else types.float64
"""Type of the number in a lane: the precision of the process. Plain numbers are float64, and are
rounded where they meet lanes."""

_FLOATS = ir.VectorType(ir.FloatType() if SINGLE else ir.DoubleType(), REGISTER)
_WORDS = ir.VectorType(ir.IntType(64), REGISTER)
_BITS = ir.VectorType(ir.IntType(1), REGISTER)


class _VectorType(types.Type):
    """Numba type of one LLVM vector; all instances of a class are equal."""

    llvm_type: ir.VectorType

    def __init__(self) -> None:
        super().__init__(name=type(self).__name__)


class Lanes(_VectorType):
    """Vector of numbers of type REAL, one per flight of a block."""

    llvm_type = _FLOATS


class Words(_VectorType):
    """Vector of uint64, one per flight of a block."""

    llvm_type = _WORDS


class Mask(_VectorType):
    """Vector of booleans, one per flight of a block."""

    llvm_type = _BITS


class Floats(types.UniTuple):
    """A vector of numbers, or a matrix of such vectors, see `numbers/linalg.py`."""


lanes, words, mask = Lanes(), Words(), Mask()
register_model(Floats)(models.UniTupleModel)


@register_model(Lanes)
@register_model(Words)
@register_model(Mask)
class _VectorModel(models.PrimitiveModel):
    def __init__(self, manager: Any, numba_type: _VectorType) -> None:
        super().__init__(manager, numba_type, numba_type.llvm_type)


def splat(builder: ir.IRBuilder, scalar: ir.Value) -> ir.Value:
    """Return the LLVM vector with `scalar` in every lane."""
    vector = ir.VectorType(scalar.type, REGISTER)
    first = builder.insert_element(
        ir.Constant(vector, ir.Undefined), scalar, ir.Constant(ir.IntType(32), 0)
    )
    zeros = ir.Constant(ir.VectorType(ir.IntType(32), REGISTER), [0] * REGISTER)
    return builder.shuffle_vector(first, ir.Constant(vector, ir.Undefined), zeros)


def vector_of(
    context: Any, builder: ir.IRBuilder, value: ir.Value, source: Any, target: Any
) -> Any:
    """Return `value` of Numba type `source` as the vector type `target`."""
    if source == target:
        return value
    if isinstance(source, types.IntEnumMember):
        source = source.dtype
    plain = {lanes: REAL, words: types.uint64, mask: types.boolean}[target]
    return splat(builder, context.cast(builder, value, source, plain))


# ---- conversions: a plain number has the same value in all lanes --------------------------------

_PLAIN = {
    lanes: (types.Float, types.Integer, types.IntEnumMember),
    words: (types.Integer,),
    mask: (types.Boolean,),
}


@lower_cast(types.Float, lanes)
@lower_cast(types.Integer, lanes)
@lower_cast(types.Integer, words)
@lower_cast(types.Boolean, mask)
def _cast_to_vector(context, builder, source, target, value):  # type: ignore[no-untyped-def]
    return vector_of(context, builder, value, source, target)


for _plain in {types.float64, REAL}:
    default_type_manager.set_compatible(_plain, lanes, Conversion.safe)
default_type_manager.set_compatible(types.int64, lanes, Conversion.safe)
default_type_manager.set_compatible(types.uint64, words, Conversion.safe)
default_type_manager.set_compatible(types.boolean, mask, Conversion.safe)


# ---- operators -------------------------------------------------------------------------------

ASKED_FIRST = {"target": "cpu"}
"""Metadata of templates that Numba tries before the dozen generic ones of an operator, which saves
a tenth of the time that kernels take to compile."""


def _binary(
    operation: Any, operand: Any, result: Any, emit: Callable[[ir.IRBuilder, Any, Any], Any]
) -> None:
    """Define `operation` for operands of the vector type `operand`, one of which may be plain."""

    @infer_global(operation)
    class _BinaryTyping(AbstractTemplate):
        metadata = ASKED_FIRST

        def generic(self, args, kws):  # type: ignore[no-untyped-def]
            fits = all(a == operand or isinstance(a, _PLAIN[operand]) for a in args)
            if len(args) == 2 and operand in args and fits:
                return signature(result, *args)
            return None

    def lower(context, builder, sig, args):  # type: ignore[no-untyped-def]
        left, right = (
            vector_of(context, builder, value, source, operand)
            for value, source in zip(args, sig.args, strict=True)
        )
        return emit(builder, left, right)

    lower_builtin(operation, operand, operand)(lower)
    for plain in _PLAIN[operand]:
        lower_builtin(operation, operand, plain)(lower)
        lower_builtin(operation, plain, operand)(lower)


def _method(name: str, **flags: Any) -> Callable[[ir.IRBuilder, Any, Any], Any]:
    return lambda builder, left, right: getattr(builder, name)(left, right, **flags)


def _ordered(symbol: str) -> Callable[[ir.IRBuilder, Any, Any], Any]:
    return lambda builder, left, right: builder.fcmp_ordered(symbol, left, right)


def is_product(value: Any) -> bool:
    """True for an LLVM value that is the result of a multiplication."""
    return isinstance(value, ir.Instruction) and value.opname == "fmul"


def fuse(builder: ir.IRBuilder, *numbers: Any) -> Any:
    """Emit the multiply-add of three numbers: a * b + c, rounded once."""
    return call_llvm(builder, "llvm.fma", *numbers)


def add_numbers(builder: ir.IRBuilder, left: Any, right: Any) -> Any:
    """Emit left + right; a product is fused into the sum, the left one if both are products."""
    if is_product(left):
        return fuse(builder, *left.operands, right)
    if is_product(right):
        return fuse(builder, *right.operands, left)
    return builder.fadd(left, right)


def _subtract(builder: ir.IRBuilder, left: Any, right: Any) -> Any:
    """Emit left - right, with products fused as in a sum."""
    if is_product(left):
        return fuse(builder, *left.operands, builder.fneg(right))
    if is_product(right):
        factor, other = right.operands
        return fuse(builder, builder.fneg(factor), other, left)
    return builder.fsub(left, right)


for _operation, _in_place, _emit in (
    (operator.add, operator.iadd, add_numbers),
    (operator.sub, operator.isub, _subtract),
    (operator.mul, operator.imul, _method("fmul")),
    (operator.truediv, operator.itruediv, _method("fdiv")),
):
    for _symbol in (_operation, _in_place):
        _binary(_symbol, lanes, lanes, _emit)

for _operation, _comparison in (
    (operator.lt, "<"),
    (operator.le, "<="),
    (operator.gt, ">"),
    (operator.ge, ">="),
    (operator.eq, "=="),
):
    _binary(_operation, lanes, mask, _ordered(_comparison))

for _operation, _name in (
    (operator.add, "add"),
    (operator.xor, "xor"),
    (operator.and_, "and_"),
    (operator.or_, "or_"),
):
    _binary(_operation, words, words, _method(_name))

_binary(operator.eq, words, mask, lambda builder, a, b: builder.icmp_unsigned("==", a, b))

for _operation, _name in ((operator.and_, "and_"), (operator.or_, "or_")):
    _binary(_operation, mask, mask, _method(_name))


def _unary(operation: Any, emit: Callable[[Any, ir.IRBuilder, Any], Any]) -> None:
    @infer_global(operation)
    class _UnaryTyping(AbstractTemplate):
        metadata = ASKED_FIRST

        def generic(self, args, kws):  # type: ignore[no-untyped-def]
            if args == (lanes,):
                return signature(lanes, lanes)
            return None

    @lower_builtin(operation, lanes)
    def _lower(context, builder, sig, args):  # type: ignore[no-untyped-def]
        return emit(context, builder, args[0])


def call_llvm(builder: ir.IRBuilder, name: str, value: ir.Value, *others: ir.Value) -> ir.Value:
    """Call the LLVM intrinsic `name` (such as `llvm.sqrt`) for the type of its first argument."""
    kind = value.type
    vector = isinstance(kind, ir.VectorType)
    scalar = (kind.element if vector else kind).intrinsic_name
    suffix = f"v{REGISTER}{scalar}" if vector else scalar
    arguments = (value, *others)
    function = cgutils.get_or_insert_function(
        builder.module, ir.FunctionType(kind, [a.type for a in arguments]), f"{name}.{suffix}"
    )
    return builder.call(function, arguments)


_unary(operator.neg, lambda context, builder, value: builder.fneg(value))
_unary(math.sqrt, lambda context, builder, value: call_llvm(builder, "llvm.sqrt", value))
_unary(abs, lambda context, builder, value: call_llvm(builder, "llvm.fabs", value))


# ---- selection and tests of masks ------------------------------------------------------------


def _selection(chosen: Any, if_true: Any, if_false: Any) -> Any:
    """Return the type of a selection; None if it is undefined."""
    if isinstance(if_true, types.BaseTuple):
        parts = [_selection(chosen, a, b) for a, b in zip(if_true, if_false, strict=True)]
        return (types.UniTuple if chosen == mask else Floats)(parts[0], len(parts))
    vectors = [t for t in (if_true, if_false) if isinstance(t, _VectorType)]
    if chosen == mask:
        plain = {types.Boolean: mask, types.Float: lanes, types.Integer: lanes}
        return vectors[0] if vectors else plain.get(type(if_true), lanes)
    if isinstance(chosen, types.Boolean) and not vectors:
        kind = types.unliteral(if_true)
        return kind if kind in (types.boolean, types.uint64) else types.float64
    return None


@intrinsic
def select(typing_context, chosen, if_true, if_false):  # type: ignore[no-untyped-def]
    """Return `if_true` where `chosen`, else `if_false`: numbers, vectors or matrices."""

    def choose(context, builder, chosen, kind, values, sources):  # type: ignore[no-untyped-def]
        if isinstance(kind, types.BaseTuple):
            parts = []
            for i, part in enumerate(kind):
                some = [builder.extract_value(value, i) for value in values]
                parts.append(
                    choose(context, builder, chosen, part, some, [s.types[i] for s in sources])
                )
            return context.make_tuple(builder, kind, parts)
        for i, source in enumerate(sources):
            cast = vector_of if isinstance(kind, _VectorType) else _cast
            values[i] = cast(context, builder, values[i], source, kind)
        return builder.select(chosen, *values)

    def lower(context, builder, sig, args):  # type: ignore[no-untyped-def]
        return choose(context, builder, args[0], sig.return_type, list(args[1:]), sig.args[1:])

    kind = _selection(chosen, if_true, if_false)
    return kind and (kind(chosen, if_true, if_false), lower)


def _cast(context: Any, builder: ir.IRBuilder, value: Any, source: Any, target: Any) -> Any:
    return context.cast(builder, value, source, target)


@intrinsic
def zero_like(typing_context, value):  # type: ignore[no-untyped-def]
    """Return zero times a number, vector or matrix: zero of its type, and NaN where it is NaN."""

    def times_zero(context, builder, number, kind):  # type: ignore[no-untyped-def]
        if isinstance(kind, types.BaseTuple):
            parts = [builder.extract_value(number, i) for i in range(len(kind))]
            zeros = [times_zero(context, builder, *each) for each in zip(parts, kind, strict=True)]
            return context.make_tuple(builder, kind, zeros)
        if kind != lanes:
            number = context.cast(builder, number, kind, types.float64)
        return builder.fmul(ir.Constant(number.type, None), number)

    def lower(context, builder, sig, args):  # type: ignore[no-untyped-def]
        return times_zero(context, builder, args[0], value)

    plain = isinstance(value, (types.Float, types.Integer))
    return (types.float64 if plain else value)(value), lower


@intrinsic
def no_lane(typing_context, value):  # type: ignore[no-untyped-def]
    """Return a mask without any lane, or False where the number `value` is a plain one."""

    def lower(context, builder, sig, args):  # type: ignore[no-untyped-def]
        return context.get_constant_null(sig.return_type)

    return (mask if value == lanes else types.boolean)(value), lower


@intrinsic
def logical_not(typing_context, asked):  # type: ignore[no-untyped-def]
    """Return the negation of a mask or boolean."""

    def lower(context, builder, sig, args):  # type: ignore[no-untyped-def]
        return builder.not_(args[0])

    return asked(asked), lower


@intrinsic
def _bits_of_mask(typing_context, asked):  # type: ignore[no-untyped-def]
    def lower(context, builder, sig, args):  # type: ignore[no-untyped-def]
        return builder.zext(builder.bitcast(args[0], ir.IntType(REGISTER)), ir.IntType(64))

    return types.uint64(asked), lower


def any_of(asked: Any) -> bool:
    """Return True if any lane is set: the only branch on data in kernels, to skip idle work."""
    raise NotImplementedError("any_of is available inside kernels only")


def all_of(asked: Any) -> bool:
    """Return True if all lanes are set."""
    raise NotImplementedError("all_of is available inside kernels only")


@overload(any_of)
def _any_of(asked):  # type: ignore[no-untyped-def]
    if asked == mask:
        return lambda asked: _bits_of_mask(asked) != 0
    if isinstance(asked, types.Boolean):
        return lambda asked: asked
    return None


@overload(all_of)
def _all_of(asked):  # type: ignore[no-untyped-def]
    if asked == mask:
        return lambda asked: _bits_of_mask(asked) == (1 << REGISTER) - 1
    if isinstance(asked, types.Boolean):
        return lambda asked: asked
    return None


# --------------------------------------------------------------------------------------------------
# Primitives of the elementary functions: bit patterns, rounding and fused multiply-adds.
#
# Each accepts a plain number or lanes, because LLVM's instructions do.
# --------------------------------------------------------------------------------------------------

_INT = ir.IntType(64)


class _Form(NamedTuple):
    """Form of floating-point numbers, by IEEE 754."""

    real: ir.Type
    word: ir.IntType  #: integer with as many bits
    bits: int  #: of the mantissa
    bias: int  #: of the exponent


_DOUBLE_FORM = _Form(ir.DoubleType(), ir.IntType(64), 52, 1023)
_SINGLE_FORM = _Form(ir.FloatType(), ir.IntType(32), 23, 127)
_LANES_FORM = _SINGLE_FORM if SINGLE else _DOUBLE_FORM


def _form_of(value: ir.Value) -> _Form:
    """The form of a number, or of the numbers in lanes."""
    return _LANES_FORM if isinstance(value.type, ir.VectorType) else _DOUBLE_FORM


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
    real, word, bits, bias = _form_of(x)
    biased = builder.fadd(x, _constant(builder, x, float(bias), real))
    shifted = builder.shl(builder.fptosi(biased, _like(x, word)), _constant(builder, x, bits, word))
    return builder.bitcast(shifted, _like(x, real))


def _exponent_of(builder: ir.IRBuilder, x: ir.Value) -> ir.Value:
    real, word, bits, bias = _form_of(x)
    pattern = builder.bitcast(x, _like(x, word))
    biased = builder.lshr(pattern, _constant(builder, x, bits, word))
    return builder.sitofp(builder.sub(biased, _constant(builder, x, bias, word)), _like(x, real))


def _with_exponent_zero(builder: ir.IRBuilder, mantissa: ir.Value) -> ir.Value:
    """The number from 1 to 2 with these bits of the mantissa."""
    real, word, bits, bias = _form_of(mantissa)
    one = builder.or_(mantissa, _constant(builder, mantissa, bias << bits, word))
    return builder.bitcast(one, _like(mantissa, real))


def _mantissa_of(builder: ir.IRBuilder, x: ir.Value) -> ir.Value:
    _, word, bits, _ = _form_of(x)
    pattern = builder.bitcast(x, _like(x, word))
    kept = builder.and_(pattern, _constant(builder, x, (1 << bits) - 1, word))
    return _with_exponent_zero(builder, kept)


round_to_even = _of_float(lambda builder, x: call_llvm(builder, "llvm.rint", x))
"""Nearest integer, ties to even, as a float."""
power_of_two = _of_float(_power_of_two)
"""2 ** x, exact, for an integer-valued float in [-1022, 1023], or [-126, 127] in float32."""
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
    """Return the top bits of a word, as many as a mantissa has, as a float in [1, 2)."""
    if not _is_word(word):
        return None

    def lower(context, builder, sig, args):  # type: ignore[no-untyped-def]
        form = _form_of(args[0])
        kept = builder.lshr(args[0], _constant(builder, args[0], 64 - form.bits))
        if form.word != _INT:
            kept = builder.trunc(kept, _like(kept, form.word))
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

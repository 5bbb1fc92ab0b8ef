"""Records of WIDTH flights, read by field name inside kernels, and access by addresses."""

import hashlib
import operator
from typing import Any

import numpy as np
from llvmlite import ir
from numba import types
from numba.core import cgutils, typing
from numba.core.datamodel import models
from numba.core.typing.arraydecl import GetItemBuffer, SetItemBuffer
from numba.core.typing.templates import AttributeTemplate, infer_global
from numba.extending import (
    infer_getattr,
    intrinsic,
    lower_getattr_generic,
    lower_setattr_generic,
    register_model,
)
from numba.np.arrayobj import make_array, populate_array
from numba.np.numpy_support import from_dtype

from quad_gym.kernels.numbers.lanes import ASKED_FIRST, lanes, vector_of, words
from quad_gym.records import REAL_BYTES, REGISTER, WIDTH

# --------------------------------------------------------------------------------------------------
# Records of WIDTH flights, read by field name inside kernels.
#
# A block is a NumPy structured record in which every field has a trailing axis of WIDTH (see
# `records/layout.py`). `lanes_of(block)` is a view of this memory for kernels: `block.mass` is a
# `Lanes`, `block.inertia` an array of `Lanes` of shape (3, 3). The scalar instance of a kernel
# takes a plain record with these field names, where `record.mass` is a float and `record.inertia` a
# float array.
# --------------------------------------------------------------------------------------------------


def _bytes_of(element: Any) -> int:
    """Bytes of the number or word of one flight."""
    return 8 if element == words else REAL_BYTES


def _array_of_lanes(element: Any, axes: int) -> Any:
    """Type of an array of lanes in a block: if they are not the whole block, with gaps.

    Copies of whole blocks may be unaligned, and unaligned loads are as fast.
    """
    whole = REGISTER == WIDTH
    return types.Array(element, axes, "C" if whole else "A", aligned=not whole)


class LaneRecord(types.Type):
    """Pointer to a record of WIDTH flights, whose fields are read as lanes."""

    def __init__(self, record: types.Record) -> None:
        self.record = record
        # a digest, as a record's name lists all its fields and is part of every symbol
        digest = hashlib.sha256(record.name.encode()).hexdigest()[:16]
        super().__init__(name=f"LaneRecord({digest})")

    def field(self, name: str) -> Any:
        """Return the type of field `name`: lanes, words, or an array of them."""
        nested = self.record.typeof(name)
        if not isinstance(nested, types.NestedArray) or nested.shape[-1] != WIDTH:
            raise TypeError(f"field {name!r} of a block must end in an axis of {WIDTH}")
        element = words if nested.dtype == types.uint64 else lanes
        if nested.ndim == 1:
            return element
        return _array_of_lanes(element, nested.ndim - 1)


@register_model(LaneRecord)
class _LaneRecordModel(models.PrimitiveModel):
    def __init__(self, manager: Any, numba_type: LaneRecord) -> None:
        super().__init__(manager, numba_type, ir.IntType(8).as_pointer())


@intrinsic
def lanes_of(typing_context, record):  # type: ignore[no-untyped-def]
    """Return a block as lanes, without copying: every field is read WIDTH flights at a time."""
    if isinstance(record, LaneRecord):
        return record(record), lambda context, builder, sig, args: args[0]
    if not isinstance(record, types.Record):
        return None

    def lower(context, builder, sig, args):  # type: ignore[no-untyped-def]
        return builder.bitcast(args[0], ir.IntType(8).as_pointer())

    return LaneRecord(record)(record), lower


@infer_getattr
class _LaneRecordAttributes(AttributeTemplate):
    key = LaneRecord

    def generic_resolve(self, block: LaneRecord, name: str) -> Any:
        return block.field(name) if name in block.record.fields else None


def _field_pointer(
    builder: ir.IRBuilder, block: LaneRecord, pointer: Any, name: str, kind: Any
) -> Any:
    word = ir.IntType(64)
    offset: Any = ir.Constant(word, block.record.offset(name))
    if kind == words and REGISTER < WIDTH and REAL_BYTES < 8:
        # the address of one flight of a block is that of the block, a multiple of REAL_BYTES
        # WIDTH, and that of the flight's lane among numbers; its words have twice the distance
        lane = ir.Constant(word, REAL_BYTES * WIDTH - 1)
        offset = builder.add(builder.and_(builder.ptrtoint(pointer, word), lane), offset)
    return builder.bitcast(builder.gep(pointer, [offset]), kind.llvm_type.as_pointer())


@lower_getattr_generic(LaneRecord)
def _get_field(context, builder, block, pointer, name):  # type: ignore[no-untyped-def]
    kind = block.field(name)
    if not isinstance(kind, types.Array):
        return builder.load(_field_pointer(builder, block, pointer, name, kind), align=REAL_BYTES)

    shape = block.record.typeof(name).shape[:-1]
    data = _field_pointer(builder, block, pointer, name, kind.dtype)
    return _array_of(context, builder, kind, data, shape)


def _array_of(context: Any, builder: ir.IRBuilder, kind: Any, data: Any, shape: Any) -> Any:
    """Return an array of lanes in memory."""
    strides: list[int] = []
    size = WIDTH * _bytes_of(kind.dtype)
    for length in reversed(shape):
        strides.insert(0, size)
        size *= length
    array = make_array(kind)(context, builder)
    populate_array(
        array,
        data=data,
        shape=cgutils.pack_array(builder, [context.get_constant(types.intp, n) for n in shape]),
        strides=cgutils.pack_array(builder, [context.get_constant(types.intp, s) for s in strides]),
        itemsize=context.get_constant(types.intp, REGISTER * _bytes_of(kind.dtype)),
        meminfo=None,
        parent=None,
    )
    return array._getvalue()


@intrinsic
def numbers_of(typing_context, block):  # type: ignore[no-untyped-def]
    """Return all numbers of a block as one array of lanes, in the order of its fields."""
    if not isinstance(block, LaneRecord):
        return None
    kind = _array_of_lanes(lanes, 1)

    def lower(context, builder, sig, args):  # type: ignore[no-untyped-def]
        data = builder.bitcast(args[0], kind.dtype.llvm_type.as_pointer())
        count = block.record.size // (WIDTH * REAL_BYTES)
        return _array_of(context, builder, kind, data, (count,))

    return kind(block), lower


@lower_setattr_generic(LaneRecord)
def _set_field(context, builder, sig, args, name):  # type: ignore[no-untyped-def]
    block, source = sig.args
    pointer, value = args
    kind = block.field(name)
    vector = vector_of(context, builder, value, source, kind)
    builder.store(vector, _field_pointer(builder, block, pointer, name, kind), align=REAL_BYTES)


@intrinsic(prefer_literal=True)
def set_field(typing_context, block, name, value):  # type: ignore[no-untyped-def]
    """Write a field of a block, for functions that are generated for several fields.

    `getattr` reads such a field; for both, the name is a constant.
    """
    if not isinstance(block, LaneRecord) or not isinstance(name, types.StringLiteral):
        return None
    field = name.literal_value

    def lower(context, builder, sig, args):  # type: ignore[no-untyped-def]
        stored = typing.signature(types.none, block, value)
        _set_field(context, builder, stored, (args[0], args[2]), field)
        return context.get_dummy_value()

    return types.none(block, name, value), lower


@intrinsic(prefer_literal=True)
def reset(typing_context, block, chosen, value, names):  # type: ignore[no-untyped-def]
    """Set fields of a block, all numbers of them, to `value` where `chosen`; names: "a b c"."""
    if not isinstance(block, LaneRecord) or not isinstance(names, types.StringLiteral):
        return None

    def lower(context, builder, sig, args):  # type: ignore[no-untyped-def]
        for name in names.literal_value.split():
            kind = block.field(name)
            element = kind.dtype if isinstance(kind, types.Array) else kind
            number = vector_of(context, builder, args[2], types.unliteral(value), element)
            first = _field_pointer(builder, block, args[0], name, element)
            for k in range(0, block.record.typeof(name).nitems // REGISTER, WIDTH // REGISTER):
                pointer = builder.gep(first, [ir.Constant(ir.IntType(32), k)])
                before = builder.load(pointer, align=REAL_BYTES)
                builder.store(builder.select(args[1], number, before), pointer, align=REAL_BYTES)
        return context.get_dummy_value()

    return types.none(block, chosen, types.unliteral(value), names), lower


@intrinsic(prefer_literal=True)
def keep_fields(  # type: ignore[no-untyped-def]
    typing_context, block, other, chosen, names, prefix, others
):
    """Copy fields of another block where `chosen`, all numbers of them; names: "a b c".

    `prefix` and `others` come before these names in the two blocks.
    """
    if not isinstance(block, LaneRecord) or not isinstance(names, types.StringLiteral):
        return None

    def lower(context, builder, sig, args):  # type: ignore[no-untyped-def]
        for name in names.literal_value.split():
            to, source = prefix.literal_value + name, others.literal_value + name
            kind = block.field(to)
            element = kind.dtype if isinstance(kind, types.Array) else kind
            first = _field_pointer(builder, block, args[0], to, element)
            copied = _field_pointer(builder, other, args[1], source, element)
            for k in range(0, block.record.typeof(to).nitems // REGISTER, WIDTH // REGISTER):
                step = [ir.Constant(ir.IntType(32), k)]
                pointer, place = builder.gep(first, step), builder.gep(copied, step)
                numbers = (builder.load(where, align=REAL_BYTES) for where in (place, pointer))
                builder.store(builder.select(args[2], *numbers), pointer, align=REAL_BYTES)
        return context.get_dummy_value()

    return types.none(block, other, types.unliteral(chosen), names, prefix, others), lower


def _counted_from_the_start(generic: Any, args: Any, kws: Any) -> Any:
    """The signature of an access to an array of lanes, or by an enum, with unsigned indices.

    For signed ones, Numba adds the length to a negative index, which takes a tenth of a filter's
    time. Numba itself takes enums from 0.68 on.
    """
    array, index, *value = args
    parts = list(index) if isinstance(index, types.BaseTuple) else [index]
    by_enum = any(isinstance(part, types.IntEnumMember) for part in parts)
    if not by_enum and getattr(array, "dtype", None) not in (lanes, words):
        return None
    numbers = (types.Integer, types.IntEnumMember)
    parts = [types.uintp if isinstance(part, numbers) else part for part in parts]
    index = types.BaseTuple.from_types(parts) if isinstance(index, types.BaseTuple) else parts[0]
    return generic((array, index, *value), kws)


@infer_global(operator.getitem)
class _Reading(GetItemBuffer):  # type: ignore[misc]
    metadata = ASKED_FIRST

    def generic(self, args: Any, kws: Any) -> Any:
        return _counted_from_the_start(super().generic, args, kws)


@infer_global(operator.setitem)
class _Writing(SetItemBuffer):  # type: ignore[misc]
    metadata = ASKED_FIRST

    def generic(self, args: Any, kws: Any) -> Any:
        return _counted_from_the_start(super().generic, args, kws)


# --------------------------------------------------------------------------------------------------
# Access to records, arrays and rows of numbers by their addresses in compiled code.
#
# An address is a word (int64). The caller that passes one keeps the memory alive.
# --------------------------------------------------------------------------------------------------

_BYTES = ir.IntType(8).as_pointer()
_INDEX = ir.IntType(32)
_SINGLE = ir.FloatType()


def _pointer_at(kind: Any) -> Any:
    @intrinsic
    def at(typing_context, address):  # type: ignore[no-untyped-def]
        def lower(context, builder, sig, args):  # type: ignore[no-untyped-def]
            return builder.inttoptr(args[0], context.get_value_type(kind))

        return kind(types.int64), lower

    return at


def record_at(dtype: np.dtype) -> Any:
    """Return a function that returns the record of a type at an address."""
    return _pointer_at(from_dtype(dtype))


def lanes_at(dtype: np.dtype) -> Any:
    """Return a function that returns the lanes of a block of a type at an address."""
    return _pointer_at(LaneRecord(from_dtype(dtype)))


def array_at(dtype: Any) -> Any:
    """Return a function that returns the array of a type, and of a given length, at an address."""
    kind = types.Array(from_dtype(np.dtype(dtype)), 1, "C", aligned=False)

    @intrinsic
    def at(typing_context, address, length):  # type: ignore[no-untyped-def]
        def lower(context, builder, sig, args):  # type: ignore[no-untyped-def]
            element = context.get_data_type(kind.dtype)
            size = context.get_constant(types.intp, context.get_abi_sizeof(element))
            array = make_array(kind)(context, builder)
            populate_array(
                array,
                data=builder.inttoptr(args[0], element.as_pointer()),
                shape=cgutils.pack_array(builder, [args[1]]),
                strides=cgutils.pack_array(builder, [size]),
                itemsize=size,
                meminfo=None,
                parent=None,
            )
            return array._getvalue()

        return kind(types.int64, types.int64), lower

    return at


@intrinsic
def store_lanes(typing_context, address, value):  # type: ignore[no-untyped-def]
    """Write lanes or words to consecutive float64 at an address, whatever the precision."""
    if value not in (lanes, words):
        return None

    def lower(context, builder, sig, args):  # type: ignore[no-untyped-def]
        number, wide = args[1], ir.VectorType(ir.DoubleType(), REGISTER)
        if value == words:
            number = builder.uitofp(number, wide)
        elif number.type != wide:
            number = builder.fpext(number, wide)
        builder.store(number, builder.inttoptr(args[0], wide.as_pointer()), align=8)
        return context.get_dummy_value()

    return types.none(types.int64, value), lower


def _lane_pointer(builder: ir.IRBuilder, addresses: Any, offset: Any, lane: int) -> Any:
    address = builder.extract_element(addresses, _INDEX(lane))
    return builder.inttoptr(builder.add(address, offset), lanes.llvm_type.element.as_pointer())


@intrinsic
def gather_lanes(typing_context, addresses, offset):  # type: ignore[no-untyped-def]
    """Read a number for each lane, at an offset from its address (words)."""
    if addresses != words:
        return None

    def lower(context, builder, sig, args):  # type: ignore[no-untyped-def]
        value = ir.Constant(lanes.llvm_type, ir.Undefined)
        for lane in range(REGISTER):
            number = builder.load(_lane_pointer(builder, *args, lane), align=REAL_BYTES)
            value = builder.insert_element(value, number, _INDEX(lane))
        return value

    return lanes(words, types.int64), lower


@intrinsic
def scatter_lanes(typing_context, addresses, offset, value):  # type: ignore[no-untyped-def]
    """Write each lane at an offset from its address (words)."""
    if addresses != words or value != lanes:
        return None

    def lower(context, builder, sig, args):  # type: ignore[no-untyped-def]
        for lane in range(REGISTER):
            number = builder.extract_element(args[2], _INDEX(lane))
            builder.store(number, _lane_pointer(builder, *args[:2], lane), align=REAL_BYTES)
        return context.get_dummy_value()

    return types.none(words, types.int64, lanes), lower


@intrinsic
def prefetch(typing_context, address):  # type: ignore[no-untyped-def]
    """Prefetch the cache line at an address, which may be invalid."""

    def lower(context, builder, sig, args):  # type: ignore[no-untyped-def]
        word = ir.IntType(32)
        kind = ir.FunctionType(ir.VoidType(), [_BYTES, word, word, word])
        function = builder.module.declare_intrinsic("llvm.prefetch", [_BYTES], kind)
        place = builder.inttoptr(args[0], _BYTES)
        builder.call(function, [place, word(0), word(2), word(1)])  # read, to the second level
        return context.get_dummy_value()

    return types.none(types.int64), lower


@intrinsic
def store_tile(typing_context, address, pitch, source, first):  # type: ignore[no-untyped-def]
    """Write REGISTER elements of an array of lanes, from `first` on, as float32, one row per lane.

    The first lane's row is at `address`; each next one is `pitch` bytes further.
    """

    def lower(context, builder, sig, args):  # type: ignore[no-untyped-def]
        begin, pitch, _, first = args
        array = context.make_array(sig.args[2])(context, builder, args[2])
        rows = []
        for k in range(REGISTER):
            place = builder.add(first, context.get_constant(types.intp, k))
            pointer = cgutils.get_item_pointer(context, builder, sig.args[2], array, [place])
            row = builder.load(pointer, align=REAL_BYTES)
            narrow = ir.VectorType(_SINGLE, REGISTER)
            rows.append(row if row.type == narrow else builder.fptrunc(row, narrow))
        for lane, row in enumerate(_transposed(builder, rows)):
            offset = builder.mul(pitch, context.get_constant(types.int64, lane))
            pointer = builder.inttoptr(builder.add(begin, offset), row.type.as_pointer())
            builder.store(row, pointer, align=4)
        return context.get_dummy_value()

    return types.none(types.int64, types.int64, source, types.intp), lower


def _transposed(builder: ir.IRBuilder, rows: list[Any]) -> list[Any]:
    """Transpose a square matrix of vectors by swapping off-diagonal blocks of doubling size."""
    size = 1
    while size < REGISTER:
        # indices of the sources of rows i and i + size in the concatenation of both rows
        upper = [k if k & size == 0 else REGISTER + k - size for k in range(REGISTER)]
        lower = [k + size if k & size == 0 else REGISTER + k for k in range(REGISTER)]
        masks = [ir.Constant(ir.VectorType(_INDEX, REGISTER), chosen) for chosen in (upper, lower)]
        for i in range(REGISTER):
            if i & size == 0:
                pair = rows[i], rows[i + size]
                rows[i], rows[i + size] = (builder.shuffle_vector(*pair, m) for m in masks)
        size *= 2
    return rows

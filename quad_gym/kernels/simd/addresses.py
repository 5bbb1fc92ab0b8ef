"""Access to records, arrays and rows of numbers by their addresses in compiled code.

An address is a word (int64). The caller that passes one keeps the memory alive.
"""

from typing import Any

import numpy as np
from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.extending import intrinsic
from numba.np.arrayobj import make_array, populate_array
from numba.np.numpy_support import from_dtype

from quad_gym.kernels.simd.blocks import LaneRecord
from quad_gym.kernels.simd.lanes import lanes, words
from quad_gym.records import REGISTER

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
    """Write lanes to consecutive float64 at an address."""
    if value != lanes:
        return None

    def lower(context, builder, sig, args):  # type: ignore[no-untyped-def]
        builder.store(args[1], builder.inttoptr(args[0], args[1].type.as_pointer()), align=8)
        return context.get_dummy_value()

    return types.none(types.int64, lanes), lower


def _lane_pointer(builder: ir.IRBuilder, addresses: Any, offset: Any, lane: int) -> Any:
    address = builder.extract_element(addresses, _INDEX(lane))
    return builder.inttoptr(builder.add(address, offset), ir.DoubleType().as_pointer())


@intrinsic
def gather_lanes(typing_context, addresses, offset):  # type: ignore[no-untyped-def]
    """Read a float64 for each lane, at an offset from its address (words)."""
    if addresses != words:
        return None

    def lower(context, builder, sig, args):  # type: ignore[no-untyped-def]
        value = ir.Constant(lanes.llvm_type, ir.Undefined)
        for lane in range(REGISTER):
            number = builder.load(_lane_pointer(builder, *args, lane), align=8)
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
            builder.store(number, _lane_pointer(builder, *args[:2], lane), align=8)
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
            wide = builder.load(pointer, align=8)
            rows.append(builder.fptrunc(wide, ir.VectorType(_SINGLE, REGISTER)))
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

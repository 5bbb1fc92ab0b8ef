"""Stages in compiled code: the decorator that makes one, and the call through the table."""

from collections.abc import Callable
from typing import Any

from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.extending import intrinsic
from numba.np.numpy_support import from_dtype

from quad_gym.kernels.compiling.decorators import entry, kernel
from quad_gym.kernels.simd.blocks import lanes_of
from quad_gym.kernels.stages import STAGE_TABLE
from quad_gym.records import FLIGHT_BLOCK, PARAMS_BLOCK, SETTINGS, WARP, WIDTH, WORK_BLOCK

_DTYPES = (FLIGHT_BLOCK, PARAMS_BLOCK, PARAMS_BLOCK, SETTINGS, WORK_BLOCK, STAGE_TABLE)
_ARGUMENTS = (*map(from_dtype, _DTYPES), types.int64)
SIGNATURE = types.none(*_ARGUMENTS)
"""Signature of every stage: flight, world, model, settings, work, stages, flag."""


def stage(function: Callable[..., Any]) -> Any:
    """Compile `function` as a stage.

    Its arguments are a block of flights, the true parameters and the assumed ones, the settings,
    the workspace, the table of stages, and a number whose meaning depends on the stage. Blocks
    come as lanes; `work.mask` holds those to work on.
    """
    body = kernel(function)

    def call(flight, world, model, settings, work, stages, flag):  # type: ignore[no-untyped-def]
        world, model, work = lanes_of(world), lanes_of(model), lanes_of(work)
        body(lanes_of(flight), world, model, settings, work, stages, flag)

    call.__name__, call.__module__ = function.__name__, function.__module__
    call.__qualname__ = function.__qualname__
    return entry(call, SIGNATURE)


@intrinsic
def _call(typing_context, address, flight, world, model, settings, work, stages, flag):  # type: ignore[no-untyped-def]
    def lower(context, builder, sig, args):  # type: ignore[no-untyped-def]
        kind = context.call_conv.get_function_type(types.none, _ARGUMENTS)
        pointers = [
            builder.bitcast(value, context.get_value_type(wanted))
            for value, wanted in zip(args[1:7], _ARGUMENTS, strict=False)
        ]
        last = context.cast(builder, args[7], sig.args[7], types.int64)
        context.call_conv.call_function(
            builder,
            builder.inttoptr(args[0], ir.PointerType(kind)),
            types.none,
            _ARGUMENTS,
            [*pointers, last],
        )
        return context.get_dummy_value()

    return types.none(address, flight, world, model, settings, work, stages, flag), lower


SLOT = "qg_call_slot"
"""Function that calls the stage of a slot by its name, as a GPU must: `compiling/device.py` writes
it for a configuration."""


@intrinsic
def _call_slot(typing_context, stage, flight, world, model, settings, work, stages, flag):  # type: ignore[no-untyped-def]
    def lower(context, builder, sig, args):  # type: ignore[no-untyped-def]
        byte, word = ir.IntType(8).as_pointer(), ir.IntType(64)
        kind = ir.FunctionType(ir.VoidType(), [word, *[byte] * 6, word])
        function = cgutils.get_or_insert_function(builder.module, kind, SLOT)
        numbers = [context.cast(builder, args[k], sig.args[k], types.int64) for k in (0, 7)]
        pointers = [builder.bitcast(value, byte) for value in args[1:7]]
        builder.call(function, [numbers[0], *pointers, numbers[1]])
        return context.get_dummy_value()

    return types.none(stage, flight, world, model, settings, work, stages, flag), lower


@kernel
def _call_by_name(stages, stage, flight, world, model, settings, work, flag):
    _call_slot(stage, flight, world, model, settings, work, stages, flag)


@kernel
def _call_by_address(stages, stage, flight, world, model, settings, work, flag):
    address = stages.address[stage]
    if address != 0:
        _call(address, flight, world, model, settings, work, stages, flag)


call_stage = _call_by_name if WIDTH == WARP else _call_by_address
"""Call a stage unless its slot is empty; the records are those that it is compiled for."""

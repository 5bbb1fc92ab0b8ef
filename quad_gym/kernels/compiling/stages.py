"""Stages in compiled code: the decorator that makes one, and the call through the table."""

from collections.abc import Callable
from typing import Any

from llvmlite import ir
from numba import types
from numba.extending import intrinsic
from numba.np.numpy_support import from_dtype

from quad_gym.kernels.compiling.decorators import entry, kernel
from quad_gym.kernels.simd.blocks import lanes_of
from quad_gym.kernels.stages import STAGE_TABLE
from quad_gym.records import FLIGHT_BLOCK, PARAMS_BLOCK, SETTINGS, WORK_BLOCK

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


@kernel
def call_stage(stages, stage, flight, world, model, settings, work, flag):
    """Call a stage unless its slot is empty; the records are those that it is compiled for."""
    address = stages.address[stage]
    if address != 0:
        _call(address, flight, world, model, settings, work, stages, flag)

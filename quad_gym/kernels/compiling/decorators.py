"""The decorators `kernel`, `routine`, `entry` and `stage`, and the call of a stage.

No fast-math flag is set: multiply-adds are fused only where numbers are lowered, see
`kernels/numbers/lanes.py`, so that a result does not depend on the code around its computation.
"""

import functools
from collections.abc import Callable
from typing import Any

import numba
from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.core.registry import CPUDispatcher
from numba.extending import intrinsic
from numba.np.numpy_support import from_dtype

from quad_gym.kernels.compiling.cache import CodeCache, note_import
from quad_gym.kernels.compiling.linking import EntryCompiler, KernelCompiler, KernelDispatcher
from quad_gym.kernels.numbers.blocks import lanes_of
from quad_gym.kernels.stages import STAGE_TABLE
from quad_gym.records import FLIGHT_BLOCK, PARAMS_BLOCK, SETTINGS, WARP, WIDTH, WORK_BLOCK

# --------------------------------------------------------------------------------------------------
# The decorators `kernel`, `routine` and `entry`.
# --------------------------------------------------------------------------------------------------

_OPTIONS: dict[str, Any] = {"nopython": True, "boundscheck": None, "error_model": "numpy"}


def kernel(function: Callable[..., Any]) -> Any:
    """Compile `function` as part of the code that calls it, inlined: for small functions."""
    return _kernel(function, forceinline=True)


def routine(function: Callable[..., Any]) -> Any:
    """Compile `function` as part of the code that calls it, out of line: for large functions."""
    return _kernel(function)


def _kernel(function: Callable[..., Any], **options: Any) -> Any:
    note_import(function)
    return KernelDispatcher(
        py_func=function, targetoptions=_OPTIONS | options, pipeline_class=KernelCompiler
    )


class EntryDispatcher(CPUDispatcher):  # type: ignore[misc]
    """Compiled code that Python calls: cached on disk, compiled by one process at a time."""

    signature: Any = None
    """the only signature that it accepts, if there is only one"""

    def compile(self, signature: Any) -> Any:
        """Load the compiled code for a signature, or compile it and keep it in the cache."""
        arguments, _ = numba.core.sigutils.normalize_signature(signature)
        if self.overloads.get(tuple(arguments)) is not None:
            return super().compile(signature)
        with self._cache.compiling_alone(signature, self.targetctx):
            return super().compile(signature)

    def is_cached(self) -> bool:
        """True if the code for its signature is loaded or in the cache."""
        return bool(self.overloads) or self._cache.holds(self.signature, self.targetctx)


def entry(function: Callable[..., Any] | None = None, signature: Any = None) -> Any:
    """Compile `function` for calls from Python: cached on disk, running without the GIL.

    As a decorator: `@entry`, or `@entry(signature=...)` with the Numba types of its arguments, so
    that it can be compiled ahead of a call.
    """
    if function is None:
        return functools.partial(entry, signature=signature)
    note_import(function)
    options = _OPTIONS | {"nogil": True}
    dispatcher = EntryDispatcher(function, targetoptions=options, pipeline_class=EntryCompiler)
    dispatcher._cache = CodeCache(function)
    dispatcher.signature = signature
    return dispatcher


# --------------------------------------------------------------------------------------------------
# Stages in compiled code: the decorator that makes one, and the call through the table.
# --------------------------------------------------------------------------------------------------

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
"""Function that calls the stage of a slot by its name, as a GPU must: `compiling/building.py`
writes it for a configuration."""


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

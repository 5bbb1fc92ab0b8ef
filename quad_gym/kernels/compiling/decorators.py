"""The decorators `kernel`, `routine` and `entry`.

No fast-math flag is set: multiply-adds are fused only where numbers are lowered, see
`kernels/simd/lanes.py`, so that a result does not depend on the code around its computation.
"""

import functools
from collections.abc import Callable
from typing import Any

import numba
from numba.core.registry import CPUDispatcher

from quad_gym.kernels.compiling.cache import CodeCache
from quad_gym.kernels.compiling.linking import EntryCompiler, KernelCompiler, KernelDispatcher
from quad_gym.kernels.digest import note_import

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

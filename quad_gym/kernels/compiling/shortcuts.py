"""Shortcuts through Numba, for processes that only compile kernels.

Numba's own Python code takes three quarters of the time in which kernels compile, and a third of
it has no effect on their machine code. `take` replaces the functions of Numba that do this part.
The replacements lead to the same machine code: `tests/unit/compiling/test_shortcuts.py` compares.

Only workers take them (`workers.py`), not the processes of users, which compile other functions,
too. Some of the names are private. In a version of Numba that is not among the tested ones,
nothing is replaced, and kernels compile as before, only longer.
"""

import functools
from typing import Any

import numba
from llvmlite import ir
from numba.core import base, compiler_machinery, postproc, transforms
from numba.core.runtime.context import NRTContext
from numba.core.types.functions import BaseFunction
from numba.core.typing.context import BaseContext as TypingContext

TESTED = ("0.63", "0.64", "0.65", "0.66", "0.67", "0.68")
"""Versions of Numba in which the replaced functions are the ones that this file describes."""


def take(version: str = numba.__version__) -> bool:
    """Replace functions of Numba in this process, once; False in versions that are not tested."""
    if ".".join(version.split(".")[:2]) not in TESTED:
        return False
    for owner, name, shortcut in _SHORTCUTS:
        setattr(owner, name, shortcut(getattr(owner, name)))
    return True


def _without_descriptions(run_pass: Any) -> Any:
    """Run a pass of the compiler without describing the types of arguments for listeners.

    In every pass of every kernel, such a description would list all fields of the records.
    """

    def run(manager: Any, index: int, compiler_pass: Any, state: Any) -> None:
        if compiler_pass.name() != "nopython_rewrites":  # of operations on whole arrays
            compiler_pass.analysis = manager._analysis
            compiler_pass.run_initialization(state)
            compiler_pass.run_pass(state)
            compiler_pass.run_finalizer(state)

    return run


def _at_the_end(run: Any) -> Any:
    """Determine how long variables live only for the last pass, the only one that needs it.

    It is expensive, and other passes ask for it in order to leave the code in a complete state.
    """

    def analyze(processor: Any, emit_dels: bool = False, extend_lifetimes: bool = False) -> None:
        code = processor.func_ir
        if emit_dels or code.is_generator:
            run(processor, emit_dels, extend_lifetimes)
        else:
            code.blocks = transforms.canonicalize_cfg(code.blocks)
            code.variable_lifetime = postproc.VariableLifetime(code.blocks)  # when asked
            code.generator_info = None

    return analyze


def _after_registrations(refresh: Any) -> Any:
    """Refresh a context only if functions have been registered since it was last refreshed."""
    known: dict[int, int] = {}

    def count(context: Any) -> int:
        return sum(
            len(getattr(registry, kind))
            for each in {context, getattr(context, "typing_context", context)}
            for registry, loader in each._registries.items()
            for kind in loader.registry_items
        )

    def refresh_once(context: Any) -> None:
        key, found = id(context._registries), count(context)  # which copies of a context share
        if known.get(key) != found:
            refresh(context)
            known[key] = found  # from before, as `refresh` may register more

    return refresh_once


def _remembered(get_call_type: Any) -> Any:
    """Choose an implementation of a function once for the types of its arguments."""
    known: dict[Any, tuple[Any, Any, Any]] = {}

    def resolve(function: Any, context: Any, args: Any, kws: Any) -> Any:
        if kws:
            return get_call_type(function, context, args, kws)
        key = (id(function), id(context), tuple(args))
        if key not in known:
            signature = get_call_type(function, context, args, kws)
            known[key] = function, signature, function._impl_keys[signature.args]
        _, signature, implementation = known[key]
        function._impl_keys[signature.args] = implementation  # as the call would do
        return signature

    return resolve


def _by_text(get_abi_size: Any) -> Any:
    """Ask LLVM only once for the size of a type, as it has to parse a module for that."""
    known: dict[tuple[str, int], int] = {}

    def size(kind: Any, target_data: Any, context: Any = None) -> int:
        text = str(kind)
        if "%" in text:  # a named type, which is another one in another module
            return int(get_abi_size(kind, target_data, context))
        key = (text, id(target_data))
        if key not in known:
            known[key] = get_abi_size(kind, target_data, context)
        return known[key]

    return size


def _where_counted(change: Any) -> Any:
    """Change counts of references only in values that have some, unlike numbers.

    Otherwise Numba takes every tuple of numbers apart to look for them, in code that LLVM then
    has to remove.
    """

    @functools.cache
    def counted(models: Any, kind: Any) -> bool:
        return bool(models[kind].contains_nrt_meminfo())

    def change_counted(counts: Any, builder: Any, kind: Any, value: Any, function: str) -> None:
        if counted(counts._context.data_model_manager, kind):
            change(counts, builder, kind, value, function)

    return change_counted


def _remembered_attribute(find: Any) -> Any:
    """Look up an attribute of a type, such as a field of a record, once."""
    known: dict[Any, Any] = {}

    def find_once(context: Any, kind: Any, attribute: str) -> Any:
        key = (id(context), kind, attribute)
        if known.get(key) is None:
            known[key] = find(context, kind, attribute)
        return known[key]

    return find_once


_SHORTCUTS: tuple[tuple[Any, str, Any], ...] = (
    (compiler_machinery.PassManager, "_runPass", _without_descriptions),
    (postproc.PostProcessor, "run", _at_the_end),
    (base.BaseContext, "refresh", _after_registrations),
    (TypingContext, "refresh", _after_registrations),
    (TypingContext, "find_matching_getattr_template", _remembered_attribute),
    (BaseFunction, "get_call_type", _remembered),
    (base, "_has_loc", functools.cache),
    (ir.Type, "get_abi_size", _by_text),
    (NRTContext, "_call_incref_decref", _where_counted),
)
"""Classes and modules of Numba, names of their functions, and a maker of each replacement."""

"""Kernels that stay LLVM IR until compiled code links them, by means of Numba's internals.

Numba makes a library of every jitted function: it links the functions that this one calls,
optimizes the whole, and emits machine code and two wrappers for it, even if only other jitted
functions ever call it. So nested kernels are optimized and emitted once for every level above them.
Here the library of a kernel is its unoptimized IR. An entry, the only kind of function that Python
calls, links each kernel that it reaches once, and is the only kind that is optimized and emitted.

A kernel's code therefore exists inside entries only, as a symbol that is internal to the entry's
module: a large kernel can be out of line without a second copy for other callers.
"""

from typing import Any

import llvmlite.binding as llvm
from numba.core import codegen, compiler, typed_passes
from numba.core.compiler import CompilerBase, DefaultPassBuilder
from numba.core.compiler_machinery import register_pass
from numba.core.registry import CPUDispatcher

from quad_gym.records import REAL_BYTES, REGISTER

_LANES_BYTES = REAL_BYTES * REGISTER


class _AlignedLibrary(codegen.JITCodeLibrary):  # type: ignore[misc]
    """A library whose functions keep vectors of lanes on the stack within cache lines.

    LLVM aligns the stack for the variables known when it begins to allocate registers, not for
    registers that it spills later; these would straddle cache lines, and some would straddle pages.
    """

    def add_ir_module(self, ir_module: Any) -> None:
        """Add IR as Numba has lowered it."""
        for function in ir_module.functions:
            if not function.is_declaration:
                function.attributes.alignstack = _LANES_BYTES
                function.attributes.add("uwtable")  # llvmlite omits an alignment without it
        super().add_ir_module(ir_module)


class KernelLibrary(_AlignedLibrary):
    """The IR of a kernel, and the libraries that it calls."""

    def add_llvm_module(self, ll_module: Any) -> None:
        """Keep the IR of a module as it is."""
        ll_module.data_layout = self._codegen._data_layout
        self._final_module.link_in(ll_module)

    def finalize(self) -> None:
        """Close the library, without optimizing or emitting code."""
        self._raise_if_finalized()
        for library in self._linking_libraries:
            self._reload_init.update(library._reload_init)
        self._finalize_dynamic_globals()
        self._finalized = True

    def reached(self, seen: dict[Any, None]) -> None:
        """Add all libraries below this one to `seen`, callees before callers."""
        for library in self._linking_libraries:
            if library not in seen:
                if isinstance(library, KernelLibrary):
                    library.reached(seen)
                seen[library] = None


class EntryLibrary(_AlignedLibrary):
    """The code of an entry with all kernels that it reaches."""

    _linking_libraries: list[Any]

    def finalize(self) -> None:
        """Link the kernels, optimize, and emit machine code."""
        seen: dict[Any, None] = {}
        for library in self._linking_libraries:
            if isinstance(library, KernelLibrary):
                library.reached(seen)
            seen[library] = None
        # callers first: LLVM links a function that may exist elsewhere only if it is needed already
        self._linking_libraries = list(seen)[::-1]
        self._kernels = {
            function.name
            for library in seen
            if isinstance(library, KernelLibrary)
            for function in library._final_module.functions
            if not function.is_declaration
        }
        super().finalize()

    def hide_kernels(self) -> None:
        """Make the kernels internal to the entry's module."""
        for function in self._final_module.functions:
            if function.name in self._kernels and not function.is_declaration:
                function.linkage = llvm.Linkage.internal

    def _optimize_final_module(self) -> None:
        self.hide_kernels()
        # one run: the cheap one before it, by which Numba prunes reference counts, has nothing
        # to prune in kernels
        passes, builder = self._codegen._module_pass_manager()
        passes.run(self._final_module, builder)


@register_pass(mutates_CFG=True, analysis_only=False)
class KernelLowering(typed_passes.NativeLowering):  # type: ignore[misc]
    """Lower to IR, and stop there."""

    _name = "quad_gym_kernel_lowering"

    def run_pass(self, state: Any) -> bool:
        """Lower one kernel."""
        state.library = KernelLibrary(state.targetctx.codegen(), state.func_id.func_qualname)
        flags = state.flags.copy()
        flags.no_compile = flags.no_cpython_wrapper = flags.no_cfunc_wrapper = True
        state.flags = flags
        super().run_pass(state)
        lowered = state["cr"]
        state.library._ensure_finalized()
        handle = list[Any]().append  # a unique callable: Numba finds the overload by its identity
        state.targetctx.insert_user_function(handle, lowered.fndesc, [state.library])
        state["cr"] = compiler._LowerResult(
            lowered.fndesc, lowered.call_helper, cfunc=handle, env=lowered.env
        )
        return True


@register_pass(mutates_CFG=True, analysis_only=False)
class EntryLowering(typed_passes.NativeLowering):  # type: ignore[misc]
    """Lower, link, optimize and emit."""

    _name = "quad_gym_entry_lowering"

    def run_pass(self, state: Any) -> bool:
        """Compile one entry."""
        flags = state.flags.copy()
        flags.no_cfunc_wrapper = True
        state.flags = flags
        state.library = EntryLibrary(state.targetctx.codegen(), state.func_id.func_qualname)
        state.library.enable_object_caching()
        return bool(super().run_pass(state))


_NOT_FOR_KERNELS = frozenset(
    {
        "WithLifting",
        "InlineClosureLikes",
        "RewriteDynamicRaises",
        "MakeFunctionToJitFunction",
        "InlineInlinables",
        "FindLiterallyCalls",
        "LiteralUnroll",
        "LiteralPropagationSubPipelinePass",
        "InlineOverloads",
        "AnnotateTypes",
        "DumpParforDiagnostics",
    }
)
"""Passes that have no effect on kernels, which have no closures, `with`, `literally`, or exceptions
with arguments that vary; together a tenth of the time that kernels take to compile."""


def compiler_with(lowering: type, left_out: frozenset[str] = frozenset()) -> type:
    """Return Numba's compiler with another lowering, and without some passes."""

    class Compiler(CompilerBase):  # type: ignore[misc]
        def define_pipelines(self) -> list[Any]:
            passes = DefaultPassBuilder.define_nopython_pipeline(self.state)
            passes.passes[:] = [
                (lowering if kind is typed_passes.NativeLowering else kind, description)
                for kind, description in passes.passes
                if kind.__name__ not in left_out
            ]
            passes.finalize()
            return [passes]

    return Compiler


KernelCompiler = compiler_with(KernelLowering, _NOT_FOR_KERNELS)
EntryCompiler = compiler_with(EntryLowering)


class KernelDispatcher(CPUDispatcher):  # type: ignore[misc]
    """A kernel: other compiled code may call it, Python may not."""

    def __call__(self, *args: Any, **kwargs: Any) -> Any:
        """Refuse the call, as a kernel has no separate machine code.

        Raises:
            TypeError: Always.
        """
        raise TypeError(
            f"{self.py_func.__name__} is a kernel, which only compiled code can call; "
            "call it from a function decorated with quad_gym's `entry`"
        )

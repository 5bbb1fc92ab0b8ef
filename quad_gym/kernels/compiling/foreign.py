"""Object code of entries for other processors than this machine's.

Entries are lowered and linked by Numba as for this machine, and then optimized and emitted by LLVM
for the other processor. The linked code is cached: it is the same for all processors.
"""

import contextlib
import re
import zlib
from typing import Any, NamedTuple

import llvmlite.binding as llvm
from numba.core import compiler, typed_passes
from numba.core.compiler_machinery import register_pass
from numba.core.registry import cpu_target

from quad_gym.kernels.compiling.linking import EntryLibrary, compiler_with
from quad_gym.kernels.compiling.workers import dispatcher_of

_OPTIONS = {"nopython": True, "boundscheck": None, "error_model": "numpy", "nogil": True}
_KEPT = 2
"""Number of cached files for a function."""
_LIBRARY = re.compile(
    r"sin|cos|sqrt|"
    r"llvm\.(sin|cos|sqrt|fma|fabs|copysign|floor|rint|roundeven|fsh[lr]|[su](min|max)|abs|ctpop|"
    r"mem(cpy|set|move)|lifetime|assume|experimental|vector|is)\b.*"
)
"""Functions that emitted code may call: LLVM's, and those of a C library."""


class Processor(NamedTuple):
    """A processor, in LLVM's words."""

    triple: str
    cpu: str
    features: str = ""


class _ForeignLibrary(EntryLibrary):
    """An entry with all kernels that it reaches, as IR that is neither optimized nor emitted."""

    def _optimize_final_module(self) -> None:
        self.hide_kernels()

    def _finalize_final_module(self) -> None:
        self._finalized = True


@register_pass(mutates_CFG=True, analysis_only=False)
class _ForeignLowering(typed_passes.NativeLowering):  # type: ignore[misc]
    """Lower and link."""

    _name = "quad_gym_foreign_lowering"

    def run_pass(self, state: Any) -> bool:
        """Lower one entry."""
        state.library = _ForeignLibrary(state.targetctx.codegen(), state.func_id.func_qualname)
        flags = state.flags.copy()
        flags.no_compile = flags.no_cpython_wrapper = flags.no_cfunc_wrapper = True
        state.flags = flags
        super().run_pass(state)
        lowered = state["cr"]
        state.library.finalize()
        state["cr"] = compiler._LowerResult(
            lowered.fndesc, lowered.call_helper, cfunc=None, env=lowered.env
        )
        return True


_ForeignCompiler = compiler_with(_ForeignLowering)


def linked_ir(name: str) -> tuple[str, str]:
    """Return the symbol of an entry, and its IR with all kernels that it reaches.

    Args:
        name: "module:function" of an entry.
    """
    entry = dispatcher_of(name)
    cache, context = entry._cache, cpu_target.target_context
    file = None
    if cache.folder is not None:
        stem = cache._name(entry.signature, context).removesuffix(".code")
        file = cache.folder / f"{stem}.ir"
        with contextlib.suppress(OSError, zlib.error, ValueError):
            symbol, text = zlib.decompress(file.read_bytes()).decode().split("\n", 1)
            return symbol, text
    symbol, text = _compiled(entry)
    if file is not None:
        with contextlib.suppress(OSError):
            file.parent.mkdir(parents=True, exist_ok=True)
            file.write_bytes(zlib.compress(f"{symbol}\n{text}".encode()))
            files = file.parent.glob(f"{cache._stem}.*.ir")
            for old in sorted(files, key=lambda found: found.stat().st_mtime)[:-_KEPT]:
                old.unlink(missing_ok=True)
    return symbol, text


def _compiled(entry: Any) -> tuple[str, str]:
    flags = compiler.Flags()
    cpu_target.options.parse_as_flags(flags, _OPTIONS)
    result = compiler.compile_extra(
        cpu_target.typing_context,
        cpu_target.target_context,
        entry.py_func,
        tuple(entry.signature.args),
        entry.signature.return_type,
        flags,
        {},
        pipeline_class=_ForeignCompiler,
    )
    return result.fndesc.llvm_func_name, str(result.library._final_module)


def emitted(linked: tuple[str, str], symbol: str, processor: Processor) -> bytes:
    """Return an object file with an entry as its only public function.

    Args:
        linked: From `linked_ir`.
        symbol: Name of the function in the object.
        processor: Processor to emit code for.

    Raises:
        RuntimeError: If the code calls other functions than those of a C library.
    """
    llvm.initialize_all_targets()
    llvm.initialize_all_asmprinters()
    machine = llvm.Target.from_triple(processor.triple).create_target_machine(
        cpu=processor.cpu, features=processor.features, opt=2, reloc="pic"
    )
    module = llvm.parse_assembly(_without_python(linked[1]))
    module.triple, module.data_layout = processor.triple, str(machine.target_data)
    for function in module.functions:
        if function.name == linked[0]:
            function.name = symbol
        elif not function.is_declaration:
            function.linkage = llvm.Linkage.internal
    builder = llvm.create_pass_builder(machine, llvm.PipelineTuningOptions(speed_level=2))
    builder.getModulePassManager().run(module, builder)
    foreign = [
        function.name
        for function in module.functions
        if function.is_declaration and not _LIBRARY.fullmatch(function.name)
    ]
    if foreign:
        raise RuntimeError(f"{symbol} must not call {', '.join(foreign)}")
    return bytes(machine.emit_object(module))


def _without_python(text: str) -> str:
    """Return IR without references to Numba's run time: kernels allocate no memory."""
    text = re.sub(r"(?m)^ *(tail )?call void @NRT_(inc|dec)ref\(.*$", "", text)
    text = re.sub(r"\buwtable\b(\(sync\))?", "", text)
    return text.replace("= common ", "= internal ")

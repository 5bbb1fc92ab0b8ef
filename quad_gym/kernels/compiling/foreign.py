"""Object code of entries for other processors than this machine's.

Entries are lowered and linked by Numba as for this machine, and then optimized and emitted by LLVM
for the other processor. Linked code, which is the same for all processors, and objects are cached.
"""

import contextlib
import hashlib
import os
import re
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import llvmlite.binding as llvm
from numba.core import compiler, typed_passes
from numba.core.compiler_machinery import register_pass
from numba.core.registry import cpu_target

from quad_gym.kernels.compiling.cache import CodeCache
from quad_gym.kernels.compiling.linking import EntryLibrary, compiler_with
from quad_gym.kernels.compiling.workers import dispatcher_of
from quad_gym.kernels.library import core_symbol

_OPTIONS = {"nopython": True, "boundscheck": None, "error_model": "numpy", "nogil": True}
_KEPT = 8  #: number of cached files of a kind for a function
_FORM = 4  #: version of the emission; after a change, no older object is found
_PAUSES = {
    "x86_64": ("declare void @llvm.x86.sse2.pause()", "call void @llvm.x86.sse2.pause()"),
    "aarch64": ("declare void @llvm.aarch64.hint(i32)", "call void @llvm.aarch64.hint(i32 1)"),
}  #: hint of a waiting thread to the processor, declared and called, by the processor's family

_LOADED = (b".text", b".rodata", b".data", b"CODE", b"DATA")
"""Beginnings of the names of sections with code and constants."""


class Processor(NamedTuple):
    """A processor, in LLVM's words."""

    triple: str
    cpu: str
    reloc: str = "pic"
    level: int = 2  #: level of optimization; 3 gives larger code
    tune: str = ""  #: processor for which instructions are chosen and ordered; empty: `cpu`


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


def is_cached(name: str, processor: Processor | None = None) -> bool:
    """Return True if `object_of` need not compile; without a processor, `linked`."""
    file = _file(name, "ir" if processor is None else "o", processor)
    return file is not None and file.is_file()


def object_of(name: str, processor: Processor) -> bytes:
    """Return an object file with an entry as its only public function, cached by its sources.

    Args:
        name: "module:function" of an entry.
        processor: Processor to emit code for.
    """
    return cached(name, "o", processor, lambda: emitted(linked(name), processor))


def linked(name: str) -> str:
    """Return the IR of an entry with all kernels that it reaches, cached by its sources."""
    return cached(name, "ir", None, lambda: _linked(name).encode()).decode()


def cached(name: str, suffix: str, key: Any, make: Callable[[], bytes]) -> bytes:
    """Return what `make` returns, cached by the sources of an entry and the text of a key."""
    file = _file(name, suffix, key)
    made = _read(file)
    if made is None:
        made = make()
        _write(file, made)
    return made


def code_of(name: str) -> str:
    """Return the name of the code of an entry, which depends on its sources."""
    entry = dispatcher_of(name)
    code: str = entry._cache._name(entry.signature, cpu_target.target_context)
    return code.removesuffix(".code")


def _file(name: str, suffix: str, key: Any) -> Path | None:
    """Return a cached file of an entry; None: no folder is writable."""
    folder = dispatcher_of(name)._cache.folder
    digest = hashlib.sha256(repr((key, _FORM)).encode()).hexdigest()[:12]
    return None if folder is None else Path(folder, f"{code_of(name)}.{digest}.{suffix}")


def _read(file: Path | None) -> bytes | None:
    """Return the content of a cached file; None if it is missing or damaged."""
    with contextlib.suppress(OSError, zlib.error):
        return None if file is None else zlib.decompress(file.read_bytes())
    return None


def _write(file: Path | None, content: bytes) -> None:
    """Write a cached file, and remove the oldest ones of its function."""
    if file is None or CodeCache.is_stale():
        return
    with contextlib.suppress(OSError):
        file.parent.mkdir(parents=True, exist_ok=True)
        temporary = file.with_suffix(f".{os.getpid()}.tmp")
        temporary.write_bytes(zlib.compress(content))
        temporary.replace(file)
        function = ".".join(file.name.split(".")[:3])
        files = file.parent.glob(f"{function}.*{file.suffix}")
        for old in sorted(files, key=lambda found: found.stat().st_mtime)[:-_KEPT]:
            old.unlink(missing_ok=True)


def _linked(name: str) -> str:
    """Return the IR of an entry with all kernels that it reaches, its only public function."""
    entry, flags = dispatcher_of(name), compiler.Flags()
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
    module = result.library._final_module
    for function in module.functions:
        if function.name == result.fndesc.llvm_func_name:
            function.name = core_symbol(name)
        elif not function.is_declaration:
            function.linkage = llvm.Linkage.internal
    return _without_calls(str(module))


def emitted(text: str, processor: Processor) -> bytes:
    """Return the object file of IR."""
    return bytes(machine_of(processor).emit_object(optimized(text, processor)))


def machine_of(processor: Processor) -> Any:
    """Return LLVM's code generator for a processor."""
    llvm.initialize_all_targets()
    llvm.initialize_all_asmprinters()
    return llvm.Target.from_triple(processor.triple).create_target_machine(
        cpu=processor.cpu,
        opt=processor.level,
        reloc=processor.reloc,
        codemodel="small",
    )


def optimized(text: str, processor: Processor) -> Any:
    """Return the module of IR, optimized for a processor."""
    machine = machine_of(processor)
    text = _with_pauses(text, processor.triple.partition("-")[0])
    if processor.tune:
        text = re.sub(r"(?m)^attributes #\d+ = \{", rf'\g<0> "tune-cpu"="{processor.tune}"', text)
    module = llvm.parse_assembly(text)
    module.triple, module.data_layout = processor.triple, str(machine.target_data)
    builder = llvm.create_pass_builder(
        machine, llvm.PipelineTuningOptions(speed_level=processor.level)
    )
    builder.getModulePassManager().run(module, builder)
    missing = [
        function.name
        for function in module.functions
        if function.is_declaration and not function.name.startswith(("llvm.", "qg_"))
    ]
    if missing:
        raise RuntimeError(f"kernels must not call {', '.join(missing)}")
    return module


def _with_pauses(text: str, family: str) -> str:
    """Return IR with the hints of a family in place of this machine's; none where it has none."""
    wanted = _PAUSES.get(family, ("", ""))
    for hint in _PAUSES.values():
        for ours, theirs in zip(hint, wanted, strict=True):
            text = re.sub(rf"(?m)^ *{re.escape(ours)}.*$", theirs, text)
    return text


def loaded_size(made: bytes) -> int:
    """Return the size of code and constants in an object file."""
    sections = llvm.object_file.ObjectFileRef.from_data(made).sections()
    return sum(s.size() for s in sections if (s.name() or b"").startswith(_LOADED))


def _without_calls(text: str) -> str:
    """Return IR without calls of Numba's run time, as kernels allocate no memory, and of libm."""
    text = re.sub(r"(?m)^ *(tail )?call void @NRT_(inc|dec)ref\(.*$", "", text)
    text = re.sub(r"\buwtable\b(\(sync\))?", "", text)
    for name in ("sqrt", "floor"):  # which an instruction computes, also of a GPU
        if f"@{name}(" in text:
            ours = f"declare double @llvm.{name}.f64(double"
            text = re.sub(rf"(?m)^declare double @{name}\(.*$", "", text)
            text = text.replace(f"@{name}(", f"@llvm.{name}.f64(")
            text += "" if ours in text else f"\n{ours})\n"
    return text.replace("= common ", "= internal ")

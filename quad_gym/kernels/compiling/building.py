"""Libraries of compiled kernels: for this machine, for other processors, and for a GPU.

Entries and stages are emitted as for other processors, with one process for each
core, and linked by the system's C compiler together with a small C source, through which Python
calls the entries. Records depend on the number of lanes, so each library has a process of its own.
"""

import concurrent.futures
import contextlib
import functools
import gc
import hashlib
import multiprocessing
import os
import pickle
import re
import shutil
import subprocess
import sys
import tempfile
import time
import zlib
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

import llvmlite.binding as llvm
from numba.core import compiler, typed_passes
from numba.core.compiler_machinery import register_pass
from numba.core.registry import cpu_target

from quad_gym.kernels.compiling.cache import CodeCache, digest_of
from quad_gym.kernels.compiling.decorators import SLOT
from quad_gym.kernels.compiling.linking import EntryLibrary, compiler_with
from quad_gym.kernels.compiling.workers import dispatcher_of, kernels
from quad_gym.kernels.device import HELD_IN, SETTINGS_SYMBOL
from quad_gym.kernels.entries import ENTRIES, Entry, Rows, names_of
from quad_gym.kernels.library import (
    DEVICE_KERNEL,
    FOLDER,
    available_cores,
    core_symbol,
    entry_symbol,
    file_of,
    machine,
    say,
)
from quad_gym.kernels.sources import MARK, digest_in, sources_digest
from quad_gym.kernels.stages import SOURCES, Stage
from quad_gym.records import WIDTH, require_double
from quad_gym.records.sizes import RESIDENT, WARP

# --------------------------------------------------------------------------------------------------
# Object code of entries for other processors than this machine's.
#
# Entries are lowered and linked by Numba as for this machine, and then optimized and emitted by
# LLVM for the other processor. Linked code, which is the same for all processors, and objects are
# cached.
# --------------------------------------------------------------------------------------------------

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
    fma: str = ""
    """function that computes a multiply-add of float64 where the processor cannot, as few C
    libraries do exactly; empty: an instruction, or the C library's function"""


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
    if processor.fma:
        text = text.replace("@llvm.fma.f64(", f"@{processor.fma}(")
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


# --------------------------------------------------------------------------------------------------
# The libraries of compiled kernels, with which flights need no Numba (`kernels/library.py`).
# --------------------------------------------------------------------------------------------------

PROCESSORS = {
    "x86_64": {
        8: Processor("x86_64-unknown-linux-gnu", "x86-64-v4", level=3, tune="znver4"),
        4: Processor("x86_64-unknown-linux-gnu", "x86-64-v3", level=3),
        2: Processor("x86_64-unknown-linux-gnu", "x86-64", level=3),
    },
    "aarch64": {2: Processor("aarch64-unknown-linux-gnu", "generic", level=3)},
}
"""Oldest processors on which a library runs, by family and number of lanes."""
_GENERIC = {"NUMBA_CPU_NAME": "generic", "NUMBA_CPU_FEATURES": "", "QUAD_GYM_KERNELS": "numba"}
_LINK = ("-shared", "-fPIC", "-O2", "-s", "-Wl,-Bsymbolic,-z,noexecstack,--no-undefined")
_WITH_LIBM = {("x86_64", 2)}
"""Libraries that call the C library's `fma`, `rint` and `floor`, which processors may lack."""
Result = TypeVar("Result")
_TYPES = {int: "int64_t", bool: "uint8_t", float: "double"}


def build(
    lanes: Sequence[int] = (), jobs: int | None = None, family: str | None = None
) -> list[Path]:
    """Build the libraries that do not belong to the present sources.

    Args:
        lanes: Numbers of lanes; none: all of the family.
        jobs: Number of processes that compile; None: one for each core.
        family: Family of processors; None: this machine's. CC must name a compiler for another one.

    Returns:
        All libraries, the new ones and those that are up to date.
    """
    require_double("a library of compiled kernels")
    family = family or machine()
    known = PROCESSORS.get(family, {}) if sys.platform == "linux" else {}
    if not known or not set(lanes) <= known.keys():
        have = ", ".join(f"{name} with {sorted(p)} lanes" for name, p in PROCESSORS.items())
        got = f"{sys.platform} on {family} with {list(lanes)}"
        raise ValueError(f"there are libraries for linux on {have}; got {got}")
    require_compiler()
    path = os.pathsep.join(part for part in sys.path if isinstance(part, str))
    digest = sources_digest(Path(__file__).parents[2])
    FOLDER.mkdir(exist_ok=True)
    files = []
    for count in lanes or known:
        files.append(file_of(count, family))
        if files[-1].is_file() and digest_in(files[-1].read_bytes()) == digest:
            continue
        call = f"_build({digest!r}, {jobs or available_cores()}, {family!r})"
        done = subprocess.run(
            [sys.executable, "-c", f"from {__name__} import _build; {call}"],
            env={**os.environ, **_GENERIC, "QUAD_GYM_LANES": str(count), "PYTHONPATH": path},
            check=False,
        )
        if done.returncode:
            raise RuntimeError(f"{files[-1].name} could not be built, see above")
    return files


def require_compiler() -> str:
    """Return the C compiler that links."""
    name = os.environ.get("CC") or "cc"
    if shutil.which(name) is None:
        raise RuntimeError(
            f"a C compiler must link the library, but there is no {name}: install one "
            "(Debian: apt install gcc), or name it in CC"
        )
    return name


def _build(digest: str, jobs: int, family: str) -> None:
    """Build the library with the lanes of this process."""
    names = part_names()
    file, began = file_of(WIDTH, family), time.monotonic()
    output = file.with_suffix(f".{os.getpid()}.tmp")
    say(f"quad_gym: compiling {len(names)} kernels of the library with {WIDTH} lanes")
    with tempfile.TemporaryDirectory() as folder:
        for k, content in enumerate(objects_of(names, PROCESSORS[family][WIDTH], jobs)):
            Path(folder, f"{k}.o").write_bytes(content)
        Path(folder, "entries.c").write_text(calls(digest), encoding="ascii")
        objects = [f"{k}.o" for k in range(len(names))]
        needed = ["-lm"] if (family, WIDTH) in _WITH_LIBM else []  # any other needs nothing
        command = [require_compiler(), *_LINK, "entries.c", *objects, *needed, "-o", str(output)]
        subprocess.run(command, cwd=folder, check=True)
    output.replace(file)  # whole, even if another process loads or builds it
    say(f"quad_gym: compiled the library in {time.monotonic() - began:.0f} s")


def part_names() -> list[str]:
    """Return the names of all stages and entries, the slowest to compile first."""
    return list(dict.fromkeys([*names_of([source.name for source in SOURCES]), *ENTRIES]))


def objects_of(names: Sequence[str], processor: Processor, jobs: int | None = None) -> list[bytes]:
    """Return the object files of stages and entries, with the lanes of this process.

    Args:
        names: "module:function" of each.
        processor: Processor to emit code for.
        jobs: Number of processes that compile; None: one for each core.
    """
    return in_processes(functools.partial(object_of, processor=processor), names, jobs)


def in_processes(
    function: Callable[[str], Result], names: Sequence[str], jobs: int | None = None
) -> list[Result]:
    """Return a function's results for all names; jobs None: a process for each core."""
    context = multiprocessing.get_context("spawn")
    with concurrent.futures.ProcessPoolExecutor(
        jobs or available_cores(), context, gc.disable
    ) as pool:
        return list(pool.map(function, names))


def calls(digest: str) -> str:
    """Return the C source of the functions that Python calls, and of the digest."""
    head = f'#include <stdint.h>\n\nconst char qg_sources[] = "{MARK.decode()}{digest}";\n'
    return "\n".join([head, *(_call_of(name, entry) for name, entry in ENTRIES.items())])


def _call_of(name: str, entry: Entry) -> str:
    """Return the C function of an entry, which passes its arguments as Numba does."""
    kinds, parameters, values = list[str](), list[str](), list[str]()
    for k, wanted in enumerate(entry.arguments):
        if not isinstance(wanted, Rows):
            kinds.append(_TYPES[wanted])
            parameters.append(f"int64_t a{k}")
            values.append(f"a{k}")
            continue
        shape = [f"n{k}_{axis}" for axis in range(wanted.axes)]
        size = wanted.dtype.itemsize
        strides = [" * ".join([f"{size}LL", *shape[axis + 1 :]]) for axis in range(wanted.axes)]
        kinds += [
            "void *",
            "void *",
            "int64_t",
            "int64_t",
            "void *",
            *["int64_t"] * 2 * wanted.axes,
        ]
        parameters += [f"int64_t a{k}", *(f"int64_t {length}" for length in shape)]
        values += ["0", "0", " * ".join(shape), str(size), f"(void *)a{k}", *shape, *strides]
    result = "void *" if entry.returns is None else _TYPES[entry.returns]
    returned = "void" if entry.returns is None else result
    core = core_symbol(name)
    return f"""\
extern int {core}({", ".join(["void *", "void **", *kinds])});

{returned} {entry_symbol(name)}({", ".join(parameters)})
{{
    {result} result = 0;
    void *raised = 0;
    if ({core}({", ".join(["&result", "&raised", *values])}))
        __builtin_trap(); /* no kernel raises */
    return{"" if returned == "void" else " result"};
}}
"""


# --------------------------------------------------------------------------------------------------
# One module for a configuration on a GPU: its settings, and the stages that it needs.
#
# Settings and the choice of stages are constants: every call is direct, and code that the
# configuration does not reach is removed. The module is emitted as PTX, or for this machine's
# processor, to check it without a GPU. Blocks must have WARP flights, see `records/sizes.py`.
# --------------------------------------------------------------------------------------------------

ENTRY = "quad_gym.kernels.device:fly_one"
GPU = Processor("nvptx64-nvidia-cuda", "sm_80", level=3)
_RECORDS = ("flight", "world", "model", "settings", "work", "stages")
_STAGE = r"@qg_core_\w+_stage\("

_KERNEL = """
declare i32 @llvm.nvvm.read.ptx.sreg.tid.x()
declare i32 @llvm.nvvm.read.ptx.sreg.ctaid.x()
declare i32 @llvm.nvvm.read.ptx.sreg.ntid.x()
declare i32 @llvm.nvvm.read.ptx.sreg.nctaid.x()
declare i32 @{core}(ptr, ptr, i64, i64, i64, i64, i64)

define ptx_kernel void @{kernel}(i64 %call, i64 %blocks, i64 %command) \
"nvvm.maxntid"="{warp}" "nvvm.minctasm"="{resident}" {{
entry:
  %ret = alloca ptr
  %exc = alloca ptr
  %tid = call i32 @llvm.nvvm.read.ptx.sreg.tid.x()
  %cta = call i32 @llvm.nvvm.read.ptx.sreg.ctaid.x()
  %threads = call i32 @llvm.nvvm.read.ptx.sreg.ntid.x()
  %ctas = call i32 @llvm.nvvm.read.ptx.sreg.nctaid.x()
  %begin = mul i32 %cta, %threads
  %thread = add i32 %begin, %tid
  %lane32 = and i32 %thread, 31
  %warp32 = lshr i32 %thread, 5
  %all = mul i32 %ctas, %threads
  %warps32 = lshr i32 %all, 5
  %lane = zext i32 %lane32 to i64
  %warp = zext i32 %warp32 to i64
  %warps = zext i32 %warps32 to i64
  br label %loop
loop:
  %index = phi i64 [ %warp, %entry ], [ %next, %body ]
  %more = icmp slt i64 %index, %blocks
  br i1 %more, label %body, label %done
body:
  %code = call i32 @{core}(ptr %ret, ptr %exc, i64 %call, i64 %index, i64 %lane, i64 %warp, \
i64 %command)
  %next = add i64 %index, %warps
  br label %loop
done:
  ret void
}}
"""


def dispatcher(settings: bytes, stages: Mapping[Stage, str]) -> str:
    """Return the IR of the settings, and of the function that calls the stage of a slot."""
    numbers = "".join(f"\\{byte:02X}" for byte in settings)
    given = ", ".join(f"ptr %{name}" for name in _RECORDS)
    passed = given.replace("%settings", f"@{SETTINGS_SYMBOL}")
    kinds = ", ".join(["ptr"] * (2 + len(_RECORDS)))
    cores = {int(slot): core_symbol(name) for slot, name in sorted(stages.items())}
    cases = " ".join(f"i64 {slot}, label %s{slot}" for slot in cores)
    lines = [
        f'@{SETTINGS_SYMBOL} = constant [{len(settings)} x i8] c"{numbers}", align 16',
        *(f"declare i32 @{core}({kinds}, i64)" for core in sorted(set(cores.values()))),
        f"define void @{SLOT}(i64 %stage, {given}, i64 %flag) alwaysinline {{",
        "entry:",
        "  %ret = alloca ptr",
        "  %exc = alloca ptr",
        f"  switch i64 %stage, label %none [ {cases} ]",
    ]
    for slot, core in cores.items():
        lines += [
            f"s{slot}:",
            f"  %c{slot} = call i32 @{core}(ptr %ret, ptr %exc, {passed}, i64 %flag)",
            "  br label %none",
        ]
    return "\n".join([*lines, "none:", "  ret void", "}", ""])


def module_of(settings: bytes, stages: Mapping[Stage, str], processor: Processor = GPU) -> Any:
    """Return the optimized module of a configuration.

    Args:
        settings: SETTINGS record of the batch.
        stages: Names of the stages that it needs, by slot.
        processor: GPU, or a processor whose code is called for each flight, `core_symbol(ENTRY)`.
    """
    names, public = sorted(set(stages.values())), core_symbol(ENTRY)
    texts = [linked(ENTRY), *map(linked, names), dispatcher(settings, stages)]
    if processor is GPU:
        texts[0] = texts[0].replace(f'"{HELD_IN}"', '"=l,0"')
        texts.append(
            _KERNEL.format(core=public, kernel=DEVICE_KERNEL, warp=WARP, resident=RESIDENT)
        )
        public = DEVICE_KERNEL
    module = llvm.parse_assembly(_plain(texts[0]))
    for text in texts[1:]:
        module.link_in(llvm.parse_assembly(_plain(text)))
    cores = set(map(core_symbol, names))
    for value in (*module.functions, *module.global_variables):
        if not value.is_declaration and value.name != public:
            value.linkage = llvm.Linkage.internal
    for function in module.functions:
        if function.name in cores:
            function.add_function_attribute("noinline")
    module = optimized(str(module), processor)
    return llvm.parse_assembly(_in_global_memory(str(module))) if processor is GPU else module


def ptx_of(settings: bytes, stages: Mapping[Stage, str]) -> bytes:
    """Return the PTX of a configuration, with DEVICE_KERNEL, cached by sources and settings."""
    names = [ENTRY, *sorted(set(stages.values()))]

    def emit() -> bytes:
        if missing := [name for name in names if not is_cached(name)]:
            say(f"quad_gym: compiling {kernels(len(missing))} for a GPU (once)")
            in_processes(linked, missing)
        text: str = machine_of(GPU).emit_assembly(module_of(settings, stages))
        return text.encode()

    key = (settings, sorted(stages), list(map(code_of, names)), digest_of(__name__))
    return cached(ENTRY, "ptx", key, emit)


def write() -> None:
    """Write the PTX for pickled settings and stages on standard input to standard output."""
    sys.stdout.buffer.write(ptx_of(*pickle.load(sys.stdin.buffer)))


def _plain(text: str) -> str:
    """Return IR without alignments of the stack; a stage's flight and workspace do not overlap."""
    text = re.sub(r"\balignstack(=\d+|\(\d+\))", "nounwind", text)
    return re.sub(
        rf"(?m)^define [^\n]*{_STAGE}[^\n]*$",
        lambda found: re.sub(r"ptr (%arg\.(?:flight|work)\b)", r"ptr noalias \1", found.group()),
        text,
    )


def _in_global_memory(text: str) -> str:
    """Return IR that addresses records as global memory; generic addresses take more instructions.

    Addresses from integers and the records of stages are cast, from which LLVM infers the rest.
    """
    text = re.sub(
        r"(?m)^( +)(%\S+) = inttoptr i64 (%\S+) to ptr$",
        r"\1\2.qg = inttoptr i64 \3 to ptr addrspace(1)\n"
        r"\1\2 = addrspacecast ptr addrspace(1) \2.qg to ptr",
        text,
    )
    record = r"(%arg\.(?:flight|world|model|work))(?=[,)])"
    lines, names = list[str](), list[str]()
    for line in text.split("\n"):
        if line.startswith("define internal") and re.search(_STAGE, line):
            names = re.findall(record, line)
            lines.append(re.sub(record, r"\1.generic", line))
            continue
        lines.append(line)
        if names and re.match(r"^[\w.$]+:", line):
            for name in names:
                lines.append(f"  {name}.qg = addrspacecast ptr {name}.generic to ptr addrspace(1)")
                lines.append(f"  {name} = addrspacecast ptr addrspace(1) {name}.qg to ptr")
            names = []
    return "\n".join(lines)

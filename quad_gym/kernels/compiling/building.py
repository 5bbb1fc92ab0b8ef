"""The libraries of compiled kernels, with which flights need no Numba (`kernels/library.py`).

Entries and stages are emitted as for other processors (`foreign.py`), with one process for each
core, and linked by the system's C compiler together with a small C source, through which Python
calls the entries. Records depend on the number of lanes, so each library has a process of its own.
"""

import concurrent.futures
import functools
import gc
import multiprocessing
import os
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TypeVar

from quad_gym.kernels.compiling.foreign import Processor, object_of
from quad_gym.kernels.cores import available_cores
from quad_gym.kernels.entries import ENTRIES, Entry, Rows
from quad_gym.kernels.library import FOLDER, core_symbol, entry_symbol, file_of, machine, say
from quad_gym.kernels.linked import names_of
from quad_gym.kernels.sources import MARK, digest_in, sources_digest
from quad_gym.kernels.stages import SOURCES
from quad_gym.records import WIDTH

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

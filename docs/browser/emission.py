"""The kernels of some batches as one WebAssembly module; records must have one lane."""

import concurrent.futures
import importlib.util
import multiprocessing
import os
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Collection, Sequence
from pathlib import Path

from quad_gym.kernels.compiling.building import Processor, is_cached, object_of
from quad_gym.kernels.entries import fly
from quad_gym.kernels.library import core_symbol, say

_PROCESSOR = Processor("wasm32-unknown-unknown", "generic", "static")
_HERE = Path(__file__).parent
_BUILT = _HERE.parent / "_build" / "wasm"
"""Folder in which Zig compiles its C library, once"""
_LIBRARIES = ("libc.a", "libzigc.a", "libcompiler_rt.a")
_WORKERS = 2
STACK = 1 << 19
"""Size of the stack [bytes], which is first in memory."""


def missing_tools() -> list[str]:
    """Return the packages that a build needs and that are not installed."""
    return [] if importlib.util.find_spec("ziglang") else ["ziglang"]


def _zig(*words: str | Path) -> None:
    """Run Zig: its C compiler `cc`, or its linker `wasm-ld`."""
    variables = {**os.environ, "ZIG_GLOBAL_CACHE_DIR": str(_BUILT)}
    subprocess.run([sys.executable, "-m", "ziglang", *words], env=variables, check=True)


def _compile(source: Path) -> Path:
    """Compile a C file without contraction of products and sums; returns the object file."""
    found = source.with_suffix(".c.o")
    _zig("cc", "-target", "wasm32-wasi", "-O2", "-ffp-contract=off", "-c", source, "-o", found)
    return found


def _libraries(folder: Path) -> list[Path]:
    """Return the C library's archives, which Zig compiles for the first program that it links."""
    program = Path(folder, "program.c")
    program.write_text("int main(void) { return 0; }\n")
    _zig("cc", "-target", "wasm32-wasi", program, "-o", program.with_suffix(".wasm"))
    return [max(_BUILT.rglob(name), key=os.path.getmtime) for name in _LIBRARIES]


def module_of(stages: Collection[str]) -> tuple[bytes, list[str]]:
    """Return a module with `fly` and stages, and the stages in the order of `stage_address`."""
    names = sorted(stages)
    _prepare([fly.name, *names])
    with tempfile.TemporaryDirectory() as name_of_folder:
        folder, objects = Path(name_of_folder), list[Path]()
        for name in (fly.name, *names):
            objects.append(folder / f"{core_symbol(name)}.o")
            objects[-1].write_bytes(object_of(name, _PROCESSOR))
        (folder / "stages.c").write_text(_table(names))
        shutil.copy(_HERE / "fma.c", folder)
        objects += [_compile(folder / name) for name in ("stages.c", "fma.c")]
        module = folder / "module.wasm"
        exports = [
            f"--export={name}" for name in (core_symbol(fly.name), "stage_address", "__heap_base")
        ]
        options = ["--no-entry", "--strip-all", "--stack-first", "-z", f"stack-size={STACK}"]
        given = [*options, *exports, "--wrap=fma", *objects, *_libraries(folder)]
        _zig("wasm-ld", *given, "-o", module)
        return module.read_bytes(), names


def _prepare(names: Sequence[str]) -> None:
    """Compile the functions that are not in the cache, in processes."""
    missing = [name for name in names if not is_cached(name, _PROCESSOR)]
    if missing:
        say(f"quad_gym: compiling {len(missing)} kernels to WebAssembly (once)")
        context = multiprocessing.get_context("spawn")
        with concurrent.futures.ProcessPoolExecutor(_WORKERS, context) as pool:
            for task in [pool.submit(object_of, name, _PROCESSOR) for name in missing]:
                task.result()


def _table(names: Sequence[str]) -> str:
    """Return the C source of `stage_address`."""
    symbols = [core_symbol(name) for name in names]
    return "\n".join(
        [
            *(f"extern void {symbol}(void);" for symbol in symbols),
            f"static void (*const stages[])(void) = {{{', '.join(symbols)}}};",
            "unsigned stage_address(int k) { return (unsigned)stages[k]; }",
            "",
        ]
    )

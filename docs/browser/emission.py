"""The kernels of some batches as one WebAssembly module; records must have one lane."""

import concurrent.futures
import multiprocessing
import shutil
import subprocess
import tempfile
from collections.abc import Collection, Sequence
from pathlib import Path

from quad_gym.kernels.compiling.building import Processor, is_cached, object_of
from quad_gym.kernels.entries import fly
from quad_gym.kernels.library import core_symbol, say

_PROCESSOR = Processor("wasm32-unknown-unknown", "generic", "static")
_HERE = Path(__file__).parent
_LIBC = "/usr/lib/wasm32-wasi"
_WORKERS = 2
STACK = 1 << 19
"""Size of the stack [bytes], which is first in memory."""


def missing_tools() -> list[str]:
    """Return the programs and libraries that a build needs and that this machine lacks."""
    tools = [tool for tool in ("clang", "wasm-ld") if shutil.which(tool) is None]
    return tools + ([] if Path(_LIBC, "libc.a").exists() else ["wasi-libc"])


def module_of(stages: Collection[str]) -> tuple[bytes, list[str]]:
    """Return a module with `fly` and stages, and the stages in the order of `stage_address`."""
    names = sorted(stages)
    _prepare([fly.name, *names])
    with tempfile.TemporaryDirectory() as folder:
        objects = []
        for name in (fly.name, *names):
            objects.append(Path(folder, f"{core_symbol(name)}.o"))
            objects[-1].write_bytes(object_of(name, _PROCESSOR))
        Path(folder, "stages.c").write_text(_table(names))
        for source in (Path(folder, "stages.c"), _HERE / "fma.c"):
            objects.append(Path(folder, f"{source.stem}.c.o"))
            clang = ["clang", "--target=wasm32-wasi", "-O2", "-ffp-contract=off"]
            subprocess.run([*clang, "-c", source, "-o", objects[-1]], check=True)
        module = Path(folder, "module.wasm")
        exports = [
            f"--export={name}" for name in (core_symbol(fly.name), "stage_address", "__heap_base")
        ]
        options = ["--no-entry", "--strip-all", "--stack-first", "-z", f"stack-size={STACK}"]
        link = ["wasm-ld", *options, *exports, "--wrap=fma", *objects, f"{_LIBC}/libc.a"]
        subprocess.run([*link, "-o", module], check=True)
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

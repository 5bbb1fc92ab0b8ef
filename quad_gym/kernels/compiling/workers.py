"""Parallel compilation of functions that are not in the cache, in separate processes.

Each worker goes through the functions, claims those that no other worker has claimed, by making a
file in a folder, named by their number, and compiles them into the cache. It ends with its
parent; a function that it was compiling is then not in the cache.

`multiprocessing` would not do: a process that it spawns runs the user's script again, and daemonic
processes, as in `AsyncVectorEnv`, may not start any.
"""

import contextlib
import gc
import importlib
import os
import subprocess
import sys
import tempfile
import threading
import time
import warnings
from collections.abc import Collection, Sequence
from pathlib import Path
from typing import Any

from numba.core.registry import cpu_target

from quad_gym.kernels.compiling import shortcuts
from quad_gym.kernels.compiling.cache import CodeCache, locked, save_digests, where_cached
from quad_gym.kernels.library import available_cores, say

MAX_WORKERS = 8
_START = (
    "import sys; sys.path[:] = {path!r}; from {module} import work; "
    "work({names!r}, {claims!r}, {copies!r})"
)
_FORKS = sys.platform == "linux"
"""True where workers are copies of one process, which imports Numba once for all of them."""


def dispatcher_of(name: str) -> Any:
    """The compiled function with a name such as "quad_gym.kernels.batch:fly"."""
    module, _, function = name.partition(":")
    return getattr(importlib.import_module(module), function)


def prepare(names: Sequence[str], processes: int | None = None) -> None:
    """Load compiled functions, and compile those that are not in the cache.

    Args:
        names: "module:function" of entries that have a signature; the longest to compile first.
        processes: Number of processes that compile; None: one for each core.
    """
    missing = _missing(names)
    if missing:
        folder = dispatcher_of(names[0])._cache.folder
        lock = None if folder is None else folder / "compiling.lock"
        with locked(lock, "quad_gym: waiting for another process, which compiles"):
            missing = _missing(names)
            if missing:
                _compile(missing, available_cores() if processes is None else processes)
    for name in names:  # functions that a worker could not compile are compiled here and raise here
        dispatcher_of(name).compile(dispatcher_of(name).signature)


def _missing(names: Collection[str]) -> list[str]:
    return [name for name in names if not dispatcher_of(name).is_cached()]


def _compile(names: Sequence[str], processes: int) -> None:
    """Compile `names`: into the cache by processes, or else in this one."""
    progress = _Progress(names)
    workers = min(processes, MAX_WORKERS, len(names))
    cached = all(dispatcher_of(name)._cache.folder is not None for name in names)
    program = sys.executable and not getattr(sys, "frozen", False)
    announcing, CodeCache.announcing = CodeCache.announcing, False
    try:
        if workers > 1 and program and cached:
            _compile_in_processes(names, workers, progress)
        for name in _missing(names):
            progress.show([name])
            dispatcher_of(name).compile(dispatcher_of(name).signature)
    finally:
        CodeCache.announcing = announcing
        progress.finish()


def _compile_in_processes(names: Sequence[str], workers: int, progress: "_Progress") -> None:
    """Compile `names` into the cache, in processes; failures are skipped."""
    path = [folder for folder in sys.path if isinstance(folder, str)]
    started, copies = (1, workers) if _FORKS else (workers, 0)
    save_digests()
    with tempfile.TemporaryDirectory() as claims, contextlib.ExitStack() as running:
        code = _START.format(
            path=path, module=__name__, names=list(names), claims=claims, copies=copies
        )
        processes = []
        with contextlib.suppress(OSError):  # out of memory or of processes: fewer workers
            for _ in range(started):
                process = subprocess.Popen(
                    [sys.executable, "-c", code],
                    stdin=subprocess.PIPE,  # which closes when this process ends
                    stdout=subprocess.DEVNULL,
                    stderr=subprocess.DEVNULL,
                    start_new_session=True,  # Ctrl-C is for the parent, which ends its workers
                )
                running.enter_context(process)
                running.callback(process.kill)
                processes.append(process)
        while any(process.poll() is None for process in processes):
            progress.show([names[int(number)] for number in os.listdir(claims)])
            time.sleep(0.1)


def work(names: Sequence[str], claims: str, copies: int = 0) -> None:
    """Run a worker, or copies of it, which begin with all imports done; ends the process."""
    gc.disable()  # compiling makes few cycles, and looking for them takes a tenth of the time
    shortcuts.take()
    for name in names:
        dispatcher_of(name)  # imports its module
    cpu_target.target_context.refresh()  # imports the rest of Numba
    forked = _forked(copies)
    threading.Thread(target=_end_with_parent, daemon=True).start()  # threads are not copied
    if not forked:
        _compile_unclaimed(names, claims)
    for process in forked:
        os.waitpid(process, 0)
    os._exit(0)  # otherwise Python frees each object, which takes a tenth of the time, too


def _forked(copies: int) -> list[int]:
    """Copy this process; returns the identifiers of the copies, and nothing in a copy itself."""
    forked: list[int] = []
    warnings.simplefilter("ignore", DeprecationWarning)  # of threads: those of BLAS are idle
    with contextlib.suppress(OSError):  # out of memory or of processes: fewer workers
        for _ in range(copies):
            process = os.fork()
            if process == 0:
                return []
            forked.append(process)
    return forked


def _compile_unclaimed(names: Sequence[str], claims: str) -> None:
    for number, name in enumerate(names):
        with contextlib.suppress(FileExistsError):
            Path(claims, str(number)).touch(exist_ok=False)
            dispatcher_of(name).compile(dispatcher_of(name).signature)
            if _missing([name]):  # it cannot write: the parent finds out why
                return


def _end_with_parent() -> None:
    """End this process at once, even while it compiles, when its standard input closes."""
    sys.stdin.read()
    os._exit(1)


def kernels(count: int) -> str:
    """Format a number of kernels."""
    return "1 kernel" if count == 1 else f"{count} kernels"


class _Progress:
    """Progress line on standard error: the functions being compiled, and the elapsed time."""

    def __init__(self, names: Sequence[str]) -> None:
        self._names, self._missing = names, list(names)
        self._start = time.monotonic()
        self._moves = sys.stderr is not None and sys.stderr.isatty()
        where = where_cached(*(dispatcher_of(name)._cache.folder for name in names))
        say(f"quad_gym: compiling {kernels(len(names))} for this machine ({where})")

    def show(self, begun: Collection[str]) -> None:
        """Update the line, if standard error is a terminal; `begun`: done or under way."""
        if self._moves:
            running = _missing([name for name in self._missing if name in begun])
            self._missing = [n for n in self._missing if n not in begun or n in running]
            text = f"{self._count()}, {self._seconds():.0f} s"
            functions = ", ".join(n.partition(":")[2].removesuffix("_stage") for n in running)
            say(f"\rquad_gym: {text:<26} {functions[:40]:<40}", end="")

    def finish(self) -> None:
        """Report the result."""
        self._missing = _missing(self._missing)
        text = f"quad_gym: compiled {self._count()} in {self._seconds():.0f} s"
        say(f"{chr(13) if self._moves else ''}{text:<78}".rstrip())

    def _count(self) -> str:
        return f"{len(self._names) - len(self._missing)} of {kernels(len(self._names))}"

    def _seconds(self) -> float:
        return time.monotonic() - self._start

"""Parallel compilation of functions that are not in the cache, in separate processes.

A worker takes names of compiled functions from its standard input, compiles each into the cache,
and reports it on its standard output. It ends when its input closes, so that it never outlives its
parent; a function that it was compiling is then not in the cache.
"""

import gc
import importlib
import os
import queue
import subprocess
import sys
import threading
import time
from collections.abc import Sequence
from typing import IO, Any

from quad_gym.kernels.compiling.cache import CodeCache, where_cached
from quad_gym.kernels.compiling.cores import available_cores
from quad_gym.kernels.compiling.locks import locked, say

MOST_WORKERS = 8
_START = "import sys; sys.path[:] = {path!r}; from {module} import work; work()"
_COMPILED = "compiled"


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
        dispatcher = dispatcher_of(name)
        dispatcher.compile(dispatcher.signature)


def _missing(names: Sequence[str]) -> list[str]:
    return [name for name in names if not dispatcher_of(name).is_cached()]


def _compile(names: Sequence[str], processes: int) -> None:
    """Compile `names`: into the cache by processes, or else in this one."""
    progress = _Progress(names)
    workers = min(processes, MOST_WORKERS, len(names))
    cached = all(dispatcher_of(name)._cache.folder is not None for name in names)
    program = sys.executable and not getattr(sys, "frozen", False)
    try:
        if workers > 1 and program and cached:
            _compile_in_processes(names, workers, progress)
        announcing, CodeCache.announcing = CodeCache.announcing, False
        try:
            for name in _missing(names):
                progress.begins(name)
                progress.show()
                dispatcher_of(name).compile(dispatcher_of(name).signature)
                progress.ends(name, True)
        finally:
            CodeCache.announcing = announcing
    finally:
        progress.finish()


def _compile_in_processes(names: Sequence[str], workers: int, progress: "_Progress") -> None:
    """Compile `names` into the cache, in processes; failures are skipped."""
    todo: queue.SimpleQueue[str] = queue.SimpleQueue()
    for name in names:
        todo.put(name)
    processes: list[subprocess.Popen[str]] = []
    threads = []
    try:
        for _ in range(workers):
            try:
                processes.append(_started())
            except OSError:  # out of memory or of processes: fewer workers
                break
            arguments = (processes[-1], todo, progress)
            threads.append(threading.Thread(target=_feed, args=arguments, daemon=True))
            threads[-1].start()
        while any(thread.is_alive() for thread in threads):
            for thread in threads:
                thread.join(timeout=0.25)
            progress.show()
    finally:  # also where Ctrl-C interrupts
        for process in processes:
            process.kill()
        for process in processes:
            process.wait()
        for thread in threads:
            thread.join()
        for process in processes:
            for pipe in (process.stdin, process.stdout):
                _close(pipe)


def _close(pipe: IO[str] | None) -> None:
    try:
        if pipe is not None:
            pipe.close()
    except OSError:  # the process ended before it read everything
        pass


def _started() -> "subprocess.Popen[str]":
    path = [folder for folder in sys.path if isinstance(folder, str)]
    code = _START.format(path=path, module=__name__)
    return subprocess.Popen(
        [sys.executable, "-c", code],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
        start_new_session=True,  # Ctrl-C is for the parent, which ends its workers
    )


def _feed(
    process: "subprocess.Popen[str]", todo: "queue.SimpleQueue[str]", progress: "_Progress"
) -> None:
    """Send names to one worker, one after the other, until none is left or it fails."""
    assert process.stdin is not None
    assert process.stdout is not None
    while True:
        try:
            name = todo.get_nowait()
        except queue.Empty:
            return
        progress.begins(name)
        try:
            process.stdin.write(name + "\n")
            process.stdin.flush()
            answer = process.stdout.readline().strip()
        except (OSError, ValueError):
            answer = ""
        progress.ends(name, answer == _COMPILED)
        if answer != _COMPILED:  # it died, or cannot write: the parent finds out why
            return


def work() -> None:
    """Run a worker."""
    answers = os.fdopen(os.dup(1), "w")
    os.dup2(2, 1)  # other output is no answer
    gc.disable()  # compiling makes few cycles, and looking for them takes a tenth of the time
    CodeCache.announcing = CodeCache.complaining = False
    names: queue.SimpleQueue[str] = queue.SimpleQueue()
    threading.Thread(target=_listen, args=(names,), daemon=True).start()
    while True:
        dispatcher = dispatcher_of(names.get())
        try:
            dispatcher.compile(dispatcher.signature)
            held = dispatcher._cache.holds(dispatcher.signature, dispatcher.targetctx)
            answer = _COMPILED if held else "not cached"
        except Exception as error:  # the parent compiles it again, and raises
            answer = f"failed: {type(error).__name__}"
        try:
            print(answer, file=answers, flush=True)
        except OSError:  # the parent is gone
            os._exit(1)


def _listen(names: "queue.SimpleQueue[str]") -> None:
    """Forward names from standard input; when it closes, exit at once, even while compiling."""
    for line in sys.stdin:
        names.put(line.strip())
    os._exit(0)


class _Progress:
    """Progress line on standard error: the functions being compiled, and the elapsed time."""

    def __init__(self, names: Sequence[str]) -> None:
        self._count = len(names)
        self._done: list[str] = []
        self._running: list[str] = []
        self._start = time.monotonic()
        self._moves = sys.stderr is not None and sys.stderr.isatty()
        folders = [dispatcher_of(name)._cache.folder for name in names]
        where = where_cached(*folders)
        say(f"quad_gym: compiling {self._count} parts for this machine ({where})")

    def begins(self, name: str) -> None:
        """Note that `name` is being compiled."""
        self._running.append(name)

    def ends(self, name: str, well: bool) -> None:
        """Note that `name` is no longer being compiled; `well`: it is in the cache."""
        self._running.remove(name)
        if well:
            self._done.append(name)

    def show(self) -> None:
        """Update the line, if standard error is a terminal."""
        if self._moves:
            running = ", ".join(
                name.partition(":")[2].removesuffix("_stage") for name in list(self._running)
            )
            text = f"quad_gym: {len(self._done)} of {self._count} parts, {self._seconds():.0f} s"
            say(f"\r{text:<36} {running[:40]:<40}", end="")

    def finish(self) -> None:
        """Report the result."""
        text = f"quad_gym: compiled {len(self._done)} of {self._count} parts"
        say(f"{chr(13) if self._moves else ''}{f'{text} in {self._seconds():.0f} s':<78}".rstrip())

    def _seconds(self) -> float:
        return time.monotonic() - self._start

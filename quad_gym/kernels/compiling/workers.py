"""Compiling side by side: what is missing in the cache, in processes of its own.

A worker takes names of compiled functions from its standard input, compiles each into the cache,
and says so on its standard output. It outlives nobody: when its input closes it ends, and what it
was compiling is not in the cache then.
"""

import gc
import importlib
import queue
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Sequence
from typing import IO, Any

from quad_gym.kernels.compiling.cache import CodeCache
from quad_gym.kernels.compiling.cores import available_cores

MOST_WORKERS = 8
_START = "import sys; sys.path[:] = {path!r}; from {module} import work; work()"


def dispatcher_of(name: str) -> Any:
    """The compiled function of a name such as "quad_gym.kernels.batch:fly"."""
    module, _, function = name.partition(":")
    return getattr(importlib.import_module(module), function)


def prepare(names: Sequence[str], processes: int | None = None) -> None:
    """Load compiled functions, and compile what is not in the cache.

    Args:
        names: "module:function" of entries that have a signature; what takes longest comes first.
        processes: Processes that compile; None: as many as there are cores.
    """
    missing = [name for name in names if not dispatcher_of(name).is_cached()]
    workers = min(available_cores() if processes is None else processes, MOST_WORKERS, len(missing))
    shared = all(dispatcher_of(name)._cache.folder is not None for name in missing)
    if workers > 1 and sys.executable and shared:
        _compile_in_processes(missing, workers)
    for name in names:  # what a worker could not compile, is compiled here and raises here
        dispatcher = dispatcher_of(name)
        dispatcher.compile(dispatcher.signature)


def _compile_in_processes(names: Sequence[str], workers: int) -> None:
    """Compile `names` into the cache, in processes; what fails is left out."""
    todo: queue.SimpleQueue[str] = queue.SimpleQueue()
    for name in names:
        todo.put(name)
    progress = _Progress(names)
    processes = [_started() for _ in range(workers)]
    threads = [
        threading.Thread(target=_feed, args=(process, todo, progress), daemon=True)
        for process in processes
    ]
    try:
        for thread in threads:
            thread.start()
        while any(thread.is_alive() for thread in threads):
            for thread in threads:
                thread.join(timeout=0.25)
            progress.show()
    finally:  # also where Ctrl-C interrupts
        for process in processes:
            process.kill()
            process.wait()
            for pipe in (process.stdin, process.stdout):
                _close(pipe)
        progress.finish()


def _close(pipe: IO[str] | None) -> None:
    try:
        if pipe is not None:
            pipe.close()
    except OSError:  # the process has gone before it read everything
        pass


def _started() -> subprocess.Popen[str]:
    code = _START.format(path=sys.path, module=__name__)
    return subprocess.Popen(
        [sys.executable, "-c", code], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    )


def _feed(
    process: "subprocess.Popen[str]", todo: "queue.SimpleQueue[str]", progress: "_Progress"
) -> None:
    """Hand names to one worker, one after the other, until there are none or it dies."""
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
            answer = process.stdout.readline()
        except (OSError, ValueError):
            answer = ""
        progress.ends(name)
        if not answer:
            return


def work() -> None:
    """What a worker does."""
    if threading.current_thread() is threading.main_thread():
        signal.signal(signal.SIGINT, signal.SIG_IGN)  # the parent ends its workers
    gc.disable()  # compiling makes few cycles, and looking for them takes a tenth of the time
    CodeCache.announcing = False
    for line in sys.stdin:
        dispatcher = dispatcher_of(line.strip())
        try:
            dispatcher.compile(dispatcher.signature)
            answer = "compiled"
        except Exception as error:  # the parent compiles it again, and raises
            answer = f"failed: {type(error).__name__}"
        print(answer, flush=True)


class _Progress:
    """One line on standard error that says what is being compiled, and for how long."""

    def __init__(self, names: Sequence[str]) -> None:
        self._names, self._done = list(names), 0
        self._running: list[str] = []
        self._start = time.monotonic()
        self._moves = sys.stderr is not None and sys.stderr.isatty()
        folder = dispatcher_of(names[0])._cache.folder
        self._say(f"quad_gym: compiling {len(names)} parts for this machine, once ({folder})\n")

    def begins(self, name: str) -> None:
        self._running.append(name)

    def ends(self, name: str) -> None:
        self._running.remove(name)
        self._done += 1

    def show(self) -> None:
        """Move the line on, where somebody looks at it."""
        if self._moves:
            running = ", ".join(
                name.partition(":")[2].removesuffix("_stage") for name in self._running
            )
            text = f"quad_gym: {self._done} of {len(self._names)} parts, {self._seconds():.0f} s"
            self._say(f"\r{text:<36} {running[:40]:<40}")

    def finish(self) -> None:
        end = "\r" if self._moves else ""
        text = f"quad_gym: compiled {self._done} of {len(self._names)} parts in {self._seconds():.0f} s"
        self._say(f"{end}{text:<78}\n")

    def _seconds(self) -> float:
        return time.monotonic() - self._start

    def _say(self, text: str) -> None:
        if sys.stderr is not None:
            sys.stderr.write(text)
            sys.stderr.flush()

"""Run tests with one broken line in a kernel, without compiling the other kernels again.

    python -m scripts.mutants_of_kernels

A process compiles all kernels once, with few optimizations and two lanes, and keeps them as LLVM
IR. For each broken line it forks. The child translates the function with this line, under its old
symbol, and puts it in the place of the old one. As its type is the same, no caller changes: entries
and stages that reach it are only linked, optimized and emitted again, and each only when a test
calls it. Then the child runs the tests.

Orders come on standard input, answers go to standard output, one JSON object on a line each. An
order has `file`, `line`, `after` (the line; null: none is broken), `arguments` of pytest,
`variables` of the environment and `limit`, the seconds of processor time. An answer has `code`,
`printed` and `cpu`. With code null the line cannot be broken here, and `printed` says why: it is
not in a kernel, or it changes the type of a result.
"""

import contextlib
import gc
import importlib
import itertools
import json
import os
import resource
import signal
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from types import CodeType, FunctionType
from typing import Any

import pytest
from numba.core.bytecode import FunctionIdentity
from numba.core.errors import NumbaError

from quad_gym.kernels.compiling.cache import CodeCache
from quad_gym.kernels.compiling.decorators import EntryDispatcher
from quad_gym.kernels.compiling.linking import KernelDispatcher
from quad_gym.kernels.compiling.workers import dispatcher_of
from quad_gym.kernels.entries import FILTER_ENTRIES, SENSORS_AND_VEHICLE, names_of
from quad_gym.kernels.stages import SOURCES

_USUAL = ("gymnasium", "hypothesis", "quad_gym", "quad_gym.envs", "scipy.linalg", "scipy.stats")
"""Modules that most tests import."""
_WAITS = 20.0  #: longest time of a run, as a multiple of its limit of processor time
_UNSUITABLE = 99  #: exit code of a child that cannot break its line


class Unsuitable(Exception):  # noqa: N818  # no error: the line is broken in another way
    """A line that cannot be broken in a process whose kernels are compiled."""


def every_name() -> list[str]:
    """Return the names of all stages and entries."""
    stages = names_of([source.name for source in SOURCES])
    return [*stages, *FILTER_ENTRIES, *SENSORS_AND_VEHICLE]


class Kernels:
    """Kernels of this process, compiled.

    Args:
        names: Names of stages and entries, which are compiled.
    """

    def __init__(self, names: Sequence[str]) -> None:
        for name in names:
            dispatcher_of(name).compile(dispatcher_of(name).signature)
        objects = gc.get_objects()
        self.functions = [item for item in objects if type(item) is FunctionType]
        self.kernels: list[Any] = [item for item in objects if isinstance(item, KernelDispatcher)]
        self.entries: list[Any] = [item for item in objects if isinstance(item, EntryDispatcher)]

    def change(self, file: Path, before: str, after: str) -> None:
        """Change kernels as the text of their file has changed.

        Raises:
            Unsuitable: If the change is not in a kernel, or changes the type of a result.
        """
        old, new = (compile(text, str(file), "exec") for text in (before, after))
        codes = {_place(a): b for a, b in _differing(old, new)}
        changed = [
            function
            for function in self.functions
            if function.__code__.co_filename == str(file) and _place(function.__code__) in codes
        ]
        if not changed:
            raise Unsuitable("not in a function")
        for function in changed:
            function.__code__ = codes[_place(function.__code__)]
        identities = {id(function) for function in changed}
        kernels = [item for item in self.kernels if id(item.py_func) in identities]
        entries = [item for item in self.entries if id(item.py_func) in identities]
        known = {id(item.py_func) for item in (*kernels, *entries)}
        if identities - known:
            raise Unsuitable("not in a kernel")
        replaced = {library for kernel in kernels for library in _translate_again(kernel)}
        for entry in self.entries:
            reached = {
                library
                for compiled in entry.overloads.values()
                for library in compiled.library._linking_libraries
            }
            if entry in entries or reached & replaced:
                entry._reset_overloads()


def _differing(old: CodeType, new: CodeType) -> Iterator[tuple[CodeType, CodeType]]:
    """Yield the innermost of the codes that differ between two versions of a source."""
    inner = [
        (a, b)
        for a, b in zip(old.co_consts, new.co_consts, strict=False)
        if isinstance(a, CodeType) and isinstance(b, CodeType)
    ]
    for a, b in inner:
        yield from _differing(a, b)
    if _own(old) != _own(new):
        yield old, new


def _place(code: CodeType) -> tuple[str, int]:
    return code.co_qualname, code.co_firstlineno


def _own(code: CodeType) -> tuple[Any, ...]:
    constants = [(type(c), repr(c)) for c in code.co_consts if not isinstance(c, CodeType)]
    return code.co_code, constants, code.co_names, code.co_varnames, code.co_freevars


def _translate_again(kernel: Any) -> list[Any]:
    """Translate a kernel whose code has changed, and return its libraries with the new code."""
    old = dict(kernel.overloads)
    kernel._reset_overloads()
    kept = FunctionIdentity._unique_ids
    for arguments, compiled in old.items():
        number = int(compiled.fndesc.unique_name.rpartition("$")[2])
        FunctionIdentity._unique_ids = itertools.chain([number], kept)
        kernel.compile(arguments)
        fresh = kernel.overloads[arguments]
        if fresh.signature != compiled.signature:
            raise Unsuitable(f"type changes to {fresh.signature}")
        assert fresh.fndesc.mangled_name == compiled.fndesc.mangled_name
        for name in ("_final_module", "_shared_module", "_linking_libraries"):
            setattr(compiled.library, name, getattr(fresh.library, name))
    FunctionIdentity._unique_ids = kept
    return [compiled.library for compiled in old.values()]


def keep_in_memory() -> None:
    """Neither read nor write the cache of compiled kernels: digests do not know broken lines."""
    CodeCache.announcing = False
    nothing = {"load_overload": None, "save_overload": None, "holds": True}
    for name, value in nothing.items():
        setattr(CodeCache, name, lambda *_, value=value: value)
    CodeCache.compiling_alone = lambda *_: contextlib.nullcontext()  # type: ignore[assignment, method-assign]


@contextlib.contextmanager
def _broken(order: dict[str, Any]) -> Iterator[tuple[Path, str, str] | None]:
    """Break the line of an order in its file, which some tests read; yield file, old and new text.

    An order without one yields None.
    """
    if order["after"] is None:
        yield None
        return
    file = Path.cwd() / order["file"]
    before = file.read_text(encoding="utf-8")
    lines = before.splitlines(keepends=True)
    lines[order["line"] - 1] = order["after"] + "\n"
    try:
        file.write_text("".join(lines), encoding="utf-8")
        yield file, before, "".join(lines)
    finally:
        file.write_text(before, encoding="utf-8")


def _run(kernels: Kernels, order: dict[str, Any], changed: Any, printed: Any) -> None:
    """Change a kernel and run tests, in a child, which ends here."""
    code = _UNSUITABLE
    try:
        os.setsid()
        os.dup2(os.open(os.devnull, os.O_RDONLY), 0)
        os.dup2(printed.fileno(), 1)
        os.dup2(printed.fileno(), 2)
        limit = int(order["limit"])
        resource.setrlimit(resource.RLIMIT_CPU, (limit, limit + 5))
        resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
        os.environ.update(order["variables"])
        if changed is not None:
            try:
                kernels.change(*changed)
            except Unsuitable as reason:
                print(reason, flush=True)
                return
            except NumbaError as error:  # as in each test that calls it
                print(f"{error}\nERROR compilation", flush=True)
                code = 1
                return
        code = int(pytest.main(order["arguments"]))
    finally:
        for stream in (sys.stdout, sys.stderr):
            stream.flush()
        os._exit(code)


def _answer(kernels: Kernels, order: dict[str, Any]) -> dict[str, Any]:
    with tempfile.TemporaryFile("w+", errors="replace") as printed, _broken(order) as changed:
        child = os.fork()
        if child == 0:
            _run(kernels, order, changed, printed)
        ends = time.monotonic() + _WAITS * order["limit"]
        done, status, used = os.wait4(child, os.WNOHANG)
        while not done:
            time.sleep(0.05)
            if time.monotonic() > ends:
                os.kill(child, signal.SIGXCPU)
                ends = float("inf")
            done, status, used = os.wait4(child, os.WNOHANG)
        with contextlib.suppress(ProcessLookupError):
            os.killpg(child, signal.SIGKILL)  # what its tests may have left
        printed.seek(0)
        code = os.waitstatus_to_exitcode(status)
        return {
            "code": None if code == _UNSUITABLE else code,
            "printed": printed.read(),
            "cpu": used.ru_utime + used.ru_stime,
        }


def main() -> None:
    """Compile all kernels, then answer orders."""
    answers = os.fdopen(os.dup(1), "w")
    os.dup2(2, 1)
    gc.disable()
    keep_in_memory()
    kernels = Kernels(every_name())
    for name in _USUAL:
        importlib.import_module(name)
    gc.freeze()
    gc.enable()
    print(json.dumps({"cpu": time.process_time()}), file=answers, flush=True)
    for line in sys.stdin:
        print(json.dumps(_answer(kernels, json.loads(line))), file=answers, flush=True)


if __name__ == "__main__":
    main()

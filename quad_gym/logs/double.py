"""Analyses that compute in double precision, whatever the precision of the process.

Calibration takes differences of likelihoods, and smoothing inverts covariances: in single
precision, intervals of a calibration were 0.5 to 1.6 times as wide. A process computes in one
precision. One in single precision therefore starts another one in double precision, which gets the
arguments and returns sentences on progress, warnings, and the result or the error.
`multiprocessing` would not do: a process that it spawns runs the user's script again.
"""

import contextlib
import functools
import importlib
import os
import pickle
import subprocess
import sys
import threading
import traceback
import warnings
from collections.abc import Callable
from typing import Any, ParamSpec, TypeVar, cast

from quad_gym.records.sizes import SINGLE, require_double

P = ParamSpec("P")
R = TypeVar("R")

_START = "import sys; sys.path[:] = {path!r}; from {module} import serve; serve()"
_UNSENT = (
    "computes in another process, with double precision, as QUAD_GYM_PRECISION is single; its "
    "arguments cannot be sent there"
)


def in_double(function: Callable[P, R]) -> Callable[P, R]:
    """Make a function of a module compute in double precision, in another process if needed.

    Arguments and result are pickled. An argument `progress` is called in this process. Ctrl-C and
    errors of `progress` end the other process, which also ends with this one.
    """
    if not SINGLE:
        return function

    @functools.wraps(function)
    def run(*args: P.args, **keywords: P.kwargs) -> R:
        given: dict[str, Any] = dict(keywords)
        progress, name = given.pop("progress", None), function.__name__
        if not sys.executable or getattr(sys, "frozen", False):  # no Python that could be started
            require_double(name)
        try:
            arguments = pickle.dumps((args, given))
        except Exception as error:  # of the type that the argument raises
            raise ValueError(f"{name} {_UNSENT}: {error}") from error
        path = [folder for folder in sys.path if isinstance(folder, str)]
        variables = {**os.environ, "QUAD_GYM_PRECISION": "double"}
        variables.pop("QUAD_GYM_LANES", None)  # of single precision
        with subprocess.Popen(
            [sys.executable, "-c", _START.format(path=path, module=__name__)],
            stdin=subprocess.PIPE,  # which closes when this process ends
            stdout=subprocess.PIPE,
            env=variables,
            start_new_session=True,  # Ctrl-C is for this process, which ends the other one
        ) as process:
            assert process.stdin is not None
            try:
                with contextlib.suppress(OSError):  # it has ended, and replies nothing either
                    call = (function.__module__, name, arguments, progress is not None)
                    process.stdin.write(pickle.dumps(call))
                    process.stdin.flush()
                while True:
                    kind, content = _next_reply(process, name)
                    if kind == "result":
                        return content  # type: ignore[no-any-return]
                    if kind == "error":
                        raise content
                    if kind == "warning":
                        warnings.warn(content, stacklevel=2)
                    elif progress is not None:
                        progress(content)
            finally:
                process.kill()
                with contextlib.suppress(OSError):  # of arguments that it did not read
                    process.stdin.close()

    return run


def _next_reply(process: "subprocess.Popen[bytes]", name: str) -> Any:
    try:
        return pickle.load(cast("Any", process.stdout))
    except (EOFError, pickle.UnpicklingError):
        ended = f"the process with double precision, which computed {name}, has ended"
        raise RuntimeError(f"{ended} with exit code {process.wait()}") from None


def serve() -> None:
    """Call the function that standard input names, and write what it returns to standard output."""
    replies, sys.stdout = sys.stdout.buffer, sys.stderr  # what it prints is no reply

    def reply(kind: str, content: Any) -> None:
        replies.write(pickle.dumps((kind, content)))
        replies.flush()

    module, name, arguments, tells = pickle.load(sys.stdin.buffer)
    threading.Thread(target=_end_with_parent, daemon=True).start()
    warnings.showwarning = lambda message, *_, **__: reply("warning", message)
    try:
        try:
            args, keywords = pickle.loads(arguments)
        except Exception as error:  # such as a class of the user's script
            raise ValueError(f"{name} {_UNSENT}: {error}") from error
        if tells:
            keywords["progress"] = functools.partial(reply, "progress")
        reply("result", getattr(importlib.import_module(module), name)(*args, **keywords))
    except Exception as error:
        told = f"In the process with double precision:\n{traceback.format_exc()}"
        try:
            pickle.loads(pickle.dumps(error))
        except Exception:  # of a class that is not made for pickling
            error = RuntimeError(f"{type(error).__name__}: {error}")
        error.add_note(told)
        reply("error", error)


def _end_with_parent() -> None:
    """End this process at once when its standard input closes."""
    os.read(0, 1)
    os._exit(1)

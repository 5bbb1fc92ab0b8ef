"""Compiled code on disk: found by what it was compiled from, written by one process at a time.

A file holds the code of one function for one signature. Its name ends in a digest of everything
that shapes the code: the sources, the signature, Numba, the processor. A stale file is therefore
never found; a damaged one counts as none.
"""

import contextlib
import functools
import hashlib
import inspect
import os
import pickle
import sys
import time
import uuid
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import llvmlite
import numba
from numba.core import caching, compiler
from numba.core.serialize import dumps

from quad_gym.kernels.compiling.digest import digest_of

KEPT = 8
"""Files of a function that are kept: of other sources, processors or signatures, the latest."""
_LOCATORS = (
    caching.UserProvidedCacheLocator,  # the folder that NUMBA_CACHE_DIR names
    caching.InTreeCacheLocator,  # __pycache__ beside the kernels
    caching.UserWideCacheLocator,  # the user's cache folder, where the package is read-only
)


def cache_of(function: Callable[..., Any]) -> "CodeCache":
    """The cache of the compiled code of a function."""
    return CodeCache(function)


class CodeCache(caching._Cache):  # type: ignore[misc]
    """The compiled code of one function, by signature; what Numba asks a dispatcher's cache for."""

    announcing = True
    """whether to say that something is compiled; a process that compiles for another does not"""

    def __init__(self, function: Callable[..., Any]) -> None:
        self._function = function

    @functools.cached_property
    def folder(self) -> Path | None:
        """Where the files are; None where no folder can be written."""
        file = inspect.getfile(self._function)
        for kind in _LOCATORS:
            locator = kind.from_function(self._function, file)
            if locator is not None:
                return Path(locator.get_cache_path())
        return None

    @property
    def cache_path(self) -> str | None:
        """The folder, as Numba wants it."""
        return None if self.folder is None else str(self.folder)

    @functools.cached_property
    def _stem(self) -> str:
        module = Path(inspect.getfile(self._function)).stem
        name = self._function.__qualname__.replace("<", "").replace(">", "")
        return f"{module}.{name}.py{sys.version_info[0]}{sys.version_info[1]}"

    @functools.cached_property
    def _sources(self) -> str:
        return digest_of(Path(inspect.getfile(self._function)))

    def _path(self, signature: Any, context: Any) -> Path | None:
        if self.folder is None:
            return None
        from quad_gym.kernels.compiling.decorators import LEAN

        arguments, _ = numba.core.sigutils.normalize_signature(signature)
        parts = (
            self._sources,
            str(tuple(arguments)),
            str(context.codegen().magic_tuple()),
            f"{numba.__version__} {llvmlite.__version__} {LEAN}",
        )
        digest = hashlib.sha256("\n".join(parts).encode()).hexdigest()
        return self.folder / f"{self._stem}.{digest[:32]}.code"

    # ---- what Numba calls -------------------------------------------------------------------

    def load_overload(self, sig: Any, target_context: Any) -> Any:
        """The compiled code of a signature, or None."""
        target_context.refresh()
        path = self._path(sig, target_context)
        if path is None or not path.is_file():
            return None
        try:
            return compiler.CompileResult._rebuild(target_context, *pickle.loads(path.read_bytes()))
        except Exception:  # whatever reading a damaged file raises, it is as good as none
            return None

    def save_overload(self, sig: Any, data: Any) -> None:
        """Write the compiled code of a signature; where that fails, say so and go on."""
        path = self._path(sig, data.target_context)
        if path is None:
            return
        temporary = path.with_suffix(f".{uuid.uuid4().hex[:12]}.tmp")
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            temporary.write_bytes(dumps(data._reduce()))
            temporary.replace(path)
        except OSError as error:
            temporary.unlink(missing_ok=True)
            print(f"quad_gym: the compiled code was not cached: {error}", file=sys.stderr)
        else:
            self._tidy(path)

    def flush(self) -> None:
        """Delete the files of this function."""
        for path in self._files():
            path.unlink(missing_ok=True)

    def enable(self) -> None:
        """Nothing: the cache is always on."""

    def disable(self) -> None:
        """Nothing: the cache is always on."""

    # ---- who compiles -----------------------------------------------------------------------

    def holds(self, signature: Any, context: Any) -> bool:
        """Whether there is a file for a signature."""
        path = self._path(signature, context)
        return path is not None and path.is_file()

    @contextlib.contextmanager
    def compiling_alone(self, signature: Any, context: Any) -> Iterator[None]:
        """Hold off other processes that want to compile the same; they load the result then.

        A process that dies gives its lock back.
        """
        if self.holds(signature, context):
            yield
            return
        with contextlib.ExitStack() as held:
            path = self._path(signature, context)
            if path is not None:
                held.enter_context(_locked(path.with_suffix(".lock")))
            if self.announcing and not self.holds(signature, context):
                where = "not cached: no folder can be written; set NUMBA_CACHE_DIR"
                where = where if self.folder is None else f"cached in {self.folder}"
                print(
                    f"quad_gym: compiling {self._function.__name__} (once; {where})",
                    file=sys.stderr,
                    flush=True,
                )
            yield

    def _files(self) -> list[Path]:
        return [] if self.folder is None else list(self.folder.glob(f"{self._stem}.*.code"))

    def _tidy(self, latest: Path) -> None:
        """Delete the oldest files of this function, and what killed processes left."""
        with contextlib.suppress(OSError):
            others = sorted(self._files(), key=lambda path: path.stat().st_mtime, reverse=True)
            for path in others[KEPT:]:
                path.unlink(missing_ok=True)
            for path in latest.parent.glob(f"{self._stem}.*.tmp"):
                if time.time() - path.stat().st_mtime > 3600.0:
                    path.unlink(missing_ok=True)


@contextlib.contextmanager
def _locked(path: Path) -> Iterator[None]:
    """Hold a lock between processes; without one where the system or the folder has none."""
    try:
        import fcntl
    except ImportError:  # not a POSIX system: two processes may compile the same
        yield
        return
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        file = open(path, "ab")  # noqa: SIM115 - closed below
    except OSError:
        yield
        return
    with file:
        with contextlib.suppress(OSError):  # some network file systems have no locks
            fcntl.flock(file, fcntl.LOCK_EX)
        try:
            yield
        finally:
            # others that wait for this file hold it open; the next one makes a new file
            with contextlib.suppress(OSError):
                os.unlink(path)

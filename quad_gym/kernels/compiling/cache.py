"""Compiled code on disk: identified by its sources, written by one process at a time.

A file holds the code of one function for one signature, and a checksum. Its name ends in a digest
of everything that shapes the code: the sources, the closure of the function, the signature, Numba,
the processor. A stale file is therefore never found; a damaged one is ignored.
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
import llvmlite.binding as llvm
import numba
from numba.core import caching, compiler, config
from numba.core.runtime import rtsys
from numba.core.serialize import dumps

from quad_gym.kernels.compiling.digest import closure_of, digest_of_function
from quad_gym.kernels.compiling.locks import locked, say
from quad_gym.records import WIDTH

_FORM = 3
"""Version of the files' contents and of the compilation; after a change, no older file is found."""
KEPT = 8
"""Number of files kept for a function: the latest for other sources, processors or signatures."""
_LOCATORS = (
    caching.UserProvidedCacheLocator,  # the folder that NUMBA_CACHE_DIR names
    caching.InTreeCacheLocator,  # __pycache__ next to the kernels
    caching.UserWideCacheLocator,  # the user's cache folder, where the package is read-only
)


def cache_of(function: Callable[..., Any]) -> "CodeCache":
    """The cache of the compiled code of a function."""
    return CodeCache(function)


@functools.lru_cache(maxsize=64)  # the records of a stage's arguments take milliseconds to write
def _written(arguments: tuple[Any, ...]) -> str:
    """The types of arguments as text."""
    return str(arguments)


def _compiler(context: Any) -> str:
    """The compiler, its options, and the processor that it compiles for."""
    from quad_gym.kernels.compiling.decorators import LEAN

    options = (config.OPT, config.LOOP_VECTORIZE, config.SLP_VECTORIZE, config.BOUNDSCHECK)
    versions = f"{numba.__version__} {llvmlite.__version__}"
    return f"{context.codegen().magic_tuple()} {versions} {_FORM} {LEAN} {WIDTH} {options}"


def _needed(module: Any) -> tuple[str, ...]:
    """Names of the external symbols that a module uses; LLVM aborts if one is missing."""
    return tuple(
        value.name
        for values in (module.functions, module.global_variables)
        for value in values
        if value.is_declaration and not value.name.startswith("llvm.")
    )


def where_cached(*folders: Path | None) -> str:
    """Describe where code is cached, for messages."""
    known = [str(folder) for folder in folders if folder is not None]
    if not known:
        return "not cached: no folder can be written; set NUMBA_CACHE_DIR to one that can"
    return f"once; cached in {os.path.commonpath(known)}"


class CodeCache(caching._Cache):  # type: ignore[misc]
    """The compiled code of one function, by signature: a dispatcher's cache, as Numba calls it."""

    announcing = True
    """flag for announcing a compilation; off in a process that compiles for another one"""
    complaining = True
    """flag for reporting that code cannot be cached; once is enough"""

    def __init__(self, function: Callable[..., Any]) -> None:
        self._function = function
        self._found: dict[str, bytes] = {}
        """contents read but not yet loaded, by file name, so that each file is read once"""

    @functools.cached_property
    def folder(self) -> Path | None:
        """Folder in which files are written; None if no folder is writable."""
        file = inspect.getfile(self._function)
        for kind in _LOCATORS:
            locator = kind.from_function(self._function, file)
            if locator is not None:
                return Path(locator.get_cache_path()).absolute()
        return None

    @functools.cached_property
    def _folders(self) -> list[Path]:
        """Folders in which files are looked up, including the kernels' own `__pycache__`."""
        beside = Path(inspect.getfile(self._function)).absolute().parent / "__pycache__"
        if self.folder is None:
            return [beside]
        return [self.folder] if config.CACHE_DIR else [self.folder, beside]

    @property
    def cache_path(self) -> str | None:
        """The folder, in the form that Numba expects."""
        return None if self.folder is None else str(self.folder)

    @functools.cached_property
    def _stem(self) -> str:
        """Common prefix of the names of all files of this function, independent of its sources."""
        module = Path(inspect.getfile(self._function)).stem
        name = self._function.__qualname__.replace("<", "").replace(">", "")
        stem = f"{module}.{name}.py{sys.version_info[0]}{sys.version_info[1]}"
        closed_over = [
            f"{getattr(value, '__module__', '')}:{getattr(value, '__qualname__', '')}"
            for value in closure_of(self._function)
        ]
        if closed_over:  # separate files for functions made from one piece of source
            stem += f".{hashlib.sha256(' '.join(closed_over).encode()).hexdigest()[:8]}"
        return stem

    @functools.cached_property
    def _sources(self) -> str:
        return digest_of_function(self._function)

    def _name(self, signature: Any, context: Any) -> str:
        """The name of the file of a signature."""
        arguments, _ = numba.core.sigutils.normalize_signature(signature)
        parts = (self._sources, _written(tuple(arguments)), _compiler(context))
        digest = hashlib.sha256("\n".join(parts).encode()).hexdigest()
        return f"{self._stem}.{digest[:32]}.code"

    def _content(self, signature: Any, context: Any) -> bytes | None:
        """Content of the file of a signature; None if it is missing or damaged."""
        if not self._folders:
            return None
        name = self._name(signature, context)
        for folder in self._folders:
            if name in self._found:
                break
            with contextlib.suppress(OSError):
                content = (folder / name).read_bytes()
                if hashlib.sha256(content[32:]).digest() == content[:32]:
                    self._found[name] = content[32:]
        return self._found.get(name)

    # ---- what Numba calls -------------------------------------------------------------------

    def load_overload(self, sig: Any, target_context: Any) -> Any:
        """The compiled code of a signature, or None."""
        content = self._content(sig, target_context)
        self._found.clear()
        if content is None:
            return None
        try:
            needed, parts = pickle.loads(content)
            rtsys.initialize(target_context)
            if not all(map(llvm.address_of_symbol, needed)):
                target_context.refresh()  # registers the rest of Numba, which takes 0.3 s
            return compiler.CompileResult._rebuild(target_context, *parts)
        except Exception:  # any error of reading counts as no file
            return None

    def save_overload(self, sig: Any, data: Any) -> None:
        """Write the compiled code of a signature; if this fails, report it and continue."""
        if self.folder is None:
            return
        path = self.folder / self._name(sig, data.target_context)
        content = dumps((_needed(data.library._final_module), data._reduce()))
        temporary = path.with_suffix(f".{uuid.uuid4().hex[:12]}.tmp")
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            temporary.write_bytes(hashlib.sha256(content).digest() + content)
            temporary.replace(path)
        except OSError as error:
            if CodeCache.complaining:
                CodeCache.complaining = False
                say(f"quad_gym: compiled code cannot be cached in {self.folder}: {error.strerror}")
        else:
            self._tidy()
        finally:  # also where Ctrl-C interrupts
            with contextlib.suppress(OSError):
                temporary.unlink(missing_ok=True)

    def flush(self) -> None:
        """Delete the files of this function."""
        self._found.clear()
        for path in self._files("code"):
            path.unlink(missing_ok=True)

    def enable(self) -> None:
        """Do nothing: the cache is always on."""

    def disable(self) -> None:
        """Do nothing: the cache is always on."""

    # ---- who compiles -----------------------------------------------------------------------

    def holds(self, signature: Any, context: Any) -> bool:
        """True if there is an undamaged file for a signature."""
        return self._content(signature, context) is not None

    @contextlib.contextmanager
    def compiling_alone(self, signature: Any, context: Any) -> Iterator[None]:
        """Block other processes that would compile the same code; they load the result then."""
        if self.holds(signature, context):
            yield
            return
        path = None if self.folder is None else self.folder / self._name(signature, context)
        with locked(None if path is None else path.with_suffix(".lock")):
            if self.announcing and not self.holds(signature, context):
                where = where_cached(self.folder)
                say(f"quad_gym: compiling {self._function.__name__} ({where})")
            yield

    def _files(self, kind: str) -> list[Path]:
        return [] if self.folder is None else list(self.folder.glob(f"{self._stem}.*.{kind}"))

    def _tidy(self) -> None:
        """Delete the oldest files of this function, and the remains of killed processes."""
        with contextlib.suppress(OSError):
            files = self._files("code")
            files.sort(key=lambda path: path.stat().st_mtime, reverse=True)
            for path in files[KEPT:]:
                path.unlink(missing_ok=True)
            for path in (*self._files("tmp"), *self._files("lock")):
                if time.time() - path.stat().st_mtime > 3600.0:
                    path.unlink(missing_ok=True)

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
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import llvmlite
import llvmlite.binding as llvm
import numba
from numba.core import caching, compiler, config
from numba.core.runtime import rtsys
from numba.core.serialize import dumps

from quad_gym.kernels.digest import digest_of_function, edited_source
from quad_gym.kernels.library import say
from quad_gym.records import REGISTER, WIDTH

_FORM = 5
"""Version of the files' contents and of the compilation; after a change, no older file is found."""
KEPT = 8
"""Number of files kept for a function: the latest for other sources, processors or signatures."""
_LOCATORS = (
    caching.UserProvidedCacheLocator,  # the folder that NUMBA_CACHE_DIR names
    caching.InTreeCacheLocator,  # __pycache__ next to the kernels
    caching.UserWideCacheLocator,  # the user's cache folder, where the package is read-only
)


def where_cached(*folders: Path | None) -> str:
    """Describe where code is cached, for messages."""
    known = [str(folder) for folder in folders if folder is not None]
    if not known:
        return "not cached: no folder can be written; set NUMBA_CACHE_DIR to one that can"
    return f"once; cached in {os.path.commonpath(known)}"


@contextlib.contextmanager
def locked(path: Path | None, waiting: str = "") -> Iterator[None]:
    """Hold a lock between processes; a process that dies releases it.

    Where the system or the folder supports no locks (path: None), two processes may do the same
    work. `waiting`: message on standard error if another process holds the lock.
    """
    from filelock import FileLock, Timeout  # here, as only compiling needs it

    with contextlib.ExitStack() as held:
        with contextlib.suppress(OSError, NotImplementedError):
            if path is not None:
                path.parent.mkdir(parents=True, exist_ok=True)
                try:
                    held.enter_context(FileLock(path, timeout=0 if waiting else -1))
                except Timeout:
                    say(waiting)
                    held.enter_context(FileLock(path))
        yield


@functools.lru_cache(maxsize=64)  # the records of a stage's arguments take milliseconds to write
def _written(arguments: tuple[Any, ...]) -> str:
    """The types of arguments as text."""
    return str(arguments)


def _compiler(context: Any) -> str:
    """The compiler, its options, and the processor that it compiles for."""
    options = (config.OPT, config.LOOP_VECTORIZE, config.SLP_VECTORIZE, config.BOUNDSCHECK)
    versions = f"{numba.__version__} {llvmlite.__version__}"
    return f"{context.codegen().magic_tuple()} {versions} {_FORM} {WIDTH} {REGISTER} {options}"


def _needed(module: Any) -> tuple[str, ...]:
    """Names of the external symbols that a module uses; LLVM aborts if one is missing."""
    return tuple(
        value.name
        for values in (module.functions, module.global_variables)
        for value in values
        if value.is_declaration and not value.name.startswith("llvm.")
    )


class CodeCache:
    """The compiled code of one function, by signature: a dispatcher's cache, as Numba calls it."""

    announcing = True
    """flag for announcing a compilation; off while a line of progress is shown"""
    complaining = True
    """flag for reporting that code cannot be cached; once is enough"""

    def __init__(self, function: Callable[..., Any]) -> None:
        self._function = function

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

    @functools.cached_property
    def _stem(self) -> str:
        """Common prefix of the names of all files of this function, independent of its sources."""
        module = Path(inspect.getfile(self._function)).stem
        name = self._function.__qualname__.replace("<", "").replace(">", "")
        return f"{module}.{name}.py{sys.version_info[0]}{sys.version_info[1]}"

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
        name = self._name(signature, context)
        for folder in self._folders:
            with contextlib.suppress(OSError):
                content = (folder / name).read_bytes()
                if hashlib.sha256(content[32:]).digest() == content[:32]:
                    return content[32:]
        return None

    def holds(self, signature: Any, context: Any) -> bool:
        """True if there is an undamaged file for a signature."""
        return self._content(signature, context) is not None

    @contextlib.contextmanager
    def compiling_alone(self, signature: Any, context: Any) -> Iterator[None]:
        """Block other processes that would compile this function; they load the result then."""
        if self.holds(signature, context):
            yield
            return
        with locked(None if self.folder is None else self.folder / f"{self._stem}.lock"):
            if self.announcing and not self.holds(signature, context):
                where = where_cached(self.folder)
                say(f"quad_gym: compiling {self._function.__name__} ({where})")
            yield

    @staticmethod
    def is_stale() -> bool:
        """True if a source has changed since this process imported it; reports it once.

        Code that is compiled here is then that of no file, and must not be kept.
        """
        file = edited_source()
        if file is not None and CodeCache.complaining:
            CodeCache.complaining = False
            say(f"quad_gym: compiled code is not cached: {file} has changed since it was imported")
        return file is not None

    # ---- what Numba calls -------------------------------------------------------------------

    def load_overload(self, sig: Any, target_context: Any) -> Any:
        """The compiled code of a signature, or None."""
        content = self._content(sig, target_context)
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
        if self.folder is None or self.is_stale():
            return
        content = dumps((_needed(data.library._final_module), data._reduce()))
        temporary = self.folder / f"{self._stem}.tmp"  # one process at a time writes it
        try:
            self.folder.mkdir(parents=True, exist_ok=True)
            temporary.write_bytes(hashlib.sha256(content).digest() + content)
            temporary.replace(self.folder / self._name(sig, data.target_context))
            files = self.folder.glob(f"{self._stem}.*.code")
            for old in sorted(files, key=lambda file: file.stat().st_mtime)[:-KEPT]:
                with contextlib.suppress(OSError):  # Windows keeps a file that is being read
                    old.unlink()
        except OSError as error:
            if CodeCache.complaining:
                CodeCache.complaining = False
                say(f"quad_gym: compiled code cannot be cached in {self.folder}: {error.strerror}")
        finally:  # also where Ctrl-C interrupts
            with contextlib.suppress(OSError):
                temporary.unlink(missing_ok=True)

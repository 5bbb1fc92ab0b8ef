"""Compiled code on disk: identified by its sources, written by one process at a time.

A file holds the code of one function for one signature, and a checksum. Its name ends in a digest
of everything that shapes the code: the sources, the closure of the function, the signature, Numba,
the processor. A stale file is therefore never found; a damaged one is ignored.
"""

import ast
import atexit
import bisect
import contextlib
import dis
import functools
import hashlib
import importlib.util
import inspect
import json
import os
import pickle
import sys
import time
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from types import CodeType, FunctionType
from typing import Any, NamedTuple

import llvmlite
import llvmlite.binding as llvm
import numba
import numpy as np
from numba.core import caching, compiler, config
from numba.core.runtime import rtsys
from numba.core.serialize import dumps

from quad_gym.kernels.library import say
from quad_gym.records import PRECISION, REGISTER, ROOM, WIDTH

# --------------------------------------------------------------------------------------------------
# Digests of everything that compiled code depends on, which show whether a cache is stale.
#
# The digest of a module follows its imports through the package, so that nothing has to be listed
# by hand. Comments, docstrings and layout do not count, as the syntax tree is hashed.
# --------------------------------------------------------------------------------------------------

PACKAGE = __package__.partition(".")[0]
_NO_CODE = {
    *(f"{PACKAGE}.kernels.compiling.{name}" for name in ("building", "cache", "workers")),
    *(f"{PACKAGE}.kernels.{name}" for name in ("library", "sources")),
}
"""Modules that determine when code is compiled, but do not change the code."""
_BEGAN = time.time()  #: when this process began to import kernels [s]


class _Imported(NamedTuple):
    """A module with kernels as it was when its first kernel was made."""

    names: int  #: identity of its names, another one after a reload
    when: float  #: time [s]
    file: Path | None
    status: tuple[int, ...]  #: status of the file; nothing if there is none


_IMPORTED: dict[str, _Imported] = {}
"""Modules with kernels, by name."""
_FILES: dict[str, Path] = {}
"""Files of the modules of which there are digests."""
_TABLE = f"{PACKAGE}.params.sensor_table"
"""Module of parameters of which code depends on the values `SENSOR_SHAPES` only."""


def digest_of(module: str) -> str:
    """Digest of an imported module and of all modules that it imports, directly or not.

    Modules of other packages do not count, except those next to the module itself.
    """
    packages = {PACKAGE, module.partition(".")[0]}
    todo, seen = [module], dict[str, str]()
    while todo:
        name = todo.pop()
        if name not in seen and name.partition(".")[0] in packages:
            seen[name], imported = _read(name)
            todo += imported
    return _combined(seen)


def _combined(digests: dict[str, str]) -> str:
    """Digest of modules' names and digests: with names, as two may swap their contents."""
    lines = [sys.version, *(f"{name} {digest}" for name, digest in sorted(digests.items()))]
    return hashlib.sha256("\n".join(lines).encode()).hexdigest()


@functools.cache
def _read(name: str) -> tuple[str, list[str]]:
    """Digest of a module, and names that it imports; nothing for names that are not of modules."""
    module = sys.modules.get(name)
    if name in _NO_CODE or module is None or module.__file__ is None:
        return "", []
    if name == _TABLE:
        return hashlib.sha256(repr(module.SENSOR_SHAPES).encode()).hexdigest(), []
    _FILES[name] = Path(module.__file__)
    return _parsed(Path(module.__file__).read_bytes(), module.__package__ or "")


def edited_source() -> Path | None:
    """File that may have changed since this process imported it, of those that have digests.

    Digests are of files, and compiled code is of what was imported, so that the latter must not be
    kept under the former. An edit changes a file's time, or, if it replaces the file or the time is
    set, the time of its change of status. The clock of files lags behind `time.time` by up to one
    tick of the kernel, 4 to 10 ms, so that an edit soon after the import shows in the status alone.
    """
    for name, file in _FILES.items():
        with contextlib.suppress(OSError):
            status = file.stat()
            imported = _IMPORTED.get(name)
            began = _BEGAN if imported is None else imported.when
            if max(status.st_mtime, status.st_ctime) > began:
                return file
            if (
                imported is not None
                and imported.file == file
                and imported.status != _changing(status)
            ):
                return file
    return None


def note_import(function: Callable[..., Any]) -> None:
    """Note when the module of a kernel was imported, at the latest; for `edited_source`."""
    names = function.__globals__
    known = _IMPORTED.get(function.__module__)
    if known is None or known.names != id(names):
        file, status = None, tuple[int, ...]()
        with contextlib.suppress(OSError, KeyError):
            file = Path(names["__file__"])
            status = _changing(file.stat())
        _IMPORTED[function.__module__] = _Imported(id(names), time.time(), file, status)


def _changing(status: os.stat_result) -> tuple[int, ...]:
    """What an edit of a file changes of its status."""
    return status.st_ino, status.st_size, status.st_mtime_ns, status.st_ctime_ns


def _parsed(content: bytes, package: str) -> tuple[str, list[str]]:
    """Digest of a source in a package, and the names that it imports."""
    known = _known_sources()
    key = hashlib.sha256(package.encode() + b"\n" + content).hexdigest()
    if key not in known:
        tree, imported = ast.parse(content), set[str]()
        for node in ast.walk(tree):
            imported.update(_imports(node, package))
            if isinstance(body := getattr(node, "body", None), list):  # drop strings: docstrings
                node.body = [part for part in body if not _is_string(part)]  # type: ignore[attr-defined]
        known[key] = hashlib.sha256(ast.dump(tree).encode()).hexdigest(), sorted(imported)
    return known[key]


def _imports(node: ast.AST, package: str) -> Iterable[str]:
    """Names of modules, and of possible modules, that a statement imports."""
    if isinstance(node, ast.Import):
        return [alias.name for alias in node.names]
    if not isinstance(node, ast.ImportFrom):
        return []
    module = importlib.util.resolve_name("." * node.level + (node.module or ""), package)
    return [module, *(f"{module}.{alias.name}" for alias in node.names)]


def _is_string(statement: ast.AST) -> bool:
    value = statement.value if isinstance(statement, ast.Expr) else None
    return isinstance(value, ast.Constant) and isinstance(value.value, str)


@functools.cache
def _known_sources() -> dict[str, tuple[str, list[str]]]:
    """Earlier results of `_parsed`, stored when a process ends: parsing takes over a second."""
    known: dict[str, tuple[str, list[str]]] = {}
    with contextlib.suppress(OSError, ValueError, TypeError, AttributeError):  # none, or damaged
        for key, (digest, names) in json.loads(_digests_file().read_text()).items():
            known[key] = str(digest), list(names)
    atexit.register(_save_sources, len(known))
    return known


def _digests_file() -> Path:
    folder = Path(os.environ.get("NUMBA_CACHE_DIR") or Path(__file__).with_name("__pycache__"))
    return folder / f"quad_gym_digests.{sys.implementation.cache_tag}.json"


def _save_sources(count: int) -> None:
    """Store the results of `_parsed` if there are more than `count`."""
    file, known = _digests_file(), _known_sources()
    temporary = file.with_suffix(f".{os.getpid()}.tmp")
    if len(known) > count:
        with contextlib.suppress(OSError):
            file.parent.mkdir(parents=True, exist_ok=True)
            temporary.write_text(json.dumps(dict(list(known.items())[-1000:])))
            temporary.replace(file)


def save_digests() -> None:
    """Store the digests of sources now, so that processes that this one starts parse none."""
    _save_sources(0)


_JUMPS = {*dis.hasjrel, *dis.hasjabs}
"""Instructions whose argument is the place of another one."""
_BYTES = 2  #: size of an instruction


def digest_of_function(function: Callable[..., Any]) -> str:
    """Digest of a function: its module with all imports, its instructions, defaults and closure.

    Functions made from one piece of source differ in their closures and defaults. Functions among
    these values count with their own modules, other values as they are.
    """
    return hashlib.sha256("\n".join(_function(function, ())).encode()).hexdigest()


def _function(function: Any, above: tuple[Any, ...]) -> Iterator[str]:
    yield f"{function.__module__}:{function.__qualname__}"
    if function in above:  # recursion
        return
    yield digest_of(function.__module__)
    yield from _code(function.__code__)
    closure = [cell.cell_contents for cell in function.__closure__ or ()]
    keywords = sorted((function.__kwdefaults__ or {}).items())
    yield from _value((function.__defaults__, keywords, closure), (*above, function))


def _code(code: CodeType) -> Iterator[str]:
    """Instructions, independent of their lines: functions of a module may share a name.

    With -OO, Python writes "NOP" in place of a docstring, which moves the targets of jumps.
    """
    instructions = list(dis.get_instructions(code))
    skipped = [instruction.offset for instruction in instructions if instruction.opname == "NOP"]
    for instruction in instructions:
        value = instruction.argval
        if instruction.opname == "NOP":
            continue
        if isinstance(value, CodeType):
            yield from _code(value)
            continue
        if instruction.opcode in _JUMPS:
            value -= _BYTES * bisect.bisect_left(skipped, value)
        yield f"{instruction.opname} {value!r}"


def _value(value: Any, above: tuple[Any, ...]) -> Iterator[str]:
    # dispatchers and intrinsics count as the functions from which they were made
    value = getattr(value, "py_func", None) or getattr(value, "__wrapped__", value)
    if isinstance(value, FunctionType):
        yield from _function(value, above)
    elif isinstance(value, tuple | list):
        yield f"{type(value).__name__} of {len(value)}"
        for item in value:
            yield from _value(item, above)
    elif value is None or isinstance(value, int | float | complex | str | bytes | np.generic):
        yield f"{type(value).__qualname__} {value!r}"
    else:
        raise TypeError(
            f"compiled code cannot be cached that closes over {value!r}: "
            "expected functions, numbers, strings, or tuples of these"
        )


# --------------------------------------------------------------------------------------------------
# Compiled code on disk: identified by its sources, written by one process at a time.
# --------------------------------------------------------------------------------------------------

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
    versions = f"{numba.__version__} {llvmlite.__version__} {_FORM}"
    records = f"{PRECISION} {WIDTH} {REGISTER}" + (f" {ROOM}" if ROOM else "")
    return f"{context.codegen().magic_tuple()} {versions} {records} {options}"


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

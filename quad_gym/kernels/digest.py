"""Digests of everything that compiled code depends on, which show whether a cache is stale.

The digest of a module follows its imports through the package, so that nothing has to be listed by
hand. Comments, docstrings and layout do not count, as the syntax tree is hashed.
"""

import ast
import atexit
import contextlib
import dis
import functools
import hashlib
import importlib.util
import json
import os
import sys
import time
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from types import CodeType, FunctionType
from typing import Any

import numpy as np

PACKAGE = __package__.partition(".")[0]
_NO_CODE = {
    *(f"{__package__}.compiling.{name}" for name in ("building", "cache", "workers")),
    *(f"{__package__}.{name}" for name in ("cores", "digest", "library", "linked", "sources")),
}
"""Modules that determine when code is compiled, but do not change the code."""
_BEGAN = time.time()  #: when this process began to import kernels [s]
_IMPORTED: dict[str, tuple[int, float]] = {}
"""Modules with kernels: the identity of their names, and when the first kernel was made [s]."""
_FILES: dict[str, Path] = {}
"""Files of the modules of which there are digests."""
_TABLE = f"{PACKAGE}.params.aid_table"
"""Module of parameters of which code depends on the values `AID_SHAPES` only."""


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
        return hashlib.sha256(repr(module.AID_SHAPES).encode()).hexdigest(), []
    _FILES[name] = Path(module.__file__)
    return _parsed(Path(module.__file__).read_bytes(), module.__package__ or "")


def edited_source() -> Path | None:
    """File that may have changed since this process imported it, of those that have digests.

    Digests are of files, and compiled code is of what was imported, so that the latter must not be
    kept under the former. An edit changes a file's time, or, if it replaces the file or the time is
    set, the time of its change of status.
    """
    for name, file in _FILES.items():
        with contextlib.suppress(OSError):
            status = file.stat()
            _, imported = _IMPORTED.get(name, (0, _BEGAN))
            if max(status.st_mtime, status.st_ctime) > imported:
                return file
    return None


def note_import(function: Callable[..., Any]) -> None:
    """Note when the module of a kernel was imported, at the latest; for `edited_source`."""
    names = function.__globals__
    known = _IMPORTED.get(function.__module__)
    if known is None or known[0] != id(names):
        _IMPORTED[function.__module__] = id(names), time.time()


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
    folder = Path(os.environ.get("NUMBA_CACHE_DIR") or Path(__file__).with_name("__pycache__"))
    file = folder / f"quad_gym_digests.{sys.implementation.cache_tag}.json"
    known: dict[str, tuple[str, list[str]]] = {}
    with contextlib.suppress(OSError, ValueError, TypeError, AttributeError):  # none, or damaged
        for key, (digest, names) in json.loads(file.read_text()).items():
            known[key] = str(digest), list(names)
    count = len(known)

    @atexit.register
    def save() -> None:
        temporary = file.with_suffix(f".{os.getpid()}.tmp")
        if len(known) > count:
            with contextlib.suppress(OSError):
                folder.mkdir(parents=True, exist_ok=True)
                temporary.write_text(json.dumps(dict(list(known.items())[-1000:])))
                temporary.replace(file)

    return known


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
    """Instructions, independent of their lines: functions of a module may share a name."""
    for instruction in dis.get_instructions(code):
        if isinstance(instruction.argval, CodeType):
            yield from _code(instruction.argval)
        else:
            yield f"{instruction.opname} {instruction.argval!r}"


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

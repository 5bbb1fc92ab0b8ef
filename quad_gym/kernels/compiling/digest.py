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
import inspect
import json
import os
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from types import BuiltinFunctionType, CodeType, FunctionType, ModuleType
from typing import Any

import numpy as np
from numba.core import config

PACKAGE = __package__.partition(".")[0]
_BASE = Path(__file__).resolve().parents[len(__package__.split("."))]
"""The folder that contains the package."""
_NO_CODE = {f"{__package__}.{name}" for name in ("cache", "cores", "digest", "locks", "workers")}
"""Modules that determine when code is compiled, but do not change the code."""


# ---- modules ---------------------------------------------------------------------------------


def digest_of(path: Path) -> str:
    """Digest of a source file and of all modules of the package that it imports, directly or not.

    Args:
        path: The file of the compiled function; it may be outside the package.

    Raises:
        SyntaxError, OSError: If a file cannot be read.
    """
    todo, seen = [path.resolve()], {}
    while todo:
        file = todo.pop()
        if file not in seen:
            seen[file], imported = _read(file, file.stat().st_mtime_ns)
            todo += imported
    digest = hashlib.sha256(sys.version.encode())
    # with names, as two files may swap their contents; relative, as a package may be moved
    for line in sorted(f"{os.path.relpath(file, _BASE)} {seen[file]}\n" for file in seen):
        digest.update(line.encode())
    return digest.hexdigest()


@functools.cache
def flights_digest() -> str:
    """Digest of all sources on which flights and their results depend.

    Results on disk are stored with it: after a change of code they are measured again. The layout
    of commands and pictures does not count.
    """
    apart = {"commands", "experiments", "rendering", "compiling"}
    names = sorted(name for name in _sources_of(_BASE / PACKAGE) if not apart & {*name.split("/")})
    files = [_BASE / name for name in names]
    digests = [_read(file, file.stat().st_mtime_ns)[0] for file in files]
    lines = (f"{name} {digest}\n" for name, digest in zip(names, digests, strict=True))
    return hashlib.sha256("".join(lines).encode()).hexdigest()


@functools.lru_cache(maxsize=1024)
def _read(file: Path, changed: int) -> tuple[str, tuple[Path, ...]]:
    """Digest of one file, and the files of the package that it imports."""
    content = file.read_bytes()
    place = "/".join(file.relative_to(_BASE).parts[:-1]) if _BASE in file.parents else ""
    key = hashlib.sha256(place.encode() + b"\n" + content).hexdigest()
    known = _known()
    if key not in known:
        known[key] = _parsed(content, file)
        _save_at_exit()
    digest, imported = known[key]
    paths = [_path_of(name) for name in imported if name not in _NO_CODE]
    return digest, tuple(filter(None, paths))


def _parsed(content: bytes, file: Path) -> tuple[str, list[str]]:
    """Digest of a source, and the names that it imports."""
    tree = ast.parse(content)
    imported = {name for node in ast.walk(tree) for name in _imports(node, file)}
    for node in ast.walk(tree):
        _drop_docstring(node)
    return hashlib.sha256(ast.dump(tree).encode()).hexdigest(), sorted(imported)


# earlier results of parsing, by the hash of the source: parsing takes longer than loading code


def _memory() -> Path:
    """The file that stores them, one for each version of Python, as syntax trees differ."""
    folder = config.CACHE_DIR or Path(__file__).with_name("__pycache__")
    return Path(folder) / f"quad_gym_digests.{sys.implementation.cache_tag}.json"


@functools.cache
def _known() -> dict[str, tuple[str, list[str]]]:
    try:
        found = json.loads(_memory().read_text())
        return {str(key): (str(digest), list(names)) for key, (digest, names) in found.items()}
    except (OSError, ValueError, TypeError, AttributeError):  # none yet, or a damaged one
        return {}


@functools.cache
def _save_at_exit() -> None:
    """Write the known digests once, when this process ends; a failure is harmless."""
    atexit.register(_save)


def _save() -> None:
    file = _memory()
    temporary = file.with_suffix(f".{os.getpid()}.tmp")
    try:
        file.parent.mkdir(parents=True, exist_ok=True)
        temporary.write_text(json.dumps(dict(list(_known().items())[-1000:])))
        temporary.replace(file)
    except OSError:
        with contextlib.suppress(OSError):
            temporary.unlink(missing_ok=True)


def _imports(node: ast.AST, file: Path) -> list[str]:
    """Names of modules, and of possible modules, that a statement imports."""
    if isinstance(node, ast.Import):
        return [alias.name for alias in node.names]
    if not isinstance(node, ast.ImportFrom):
        return []
    module = node.module or ""
    if node.level > 0:
        if _BASE not in file.parents:
            return []
        parts = file.relative_to(_BASE).parts[: -node.level]
        module = ".".join([*parts, module]) if module else ".".join(parts)
    return [module, *(f"{module}.{alias.name}" for alias in node.names)]


def _path_of(name: str) -> Path | None:
    """The file of a module of the package, or of one next to it, such as a test's helpers."""
    root = name.partition(".")[0]
    base = _BASE
    if root != PACKAGE:
        if root != "tests" or root not in sys.modules:
            return None
        base = Path(sys.modules[root].__path__[0]).resolve().parent
    place = name.replace(".", "/")
    known = _sources_of(base / root)
    for source in (f"{place}/__init__.py", f"{place}.py"):
        if source in known:
            return base / source
    return None


@functools.cache  # one scan of the folders instead of two look-ups for each of a thousand names
def _sources_of(package: Path) -> frozenset[str]:
    """The source files of a package, relative to the folder that contains it."""
    return frozenset(
        os.path.relpath(os.path.join(folder, file), package.parent).replace(os.sep, "/")
        for folder, _, files in os.walk(package)
        for file in files
        if file.endswith(".py")
    )


def _drop_docstring(node: ast.AST) -> None:
    """Remove the strings that are statements: docstrings, also of attributes."""
    body = getattr(node, "body", None)
    if isinstance(body, list):
        kept = [
            statement
            for statement in body
            if not (
                isinstance(statement, ast.Expr)
                and isinstance(statement.value, ast.Constant)
                and isinstance(statement.value.value, str)
            )
        ]
        node.body = kept  # type: ignore[attr-defined]


# ---- functions -------------------------------------------------------------------------------


def digest_of_function(function: Callable[..., Any]) -> str:
    """Digest of a function: its module with all imports, its instructions, defaults and closure.

    Functions made from one piece of source differ in their closures and defaults. Functions among
    these values count with their own modules, other values as they are.

    Raises:
        TypeError: If it closes over a value that has no lasting identity.
    """
    return hashlib.sha256("\n".join(_function(function, ())).encode()).hexdigest()


def closure_of(function: Callable[..., Any]) -> list[Any]:
    """Values that a function closes over, with plain functions in place of compiled ones."""
    return [_plain(cell.cell_contents) for cell in function.__closure__ or ()]  # type: ignore[attr-defined]


def _plain(value: Any) -> Any:
    """The function from which a dispatcher or an intrinsic was made; else the value itself."""
    return getattr(value, "py_func", None) or getattr(value, "__wrapped__", value)


def _function(function: Any, above: tuple[Any, ...]) -> Iterator[str]:
    yield f"{function.__module__}:{function.__qualname__}"
    if function in above:  # recursion
        return
    yield digest_of(Path(inspect.getfile(function)))
    yield from _code(function.__code__)
    held = (function.__defaults__, function.__kwdefaults__, closure_of(function))
    yield from _value(held, (*above, function))


def _code(code: CodeType) -> Iterator[str]:
    """Instructions, independent of their lines: functions of a module may share a name."""
    for instruction in dis.get_instructions(code):
        if isinstance(instruction.argval, CodeType):
            yield from _code(instruction.argval)
        else:
            yield f"{instruction.opname} {instruction.argval!r}"


def _value(value: Any, above: tuple[Any, ...]) -> Iterator[str]:
    value = _plain(value)
    if isinstance(value, FunctionType):
        yield from _function(value, above)
    elif isinstance(value, tuple | list):
        yield f"{type(value).__name__} of {len(value)}"
        for item in value:
            yield from _value(item, above)
    elif isinstance(value, dict):
        yield from _value(list(value.items()), above)
    elif isinstance(value, np.ndarray) and not value.dtype.hasobject:
        content = hashlib.sha256(value.tobytes()).hexdigest()
        yield f"{value.dtype.descr} {value.shape} {content}"
    elif isinstance(value, np.dtype):
        yield f"dtype {value!r}"
    elif value is None or isinstance(value, int | float | complex | str | bytes | np.generic):
        yield f"{type(value).__qualname__} {value!r}"
    elif isinstance(value, ModuleType):
        yield f"module {value.__name__}"
    elif isinstance(value, BuiltinFunctionType):
        yield f"builtin {value.__module__}:{value.__qualname__}"
    else:
        raise TypeError(
            f"compiled code cannot be cached that closes over {value!r}: "
            "expected functions, numbers, strings, arrays, or tuples of these"
        )

"""Which sources compiled code depends on, as a digest that decides whether a cache is stale.

The digest of a module follows its imports through the package, so that nothing has to be listed by
hand. Comments, docstrings and layout do not count: what is hashed is the syntax tree.
"""

import ast
import functools
import hashlib
import sys
from pathlib import Path

PACKAGE = __package__.partition(".")[0]
_NO_CODE = {f"{__package__}.{name}" for name in ("cache", "digest", "linking_check", "workers")}
"""Modules that decide when code is compiled, not what."""


def digest_of(path: Path) -> str:
    """A digest of a source file and of everything of the package that it imports, directly or not.

    Args:
        path: The file of the compiled function; it may lie outside the package.

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
    for content in sorted(seen.values()):
        digest.update(content.encode())
    return digest.hexdigest()


@functools.lru_cache(maxsize=1024)
def _read(file: Path, changed: int) -> tuple[str, tuple[Path, ...]]:
    """The digest of one file, and the files of the package that it imports."""
    tree = ast.parse(file.read_bytes())
    imported = {name for node in ast.walk(tree) for name in _imports(node, file)}
    paths = [_path_of(name) for name in imported if name not in _NO_CODE]
    for node in ast.walk(tree):
        _drop_docstring(node)
    return hashlib.sha256(ast.dump(tree).encode()).hexdigest(), tuple(filter(None, paths))


def _imports(node: ast.AST, file: Path) -> list[str]:
    """Names of modules, and of what may be modules, that a statement imports."""
    if isinstance(node, ast.Import):
        return [alias.name for alias in node.names]
    if isinstance(node, ast.ImportFrom) and node.level == 0 and node.module:
        return [node.module, *(f"{node.module}.{alias.name}" for alias in node.names)]
    return []


def _path_of(name: str) -> Path | None:
    """The file of a module of the package, or of one beside it such as a test's helpers."""
    root = name.partition(".")[0]
    if root != PACKAGE and not (root in sys.modules and root == "tests"):
        return None
    base = Path(__file__).resolve().parents[len(__package__.split("."))]
    if root != PACKAGE:
        module = sys.modules[root]
        base = Path(module.__path__[0]).resolve().parent
    file = base.joinpath(*name.split("."))
    if (file / "__init__.py").is_file():
        return file / "__init__.py"
    source = file.with_suffix(".py")
    return source if source.is_file() else None


def _drop_docstring(node: ast.AST) -> None:
    """Remove the strings that stand alone as statements: docstrings, also those of attributes."""
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

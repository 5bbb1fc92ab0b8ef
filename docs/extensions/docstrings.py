"""Conversion of docstrings for Sphinx: Markdown tables, and the specification.

Docstrings have Markdown tables, which are readable in `help`; Sphinx reads reStructuredText. Of the
specification, `QuadEnv`'s docstring, only arguments stay: `environment_pages.py` shows the rest.
"""

import re
from collections.abc import Iterator
from itertools import groupby
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from sphinx.application import Sphinx
from sphinx.util.typing import stringify_annotation

SPECIFICATION = (
    "A quadrotor that is controlled on estimated state.",
    "",
    "Observation, action, reward, start, endings and `info` are on the page of each environment.",
    "",
)
PLAIN = ("attribute", "data", "property")
"""Kinds of objects without sections in their docstrings."""

kept: dict[str, list[str]] = {}
"""Docstrings of these kinds, stored while Napoleon works."""

ALIAS = re.compile("Alias for field number")
"""Default docstring of the fields of a named tuple."""

BUILT_IN = (tuple, dict, int, float, str, BaseException)
"""Types of Python whose methods the pages leave out."""

ARRAYS = {
    stringify_annotation(long, "smart"): short
    for long, short in (
        (ArrayLike, "~numpy.typing.ArrayLike"),
        (NDArray[np.float64], "NDArray[float64]"),
        (NDArray[np.float32], "NDArray[float32]"),
        (NDArray[np.int64], "NDArray[int64]"),
        (NDArray[np.bool_], "NDArray[bool]"),
        (NDArray[Any], "NDArray"),
    )
}


def _cells(line: str) -> list[str]:
    return [cell.strip() for cell in line.strip().strip("|").split("|")]


def _list_table(lines: list[str]) -> Iterator[str]:
    """Convert a Markdown table to a list-table."""
    indent = lines[0][: len(lines[0]) - len(lines[0].lstrip())]
    head, _, *rows = map(_cells, lines)
    yield from ("", f"{indent}.. list-table::", f"{indent}   :header-rows: 1", "")
    for row in (head, *rows):
        for number, cell in enumerate(row):
            yield f"{indent}   {'* -' if number == 0 else '  -'} {cell}"
    yield ""


def _is_table(line: str) -> bool:
    return line.lstrip().startswith("|") and line.rstrip().endswith("|")


def rewrite(app: Sphinx, what: str, name: str, obj: Any, options: Any, lines: list[str]) -> None:
    """Rewrite a docstring in place."""
    if name == "quad_gym.QuadEnv":
        arguments = slice(lines.index("Args:"), lines.index("## Version history"))
        lines[:] = [*SPECIFICATION, *lines[arguments]]
    found: list[str] = []
    for is_table, part in groupby(lines, _is_table):
        part = list(part)
        found += _list_table(part) if is_table and len(part) > 2 else part
    lines[:] = found

    if what in PLAIN:
        kept[name] = [line for line in lines if not ALIAS.match(line)]


def restore(app: Sphinx, what: str, name: str, obj: Any, options: Any, lines: list[str]) -> None:
    """Undo Napoleon's change of fields, where it turns text before a colon into a type."""
    if what in PLAIN:
        lines[:] = kept.pop(name)


def shorten(
    app: Sphinx,
    what: str,
    name: str,
    obj: Any,
    options: Any,
    signature: str | None,
    returns: str | None,
) -> tuple[str | None, str | None]:
    """Shorten types of arrays to their names in the code."""
    parts = [signature, returns]
    for long, short in ARRAYS.items():
        parts = [part and part.replace(long, short) for part in parts]
    return parts[0], parts[1]


def skip(app: Sphinx, what: str, name: str, obj: Any, skipped: bool, options: Any) -> bool | None:
    """Leave out what classes inherit from Python's tuples, dictionaries and numbers."""
    owner = getattr(obj, "__objclass__", None) or type(getattr(obj, "__self__", None))
    return True if getattr(owner, "__module__", "") == "builtins" and owner in BUILT_IN else None


def setup(app: Sphinx) -> dict[str, Any]:
    """Rewrite docstrings before Napoleon does, and after."""
    app.connect("autodoc-process-docstring", rewrite, priority=100)
    app.connect("autodoc-process-docstring", restore, priority=900)
    app.connect("autodoc-process-signature", shorten)
    app.connect("autodoc-skip-member", skip)
    return {"parallel_read_safe": True, "parallel_write_safe": True}

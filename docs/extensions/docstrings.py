"""Docstrings for Sphinx, which reads reStructuredText: Markdown tables, and the specification.

Tables in docstrings are Markdown's, as `help` shows them best. The specification of environments,
`QuadEnv`'s docstring, has its own pages (`environment_pages.py`); its arguments stay.
"""

from collections.abc import Iterator
from itertools import groupby
from typing import Any

from sphinx.application import Sphinx

SPECIFICATION = (
    "A quadrotor that is controlled on estimated state.",
    "",
    "Observation, action, reward, start, endings and `info` are on the page of each environment.",
    "",
)


def _cells(line: str) -> list[str]:
    return [cell.strip() for cell in line.strip().strip("|").split("|")]


def _list_table(lines: list[str]) -> Iterator[str]:
    """A table of Markdown as a list-table."""
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


def setup(app: Sphinx) -> dict[str, Any]:
    """Rewrite docstrings before Napoleon does."""
    app.connect("autodoc-process-docstring", rewrite, priority=100)
    return {"parallel_read_safe": True, "parallel_write_safe": True}

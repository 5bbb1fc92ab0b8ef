"""Output of experiments: tables on the screen, JSON and CSV files, and one HTML page."""

import base64
import csv
import dataclasses
import json
import math
import platform
import sys
import tempfile
from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from html import escape
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from string import Template
from typing import Any

import numpy as np

from quad_gym.analysis.plots import save_figure

# --------------------------------------------------------------------------------------------------
# Output of experiments: tables on the screen, JSON and CSV files.
# --------------------------------------------------------------------------------------------------


def versions(*packages: str) -> dict[str, str | None]:
    """Versions of Python, quad_gym and further packages; None if a package is not installed."""
    found: dict[str, str | None] = dict.fromkeys(packages)
    for package in packages:
        with suppress(PackageNotFoundError):
            found[package] = version(package)
    # metadata of an editable installation may be of an earlier commit; the package is loaded
    ours = sys.modules["quad_gym"].__version__
    return {"python": platform.python_version(), "quad_gym": ours, **found}


def short_name(policy: str) -> str:
    """Name of a policy for tables and figures; for a file, its folder and name."""
    path = Path(policy)
    return f"{path.parent.name}/{path.stem}".lstrip("/") if path.suffix else policy


_made: list[Path] = []  #: folders made for later output, each one before its parents


def require_writable(option: str, folder: Path) -> None:
    """Create a folder if it is missing, or raise an OSError if files cannot be written in it."""
    missing = [path for path in (folder, *folder.parents) if not path.exists()]
    try:
        folder.mkdir(parents=True, exist_ok=True)
        _made[:0] = [path.absolute() for path in missing]
        tempfile.TemporaryFile(dir=folder).close()
    except OSError as error:
        raise OSError(f"cannot write to {option} {folder}: {error.strerror}") from None


def remove_unused_folders() -> None:
    """Remove folders that `require_writable` has created and that are still empty."""
    while _made:
        with suppress(OSError):  # not empty, or gone
            _made.pop(0).rmdir()


def without_numpy(value: Any) -> Any:
    """Convert a number or array of NumPy, such as a seed, for `json.dumps`; refuse others."""
    if isinstance(value, np.generic | np.ndarray):
        return value.tolist()
    raise TypeError(f"a record must have numbers, texts, lists and dictionaries, got {value!r}")


def as_json(value: Any) -> Any:
    """Convert a value to JSON types: dataclasses to objects, arrays to lists, NaN to null."""
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        return {f.name: as_json(getattr(value, f.name)) for f in dataclasses.fields(value)}
    if isinstance(value, Mapping):
        return {str(key): as_json(part) for key, part in value.items()}
    if isinstance(value, np.ndarray | np.generic):
        return as_json(value.tolist())
    if isinstance(value, list | tuple):
        return [as_json(part) for part in value]
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value if value is None or isinstance(value, bool | int | float | str) else str(value)


def write_json(file: Path, value: Any) -> Path:
    """Write a value as indented JSON; returns the path of the file."""
    text = json.dumps(as_json(value), indent=2, allow_nan=False, ensure_ascii=False)
    file.write_text(text + "\n", encoding="utf-8")
    return file


def columns_of(rows: Sequence[Mapping[str, Any]]) -> dict[str, list[Any]]:
    """Convert rows with the same names to columns by name."""
    return {name: [row[name] for row in rows] for name in rows[0]}


def stacked(tables: Iterable[Mapping[str, Iterable[Any]]]) -> dict[str, list[Any]]:
    """Stack tables with the same columns, one below the other."""
    columns: dict[str, list[Any]] = {}
    for table in tables:
        for name, values in table.items():
            columns.setdefault(name, []).extend(values)
    return columns


_AT_ONCE = 4096  #: rows of arrays that are Python's numbers at a time


def write_csv(file: Path, columns: Mapping[str, Any]) -> Path:
    """Write columns of equal length by heading as CSV, with empty cells for NaN and None."""
    with file.open("w", newline="", encoding="utf-8") as stream:
        writer = csv.writer(stream, lineterminator="\n")
        writer.writerow(columns)
        count = max(map(len, columns.values()), default=0)
        for first in range(0, count, _AT_ONCE):
            some = (values[first : first + _AT_ONCE] for values in columns.values())
            lists = (v.tolist() if isinstance(v, np.ndarray) else v for v in some)
            for row in zip(*lists, strict=True):
                writer.writerow(["" if as_json(cell) is None else cell for cell in row])
    return file


def markdown_table(heads: Sequence[str], rows: Iterable[Sequence[str]], texts: int = 1) -> str:
    """Return a table in Markdown; its columns after the first `texts` ones are numbers."""
    rule = ["---" if k < texts else "---:" for k in range(len(heads))]
    return "\n".join(f"| {' | '.join(line)} |" for line in (heads, rule, *rows))


def text_table(groups: Mapping[str, Sequence[str]], rows: Sequence[Sequence[str]]) -> str:
    """Format a table for the screen; the first column is left-aligned, others right-aligned.

    Args:
        groups: Headings of the columns of each group, by heading of the group.
        rows: Cells of each row, one per column.
    """
    headings = [heading for columns in groups.values() for heading in columns]
    widths = [max(map(len, column)) for column in zip(headings, *rows, strict=True)]
    spans, first = [], 0
    for group, columns in groups.items():
        # a group is at least as wide as its heading; its last column is widened if necessary
        span = range(first, first + len(columns))
        width = sum(widths[k] for k in span) + 2 * (len(columns) - 1)
        widths[span[-1]] += max(0, len(group) - width)
        spans.append((group, span, max(width, len(group))))
        first = span[-1] + 1

    def line(cells: Sequence[str]) -> str:
        padded = [
            cell.rjust(width) if k else cell.ljust(width)
            for k, (cell, width) in enumerate(zip(cells, widths, strict=True))
        ]
        return " | ".join("  ".join(padded[k] for k in span) for _, span, _ in spans).rstrip()

    groups_line = " | ".join(group.center(width) for group, _, width in spans).rstrip()
    rule = "-+-".join("-" * width for _, _, width in spans)
    return "\n".join([groups_line, line(headings), rule, *map(line, rows)])


# --------------------------------------------------------------------------------------------------
# Reports: files of numbers and figures, and one HTML page that shows them without a network.
# --------------------------------------------------------------------------------------------------

_PAGE = Path(__file__).with_name("page.html")


class Report:
    """Report in a folder, with a title: its page grows by one element with each call."""

    def __init__(self, folder: Path, title: str) -> None:
        self.folder, self._title = folder, title
        self.files: list[Path] = []
        """Files of the report"""
        self._parts: list[str] = []
        self.add("h1", title)

    def add(self, tag: str, text: str) -> None:
        """Add an element that contains only text, such as a paragraph."""
        self._parts.append(_element(tag, text))

    def add_bullets(self, sentences: Sequence[str]) -> None:
        """Add a list of sentences."""
        items = "".join(_element("li", sentence) for sentence in sentences)
        self._parts.append(f"<ul>{items}</ul>")

    def add_table(self, headings: Sequence[str], rows: Sequence[Sequence[str]]) -> None:
        """Add a table of texts."""
        cells = [[_element("th", text) for text in headings]]
        cells += [[_element("td", text) for text in row] for row in rows]
        rows_text = "".join(f"<tr>{''.join(row)}</tr>" for row in cells)
        self._parts.append(f"<table>{rows_text}</table>")

    def add_figure(self, name: str, figure: Any, caption: str) -> None:
        """Save a matplotlib figure under a name, and add it."""
        picture, *others = save_figure(figure, self.folder / name)
        self.add_picture(picture, caption)
        self.files += others

    def add_picture(self, file: Path, caption: str) -> None:
        """Add a picture or film of the folder, contained in the page, with a caption."""
        self.files.append(file)
        kind, data = file.suffix[1:], base64.b64encode(file.read_bytes()).decode()
        shown = f'<img alt="{escape(caption)}" src="data:image/{kind};base64,{data}">'
        if kind == "mp4":
            shown = f'<video controls loop src="data:video/mp4;base64,{data}"></video>'
        self._parts.append(f"<figure>{shown}{_element('figcaption', caption)}</figure>")

    def write(self) -> list[Path]:
        """Write the page, report.html; return all files, the page last."""
        page = self.folder / "report.html"
        template = Template(_PAGE.read_text(encoding="utf-8"))
        text = template.substitute(title=escape(self._title), body="\n".join(self._parts))
        page.write_text(text, encoding="utf-8")
        return [*self.files, page]


def _element(tag: str, text: str) -> str:
    return f"<{tag}>{escape(text)}</{tag}>"

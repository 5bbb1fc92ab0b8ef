"""Output of experiments: tables on the screen, JSON and CSV files."""

import csv
import dataclasses
import json
import math
import platform
import tempfile
from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

import numpy as np


def versions(*packages: str) -> dict[str, str | None]:
    """Versions of Python, quad_gym and further packages; None if a package is not installed."""
    found: dict[str, str | None] = dict.fromkeys(packages)
    for package in packages:
        with suppress(PackageNotFoundError):
            found[package] = version(package)
    return {"python": platform.python_version(), "quad_gym": version("quad-gym"), **found}


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

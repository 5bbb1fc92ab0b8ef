"""Output of experiments: tables on the screen, summaries as JSON, numbers as CSV."""

import csv
import dataclasses
import json
import math
import platform
import tempfile
from collections.abc import Mapping, Sequence
from contextlib import suppress
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

import numpy as np


def versions(*packages: str) -> dict[str, str | None]:
    """Versions of Python, quad_gym and further packages; None for one that is not installed."""
    found: dict[str, str | None] = {
        "python": platform.python_version(),
        "quad_gym": version("quad-gym"),
    }
    for package in packages:
        try:
            found[package] = version(package)
        except PackageNotFoundError:
            found[package] = None
    return found


def short_name(policy: str) -> str:
    """A policy's name for tables and pictures: of a file, its folder and its name."""
    path = Path(policy)
    return f"{path.parent.name}/{path.stem}".lstrip("/") if path.suffix else policy


_made: list[Path] = []
"""Folders that were made for files to come, each before those in which it is."""


def require_writable(option: str, folder: Path) -> None:
    """Make a folder if it is missing, and see that files can be written there.

    Args:
        option: What named it, such as "--output", for the message.
        folder: The folder.

    Raises:
        OSError: If nothing can be written there.
    """
    missing = [path for path in (folder, *folder.parents) if not path.exists()]
    try:
        folder.mkdir(parents=True, exist_ok=True)
        _made[:0] = [path.absolute() for path in missing]
        tempfile.TemporaryFile(dir=folder).close()
    except OSError as error:
        raise OSError(f"cannot write to {option} {folder}: {error.strerror}") from None


def remove_unused_folders() -> None:
    """Remove the folders that `require_writable` has made and nothing was written to."""
    while _made:
        with suppress(OSError):  # not empty, or gone
            _made.pop(0).rmdir()


def as_json(value: Any) -> Any:
    """`value` in the types of JSON: dataclasses as objects, arrays as lists, NaN as null."""
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
    """Write `value` as JSON that people can read too.

    Returns:
        The file.
    """
    text = json.dumps(as_json(value), indent=2, allow_nan=False, ensure_ascii=False)
    file.write_text(text + "\n", encoding="utf-8")
    return file


def write_csv(file: Path, columns: Mapping[str, Sequence[Any]]) -> Path:
    """Write columns of equal length, by their headings; NaN and None as empty cells.

    Returns:
        The file.

    Raises:
        ValueError: If the columns differ in length.
    """
    with file.open("w", newline="", encoding="utf-8") as stream:
        writer = csv.writer(stream, lineterminator="\n")
        writer.writerow(columns)
        for row in zip(*columns.values(), strict=True):
            writer.writerow(["" if as_json(cell) is None else cell for cell in row])
    return file


def text_table(groups: Mapping[str, Sequence[str]], rows: Sequence[Sequence[str]]) -> str:
    """A table for the screen; the first column is flush left, all others flush right.

    Args:
        groups: Headings of columns, by the heading of their group.
        rows: Cells, one for each column.
    """
    headings = [heading for columns in groups.values() for heading in columns]
    widths = [max(map(len, column)) for column in zip(headings, *rows, strict=True)]
    spans, first = [], 0
    for group, columns in groups.items():
        # a group is as wide as its heading at least; its last column takes what is missing
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

    return "\n".join(
        [
            " | ".join(group.center(width) for group, _, width in spans).rstrip(),
            line(headings),
            "-+-".join("-" * width for _, _, width in spans),
            *map(line, rows),
        ]
    )

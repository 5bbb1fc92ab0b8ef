"""Trajectories from tables."""

import csv
from pathlib import Path
from typing import Any

import numpy as np

from quad_gym.params import checks as check
from quad_gym.params.trajectories.pieces import Pieces
from quad_gym.params.trajectories.splines import through

COLUMNS = ("time", "x", "y", "z")  #: columns that a table must have; "yaw" is optional

OPTIONS = ("closed", "minimize", "at_rest", "yaw", "look_at")
"""Keywords of `Trajectory.through` that do not contradict a table."""


def from_csv(path: Path | str, **options: Any) -> Pieces:
    """Return a trajectory through the rows of a table, at their times.

    The first line names the columns: `time` [s], `x`, `y`, `z` in I [m], and optionally `yaw`
    [rad]; others are ignored. Times must increase, and are counted from the first.

    Args:
        path: A text file of comma-separated values.
        options: Keywords of `through` other than times and bounds, such as `minimize="jerk"`,
            or `at_rest=False` for a table that begins and ends in flight. With `closed=True`,
            the last row is the return to the first.

    Returns:
        The trajectory.

    Raises:
        FileNotFoundError: If there is no such file.
        ValueError: If a column is missing or a value is not a number; the message names the
            line.
    """
    check.keywords(options, OPTIONS, "Trajectory.from_csv")
    path = Path(path)
    with path.open(newline="", encoding="utf-8-sig") as stream:
        lines = csv.reader(stream)
        names = [name.strip().lower() for name in next(lines, [])]
        missing = [name for name in COLUMNS if name not in names]
        if missing:
            raise ValueError(
                f"{path} must name the columns {', '.join(COLUMNS)} in its first line, got "
                f"{', '.join(names) or 'nothing'}"
            )
        wanted = [*COLUMNS, *(["yaw"] if "yaw" in names else [])]
        places = [names.index(name) for name in wanted]
        rows = [
            _numbers(f"{path}, line {lines.line_num}", cells, places, wanted)
            for cells in lines
            if any(cell.strip() for cell in cells)
        ]
    if len(rows) < 2:
        raise ValueError(f"{path} must have at least two rows, got {len(rows)}")
    table = np.array(rows)
    behind = np.flatnonzero(np.diff(table[:, 0]) <= 0.0)
    if behind.size:
        k = int(behind[0])
        raise ValueError(
            f"{path} must have increasing times, got {table[k, 0]:g} s and then "
            f"{table[k + 1, 0]:g} s in rows {k + 1} and {k + 2}"
        )
    if "yaw" in wanted and not {"yaw", "look_at"} & {
        k for k, v in options.items() if v is not None
    }:
        options = options | {"yaw": table[:, 4]}
    if not options.get("closed", False):
        return through(table[:, 1:4], table[:, 0], **options)
    if np.abs(table[-1, 1:4] - table[0, 1:4]).max() > 1e-3:
        raise ValueError(
            f"{path} must end where it begins with closed=True, got {table[0, 1:4]} and "
            f"{table[-1, 1:4]}"
        )
    if isinstance(options.get("yaw"), np.ndarray):
        options = options | {"yaw": options["yaw"][:-1]}
    return through(table[:-1, 1:4], table[:, 0], **options)


def _numbers(where: str, cells: list[str], places: list[int], names: list[str]) -> list[float]:
    found = []
    for place, name in zip(places, names, strict=True):
        cell = cells[place].strip() if place < len(cells) else ""
        try:
            found.append(check.number(name, float(cell)))
        except ValueError:
            raise ValueError(f"{where}: {name} must be a finite number, got {cell!r}") from None
    return found

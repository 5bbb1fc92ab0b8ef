"""Tables whose cells are flown one by one, in runs that can be resumed."""

import json
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import Any, Protocol

from tqdm import tqdm

from quad_gym.analysis.reports import as_json, write_json
from quad_gym.kernels.compiling.digest import flights_digest
from quad_gym.params.sensors import SensorSuite


class Flown(Protocol):
    """Cell of a table."""

    @property
    def name(self) -> str:
        """Name of the cell in files."""

    @property
    def flown(self) -> SensorSuite:
        """Sensor suite of the flights."""


def run_cells(
    cells: Iterable[Any],
    files: Path,
    head: Mapping[str, Any],
    measure: Callable[[Any], dict[str, Any]],
    table: Callable[[dict[str, Any]], str],
) -> dict[str, Any]:
    """Compute the cells that an earlier run has not completed.

    Args:
        cells: Cells, each a `Flown`.
        files: Output path without extension: numbers in .json and the table in .md. Both are
            written again after each cell.
        head: Parameters that an earlier run must have in common with this one, in addition to the
            code of the flights.
        measure: Function that computes the results of a cell, including "sensors".
        table: Function that formats the results of all cells, by name.

    Returns:
        Results of these cells, by name.
    """
    file, chosen = files.with_suffix(".json"), list(cells)
    before = json.loads(file.read_text(encoding="utf-8")) if file.exists() else {}
    head = {**head, "sources": flights_digest()}
    same = {key: before.get(key) for key in head} == as_json(head)
    done: dict[str, Any] = before["cells"] if same else {}
    for cell in tqdm(chosen, desc=files.name, unit=" cells"):
        if done.get(cell.name, {}).get("sensors") != as_json(cell.flown):
            done[cell.name] = as_json(measure(cell))
            write_json(file, {**head, "cells": done})
            files.with_suffix(".md").write_text(table(done), encoding="utf-8")
    return {cell.name: done[cell.name] for cell in chosen}

"""Tables of many cells that are flown one by one, in runs that may be interrupted."""

import json
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import Any, Protocol

from tqdm import tqdm

from quad_gym.analysis.reports import as_json, write_json
from quad_gym.kernels.compiling.digest import flights_digest
from quad_gym.params.sensors import SensorSuite


class Flown(Protocol):
    """A cell of a table."""

    @property
    def name(self) -> str:
        """What it is called in files."""

    @property
    def flown(self) -> SensorSuite:
        """The sensors that fly."""


def run_cells(
    cells: Iterable[Any],
    files: Path,
    head: Mapping[str, Any],
    measure: Callable[[Any], dict[str, Any]],
    table: Callable[[dict[str, Any]], str],
) -> dict[str, Any]:
    """Measure all cells that a former run of the same has not.

    Args:
        cells: Each a `Flown`.
        files: Where they are written, less the suffix: .json has the numbers and .md the table.
            Both are written anew after each cell.
        head: What a former run must have in common with this one, beside the code that flies.
        measure: What is found of a cell; with "sensors".
        table: The table of all that are found, by name.

    Returns:
        What was found of these cells, by name.
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

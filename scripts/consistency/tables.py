"""Tables of cases of consistency, which can be resumed."""

import hashlib
import json
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

from tqdm import tqdm

import quad_gym
from quad_gym.analysis.reports import as_json, versions, write_json
from quad_gym.commands.consistency import Case, CaseFlights
from quad_gym.params.suites import ALL_SUITES
from quad_gym.params.vehicle import vehicle_params

APART = ("one_wall", "stale")
"""Suites of tasks, with filters that are inconsistent by design, or for want of markers."""
FLOWN = tuple(name for name in ALL_SUITES if name not in APART)  #: suites of the tables
SMALL = ("crazyflie", "uwb", "mocap")  #: suites of a small vehicle

CaseResults = dict[str, dict[str, Any]]  #: results of cases, by name


def vehicle_of(name: str) -> dict[str, Any]:
    """Keyword of the vehicle that flies a suite, if it is not the default one."""
    return {"vehicle": vehicle_params("crazyflie")} if name in SMALL else {}


def flights_digest() -> str:
    """Digest of all sources on which flights depend: after a change, they are measured again."""
    root, apart = Path(quad_gym.__file__).parent, {"commands", "experiments.py", "rendering"}
    files = (f for f in sorted(root.rglob("*.py")) if not apart & {*f.relative_to(root).parts})
    return hashlib.sha256(b"".join(file.read_bytes() for file in files)).hexdigest()


def run_cases(
    cases: Iterable[Case],
    files: Path,
    flights: CaseFlights,
    measure: Callable[[Case, CaseFlights], dict[str, Any]],
    table: Callable[[CaseResults, CaseFlights], str],
    **head: Any,
) -> CaseResults:
    """Compute the cases that an earlier run has not completed.

    Args:
        cases: Cases of the table.
        files: Output path without extension: numbers in .json and the table in .md. Both are
            written again after each case.
        flights: Flights of each case.
        measure: Function that computes the results of a case: "values" by column, "misses",
            "expected", "filters_failed" and "sensors".
        table: Function that formats the results of all cases.
        **head: Further parameters that an earlier run must have in common with this one.
    """
    file, chosen = files.with_suffix(".json"), list(cases)
    before = json.loads(file.read_text(encoding="utf-8")) if file.exists() else {}
    head = {"flights": flights.count, **head, "seeds": flights.seed_limits}
    head |= {"versions": versions("numpy", "numba"), "sources": flights_digest()}
    same = {key: before.get(key) for key in head} == as_json(head)
    done: CaseResults = before["cells"] if same else {}
    for case in tqdm(chosen, desc=files.name, unit=" cells"):
        if done.get(case.name, {}).get("sensors") != as_json(case.sensors):
            done[case.name] = as_json(measure(case, flights))
            write_json(file, {**head, "cells": done})
            files.with_suffix(".md").write_text(table(done, flights), encoding="utf-8")
    return {case.name: done[case.name] for case in chosen}


def case_table(
    first: str,
    columns: Mapping[str, str],
    cells: CaseResults,
    text: Callable[[float], str],
    *head: Sequence[str],
) -> list[str]:
    """Lines of a table in Markdown: misses bold, or in italics if there is a reason.

    `columns` are headings by name of the column, and rows in `head` are above the cases.
    """
    rows = [[first, *columns.values(), "remarks"], *head]
    for label, cell in cells.items():
        texts = []
        for name in columns:
            value = cell["values"].get(name)
            words = "" if value is None else text(value)
            mark = "*" if {"", name} & cell["expected"].keys() else "**"
            texts.append(f"{mark}{words}{mark}" if name in cell["misses"] else words)
        remarks = [
            f"{k.removeprefix('nis_')}: {v}" if k else v for k, v in cell["expected"].items()
        ]
        if cell["filters_failed"]:
            remarks.append(f"**{cell['filters_failed']} filters failed**")
        rows.append([label, *texts, "; ".join(remarks)])
    lines = [f"| {' | '.join(row)} |" for row in rows]
    return [lines[0], "|---|" + "---:|" * len(columns) + "---|", *lines[1:]]


def unexpected(cells: CaseResults) -> int:
    """Number of misses without a known reason."""
    return sum(
        not {"", name} & cell["expected"].keys()
        for cell in cells.values()
        for name in cell["misses"]
    )

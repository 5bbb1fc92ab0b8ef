"""Cases of an experiment on consistency, and tables of them that can be resumed."""

import json
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

from tqdm import tqdm

from quad_gym.analysis.consistency_flights import Findings, endless, measure_consistency
from quad_gym.analysis.reports import as_json, versions, write_json
from quad_gym.batch.flight_batch import FlightBatch
from quad_gym.envs.flights import TASK_DEFAULTS
from quad_gym.kernels.digest import flights_digest
from quad_gym.params.sensors import SensorSuite

CaseResults = dict[str, dict[str, Any]]  #: results of cases, by name


@dataclass(frozen=True)
class CaseFlights:
    """Flights of each case."""

    count: int
    first_seed: int = 0
    duration: float = 10.0
    """length [s]"""
    threads: int | None = None

    @property
    def seeds(self) -> range:
        """Consecutive seeds of the flights."""
        return range(self.first_seed, self.first_seed + self.count)

    @property
    def seed_limits(self) -> list[int]:
        """First and last seed."""
        return [self.seeds[0], self.seeds[-1]]


@dataclass(frozen=True)
class Case:
    """Configuration of flights by PD control."""

    name: str
    sensors: SensorSuite
    task: str = "random_trajectory"
    start: Literal["cold", "warm"] = "cold"
    """start of the filter"""
    keywords: Mapping[str, Any] = field(default_factory=dict)
    """further keywords of `FlightBatch`"""
    expected: Mapping[str, str] = field(default_factory=dict)
    """reasons for misses, by column; "" stands for all columns"""

    def batch(self, count: int, threads: int | None = None) -> FlightBatch:
        """Flights without early endings."""
        return FlightBatch(
            count,
            sensors=self.sensors,
            task=endless(TASK_DEFAULTS[self.task]),
            gains="tuned",
            filter_start=self.start,
            innovations="estimator" not in self.keywords,  # which only the built-in filter has
            threads=threads,
            **self.keywords,
        )


def fly(batch: FlightBatch, flights: CaseFlights, **options: Any) -> Findings:
    """Fly, and compare errors with covariances; for options, see `measure_consistency`."""
    return measure_consistency(batch, seeds=flights.seeds, duration=flights.duration, **options)


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

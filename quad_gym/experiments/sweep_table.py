"""Tables of a sweep, made from its folders only, without times and paths.

An unfinished training has only its steps.
"""

import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from quad_gym.analysis.intervals import in_brackets, mean_interval, rate_over_trainings
from quad_gym.analysis.reports import columns_of, text_table, write_csv
from quad_gym.experiments.experiment import Training

SCORES = ("mean_error", "late_error", "crash_rate", "return", "gates_passed")
"""Scores of the best evaluation of a training."""

FILES = ("trainings.csv", "groups.csv", "table.txt")


def row_of(training: Training) -> dict[str, Any]:
    """Row of a training, from its folder."""
    record = training.record()
    finished = bool(record.get("finished"))
    best = record["best"] if finished else {}
    return {
        "group": training.case,
        "seed": training.plan.seed,
        "finished": finished,
        "steps": record["steps"] if finished else training.steps_done(),
        "best_steps": best.get("steps"),
        "episodes": training.plan.episodes,
        **{name: best.get(name) for name in SCORES},
    }


def groups_of(rows: Sequence[dict[str, Any]]) -> list[dict[str, Any]]:
    """Mean of each score over the finished seeds of each group, with its 95 % interval.

    Intervals are Student's t; for crash rates, `rate_over_trainings`.
    """
    found = []
    for group in dict.fromkeys(row["group"] for row in rows):
        those = [row for row in rows if row["group"] == group]
        finished = sum(row["finished"] for row in those)
        summary = {"group": group, "trainings": len(those), "finished": finished}
        for name in SCORES:
            values = np.array([row[name] for row in those if row[name] is not None])
            low = high = None
            if values.size > 1:
                low, high = mean_interval(values)
                if name == "crash_rate":
                    _, low, high = rate_over_trainings(values, those[0]["episodes"])
            summary[name] = float(values.mean()) if values.size else None
            summary[f"{name}_low"], summary[f"{name}_high"] = low, high
        found.append(summary)
    return found


def table_text(rows: Sequence[dict[str, Any]]) -> str:
    """Tables for the screen: groups, then trainings."""

    def cell(row: dict[str, Any], name: str, form: str) -> str:
        if row[name] is None:
            return "-"
        low, high = row.get(f"{name}_low"), row.get(f"{name}_high")
        interval = None if low is None or high is None else (low, high)
        return in_brackets(row[name], interval, form)

    def cells(row: dict[str, Any]) -> list[str]:
        shown = (("mean_error", ".4f"), ("crash_rate", ".1%"), ("return", ".1f"))
        return [cell(row, name, form) for name, form in shown]

    headings = ("error [m]", "crashed", "return")
    groups = [
        [row["group"], f"{row['finished']}/{row['trainings']}", *cells(row)]
        for row in groups_of(rows)
    ]
    single = []
    for row in rows:
        finished = "yes" if row["finished"] else "no"
        name = f"{row['group']}/seed_{row['seed']}"
        single.append([name, finished, f"{row['steps']:,}", *cells(row)])
    mean = "best evaluation: mean over finished seeds [95 % interval, Student's t]"
    first = text_table({"": ("group", "finished"), mean: headings}, groups)
    heads = {"": ("training", "finished", "steps"), "best evaluation": headings}
    return f"{first}\n\n{text_table(heads, single)}\n"


def write_tables(rows: Sequence[dict[str, Any]], folder: Path) -> None:
    """Write `FILES` atomically."""
    parts = [folder / f"{name}.{os.getpid()}.part" for name in FILES]  # of this sweep alone
    for part, table in zip(parts, (rows, groups_of(rows)), strict=False):
        write_csv(part, columns_of(table))
    parts[-1].write_text(table_text(rows), encoding="utf-8")
    for part, name in zip(parts, FILES, strict=True):
        part.replace(folder / name)

"""Extracts of results for the pages: few rows of a study's table, and single speeds."""

from collections.abc import Mapping, Sequence
from typing import Any

from docs.renewal.pages import table

HEADINGS = {"success": "success", "crashed": "crashed", "error": "position error [m]"}
SPEEDS = {
    "estimate": "vector, estimate, 50 Hz, standard",
    "truth": "vector, truth, 50 Hz, standard",
}
"""Names of the benchmark's rows by the names of their marks."""


def study_rows(
    summary: Mapping[str, Any], head: str, arms: Sequence[str], columns: Sequence[str]
) -> str:
    """Some arms and columns of a study's table.

    Args:
        summary: The study's summary.json.
        head: Heading of the first column.
        arms: Names of arms; empty: all.
        columns: Names of columns, of `HEADINGS`.
    """
    labels = {arm["name"]: arm["label"] for arm in summary["study"]["arms"]}
    rows = [
        [labels[name], *(cell(summary["rows"][name][column], column) for column in columns)]
        for name in arms or labels
    ]
    return table((head, *(HEADINGS[column] for column in columns)), rows)


def cell(found: Mapping[str, float], column: str) -> str:
    """A value with its 95 % interval in brackets."""
    scale, digits = (1.0, 3) if column == "error" else (100.0, 0)
    value, low, high = (scale * found[name] for name in ("value", "low", "high"))
    if column != "error" and value < 10.0:
        digits = 1
    unit = "" if column == "error" else " %"
    return f"{value:.{digits}f} [{low:.{digits}f}, {high:.{digits}f}]{unit}"


def interface_speeds(benchmark: Mapping[str, Any]) -> dict[str, str]:
    """Steps per second of the interfaces with the default suite at 50 Hz."""
    rows = benchmark["sections"]["interfaces"]
    chosen = [
        row
        for row in rows
        if row["name"].startswith("Pendulum")
        or (row["name"].endswith(", 50 Hz, standard") and row["envs"] in (1, 1024))
    ]
    cells = {
        (row["name"].replace(", 50 Hz, standard", ""), f"{row['envs']:,}", str(row["threads"])): (
            f"{1.0 / row['seconds']:,.0f}"
        )
        for row in chosen
    }
    heads = ("interface, observation", "environments", "threads", "steps per second")
    found = {"speed_interfaces": table(heads, [[*key, value] for key, value in cells.items()])}
    for mark, name in SPEEDS.items():
        best = max(1.0 / r["seconds"] for r in rows if r["name"] == name and r["envs"] == 1024)
        thousands = f"{best / 1e3:,.0f},000"
        found[f"speed.{mark}"] = thousands if best < 1e6 else f"{best / 1e6:.1f} million"
    return found


def compile_seconds(benchmark: Mapping[str, Any]) -> str:
    """Seconds of the first reset with the default suite, from an empty cache."""
    rows = benchmark["sections"]["compile"]
    row = next(r for r in rows if r["name"] == "default" and r["cache"] == "empty")
    return f"{row['seconds']:.0f} s"

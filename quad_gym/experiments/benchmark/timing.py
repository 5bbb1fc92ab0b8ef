"""Sections of the benchmark: timing by the best of several repeats, and tables of the results."""

import platform
import statistics
import sys
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

from quad_gym.analysis.reports import text_table
from quad_gym.kernels.cores import available_cores


class Effort(NamedTuple):
    """Number and length of the repeats."""

    repeats: int
    seconds: float  #: length of a repeat [s]


@dataclass(frozen=True, kw_only=True)
class Scope:
    """Extent of the measurements."""

    envs: int
    """Number of environments in batches of interfaces, and of flights in batches of suites"""
    threads: int
    """Largest number of threads"""
    effort: Effort


class Timing(NamedTuple):
    """Duration of a piece of work."""

    best: float  #: fastest repeat [s]
    spread: float  #: ratio of the median of the repeats to the best, minus one

    def per(self, count: int) -> "Timing":
        """Duration of one of `count` equal parts."""
        return Timing(self.best / count, self.spread)


Row = dict[str, Any]  #: result of a section, for the table and the file


def measure(
    work: Callable[[], Any], effort: Effort, before: Callable[[], Any] = lambda: None
) -> Timing:
    """Time a call: the best of some repeats, each of as many calls as fit in its length.

    Args:
        work: Function to time.
        effort: Repeats and their length.
        before: Function called before every repeat, not timed.
    """
    before()
    work()
    began = time.perf_counter()
    work()
    calls = max(1, round(effort.seconds / (time.perf_counter() - began)))
    times = []
    for _ in range(effort.repeats):
        before()
        times.append(lasting(work, calls))
    return _timing(times)


def by_turns(jobs: Iterable[Callable[[], float]], turns: int) -> list[Timing]:
    """Time several jobs in alternation, so that other load on the machine affects all of them.

    Args:
        jobs: Functions that do their work and return its duration [s].
        turns: Number of turns of each job.
    """
    jobs = list(jobs)
    times = [[job() for job in jobs] for _ in range(turns)]
    return [_timing(own) for own in zip(*times, strict=True)]


def lasting(work: Callable[[], Any], calls: int) -> float:
    """Mean duration of several calls [s]."""
    began = time.perf_counter()
    for _ in range(calls):
        work()
    return (time.perf_counter() - began) / calls


def _timing(times: Sequence[float]) -> Timing:
    best = min(times)
    return Timing(best, statistics.median(times) / best - 1.0)


def report(name: str, timing: Timing, **more: Any) -> Row:
    """Make a row, and print it to stderr."""
    print(f"  {name}: {1e6 * timing.best:,.2f} us", file=sys.stderr, flush=True)
    return {"name": name, "seconds": timing.best, "spread": timing.spread, **more}


CellText = Callable[[Row], str]  #: function that formats the cell of a row in one column


def column(key: str, form: str = "", scale: float = 1) -> CellText:
    """Column of texts, or of numbers multiplied by a scale; a dash for None."""

    def cell(row: Row) -> str:
        value = row[key]
        return "-" if value is None else format(scale * value if form else value, form)

    return cell


def percent(key: str) -> CellText:
    """Column of shares, in percent; a dash for None."""
    return lambda row: "-" if row[key] is None else f"{100.0 * row[key]:.1f} %"


def per_second(row: Row) -> str:
    """Number of repetitions per second."""
    return f"{1.0 / row['seconds']:,.0f}"


NAME, SPREAD = column("name"), percent("spread")


@dataclass(frozen=True)
class Section:
    """Section of the benchmark."""

    measure: Callable[[Any], list[Row]]
    groups: Mapping[str, Mapping[str, CellText]]
    """Columns of the table by heading, in groups by heading"""
    summary: Callable[[list[Row]], str] = lambda rows: ""
    """Function that returns the text below the table"""

    def table(self, rows: list[Row]) -> str:
        """Format rows for the screen."""
        columns = [cell for group in self.groups.values() for cell in group.values()]
        headings = {heading: list(group) for heading, group in self.groups.items()}
        cells = [[cell(row) for cell in columns] for row in rows]
        return text_table(headings, cells) + self.summary(rows)


def processor() -> dict[str, Any]:
    """Name and vector instructions of the processor, as far as the system reports them."""
    found: dict[str, Any] = {"machine": platform.machine(), "cores": available_cores()}
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
    except OSError:
        return found | {"model": platform.processor()}
    fields: dict[str, str] = {}
    for line in lines:
        name, _, value = line.partition(":")
        fields.setdefault(name.strip(), value.strip())
    flags = fields.get("flags", fields.get("Features", "")).split()
    vector = [flag for flag in flags if flag.startswith(("avx", "fma", "sse4", "asimd", "sve"))]
    return found | {"model": fields.get("model name", ""), "vector_instructions": vector}

"""How the benchmark measures: the best of some repeats."""

import statistics
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple


class Effort(NamedTuple):
    """How long to measure."""

    repeats: int
    seconds: float
    """length of a repeat"""


@dataclass(frozen=True)
class Timing:
    """How long something takes."""

    best: float
    """fastest repeat [s]"""
    spread: float
    """median of the repeats over the best, less one"""

    def per(self, count: int) -> "Timing":
        """The share of one of `count` equal parts."""
        return Timing(self.best / count, self.spread)


Row = dict[str, Any]


def measure(
    work: Callable[[], Any], effort: Effort, before: Callable[[], Any] = lambda: None
) -> Timing:
    """Time a call: the best of some repeats, each of as many calls as fill its time.

    Args:
        work: What is timed.
        effort: Repeats and their length.
        before: Called before every repeat, not timed.
    """
    before()
    work()
    began = time.perf_counter()
    work()
    calls = max(1, round(effort.seconds / (time.perf_counter() - began)))
    times = []
    for _ in range(effort.repeats):
        before()
        began = time.perf_counter()
        for _ in range(calls):
            work()
        times.append((time.perf_counter() - began) / calls)
    best = min(times)
    return Timing(best, statistics.median(times) / best - 1.0)


def report(name: str, timing: Timing, **more: Any) -> Row:
    """A row of the report, announced on stderr."""
    print(f"  {name}: {1e6 * timing.best:,.2f} us", file=sys.stderr, flush=True)
    return {"name": name, "seconds": timing.best, "spread": timing.spread, **more}


def percent(share: float) -> str:
    """A share as people read it."""
    return f"{100.0 * share:.1f} %"

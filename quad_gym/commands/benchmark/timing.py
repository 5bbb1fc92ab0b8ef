"""How the benchmark measures: the best of some repeats."""

import statistics
import sys
import time
from collections.abc import Callable, Iterable, Sequence
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
        times.append(lasting(work, calls))
    return _timing(times)


def by_turns(
    jobs: Iterable[Callable[[], float]],
    turns: int,
    before: Callable[[int], Any] = lambda turn: None,
) -> list[Timing]:
    """Time some jobs that take turns, so that other load on the machine slows all of them alike.

    Args:
        jobs: Each does its work and returns how long that took [s].
        turns: Of each job.
        before: Called with the number of a turn before that.
    """
    jobs, times = list(jobs), []
    for turn in range(turns):
        before(turn)
        times.append([job() for job in jobs])
    return [_timing(own) for own in zip(*times, strict=True)]


def lasting(work: Callable[[], Any], calls: int) -> float:
    """Seconds that one of some calls takes."""
    began = time.perf_counter()
    for _ in range(calls):
        work()
    return (time.perf_counter() - began) / calls


def _timing(times: Sequence[float]) -> Timing:
    best = min(times)
    return Timing(best, statistics.median(times) / best - 1.0)


def report(name: str, timing: Timing, **more: Any) -> Row:
    """A row of the report, announced on stderr."""
    print(f"  {name}: {1e6 * timing.best:,.2f} us", file=sys.stderr, flush=True)
    return {"name": name, "seconds": timing.best, "spread": timing.spread, **more}


def percent(share: float) -> str:
    """A share as people read it."""
    return f"{100.0 * share:.1f} %"

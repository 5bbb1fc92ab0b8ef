"""A tick next to busy processes."""

import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial

from quad_gym.experiments.benchmark import timing
from quad_gym.experiments.benchmark.suites import SUITES, TRUTH, flying, ticks_of
from scripts.benchmarks.scope import Scope

MAX_BUSY = 4


@contextmanager
def _busy(count: int) -> Iterator[None]:
    """Some processes that compute all the time."""
    processes = [subprocess.Popen([sys.executable, "-c", "while True: pass"]) for _ in range(count)]
    try:
        yield
    finally:
        for process in processes:
            process.kill()
            process.wait()


def time_busy(scope: Scope) -> list[timing.Row]:
    """Time a tick with one thread and with all by turns, next to some busy processes.

    Median durations count, as another process may take a core at any time.
    """
    rows = list[timing.Row]()
    for suite in (SUITES[0], TRUTH):
        batches = [flying(scope.envs, threads, suite) for threads in (1, scope.threads)]
        steps = max(1, round(scope.effort.seconds / timing.lasting(batches[0].step, 3)))
        jobs = [partial(timing.lasting, batch.step, steps) for batch in batches]
        for busy in range(MAX_BUSY + 1):
            with _busy(busy):
                one, all_of_them = timing.by_turns(jobs, 2 * scope.effort.repeats)
            medians = [t.best * (1.0 + t.spread) / ticks_of(batches[0]) for t in (one, all_of_them)]
            what = {"suite": suite, "busy": busy, "threads": scope.threads}
            row = timing.report(f"{suite}, {busy} busy", timing.Timing(medians[0], one.spread))
            rows.append(row | what | {"all": medians[1], "gain": medians[0] / medians[1]})
    return rows


SECTION = timing.Section(
    time_busy,
    {
        "One flight's tick next to busy processes, medians": {
            "suite": timing.column("suite"),
            "busy": timing.column("busy"),
            "us, 1 thread": timing.column("seconds", ".3f", 1e6),
            "threads": timing.column("threads"),
            "us": timing.column("all", ".3f", 1e6),
            "x speed of 1": timing.column("gain", ".2f"),
        }
    },
)

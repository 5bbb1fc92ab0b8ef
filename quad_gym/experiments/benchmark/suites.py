"""A tick with each sensor suite: by number of flights and threads, and next to busy processes."""

import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial

from quad_gym.batch.flight_batch import FlightBatch
from quad_gym.experiments.benchmark import timing
from quad_gym.experiments.benchmark.stages import hovering
from quad_gym.records import Source

SUITES = ("standard", "rtk", "consumer", "indoor", "field", "crazyflie")
TRUTH = "truth"  #: row of flights without sensors and filter
MANY = 64  #: ratio of the large to the small number of flights
MOST_BUSY = 4


def _flying(count: int, threads: int, suite: str) -> FlightBatch:
    """Batch that hovers at 50 Hz with a suite, or on the true state."""
    source = Source.TRUTH if suite == TRUTH else Source.ESTIMATE
    sensors = "standard" if suite == TRUTH else suite
    return hovering(count, threads, sensors=sensors, source=source, control_rate=50.0)


def _ticks(batch: FlightBatch) -> int:
    """Ticks of all flights in a step."""
    return batch.count * batch.clocks.ticks_per_step


def time_suites(scope: timing.Scope) -> list[timing.Row]:
    """Time a tick with each suite, with one thread and with all."""
    rows = list[timing.Row]()
    for count in (scope.envs, MANY * scope.envs):
        for threads in dict.fromkeys((1, scope.threads)):
            found = list[timing.Row]()
            for suite in (*SUITES, TRUTH):
                batch = _flying(count, threads, suite)
                timed = timing.measure(batch.step, scope.effort).per(_ticks(batch))
                what = {"suite": suite, "flights": count, "threads": threads}
                name = f"{suite}, {count} flights, {threads} threads"
                found.append(timing.report(name, timed, **what))
            rows += [row | {"speed": found[0]["seconds"] / row["seconds"]} for row in found]
    few = {(row["suite"], row["threads"]): row["seconds"] for row in rows[: len(rows) // 2]}
    return [row | {"times_few": row["seconds"] / few[row["suite"], row["threads"]]} for row in rows]


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


def time_busy(scope: timing.Scope) -> list[timing.Row]:
    """Time a tick with one thread and with all by turns, next to some busy processes.

    Median durations count, as another process may take a core at any time.
    """
    rows = list[timing.Row]()
    for suite in (SUITES[0], TRUTH):
        batches = [_flying(scope.envs, threads, suite) for threads in (1, scope.threads)]
        steps = max(1, round(scope.effort.seconds / timing.lasting(batches[0].step, 3)))
        jobs = [partial(timing.lasting, batch.step, steps) for batch in batches]
        for busy in range(MOST_BUSY + 1):
            with _busy(busy):
                one, all_of_them = timing.by_turns(jobs, 2 * scope.effort.repeats)
            medians = [t.best * (1.0 + t.spread) / _ticks(batches[0]) for t in (one, all_of_them)]
            what = {"suite": suite, "busy": busy, "threads": scope.threads}
            row = timing.report(f"{suite}, {busy} busy", timing.Timing(medians[0], one.spread))
            rows.append(row | what | {"all": medians[1], "gain": medians[0] / medians[1]})
    return rows


SECTION = timing.Section(
    time_suites,
    {
        "One flight's tick at 50 Hz, by sensor suite": {
            "suite": timing.column("suite"),
            "flights": timing.column("flights", ","),
            "threads": timing.column("threads"),
            "us": timing.column("seconds", ".3f", 1e6),
            "spread": timing.SPREAD,
            "x speed of standard": timing.column("speed", ".2f"),
            "x few flights": timing.column("times_few", ".2f"),
        }
    },
)
BUSY = timing.Section(
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

"""A tick with each sensor suite, by number of flights and threads."""

from typing import Any

from quad_gym.batch.flight_batch import FlightBatch
from quad_gym.envs.config import TASK_DEFAULTS
from quad_gym.experiments.benchmark import timing
from quad_gym.records import Source

SUITES = ("standard", "rtk", "consumer", "indoor", "field", "crazyflie")
TRUTH = "truth"  #: row of flights without sensors and filter
MANY = 64  #: ratio of the large to the small number of flights


def hovering(count: int, threads: int = 1, **options: Any) -> FlightBatch:
    """Batch that hovers by PD control, half a second after its start."""
    task = TASK_DEFAULTS["hover"].replace(duration=0.0)
    batch = FlightBatch(count, task=task, gains="tuned", threads=threads, **options)
    batch.reset(seeds=range(count))
    for _ in range(round(0.5 * batch.clocks.control_rate)):
        batch.step()
    return batch


def flying(count: int, threads: int, suite: str) -> FlightBatch:
    """Batch that hovers at 50 Hz with a suite, or on the true state."""
    source = Source.TRUTH if suite == TRUTH else Source.ESTIMATE
    sensors = "standard" if suite == TRUTH else suite
    return hovering(count, threads, sensors=sensors, source=source, control_rate=50.0)


def ticks_of(batch: FlightBatch) -> int:
    """Number of ticks of all flights in a step."""
    return batch.count * batch.clocks.ticks_per_step


def time_suites(scope: timing.Scope) -> list[timing.Row]:
    """Time a tick with each suite, with one thread and with all."""
    rows = list[timing.Row]()
    for count in (scope.envs, MANY * scope.envs):
        for threads in dict.fromkeys((1, scope.threads)):
            found = list[timing.Row]()
            for suite in (*SUITES, TRUTH):
                batch = flying(count, threads, suite)
                timed = timing.measure(batch.step, scope.effort).per(ticks_of(batch))
                what = {"suite": suite, "flights": count, "threads": threads}
                name = f"{suite}, {count} flights, {threads} threads"
                found.append(timing.report(name, timed, **what))
            rows += [row | {"speed": found[0]["seconds"] / row["seconds"]} for row in found]
    few = {(row["suite"], row["threads"]): row["seconds"] for row in rows[: len(rows) // 2]}
    return [row | {"times_few": row["seconds"] / few[row["suite"], row["threads"]]} for row in rows]


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

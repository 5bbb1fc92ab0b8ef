"""Stages of a tick, one by one."""

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from quad_gym.batch.flight_batch import FlightBatch
from quad_gym.commands import benchmark
from quad_gym.commands.benchmark import hovering
from quad_gym.envs.spaces import layout_bounds, observation_layout
from quad_gym.kernels.entries import linked_table, run_stage
from quad_gym.kernels.stages import Stage, needed_stages
from quad_gym.records import Act, Sensor
from scripts.benchmarks.scope import Scope

SUITES = ("standard", "lab")
FILTER = (Stage.PREDICT, Stage.UPDATE)
AT_THE_START = frozenset(
    {
        Stage.DRAW,
        Stage.BEGIN,
        Stage.BEGIN_IN_AIR,
        Stage.BEGIN_LATE,
        Stage.BEGIN_FAULTS,
        Stage.ALIGN,
        Stage.WARM,
        Stage.FORGET_INNOVATIONS,
    }
)
"""Stages of the first instant of an episode; all others belong to a tick."""


class Staged:
    """Stage that runs on blocks of flights.

    Args:
        batch: Batch with the parameters and settings; in a calm world, without draws.
        stage: The stage.
    """

    def __init__(self, batch: FlightBatch, stage: Stage) -> None:
        self._stage, self._skipped = int(stage), batch._room.skipped
        self._flag = int(stage in AT_THE_START)
        if stage == Stage.UPDATE:
            self._flag = int(batch._settings["feature_count"][0])
        elif stage.name in Sensor.__members__:
            self._flag = int(Act.SAMPLE)
        self._others = (batch._world, batch._model, batch._settings, batch._work[0])
        self._table = linked_table(needed_stages(batch._settings[0]))

    def __call__(self, blocks: NDArray[Any]) -> None:
        """Run the stage once for every block."""
        begin = blocks.ctypes.data - self._skipped
        self._others[-1]["mask"] = 1.0
        size = (blocks.strides[0], len(blocks))
        run_stage(begin, *size, self._stage, *self._others, self._table, self._flag)


def over_a_period(batch: FlightBatch) -> NDArray[Any]:
    """Blocks of a batch at different instants, which cover a period of its sensors.

    Stages then have their mean cost, even if sensors do not measure in every tick.
    """
    clocks = batch._settings["sensor_ticks"][0][[Sensor["GNSS"], Sensor["CAMERA"]]]
    period = math.lcm(*(int(clock) for clock in clocks if clock > 0))
    blocks = batch.snapshot()
    for instant in range(period):
        blocks[instant::period] = batch.snapshot()[instant::period]
        batch.step()
    return blocks


def time_tick(scope: Scope) -> list[benchmark.Row]:
    """Time a whole tick on one core, per flight, and its stages, with `SUITES`."""
    return [row for suite in SUITES for row in _time_suite(suite, scope.batch, scope.effort)]


def _time_suite(suite: str, count: int, effort: benchmark.Effort) -> list[benchmark.Row]:
    batch = hovering(count, sensors=suite, bounds=layout_bounds(observation_layout()))
    start, blocks = over_a_period(batch), batch._blocks

    def again() -> None:
        batch.restore(start)

    def add(name: str, timed: benchmark.Timing, kind: str) -> None:
        rows.append(benchmark.report(f"{name}, {suite}", timed, part=name, kind=kind, suite=suite))

    rows: list[benchmark.Row] = []
    add("whole tick", benchmark.measure(batch.step, effort, again).per(count), "whole")
    needed = needed_stages(batch._settings[0]).keys()
    for when, kind in ((needed - AT_THE_START, "tick"), (needed & AT_THE_START, "start")):
        for stage in sorted(when):
            run = Staged(batch, stage)

            def once(run: Staged = run) -> None:
                run(blocks)

            add(stage.name.lower(), benchmark.measure(once, effort, again).per(count), kind)
    for name, parts in (
        ("filter", [row for row in rows if row["part"] in {s.name.lower() for s in FILTER}]),
        ("sum of the tick's stages", [row for row in rows if row["kind"] == "tick"]),
    ):
        add(name, benchmark.Timing(float(np.sum([row["seconds"] for row in parts])), 0.0), "sum")
    for row in rows:
        row["share"] = row["seconds"] / rows[0]["seconds"]
    return rows


SECTION = benchmark.Section(
    time_tick,
    {
        "One flight's tick, one core": {
            "suite": benchmark.column("suite"),
            "stage": lambda row: (
                row["part"] + (" (at the start)" if row["kind"] == "start" else "")
            ),
            "us": benchmark.column("seconds", ".3f", 1e6),
            "spread": benchmark.SPREAD,
            "of the whole": benchmark.percent("share"),
        }
    },
)

"""The tick's part of the benchmark: the stages that a configuration flies through, one by one."""

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from quad_gym.analysis.reports import text_table
from quad_gym.batch.flight_batch import FlightBatch
from quad_gym.commands.benchmark.timing import Effort, Row, Timing, measure, percent, report
from quad_gym.envs.configuration import TASK_DEFAULTS
from quad_gym.envs.spaces import layout_bounds, observation_layout
from quad_gym.kernels.compiling import Stage
from quad_gym.kernels.compiling.linked import linked_table
from quad_gym.kernels.compiling.stages import needed_stages
from quad_gym.kernels.single import run_stage
from quad_gym.records import Act, Sensor

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
"""Stages of the first instant of an episode; all others are a tick's."""


def hovering(count: int, **options: Any) -> FlightBatch:
    """A batch that hovers by the PD controller on the estimate, half a second after its start."""
    task = TASK_DEFAULTS["hover"].replace(duration=0.0)
    batch = FlightBatch(count, task=task, gains="tuned", threads=1, **options)
    batch.reset(seeds=range(count))
    for _ in range(100):
        batch.step()
    return batch


class Staged:
    """One stage of a batch, which can be run on blocks.

    Args:
        batch: The batch whose parameters and settings count; in a calm world, without draws.
        stage: Which stage.
        flag: What the stage is called with.
    """

    def __init__(self, batch: FlightBatch, stage: Stage, flag: int = 0) -> None:
        self._stage, self._flag, self._skipped = int(stage), flag, batch._room.skipped
        self._others = (batch._world, batch._model, batch._settings, batch._work[0])
        self._table = linked_table(needed_stages(batch._settings[0]))

    def __call__(self, blocks: NDArray[Any]) -> None:
        """Run the stage once for every block."""
        begin = blocks.ctypes.data - self._skipped
        self._others[-1]["mask"] = 1.0
        run_stage(
            begin,
            blocks.strides[0],
            len(blocks),
            self._stage,
            *self._others,
            self._table,
            self._flag,
        )


def flag_of(stage: Stage, batch: FlightBatch) -> int:
    """What a flight calls a stage with."""
    if stage == Stage.UPDATE:
        return int(batch._settings["feature_count"][0])
    if stage.name in Sensor.__members__:
        return int(Act.SAMPLE)
    return int(stage in AT_THE_START)


def over_a_period(batch: FlightBatch) -> NDArray[Any]:
    """The blocks of a batch at different instants, which cover a period of its sensors.

    So a stage has its mean cost where sensors do not measure in every tick.
    """
    clocks = batch._settings["sensor_ticks"][0][[Sensor.GNSS, Sensor.CAMERA]]
    period = math.lcm(*(int(clock) for clock in clocks if clock > 0))
    blocks = batch.snapshot()
    for instant in range(period):
        blocks[instant::period] = batch.snapshot()[instant::period]
        batch.step()
    return blocks


def time_tick(count: int, effort: Effort) -> list[Row]:
    """A whole tick on one core, and its stages, per flight, with the suites of SUITES.

    Args:
        count: Flights in a batch.
        effort: How long to measure.
    """
    return [row for suite in SUITES for row in _time_suite(suite, count, effort)]


def _time_suite(suite: str, count: int, effort: Effort) -> list[Row]:
    batch = hovering(count, sensors=suite, bounds=layout_bounds(observation_layout()))
    start, blocks = over_a_period(batch), batch._blocks

    def again() -> None:
        batch.restore(start)

    def add(name: str, timing: Timing, kind: str) -> None:
        rows.append(report(f"{name}, {suite}", timing, part=name, kind=kind, suite=suite))

    rows: list[Row] = []
    add("whole tick", measure(batch.step, effort, again).per(count), "whole")
    needed = needed_stages(batch._settings[0]).keys()
    for when, kind in ((needed - AT_THE_START, "tick"), (needed & AT_THE_START, "start")):
        for stage in sorted(when):
            run = Staged(batch, stage, flag_of(stage, batch))

            def once(run: Staged = run) -> None:
                run(blocks)

            add(stage.name.lower(), measure(once, effort, again).per(count), kind)
    for name, parts in (
        ("filter", [row for row in rows if row["part"] in {s.name.lower() for s in FILTER}]),
        ("sum of the tick's stages", [row for row in rows if row["kind"] == "tick"]),
    ):
        add(name, Timing(float(np.sum([row["seconds"] for row in parts])), 0.0), "sum")
    for row in rows:
        row["share"] = row["seconds"] / rows[0]["seconds"]
    return rows


def tick_table(rows: list[Row]) -> str:
    """The tick's figures."""
    cells = [
        (
            r["suite"],
            r["part"] + (" (at the start)" if r["kind"] == "start" else ""),
            f"{1e6 * r['seconds']:.3f}",
            percent(r["spread"]),
            percent(r["share"]),
        )
        for r in rows
    ]
    heading = "One flight's tick, one core"
    return text_table({heading: ["suite", "stage", "us", "spread", "of the whole"]}, cells)

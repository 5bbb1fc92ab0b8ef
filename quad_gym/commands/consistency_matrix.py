"""`quad-gym consistency --matrix`: NEES and NIS of many configurations, each a cell of a table.

Every suite flies every task, from a cold and from a warm start. On one task every suite also flies
with faults that end, other latencies, other mountings, randomization that the filter knows and does
not know, drawn starts, and wind. A value is the mean over all flights and instants; it misses where
it is outside the 95 % band of one instant's mean over so many flights. That band is too wide rather
than too narrow, as the mean over instants has less chance in it. What is not as the filter believes
is said of a cell, whose misses are then expected.
"""

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from quad_gym.analysis.consistency import PARTS, SENSOR_BLOCKS, mean_band
from quad_gym.analysis.consistency_flights import endless, measure_consistency
from quad_gym.analysis.reports import versions
from quad_gym.batch.flight_batch import FlightBatch
from quad_gym.commands.resumable import run_cells
from quad_gym.envs.configuration import TASK_DEFAULTS
from quad_gym.faults.presets import PRESETS, faults_of
from quad_gym.params.distributions import Uniform
from quad_gym.params.randomization import Randomization
from quad_gym.params.sensors import SensorSuite
from quad_gym.params.suites import SUITES, sensor_suite

STARTS = ("cold", "warm")
CONDITIONS_TASK = "random_trajectory"
FREEDOMS = {name: part.stop - part.start for name, part in PARTS.items()} | {
    "nis_position": 3,
    "nis_baseline": 2,
    "nis_velocity": 3,
    "nis_feature": 2,
    "nis_barometer": 1,
    "nis_magnetometer": 3,
}
"""What the columns' means are about, if the filter is consistent."""

_LEVER_ARM = (0.05, 0.02, 0.03)
_DISPLACED = Uniform(-0.01, 0.01)


@dataclass(frozen=True)
class Cell:
    """One configuration."""

    suite: str
    task: str
    start: str
    condition: str = "nominal"
    wrong: str = ""
    """what is not as the filter believes; empty: nothing"""
    sensors: SensorSuite | None = None
    """in place of the suite's"""
    keywords: Mapping[str, Any] = field(default_factory=dict)
    """of `FlightBatch`"""

    @property
    def name(self) -> str:
        """What the cell is called in files."""
        return f"{self.suite}, {self.task}, {self.start}, {self.condition}"

    @property
    def flown(self) -> SensorSuite:
        """The sensors that fly."""
        return self.sensors or sensor_suite(self.suite)

    @property
    def expected(self) -> Mapping[str, str]:
        """Why values miss, by column; "" stands for all columns."""
        if self.suite == "lab":
            return {"": "the report's filter"}
        if self.wrong:
            return {"": self.wrong}
        found, gnss = {}, self.flown.gnss
        if gnss is not None and gnss.heading_errs:
            found["nis_baseline"] = "counts constant heading errors as noise"
        if self.flown.imu.believed_accel_error > 0.0 and (
            self.task == "waypoints" or "world" in self.keywords
        ):
            reason = "counts errors of scale as noise"
            found |= {"velocity": reason, "accel_bias": reason}
        return found


def _latencies(suite: SensorSuite) -> Iterator[tuple[str, SensorSuite]]:
    """The suite with latencies of none, half and all of the longest, two periods."""
    for words, periods in (("no latency", 0), ("one period late", 1), ("two periods late", 2)):
        gnss, camera = suite.gnss, suite.camera
        if gnss is not None:
            gnss = gnss.replace(latency=periods / gnss.rate)
        if camera is not None:
            camera = camera.replace(latency=periods / camera.rate)
        aids = {
            aid.name.lower(): params.replace(latency=periods / params.rate)
            for aid, params in suite.aids.items()
        }
        yield words, suite.replace(gnss=gnss, camera=camera, **aids)


def _draws(suite: SensorSuite) -> dict[str, Any]:
    """What is drawn for the sensors of a suite, around what they are."""
    names = {"accel_noise_density", "gyro_noise_density"}
    if suite.gnss is not None:
        names |= {"position_sigma_I"} | ({"baseline_sigma"} if suite.gnss.has_baseline else set())
    names |= {"pixel_sigma"} if suite.camera is not None else set()
    return {name: Uniform(1.0, 2.0, relative=True) for name in sorted(names)} | {
        "mass": Uniform(0.8, 1.2, relative=True)
    }


def _mounting(suite: SensorSuite) -> dict[str, Any]:
    """Sensors that are not where they were meant to be."""
    found: dict[str, Any] = {"lever_arm_B": _DISPLACED}
    if suite.gnss is not None:
        found["primary_antenna_B"] = Uniform(-0.01, 0.01, offset=True)
    if suite.camera is not None:
        found["camera_rotation"] = _DISPLACED
    return found


def _conditions(name: str) -> Iterator[dict[str, Any]]:
    """The fields of cells of a suite, by what is different."""
    suite = sensor_suite(name)
    for fault, parts in PRESETS.items():
        if not parts or any(getattr(part, "duration", math.inf) == math.inf for part in parts):
            continue  # it does not end
        try:
            faults_of(fault, suite)
        except ValueError:  # the suite lacks what it concerns
            continue
        corrupted = "corrupted measurements" if fault == "gnss_jump" else ""
        yield {"condition": fault, "wrong": corrupted, "keywords": {"faults": fault}}
    for words, late in _latencies(suite):
        yield {"condition": words, "sensors": late}
    arm = suite.replace(imu=suite.imu.replace(lever_arm_B=_LEVER_ARM))
    yield {"condition": "lever arm", "sensors": arm}
    for what, draws in (("mounting", _mounting(suite)), ("noise and mass", _draws(suite))):
        known, unknown = Randomization(draws, known=True), Randomization(draws)
        yield {"condition": f"{what} drawn, known", "keywords": {"randomization": known}}
        yield {
            "condition": f"{what} drawn, unknown",
            "wrong": f"unknown {what}",
            "keywords": {"randomization": unknown},
        }
    starts = {name: Uniform(-0.1, 0.1) for name in ("start_roll", "start_pitch", "start_yaw")}
    starts["start_velocity_I"] = Uniform(-0.5, 0.5)
    yield {"condition": "start drawn", "keywords": {"randomization": Randomization(starts)}}
    yield {"condition": "fresh breeze", "keywords": {"world": "fresh_breeze"}}


def cells_of(kind: str) -> list[Cell]:
    """The cells of the matrix: "suites" on all tasks, "conditions" on one, or "all" of these."""
    suites = [Cell(s, task, start) for s in SUITES for task in TASK_DEFAULTS for start in STARTS]
    conditions = [
        Cell(suite, CONDITIONS_TASK, start, **fields)
        for suite in SUITES
        for start in STARTS
        for fields in _conditions(suite)
    ]
    return {"suites": suites, "conditions": conditions, "all": suites + conditions}[kind]


def measure(
    cell: Cell, *, flights: int, duration: float, first_seed: int, threads: int | None = None
) -> dict[str, Any]:
    """Fly a cell: its values by column, what misses, and all it takes to fly it again."""
    batch = FlightBatch(
        flights,
        sensors=cell.flown,
        task=endless(TASK_DEFAULTS[cell.task]),
        gains="tuned",
        filter_start=cell.start,
        innovations=True,
        threads=threads,
        **cell.keywords,
    )
    seeds = range(first_seed, first_seed + flights)
    found = measure_consistency(batch, seeds=seeds, duration=duration, every=0.1)
    values = {name: part.overall for name, part in found.nees.items()}
    values |= {f"nis_{name}": part.overall for name, part in found.nis.items()}
    bands = {name: mean_band(FREEDOMS[name], [flights]) for name in values}
    misses = [k for k, v in values.items() if not bands[k][0][0] <= v <= bands[k][1][0]]
    return {
        "values": values,
        "misses": misses,
        "expected": cell.expected,
        "filters_failed": found.failed,
        "flights_astray": int(found.astray.sum()),
        "sensors": batch.sensors,
        "task": batch.task,
        "world": batch.world,
        "faults": batch.faults,
        "randomization": batch.randomization,
    }


def table_of(cells: Mapping[str, Mapping[str, Any]], flights: int) -> str:
    """The matrix in Markdown: misses bold, those that are expected in italics, with the reason."""
    names = [*PARTS, *(f"nis_{name}" for name in SENSOR_BLOCKS)]
    heads = [name.removeprefix("nis_") for name in names]
    lines = [
        f"Mean of NEES, then NIS, over {flights} flights. In a consistent filter:",
        "",
        "| suite, task, start, condition | " + " | ".join(heads) + " | expected misses |",
        "|---|" + "---:|" * len(heads) + "---|",
    ]
    band = {name: mean_band(FREEDOMS[name], [flights]) for name in names}
    spans = [f"{band[name][0][0]:.2f} to {band[name][1][0]:.2f}" for name in names]
    lines.append("| 95 % band | " + " | ".join(spans) + " | |")
    for label, cell in cells.items():
        texts, expected = [], cell["expected"]
        for name in names:
            value = cell["values"].get(name)
            text = "" if value is None else f"{value:.3g}" if value >= 100 else f"{value:.2f}"
            if name in cell["misses"]:
                text = f"*{text}*" if "" in expected or name in expected else f"**{text}**"
            texts.append(text)
        reasons = [f"{k.removeprefix('nis_')}: {v}" if k else v for k, v in expected.items()]
        if cell["filters_failed"]:
            reasons.append(f"**{cell['filters_failed']} filters failed**")
        lines.append(f"| {label} | " + " | ".join(texts) + f" | {'; '.join(reasons)} |")
    lines += ["", "**Bold**: a miss. *Italics*: a miss that is expected, for the reason given."]
    return "\n".join(lines) + "\n"


def unexpected(cells: Mapping[str, Mapping[str, Any]]) -> int:
    """How many values miss without a reason."""
    return sum(
        not ("" in cell["expected"] or name in cell["expected"])
        for cell in cells.values()
        for name in cell["misses"]
    )


def run_matrix(
    cells: list[Cell],
    output: Path,
    *,
    flights: int,
    duration: float,
    first_seed: int,
    threads: int | None = None,
) -> dict[str, Any]:
    """Fly all cells that `output` lacks; it may have some of an interrupted run of the same.

    Each is written as soon as it is done, to matrix.json and matrix.md.
    """
    head = {
        "flights": flights,
        "duration": duration,
        "seeds": [first_seed, first_seed + flights - 1],
        "versions": versions("numpy", "numba"),
    }

    def fly(cell: Cell) -> dict[str, Any]:
        many = {"flights": flights, "first_seed": first_seed, "threads": threads}
        return measure(cell, duration=duration, **many)  # type: ignore[arg-type]

    def table(done: dict[str, Any]) -> str:
        return table_of(done, flights)

    return run_cells(cells, output / "matrix", head, fly, table)

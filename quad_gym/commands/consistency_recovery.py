"""`quad-gym consistency --recovery`: what becomes of filters after faults, and of their alarms.

Every suite flies each fault of the catalogue that it can have. A fault comes after `START` and,
unless it is a step or a jump, goes after `LASTS`; flights are judged `LATER` after that. See
`analysis/recovery.py` for what is counted. Then every suite flies without a fault, for the rate of
false alarms.
"""

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

from quad_gym.analysis.consistency_flights import endless
from quad_gym.analysis.recovery import REQUIRED, follow_recovery
from quad_gym.analysis.reports import versions
from quad_gym.batch.flight_batch import FlightBatch
from quad_gym.commands.resumable import run_cells
from quad_gym.envs.configuration import TASK_DEFAULTS
from quad_gym.faults import (
    AccelBiasStep,
    Fault,
    GnssOutage,
    GyroBiasStep,
    PositionJump,
)
from quad_gym.faults.presets import PRESETS, faults_of
from quad_gym.params.sensors import SensorSuite
from quad_gym.params.suites import SUITES, sensor_suite

START, LASTS, LATER = 3.0, 5.0, 10.0
"""When faults come, how long they stay, and how long filters have to recover [s]."""
TASK = "random_trajectory"
CALM_TASKS = ("hover", "random_trajectory", "waypoints")
CALM = 60.0
"""Length of flights without a fault [s]."""
AT_ONCE = (AccelBiasStep, GyroBiasStep, PositionJump)
"""What happens at an instant; it is over when it has happened."""

COLUMNS = {
    "consistent_at_end": "consistent at its end [%]",
    "consistent": "consistent 10 s later [%]",
    "flagged": "inconsistent, flagged [%]",
    "undetected": "undetected failures [%]",
    "settling_time": "99 % consistent or flagged after [s]",
    "large_error": "large error for 2 s [%]",
    "missed": "never flagged in that time [%]",
}
CALM_COLUMNS = {
    "alarms_per_hour": "alarms per hour",
    "flagged": "time flagged [%]",
    "hours": "flown [h]",
}


@dataclass(frozen=True)
class Trial:
    """A suite and what happens to it."""

    suite: str
    what: str
    """name of the faults; without any, the task"""
    faults: tuple[Fault, ...] = ()

    @property
    def name(self) -> str:
        """What it is called in files."""
        return f"{self.suite}, {self.what}"

    @property
    def flown(self) -> SensorSuite:
        """The sensors that fly."""
        return sensor_suite(self.suite)

    @property
    def over(self) -> float:
        """When the last of the faults is over [s]."""
        return max(
            float(f.start) + (0.0 if isinstance(f, AT_ONCE) else float(f.duration))  # type: ignore[arg-type]
            for f in self.faults
        )

    @property
    def expected(self) -> str:
        """Reason for undetected failures of a filter."""
        gated = self.flown.estimator.false_alarm_probability > 0.0
        return "" if gated else "no gate, so it cannot correct itself"


def timed(fault: Fault) -> Fault:
    """A fault of the catalogue, at the time of trials."""
    times = {"start": START} if isinstance(fault, AT_ONCE) else {"start": START, "duration": LASTS}
    return fault.replace(rate=0.0, **times)  # type: ignore[no-any-return]


def trials() -> Iterator[Trial]:
    """Every suite with every fault that it can have, and without."""
    catalogue = {name: tuple(map(timed, parts)) for name, parts in PRESETS.items() if parts}
    catalogue |= {
        "gyro step of 1 deg/s": (GyroBiasStep(start=START, size=math.radians(1.0)),),
        "gnss_outage with imu_bias_step": (
            GnssOutage(start=START, duration=LASTS),
            AccelBiasStep(start=START + 0.5 * LASTS),
            GyroBiasStep(start=START + 0.5 * LASTS),
        ),
    }
    for suite in SUITES:
        for what, faults in catalogue.items():
            if _possible(faults, sensor_suite(suite)):
                yield Trial(suite, what, faults)
    for suite in SUITES:
        for task in CALM_TASKS:
            yield Trial(suite, task)


def _possible(faults: tuple[Fault, ...], suite: SensorSuite) -> bool:
    try:
        faults_of(faults, suite)
    except ValueError:
        return False
    return True


def measure(
    trial: Trial, *, flights: int, first_seed: int, threads: int | None = None
) -> dict[str, Any]:
    """Fly a trial: its numbers by column, and all it takes to fly it again."""
    calm = not trial.faults
    batch = FlightBatch(
        flights,
        sensors=trial.flown,
        task=endless(TASK_DEFAULTS[trial.what if calm else TASK]),
        gains="tuned",
        filter_start="warm",
        innovations=True,
        threads=threads,
        faults=trial.faults or None,
    )
    end = CALM if calm else trial.over + LATER
    seeds = range(first_seed, first_seed + flights)
    found = follow_recovery(batch, seeds=seeds, duration=end)
    if calm:
        hours = found.hours
        values = {
            "alarms_per_hour": found.alarms() / hours,
            "flagged": 100.0 * found.flagged.mean(),
        }
        values["hours"] = hours
    else:
        flagged = found.flagged & ~found.consistent
        values = {
            "consistent_at_end": 100.0 * found.share(found.consistent, trial.over),
            "consistent": 100.0 * found.share(found.consistent, end),
            "flagged": 100.0 * found.share(flagged, end),
            "undetected": 100.0 * found.share(found.undetected, end),
            "settling_time": found.time_to(~found.undetected, trial.over),
            "large_error": 100.0 * float(found.long_large_error().mean()),
            "missed": 100.0 * float(found.missed_alarms().mean()),
        }
    return {
        "values": values,
        "miss": not calm and values["undetected"] > 100.0 * (1.0 - REQUIRED) + 1e-9,
        "expected": "" if calm else trial.expected,
        "filters_failed": int((batch.record("filter_status") != 0).sum()),
        "sensors": batch.sensors,
        "task": batch.task,
        "faults": batch.faults,
    }


def table_of(cells: Mapping[str, Mapping[str, Any]], flights: int) -> str:
    """Two tables in Markdown: after faults, and without."""
    parts = []
    for heads, first, words in (
        (COLUMNS, "suite, fault", f"{flights} flights each, on random trajectories, warm start."),
        (CALM_COLUMNS, "suite, task", f"Without a fault, {flights} flights of {CALM:g} s each."),
    ):
        chosen = {k: v for k, v in cells.items() if set(v["values"]) == set(heads)}
        if not chosen:
            continue
        lines = [words, "", f"| {first} | " + " | ".join(heads.values()) + " | remarks |"]
        lines.append("|---|" + "---:|" * len(heads) + "---|")
        for label, cell in chosen.items():
            texts = {k: _text(cell["values"][k]) for k in heads}
            mark = "*" if cell["expected"] else "**"
            if cell["miss"]:
                texts["undetected"] = f"{mark}{texts['undetected']}{mark}"
            remark = cell["expected"] if cell["miss"] else ""
            if cell["filters_failed"]:
                remark += f" **{cell['filters_failed']} filters failed**"
            lines.append(f"| {label} | " + " | ".join(texts.values()) + f" | {remark.strip()} |")
        parts.append("\n".join(lines))
    end = "**Bold**: more than 1 % undetected failures. *Italics*: the same, expected."
    return "\n\n".join([*parts, end]) + "\n"


def _text(value: float | None) -> str:
    """A number, or a dash for what never happened (infinity, as JSON has none)."""
    return "-" if value is None or math.isinf(value) else f"{value:.1f}"


def unexpected(cells: Mapping[str, Mapping[str, Any]]) -> int:
    """How many trials miss without a reason."""
    return sum(cell["miss"] and not cell["expected"] for cell in cells.values())


def run_recovery(
    cells: list[Trial], output: Path, *, flights: int, first_seed: int, threads: int | None = None
) -> dict[str, Any]:
    """Fly all trials that `output` lacks; it may have some of an interrupted run of the same."""
    head = {
        "flights": flights,
        "seeds": [first_seed, first_seed + flights - 1],
        "versions": versions("numpy", "numba"),
    }
    fly = partial(measure, flights=flights, first_seed=first_seed, threads=threads)
    return run_cells(cells, output / "recovery", head, fly, partial(table_of, flights=flights))

"""Consistency of a filter in one configuration: flights, report, figures and numbers."""

import time
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import numpy as np
from tqdm import tqdm

from quad_gym.analysis.consistency import BAND_FLIGHTS, CONSISTENT_SHARE, PARTS, MeanSquare
from quad_gym.analysis.consistency_flights import Findings, endless, measure_consistency
from quad_gym.analysis.consistency_plots import errors_figure, mean_square_figure, whiteness_figure
from quad_gym.analysis.plots import save_figure
from quad_gym.analysis.reports import text_table, versions, write_json
from quad_gym.batch.flight_batch import FlightBatch
from quad_gym.envs.config import TASK_DEFAULTS
from quad_gym.params.sensors import SensorSuite


@dataclass(frozen=True)
class CaseFlights:
    """Flights of each case."""

    count: int
    first_seed: int = 0
    duration: float = 10.0
    """length [s]"""
    threads: int | None = None

    @property
    def seeds(self) -> range:
        """Consecutive seeds of the flights."""
        return range(self.first_seed, self.first_seed + self.count)

    @property
    def seed_limits(self) -> list[int]:
        """First and last seed."""
        return [self.seeds[0], self.seeds[-1]]


@dataclass(frozen=True)
class Case:
    """Configuration of flights by PD control."""

    name: str
    sensors: SensorSuite
    task: str = "random_trajectory"
    start: Literal["cold", "warm"] = "cold"
    """start of the filter"""
    keywords: Mapping[str, Any] = field(default_factory=dict)
    """further keywords of `FlightBatch`"""
    expected: Mapping[str, str] = field(default_factory=dict)
    """reasons for misses, by column; "" stands for all columns"""

    def batch(self, count: int, threads: int | None = None) -> FlightBatch:
        """Flights without early endings."""
        return FlightBatch(
            count,
            sensors=self.sensors,
            task=endless(TASK_DEFAULTS[self.task]),
            gains="tuned",
            filter_start=self.start,
            innovations="estimator" not in self.keywords,  # which only the built-in filter has
            threads=threads,
            **self.keywords,
        )


def fly(batch: FlightBatch, flights: CaseFlights, **options: Any) -> Findings:
    """Fly, and compare errors with covariances; for options, see `measure_consistency`."""
    return measure_consistency(batch, seeds=flights.seeds, duration=flights.duration, **options)


def run_single(
    case: Case,
    flights: CaseFlights,
    output: Path,
    *,
    settle: float,
    configuration: Any,
) -> None:
    """Fly a case, print the report, and write figures and numbers; see `measure_consistency`.

    The name of the case is the title of the figures; `configuration` is stored in the file.
    """
    began, batch = time.monotonic(), case.batch(flights.count, flights.threads)
    print(f"{case.name}; {flights.count:,} flights of {flights.duration:g} s, {case.task}.\n")
    look = {"bar_format": "{desc}: {percentage:3.0f}% of the flights, {remaining} left"}
    with tqdm(total=flights.duration, desc="simulating", mininterval=2.0, **look) as bar:
        whole = fly(batch, flights, settle=settle, progress=lambda flown: bar.update(flown - bar.n))
    findings = whole.since(settle)
    print(report_of(findings))
    files = _draw(case.name, whole, findings, settle, output)
    squares = findings.nees | {f"nis_{name}": part for name, part in findings.nis.items()}
    found = {
        "consistent": findings.consistent if findings.nees else None,
        "consistent_share": CONSISTENT_SHARE,
        "verdicts": findings.sentences(),
        "share_inside": {name: part.share_inside for name, part in squares.items()},
        "overall": {name: part.overall for name, part in squares.items()},
        "filters_failed": findings.failed,
        "flights_astray": int(findings.astray.sum()),
        "mean_tracking_error": float(findings.tracking.mean.mean()),
        "configuration": configuration,
        "sensors": batch.sensors,
        "vehicle": batch.vehicle,
        "world": batch.world,
        "faults": batch.faults,
        "seeds": flights.seed_limits,
        "versions": versions("numpy", "numba", "scipy"),
        "nees": whole.nees,
        "nis": whole.nis,
        "whiteness": findings.whiteness,
        "rms_errors": whole.errors,
        "rms_claimed": whole.claimed,
    }
    files.append(write_json(output / "consistency.json", found))
    seconds = time.monotonic() - began
    print(f"\nWrote {len(files)} files to {output} after {seconds:.1f} s.")


def _draw(
    title: str,
    whole: Findings,
    findings: Findings,
    settle: float,
    output: Path,
) -> list[Path]:
    """Draw and save the figures; return their files."""
    figures = {
        "errors": errors_figure(whole.time, whole.errors, whole.claimed, title),
    }
    if whole.nees:
        figures["nees"] = mean_square_figure("NEES", whole.nees, title, settle)
    if whole.nis:
        figures["nis"] = mean_square_figure("NIS", whole.nis, title, settle)
    if findings.whiteness:
        figures["whiteness"] = whiteness_figure(findings.whiteness, title)
    saved = (save_figure(figure, output / name) for name, figure in figures.items())
    return [file for pair in saved for file in pair]


def _table(quantity: str, parts: dict[str, MeanSquare]) -> str:
    """Format mean squares for the screen."""
    rows = [
        (
            *(part.name, f"{part.overall:.2f}", f"{part.mean[-1]:.2f}"),
            *(f"{part.low[-1]:.2f} to {part.high[-1]:.2f}", f"{100 * part.share_inside:.0f}%"),
        )
        for part in parts.values()
    ]
    columns = ["over time", "at the end", "tolerance", "inside"]
    return text_table({quantity: ["of"], "mean over flights": columns}, rows)


def _errors_alone(findings: Findings) -> str:
    """Describe the errors of an estimator without a covariance."""
    last = dict(zip(PARTS, (findings.errors[-1, part] for part in PARTS.values()), strict=True))
    r, v, e = (float(np.linalg.norm(last[name])) for name in ("position", "velocity", "attitude"))
    return (
        "The estimator has no covariance, so its consistency cannot be tested.\n"
        f"Root mean square errors at the end: position {1e3 * r:.1f} mm, velocity "
        f"{1e3 * v:.1f} mm/s, attitude {1e3 * e:.2f} mrad.\n"
        f"Flights lost: {findings.astray.sum()}."
    )


def report_of(findings: Findings) -> str:
    """Format tables and the verdict for the screen."""
    if not findings.nees:
        return _errors_alone(findings)
    tables = [_table("NEES", findings.nees)]
    if findings.nis:
        tables.append(_table("NIS", findings.nis))
    verdict = "consistent" if findings.consistent else "inconsistent"
    lines = [
        f"The filter is {verdict}:",
        *(f"  {text}" for text in findings.sentences().values()),
        f"  Filters with a numerical failure: {findings.failed}. Flights lost: "
        f"{findings.astray.sum()}.",
        f"Criterion: means within the tolerance, the 95 % band of a mean over at most "
        f"{BAND_FLIGHTS:,} values, at {100 * CONSISTENT_SHARE:.0f} % of the instants or more; "
        "white innovations; no failures.",
    ]
    return "\n\n".join([*tables, "\n".join(lines)])

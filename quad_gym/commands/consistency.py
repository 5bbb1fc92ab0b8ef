"""Test the consistency of the filter: compare errors with their estimated covariance.

  quad-gym consistency                             the suite "standard"
  quad-gym consistency circle --sensors indoor --filter-start warm
  quad-gym consistency --sensors lab               the report's filter
  quad-gym consistency --sensors lab --form corrected   the same sensors, all corrections
  quad-gym consistency --estimator ekf             an extended Kalman filter
  quad-gym consistency --estimator module:Class    a quad_gym.Estimator of your own
  quad-gym consistency --noise-factor 1.5          sensors noisier than the filter assumes

The flights follow random trajectories (or another task) by PD control. The normalized estimation
error squared (NEES) is computed for the 15 states and for each part of three, over time, and the
normalized innovation squared (NIS) for each sensor. For a consistent filter, means over 1,000
flights are inside known bands at 95 % of the instants, and innovations are white. Prints tables and
a verdict, and writes figures (PNG and SVG) and consistency.json, which has all numbers with the
configuration and the seeds.
"""

import time
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import numpy as np
from tqdm import tqdm

from quad_gym import FilterParams, SensorSuite, sensor_suite
from quad_gym.analysis.consistency import (
    BAND_FLIGHTS,
    CONSISTENT_SHARE,
    EVERY,
    PARTS,
    Findings,
    MeanSquare,
    endless,
    errors_figure,
    mean_square_figure,
    measure_consistency,
    whiteness_figure,
)
from quad_gym.analysis.plots import require_matplotlib, save_figure
from quad_gym.analysis.reports import require_writable, text_table, versions, write_json
from quad_gym.batch.flight_batch import FlightBatch
from quad_gym.commands import options
from quad_gym.envs import IDS
from quad_gym.envs.config import TASK_DEFAULTS, own_estimator
from quad_gym.params import checks as check
from quad_gym.params.suites import FIELD_FILTER
from quad_gym.records import Source

# --------------------------------------------------------------------------------------------------
# Consistency of a filter in one configuration: flights, report, figures and numbers.
# --------------------------------------------------------------------------------------------------


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
            part.name,
            f"{part.overall:.2f}",
            f"{part.mean[-1]:.2f}",
            f"{part.low[-1]:.2f} to {part.high[-1]:.2f}",
            f"{100 * part.share_inside:.0f}%",
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


# --------------------------------------------------------------------------------------------------
# Test the consistency of the filter: compare errors with their estimated covariance.
# --------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class ConsistencyArgs:
    """Options of the experiment."""

    env_id: options.TrackingId = "QuadGym/RandomTrajectory-v0"

    episodes: int = 4000
    """number of flights"""
    seed: int = 0
    """seed of the first flight; the others have consecutive seeds"""
    duration: float = 10.0
    """length of a flight [s]"""
    observation: Literal["estimate", "truth"] = options.OBSERVATION
    """observation of the controller"""
    filter_start: Literal["cold", "warm"] = "cold"
    """start of the filter: cold (from its first fix), or warm (after some seconds of hovering)"""
    settle: float = 0.0
    """initial transient excluded from averages [s]"""
    output: Path = Path("results/consistency")
    """folder for figures and numbers; earlier ones there are replaced"""
    threads: options.Threads = None

    sensors: options.SuiteName = options.SENSORS
    form: Literal["suite", "report", "corrected"] = "suite"
    """form of filter and IMU: the suite's, the report's, or the one with all corrections"""
    estimator: options.EstimatorName = None
    camera: bool = True
    """measure with the camera, if the suite has one"""
    world: str = options.WORLD
    """air, ground and battery: calm, breeze or fresh_breeze"""
    faults: str | None = None
    """faults of sensors and rotors: presets joined by +, such as gnss_outage+rotor_loss"""
    noise_factor: float = 1.0
    """true white noise, relative to the noise that the filter assumes"""

    def __post_init__(self) -> None:
        """Check the numbers."""
        options.require_at_least(self, episodes=2, seed=0, threads=1)
        full_id = options.known_id("ENV_ID", self.env_id, options.TRACKING)
        object.__setattr__(self, "env_id", full_id)
        check.number("--duration", self.duration, least=EVERY)
        check.positive("--noise-factor", self.noise_factor)
        if not 0.0 <= self.settle < self.duration:
            raise ValueError(f"--settle must be at least 0 and before the end, got {self.settle}")
        if self.own_estimator is not None and self.form != "suite":
            raise ValueError(
                f"--form {self.form} has no effect with an own --estimator, and must not be given"
            )

    @property
    def own_estimator(self) -> str | None:
        """A user's estimator; None for built-in filters."""
        return own_estimator(self.estimator)


def suite_of(args: ConsistencyArgs) -> SensorSuite:
    """Sensor suite of the options."""
    suite = sensor_suite(args.sensors)
    if not args.camera:
        suite = suite.replace(camera=None)
    samples, form = {
        "suite": (suite.imu.samples, suite.estimator),
        "report": ("instant", FilterParams()),
        "corrected": ("average", FIELD_FILTER),
    }[args.form]
    if args.estimator is not None and args.own_estimator is None:
        form = form.replace(kind=args.estimator)
    return suite.replace(imu=suite.imu.replace(samples=samples), estimator=form)


def case_of(args: ConsistencyArgs) -> Case:
    """Configuration of the options."""
    suite = suite_of(args)
    keywords: dict[str, Any] = {
        "source": Source[args.observation.upper()],
        "true_sensors": suite.scaled_noise(args.noise_factor),
        "world": args.world,
        "faults": args.faults,
    }
    if args.own_estimator is not None:
        keywords["estimator"] = args.own_estimator
    return Case(title_of(suite, args), suite, IDS[args.env_id], args.filter_start, keywords)


def title_of(suite: SensorSuite, args: ConsistencyArgs) -> str:
    """Title of the report and of the figures."""
    choices = suite.estimator
    if args.own_estimator is not None:
        return f"{args.estimator}, suite {args.sensors}, {args.filter_start} start"
    parts = [
        f"{choices.kind.upper()}, suite {args.sensors}, {args.filter_start} start",
        f"{suite.imu.samples} samples",
        choices.integration,
        f"attitude reset {'on' if choices.attitude_reset else 'off'}",
    ]
    if suite.camera is not None:
        parts.append(f"bearing noise at the {choices.bearing_noise_at} direction")
    return ", ".join(parts)


def main(args: ConsistencyArgs) -> None:
    """Run the experiment."""
    with options.usage_errors():
        require_matplotlib()
        case = case_of(args)
        case.batch(8, 1)  # rejects an invalid configuration
        require_writable("--output", args.output)
    run_single(
        case,
        CaseFlights(args.episodes, args.seed, args.duration, args.threads),
        args.output,
        settle=args.settle,
        configuration=args,
    )

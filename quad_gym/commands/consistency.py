"""Filter consistency: compare errors with the covariance that the filter claims, over many flights.

Flies random trajectories (or another task) by PD control and takes the normalized estimation error
squared (NEES) of the 15 states and of each block of three, over time, and the normalized innovation
squared (NIS) of each sensor. If the covariance is right, means over 1,000 flights lie in known
bands at 95 % of the instants, and innovations are white. The truth is the simulator's.

Prints tables and a verdict, and writes figures (PNG and SVG) and all numbers with the whole
configuration and the seeds (consistency.json). For example:

  quad-gym consistency                             the suite "standard"
  quad-gym consistency circle --sensors indoor --filter-start warm
  quad-gym consistency --sensors lab                 the report's filter
  quad-gym consistency --sensors lab --form corrected   the same sensors, all corrections
  quad-gym consistency --estimator ekf             an extended Kalman filter
  quad-gym consistency --mass-factor 1.2           a vehicle heavier than it is taken for
  quad-gym consistency --noise-factor 1.5          sensors worse than the filter believes

With --matrix it flies every suite on every task from both starts, and with faults, latencies,
mountings, randomization, drawn starts and wind on one task, and writes one table of all means.
With --recovery it flies every fault on every suite that can have it, and tables which filters are
right again after 10 s, which say that they are lost, and how often they say so without cause.
Either run, when it was interrupted, goes on where it was.

  quad-gym consistency --matrix                    everything; some 200 cells
  quad-gym consistency --matrix --cells suites     the suites on all tasks
  quad-gym consistency --recovery                  after faults
"""

import math
import sys
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from quad_gym import FilterParams, SensorSuite, sensor_suite, vehicle_params
from quad_gym.analysis.consistency import BAND_FLIGHTS, CONSISTENT_SHARE, MeanSquare
from quad_gym.analysis.consistency_flights import Findings, endless, measure_consistency
from quad_gym.analysis.consistency_plots import (
    errors_figure,
    nees_figure,
    nis_figure,
    whiteness_figure,
)
from quad_gym.analysis.plots import house_style, require_matplotlib, save_figure
from quad_gym.analysis.reports import (
    require_writable,
    text_table,
    versions,
    write_json,
)
from quad_gym.batch.flight_batch import FlightBatch
from quad_gym.commands.options import (
    TRACKING,
    SuiteName,
    TrackingId,
    known_id,
    option_name,
    require_at_least,
    usage_errors,
)
from quad_gym.envs import IDS
from quad_gym.envs.configuration import TASK_DEFAULTS
from quad_gym.params.suites import FIELD_FILTER
from quad_gym.records import Source


@dataclass(frozen=True)
class Args:
    """Options of the experiment."""

    env_id: TrackingId = "QuadGym/RandomTrajectory-v0"

    episodes: int | None = None
    """flights; if not given, 4000, or 400 in each cell of a matrix"""
    seed: int = 0
    """of the first flight; the others follow it"""
    duration: float = 10.0
    """length of a flight [s]"""
    observation: Literal["estimate", "truth"] = "estimate"
    """what the controller sees"""
    filter_start: Literal["cold", "warm", "matched"] = "cold"
    """the filter's start: from its first fix; after some seconds of hovering; or with errors
    drawn from its own covariance, which tests the filter apart from its start"""
    every: float = 0.05
    """time between two looks at the errors [s]"""
    settle: float = 0.0
    """time at the start that does not count [s]"""
    output: Path | None = None
    """folder for figures and numbers, made if it is missing; if not given, results/consistency,
    with --matrix results/consistency_matrix, with --recovery results/consistency_recovery"""
    matrix: bool = False
    """fly the matrix of configurations; of the other options only episodes, seed, duration,
    output, cells and threads concern it"""
    recovery: bool = False
    """fly faults and see how filters recover; of the other options only episodes, seed, output
    and threads concern it"""
    cells: Literal["all", "suites", "conditions"] = "all"
    """with --matrix: the suites on all tasks, other conditions on one task, or both"""
    threads: int | None = None
    """threads; if not given, as many as there are cores; results do not depend on it"""

    sensors: SuiteName = "standard"
    form: Literal["suite", "report", "corrected", "mended"] = "suite"
    """form of filter and IMU: as the suite has it, the report's, or with all corrections
    (formerly mended)"""
    samples: Literal["instant", "average"] | None = None
    """what an IMU sample holds, in place of the form's"""
    integration: Literal["euler", "midpoint"] | None = None
    """how the filter integrates IMU samples, in place of the form's"""
    attitude_reset: bool | None = None
    """transform the covariance when the attitude is corrected, in place of what the form does"""
    bearing_noise_at: Literal["measured", "predicted", "pinhole"] | None = None
    """direction to which the filter assumes camera noise is perpendicular, in place of the
    form's"""
    estimator: Literal["ukf", "ekf"] | None = None
    """the filter, in place of the suite's"""
    camera: bool = True
    """measure with the camera, if the suite has one"""
    imu_rate: float | None = None
    """IMU samples and filter cycles per second [Hz]; if not given, the suite's"""
    gnss_rate: float | None = None
    """GNSS fixes per second [Hz]; if not given, the suite's"""
    camera_rate: float | None = None
    """images per second [Hz]; if not given, the suite's"""

    mass_factor: float = 1.0
    """true mass, as a multiple of what the controller believes"""
    motor_lag_factor: float = 1.0
    """true lag of the motors, likewise"""
    world: str = "calm"
    """what air, ground and battery do: calm, breeze or fresh_breeze"""
    faults: str | None = None
    """what goes wrong with sensors and rotors: presets joined by +, as gnss_outage+rotor_loss"""
    noise_factor: float = 1.0
    """true white noise, as a multiple of what the filter believes"""

    def __post_init__(self) -> None:
        """Check the numbers."""
        if self.episodes is None:
            object.__setattr__(self, "episodes", 400 if self.tables else 4000)
        if self.output is None:
            folder = "consistency_matrix" if self.matrix else "consistency"
            folder = "consistency_recovery" if self.recovery else folder
            object.__setattr__(self, "output", Path("results") / folder)
        require_at_least(self, episodes=2, threads=1)
        object.__setattr__(self, "env_id", known_id("ENV_ID", self.env_id, TRACKING))
        if self.cells != "all" and not self.matrix:
            raise ValueError("--cells needs --matrix")
        if self.matrix and self.recovery:
            raise ValueError("--matrix and --recovery must not be given together")
        for name in ("duration", "every", "mass_factor", "motor_lag_factor", "noise_factor"):
            value = getattr(self, name)
            if not (math.isfinite(value) and value > 0.0):
                raise ValueError(f"{option_name(name)} must be above 0, got {value}")
        if not 0.0 <= self.settle < self.duration:
            raise ValueError(f"--settle must be at least 0 and before the end, got {self.settle}")

    @property
    def task(self) -> str:
        """The short name of what is flown."""
        return IDS[self.env_id]

    @property
    def tables(self) -> bool:
        """Whether a table of many configurations is wanted."""
        return self.matrix or self.recovery

    @property
    def count(self) -> int:
        """How many flights."""
        assert self.episodes is not None
        return self.episodes

    @property
    def folder(self) -> Path:
        """Where results go."""
        assert self.output is not None
        return self.output


def suite_of(args: Args) -> SensorSuite:
    """The sensor suite that the options describe."""
    suite = sensor_suite(args.sensors)
    if not args.camera:
        suite = suite.replace(camera=None)
    samples = suite.imu.samples
    if args.form != "suite":
        samples = "instant" if args.form == "report" else "average"
        form = FilterParams() if args.form == "report" else FIELD_FILTER
        suite = suite.replace(estimator=form)
    chosen = {"kind": args.estimator} if args.estimator is not None else {}
    for name in ("integration", "attitude_reset", "bearing_noise_at"):
        if getattr(args, name) is not None:
            chosen[name] = getattr(args, name)
    suite = suite.replace(
        imu=suite.imu.replace(samples=args.samples or samples),
        estimator=suite.estimator.replace(**chosen),
    )
    camera_rate = args.camera_rate if args.camera else None
    return suite.with_rates(imu=args.imu_rate, gnss=args.gnss_rate, camera=camera_rate)


def batch_of(args: Args) -> FlightBatch:
    """Flights that nothing ends before their time."""
    suite, vehicle = suite_of(args), vehicle_params("lab")
    true_vehicle = vehicle.replace(
        mass=args.mass_factor * vehicle.mass,
        motor_time_constant=args.motor_lag_factor * vehicle.motor_time_constant,
    )
    return FlightBatch(
        args.count,
        vehicle=vehicle,
        sensors=suite,
        gains="tuned",
        task=endless(TASK_DEFAULTS[args.task]),
        source=Source.ESTIMATE if args.observation == "estimate" else Source.TRUTH,
        filter_start="warm" if args.filter_start == "warm" else "cold",
        innovations=True,
        threads=args.threads,
        true_vehicle=true_vehicle,
        true_sensors=suite.scaled_noise(args.noise_factor),
        world=args.world,
        faults=args.faults,
    )


def fly(args: Args, batch: FlightBatch) -> Findings:
    """Fly all flights to their end, looking at the errors on the way."""
    shown = time.monotonic()

    def progress(flown: float) -> None:
        nonlocal shown
        if time.monotonic() > shown + 2.0:
            shown = time.monotonic()
            print(f"  {flown:.1f} of {args.duration:g} s flown", file=sys.stderr, flush=True)

    return measure_consistency(
        batch,
        seeds=range(args.seed, args.seed + args.count),
        duration=args.duration,
        every=args.every,
        settle=args.settle,
        matched=args.filter_start == "matched",
        progress=progress,
    )


def title_of(batch: FlightBatch, args: Args) -> str:
    """What was flown, in a line."""
    sensors = batch.sensors
    choices = sensors.estimator
    parts = [
        f"{choices.kind.upper()}, suite {args.sensors}, {args.filter_start} start",
        f"{sensors.imu.samples} samples",
        f"{choices.integration}",
        f"attitude reset {'on' if choices.attitude_reset else 'off'}",
    ]
    if sensors.camera is not None:
        parts.append(f"feature noise across the {choices.bearing_noise_at} direction")
    return ", ".join(parts)


def table_of(quantity: str, parts: dict[str, MeanSquare]) -> str:
    """Mean squares, for the screen."""
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


def report_of(findings: Findings) -> str:
    """Tables and the verdict, for the screen."""
    tables = [table_of("NEES", findings.nees)]
    if findings.nis:
        tables.append(table_of("NIS", findings.nis))
    lines = [
        "The filter is consistent:"
        if findings.consistent
        else "The filter is not consistent in everything:",
        *(f"  {text}" for text in findings.sentences().values()),
        f"  Filters with a numerical failure: {findings.failed}. Flights lost: "
        f"{findings.astray.sum()}.",
        f"Criterion: means within the tolerance, the 95 % band of a mean over at most "
        f"{BAND_FLIGHTS:,} values, at {100 * CONSISTENT_SHARE:.0f} % of the instants or more; "
        "white innovations; no failures.",
    ]
    return "\n\n".join([*tables, "\n".join(lines)])


def fly_tables(args: Args) -> None:
    """Fly a table of configurations, and say where it is written."""
    from quad_gym.commands import consistency_matrix as matrix
    from quad_gym.commands import consistency_recovery as recovery

    name = "matrix" if args.matrix else "recovery"
    with usage_errors():
        require_writable("--output", args.folder)
    flown: dict[str, Any] = {"flights": args.count, "first_seed": args.seed}
    flown["threads"] = args.threads
    if args.matrix:
        chosen = matrix.cells_of(args.cells)
        found = matrix.run_matrix(chosen, args.folder, duration=args.duration, **flown)
        wrong = matrix.unexpected(found)
    else:
        found = recovery.run_recovery(list(recovery.trials()), args.folder, **flown)
        wrong = recovery.unexpected(found)
    print(f"{len(found)} cells, {wrong} unexpected misses; see {args.folder / name}.md.")


def main(args: Args) -> None:
    """Fly, measure, judge, draw and write."""
    if args.tables:
        fly_tables(args)
        return
    with usage_errors():
        require_matplotlib()
        batch = batch_of(args)
        require_writable("--output", args.folder)
    began, title = time.monotonic(), title_of(batch, args)
    print(f"{title}; {args.count:,} flights of {args.duration:g} s, {args.task}.\n")
    whole = fly(args, batch)
    findings = whole.since(args.settle)
    print(report_of(findings))

    files = []
    with house_style():
        figures = {
            "nees": nees_figure(whole.nees, title, args.settle),
            "errors": errors_figure(whole.nees["state"].time, whole.errors, whole.claimed, title),
        }
        if whole.nis:
            figures["nis"] = nis_figure(whole.nis, title, args.settle)
        if findings.whiteness:
            figures["whiteness"] = whiteness_figure(findings.whiteness, title)
        for name, figure in figures.items():
            files += save_figure(figure, args.folder / name)
    squares = findings.nees | {f"nis_{name}": part for name, part in findings.nis.items()}
    found = {
        "consistent": findings.consistent,
        "consistent_share": CONSISTENT_SHARE,
        "verdicts": findings.sentences(),
        "share_inside": {name: part.share_inside for name, part in squares.items()},
        "overall": {name: part.overall for name, part in squares.items()},
        "filters_failed": findings.failed,
        "flights_astray": int(findings.astray.sum()),
        "mean_tracking_error": float(findings.tracking.mean.mean()),
        "configuration": args,
        "sensors": batch.sensors,
        "vehicle": batch.vehicle,
        "world": batch.world,
        "faults": batch.faults,
        "seeds": [args.seed, args.seed + args.count - 1],
        "versions": versions("numpy", "numba", "scipy"),
        "nees": whole.nees,
        "nis": whole.nis,
        "whiteness": findings.whiteness,
        "rms_errors": whole.errors,
        "rms_claimed": whole.claimed,
    }
    files.append(write_json(args.folder / "consistency.json", found))
    seconds = time.monotonic() - began
    print(f"\nWrote {len(files)} files to {args.folder} after {seconds:.1f} s.")

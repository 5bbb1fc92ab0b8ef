"""Is the filter honest? Compare its errors with the covariance that it claims, over many flights.

Flies random trajectories (or another task) by PD control and takes the normalised estimation error
squared (NEES) of the 15 states and of each block of three, over time, and the normalised innovation
squared (NIS) of each sensor. If the covariance is right, means over flights lie in known bands at
95 % of the instants, and innovations are white. The truth is the simulator's.

Prints a table and a verdict, and writes figures (PNG and SVG) and all numbers with the whole
configuration and the seeds (consistency.json). For example:

  python scripts/consistency.py                             the laboratory's suite, mended
  python scripts/consistency.py --form report               in the report's form
  python scripts/consistency.py --estimator ekf --start matched
  python scripts/consistency.py --mass-factor 1.2           a vehicle heavier than it is taken for
  python scripts/consistency.py --noise-factor 1.5          sensors worse than the filter believes
"""

import math
import sys
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np

from quad_gym import SensorSuite, sensor_suite, vehicle_params
from quad_gym.cli import option, parse, usage_errors
from quad_gym.consistency import (
    HONEST_SHARE,
    InnovationRecorder,
    MeanSquare,
    NeesRecorder,
    Whiteness,
    start_matched,
    verdict,
)
from quad_gym.consistency_plots import errors_figure, nees_figure, nis_figure, whiteness_figure
from quad_gym.envs.configuration import TASK_DEFAULTS
from quad_gym.plots import house_style, require_matplotlib, save_figure
from quad_gym.records import Source
from quad_gym.reports import text_table, versions, write_json
from quad_gym.simulation import FlightBatch

MENDS = {
    "samples": ("instant", "average"),
    "integration": ("euler", "midpoint"),
    "covariance_reset": ("none", "turn"),
    "feature_noise_across": ("measured", "projected"),
}
"""What each mend is in the report's form, and mended."""


@dataclass(frozen=True)
class Args:
    """Options of the experiment."""

    flights: int = option(1000, "flights", group="experiment")
    first_seed: int = option(0, "seed of the first flight; the others follow it")
    duration: float = option(10.0, "length of a flight [s]")
    task: Literal["random_trajectory", "hover", "circle", "lemniscate"] = option(
        "random_trajectory", "what is flown"
    )
    fly_on: Literal["estimate", "truth"] = option("estimate", "what the controller sees")
    start: Literal["suite", "matched"] = option(
        "suite",
        "the filter's start: as the suite has it, or with errors drawn from its own covariance, "
        "which tests the filter apart from its start",
    )
    every: float = option(0.05, "time between two looks at the errors [s]")
    settle: float = option(0.0, "time at the start that does not count [s]")
    output: Path = option(
        Path("results/consistency"), "folder for figures and numbers; made if it is missing"
    )
    threads: int | None = option(
        None, "threads; if not given, as many as there are cores; results do not depend on it"
    )

    suite: str = option("lab", "sensor suite", group="sensors and filter")
    form: Literal["suite", "report", "mended"] = option(
        "mended", "form of filter and IMU: as the suite has it, the report's, or with all mends"
    )
    samples: Literal["instant", "average"] | None = option(None, "in place of the form's")
    integration: Literal["euler", "midpoint"] | None = option(None, "in place of the form's")
    covariance_reset: Literal["none", "turn"] | None = option(None, "in place of the form's")
    feature_noise_across: Literal["measured", "predicted", "projected"] | None = option(
        None, "in place of the form's"
    )
    estimator: Literal["ukf", "ekf"] | None = option(None, "in place of the suite's")
    camera: bool = option(True, "measure with the camera, if the suite has one")
    imu_rate: float | None = option(None, "in place of the suite's [Hz]")
    gnss_rate: float | None = option(None, "in place of the suite's [Hz]")
    camera_rate: float | None = option(None, "in place of the suite's [Hz]")

    mass_factor: float = option(
        1.0, "true mass, as a multiple of what the controller believes", group="model mismatch"
    )
    noise_factor: float = option(1.0, "true white noise, as a multiple of what the filter believes")

    def __post_init__(self) -> None:
        """Check the numbers."""
        if self.flights < 2:
            raise ValueError(f"--flights must be at least 2, got {self.flights}")
        for name in ("duration", "every", "mass_factor", "noise_factor"):
            value = getattr(self, name)
            if not (math.isfinite(value) and value > 0.0):
                raise ValueError(f"--{name.replace('_', '-')} must be above 0, got {value}")
        if not 0.0 <= self.settle < self.duration:
            raise ValueError(f"--settle must be at least 0 and before the end, got {self.settle}")


def suite_of(args: Args) -> SensorSuite:
    """The sensor suite that the options describe."""
    suite = sensor_suite(args.suite)
    if not args.camera:
        suite = suite.replace(camera=None)
    chosen: dict[str, Any] = {}
    for name, (report, mended) in MENDS.items():
        if args.form != "suite":
            chosen[name] = report if args.form == "report" else mended
        if getattr(args, name) is not None:
            chosen[name] = getattr(args, name)
    samples = chosen.pop("samples", suite.imu.samples)
    if args.estimator is not None:
        chosen["kind"] = args.estimator
    suite = suite.replace(
        imu=suite.imu.replace(samples=samples), estimator=suite.estimator.replace(**chosen)
    )
    camera_rate = args.camera_rate if args.camera else None
    return suite.with_rates(imu=args.imu_rate, gnss=args.gnss_rate, camera=camera_rate)


def batch_of(args: Args) -> FlightBatch:
    """Flights that nothing ends before their time."""
    suite, vehicle = suite_of(args), vehicle_params("lab")
    endless = {"duration": 0.0, "out_of_bounds": 1e9, "ground": -1e9, "max_tilt": math.pi}
    return FlightBatch(
        args.flights,
        vehicle=vehicle,
        sensors=suite,
        gains="tuned",
        task=TASK_DEFAULTS[args.task].replace(**endless),
        source=Source.ESTIMATE if args.fly_on == "estimate" else Source.TRUTH,
        innovations=True,
        threads=args.threads,
        true_vehicle=vehicle.replace(mass=args.mass_factor * vehicle.mass),
        true_sensors=suite.scaled_noise(args.noise_factor),
    )


def fly(args: Args, batch: FlightBatch) -> tuple[NeesRecorder, InnovationRecorder]:
    """Fly all flights to their end, looking at the errors on the way."""
    dt = batch.sensors.imu.dt
    ticks, stride = round(args.duration / dt), max(1, round(args.every / dt))
    recorder = NeesRecorder()
    bins = dt * stride * np.arange(ticks // stride + 1)
    innovations = InnovationRecorder(batch, bins, args.settle)
    batch.reset(seeds=range(args.first_seed, args.first_seed + args.flights))
    if args.start == "matched":
        start_matched(batch, args.first_seed)
    recorder.add(batch, 0.0)
    shown = time.monotonic()
    for tick in range(1, ticks + 1):
        batch.step()
        innovations.add(batch, tick * dt)
        if tick % stride == 0:
            recorder.add(batch, tick * dt)
        if time.monotonic() > shown + 2.0:
            shown = time.monotonic()
            print(f"  {tick * dt:.1f} of {args.duration:g} s flown", file=sys.stderr, flush=True)
    return recorder, innovations


def title_of(batch: FlightBatch, args: Args) -> str:
    """What was flown, in a line."""
    sensors = batch.sensors
    choices = sensors.estimator
    parts = [
        f"{choices.kind.upper()}, suite {args.suite}",
        f"{sensors.imu.samples} samples",
        f"{choices.integration}",
        f"reset {choices.covariance_reset}",
    ]
    if sensors.camera is not None:
        parts.append(f"feature noise across the {choices.feature_noise_across} direction")
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
    columns = ["over time", "at the end", "band", "inside"]
    return text_table({quantity: ["of"], "mean over flights": columns}, rows)


@dataclass(frozen=True)
class Findings:
    """What was found about a filter, from the instant on that counts."""

    nees: dict[str, MeanSquare]
    nis: dict[str, MeanSquare]
    whiteness: dict[str, Whiteness]
    failed: int
    """filters that failed in a cycle"""

    @property
    def honest(self) -> bool:
        """Whether everything is as an honest filter's."""
        squares = (*self.nees.values(), *self.nis.values())
        white = all(part.white for part in self.whiteness.values())
        return self.failed == 0 and white and all(part.honest for part in squares)

    def sentences(self) -> dict[str, str]:
        """Verdicts in plain English, by what they are on."""
        said = {f"nees_{name}": f"NEES of the {verdict(part)}" for name, part in self.nees.items()}
        said |= {f"nis_{name}": f"NIS of the {verdict(part)}" for name, part in self.nis.items()}
        for name, part in self.whiteness.items():
            judged = "white" if part.white else "not white"
            text = (
                f"Innovations of the {name}: autocorrelation at most {part.largest:+.3f}: {judged}."
            )
            said[f"innovations_{name}"] = text
        return said

    def report(self) -> str:
        """Tables and the verdict, for the screen."""
        tables = [table_of("NEES", self.nees)]
        if self.nis:
            tables.append(table_of("NIS", self.nis))
        lines = [
            "The filter is honest." if self.honest else "The filter is not honest in everything:",
            *(f"  {text}" for text in self.sentences().values()),
            f"  Filters that failed in a cycle: {self.failed}.",
        ]
        return "\n\n".join([*tables, "\n".join(lines)])


def main(args: Args) -> None:
    """Fly, measure, judge, draw and write."""
    with usage_errors():
        require_matplotlib()
        batch = batch_of(args)
        args.output.mkdir(parents=True, exist_ok=True)
    began, title = time.monotonic(), title_of(batch, args)
    print(f"{title}; {args.flights:,} flights of {args.duration:g} s, {args.task}.\n")
    recorder, innovations = fly(args, batch)
    nees, nis = recorder.nees(), innovations.nis()
    errors, sigmas = recorder.errors()
    findings = Findings(
        nees={name: part.since(args.settle) for name, part in nees.items()},
        nis={name: part.since(args.settle) for name, part in nis.items()},
        whiteness=innovations.whiteness(),
        failed=int((batch.read("filter_status") != 0).sum()),
    )
    print(findings.report())

    files = []
    with house_style():
        figures = {
            "nees": nees_figure(nees, title, args.settle),
            "errors": errors_figure(nees["state"].time, errors, sigmas, title),
        }
        if nis:
            figures["nis"] = nis_figure(nis, title, args.settle)
        if findings.whiteness:
            figures["whiteness"] = whiteness_figure(findings.whiteness, title)
        for name, figure in figures.items():
            files += save_figure(figure, args.output / name)
    squares = findings.nees | {f"nis_{name}": part for name, part in findings.nis.items()}
    found = {
        "honest": findings.honest,
        "honest_share": HONEST_SHARE,
        "verdicts": findings.sentences(),
        "share_inside": {name: part.share_inside for name, part in squares.items()},
        "overall": {name: part.overall for name, part in squares.items()},
        "filters_failed": findings.failed,
        "configuration": args,
        "sensors": batch.sensors,
        "vehicle": batch.vehicle,
        "seeds": [args.first_seed, args.first_seed + args.flights - 1],
        "versions": versions("numpy", "numba", "scipy"),
        "nees": nees,
        "nis": nis,
        "whiteness": findings.whiteness,
        "rms_errors": errors,
        "rms_claimed": sigmas,
    }
    files.append(write_json(args.output / "consistency.json", found))
    seconds = time.monotonic() - began
    print(f"\nWrote {len(files)} files to {args.output} after {seconds:.1f} s.")


if __name__ == "__main__":
    main(parse(Args, description=__doc__))

"""Find the noise, delays and field of a vehicle's sensors from logs of its flights.

    quad-gym calibrate flight.csv --sensors field
    quad-gym calibrate one.csv two.csv three.csv --sensors consumer --output results/mine
    quad-gym calibrate flight.ulg --sensors consumer --output results/mine
    quad-gym train --sensors results/mine/suite.toml
    quad-gym calibrate flight.csv --vehicle mine.toml --vehicle-from crazyflie

The search uses the first part of the log, or the first of several logs, and the rest validates its
result. The written suite is then fitted to all of several logs. It has the rates, delays and noise
of this vehicle, for `replay`, `train` and all other commands. The verdict is in the last lines. If
the suite is not usable, the exit code is 1.
"""

import math
import shlex
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from quad_gym.commands.options import (
    SuiteName,
    heading_in_degrees,
    refuse_overwriting,
    usage_errors,
)
from quad_gym.commands.replay import MISFIT, LogFiles, ReadingArgs, capital, told

if TYPE_CHECKING:
    from quad_gym.logs.calibrating.calibration import Calibration
    from quad_gym.logs.calibrating.likelihood import Validation
    from quad_gym.params.suites import SensorSuite

SUITE, RESULT = "suite.toml", "calibration.json"


@dataclass(frozen=True)
class CalibrateArgs(ReadingArgs):
    """Options of the calibration."""

    logs: LogFiles
    sensors: SuiteName = "field"
    share: float = 0.5
    """share of the log that the search uses, from its beginning; or of the logs"""
    delays: bool = True
    """find the delays of time stamps, too"""
    rotation: bool = False
    """find the rotation from the IMU to the body; otherwise the magnetometer is rotated"""
    heading: tuple[float, ...] | None = None
    """heading of the body x axis at the start, from east toward north [deg], one for each log;
    by default from a baseline or a magnetometer"""
    course: bool = False
    """use the direction of the first GNSS velocity as heading"""
    vehicle: Path | None = None
    """write a vehicle (.toml) with thrust and rotor lag from the motor voltages in the logs to this
    file, and a world with its linear drag beside it (VEHICLE-world.toml)"""
    vehicle_from: str | None = None
    """vehicle that provides mass, inertia and arms: lab, crazyflie or a .toml file; defaults to
    lab"""
    output: Path | None = None
    """folder for the results, created if it is missing; defaults to results/calibrate/LOG"""
    overwrite: bool = False
    """replace the results of an earlier calibration"""


def number_rows(calibration: "Calibration") -> list[tuple[str, ...]]:
    """Return a row of texts for each number, and for each mean bias of the IMU."""
    rows: list[tuple[str, ...]] = []
    for found in calibration.numbers:
        interval = f"[{found.low:.3g}, {found.high:.3g}]" if found.determined else "not determined"
        row = (found.number.name, f"{found.prior:.3g}", f"{found.value:.3g}", interval)
        rows.append((*row, found.number.unit))
    for name, unit in (("log_accel_bias", "m/s^2"), ("log_gyro_bias", "rad/s")):
        if any(bias := getattr(calibration.suite, name)):
            values = ", ".join(f"{value:.2g}" for value in bias)
            rows.append((name, "0", values, "mean of the flights", unit))
    return rows


def validation_rows(calibration: "Calibration") -> list[tuple[str, ...]]:
    """Return a row of texts for each sensor, before and after."""
    rows = []
    pair = (calibration.before, calibration.after)
    for name in calibration.after.sensors:
        cells: list[str] = []
        for validation in pair:
            fit = validation.sensors.get(name)
            cells += (
                ["-"] * 3
                if fit is None
                else [
                    f"{fit.mean_nis:.2f}",
                    f"{100.0 * fit.rejected:.1f} %",
                    f"{fit.correlation:.2f}",
                ]
            )
        rows.append((name.replace("_", " "), *cells))
    if calibration.after.held_out_nis is not None:
        rows.append(
            ("prediction error after 1 s without GNSS", *(c for j in pair for c in _held_out(j)))
        )
    return rows


def _held_out(validation: "Validation") -> tuple[str, str, str]:
    if validation.held_out_nis is None or validation.held_out_error is None:
        return "-", "", ""
    level, up = validation.held_out_error
    return f"{validation.held_out_nis:.2f}", f"{level:.2f} m", f"{up:.2f} m up"


NUMBER_HEADINGS = ("number", "before", "found", "95 % interval", "unit")
VALIDATION_HEADINGS = {
    "validation": ["of"],
    "before": ["NIS per degree of freedom", "rejected", "correlation"],
    "after": ["NIS per degree of freedom", "rejected", "correlation"],
}


def summary_of(calibration: "Calibration") -> dict[str, Any]:
    """Return the contents of the JSON file."""

    def summary(validation: "Validation") -> dict[str, Any]:
        return {
            "measurements": {name: fit._asdict() for name, fit in validation.sensors.items()},
            "held_out_error": validation.held_out_error,
            "held_out_nis": validation.held_out_nis,
            "held_out_ratios": validation.held_out_ratios,
            "diverged": validation.diverged,
            "problems": validation.problems,
        }

    numbers = {
        found.number.name: {
            "before": found.prior,
            "found": found.value,
            "interval": (found.low, found.high),
            "determined": found.determined,
            "unit": found.number.unit,
        }
        for found in calibration.numbers
    }
    return {
        "delays": dict(calibration.delays),
        "numbers": numbers,
        "verdict": calibration.verdict,
        "split": calibration.split if math.isfinite(calibration.split) else None,
        "logs_used": calibration.used,
        "before": summary(calibration.before),
        "after": summary(calibration.after),
        "notes": calibration.notes,
    }


def write_page(folder: Path, calibration: "Calibration", title: str) -> list[Path]:
    """Write figures and page."""
    from quad_gym.analysis.plots import house_style
    from quad_gym.analysis.reports import Report
    from quad_gym.logs.plots import innovations_figure, numbers_figure

    report = Report(folder, title)
    report.add(
        "p",
        f"{capital(calibration.verdict)}. NIS per degree of freedom, of all measurements, is 1, "
        "and the correlation of successive innovations 0, for a consistent filter.",
    )
    headings = [f"{part} {name}" for part, names in VALIDATION_HEADINGS.items() for name in names]
    headings[0] = "validation"
    report.add_table(headings, validation_rows(calibration))
    report.add_table(NUMBER_HEADINGS, number_rows(calibration))
    if calibration.notes or calibration.after.problems:
        report.add_bullets([*calibration.after.problems, *calibration.notes])
    with house_style():
        caption = "Positive parameters and their intervals"
        report.add_figure("numbers", numbers_figure(calibration), caption)
        caption = "Innovations before and after; crosses are rejected"
        report.add_figure("innovations", innovations_figure(calibration), caption)
    return report.write()


def fit_body(args: CalibrateArgs, suite: "SensorSuite", starts: list[dict[str, Any]]) -> str:
    """Write the files of vehicle and world; return sentences about them."""
    from quad_gym.estimation import fit_vehicle, read_log

    assert args.vehicle is not None
    logs = [read_log(log, **args.reading()) for log in args.logs]
    lacking = [path for path, log in zip(args.logs, logs, strict=True) if log.motors is None]
    if lacking:
        which = "the log" if len(logs) == 1 else lacking[0]
        return (
            f"Wrote no {args.vehicle}: {which} has no motor voltages (columns motor_0 to motor_3)."
        )
    with usage_errors():
        begin = args.vehicle_from or "lab"
        fitted = fit_vehicle(logs, sensors=suite, start=starts, vehicle=begin)
        file = fitted.vehicle.save(args.vehicle)
        world = fitted.world.save(world_of(args.vehicle))
    lag, hover, (along, across) = (
        fitted.motor_time_constant,
        fitted.hover_voltage,
        fitted.linear_drag_over_mass,
    )
    return (
        f"Wrote {file}: rotor lag {lag.value:.3f} s [{lag.low:.3f}, {lag.high:.3f}], hover voltage "
        f"{hover.value:.2f} V [{hover.low:.2f}, {hover.high:.2f}].\n"
        f"Wrote {world}: linear drag over the mass {along.value:.2f} 1/s [{along.low:.2f}, "
        f"{along.high:.2f}] along x, {across.value:.2f} 1/s [{across.low:.2f}, {across.high:.2f}] "
        "along y."
    )


def world_of(vehicle: Path) -> Path:
    """Return the file of the world that belongs to the file of a vehicle."""
    return vehicle.with_name(f"{vehicle.stem}-world.toml")


def next_command(args: CalibrateArgs, folder: Path) -> list[str]:
    """Return the words of a replay of the same log."""
    log = args.logs[-1]  # of several, one for validation
    words = ["quad-gym", "replay", str(log), "--sensors", str(folder / SUITE)]
    words += ["--no-reported-noise"]  # the suite's noise is as found
    if args.heading is not None:
        words += ["--heading", f"{args.heading[-1]:g}"]
    return words + ["--course"] * args.course + args.words()


def starts_of(args: CalibrateArgs) -> list[dict[str, Any]]:
    """Return the starts of the logs."""
    starts: list[dict[str, Any]] = [{"course": True} if args.course else {} for _ in args.logs]
    if args.heading is not None:
        headings = args.heading * (len(starts) if len(args.heading) == 1 else 1)
        if len(headings) != len(starts):
            raise ValueError(
                f"--heading must be given for each of {len(starts)} logs, got {len(headings)}"
            )
        for start, heading in zip(starts, headings, strict=True):
            start["heading"] = math.radians(heading_in_degrees("--heading", heading))
    return starts


def main(args: CalibrateArgs) -> None:
    """Search, validate and write."""
    from quad_gym import vehicle_params
    from quad_gym.analysis.plots import require_matplotlib
    from quad_gym.analysis.reports import require_writable, text_table, versions, write_json
    from quad_gym.estimation import calibrate

    folder = args.output or Path("results/calibrate") / args.logs[0].stem
    with usage_errors():
        if args.course and args.heading is not None:
            raise ValueError("--heading must not be given with --course")
        require_matplotlib()
        refuse_overwriting(folder / RESULT, args.overwrite)
        if args.vehicle_from is not None:
            if args.vehicle is None:
                raise ValueError("--vehicle-from needs --vehicle")
            vehicle_params(args.vehicle_from)
        if args.vehicle is not None:
            if args.vehicle.suffix != ".toml":
                raise ValueError(f"--vehicle must end with .toml, got {args.vehicle}")
            for file in (args.vehicle, world_of(args.vehicle)):
                refuse_overwriting(file, args.overwrite)
            require_writable("--vehicle", args.vehicle.parent)
        require_writable("--output", folder)
        starts = starts_of(args)
        several = len(args.logs) > 1
        found = calibrate(
            list(args.logs) if several else args.logs[0],
            sensors=args.sensors,
            start=starts if several else starts[0],
            rotation=args.rotation,
            share=args.share,
            delays=args.delays,
            **args.reading(),
            progress=lambda sentence: print(f"{sentence} ...", flush=True),
        )
    numbers = text_table({"": list(NUMBER_HEADINGS)}, number_rows(found))
    print(f"\n{numbers}\n\n{text_table(VALIDATION_HEADINGS, validation_rows(found))}\n")
    if sentences := (*found.after.problems, *found.notes):
        print(told(sentences))
    found.suite.save(folder / SUITE)
    files = [folder / SUITE, *write_page(folder, found, f"Calibration with {args.logs[0].name}")]
    contents = {
        **summary_of(found),
        "configuration": args,
        "versions": versions("numpy", "numba", "scipy", "pyulog"),
    }
    files.append(write_json(folder / RESULT, contents))
    print(f"\nWrote {len(files)} files to {folder}; open {folder / 'report.html'}.")
    if args.vehicle is not None:
        print(fit_body(args, found.suite, starts))
    print(f"{capital(found.verdict)}.")
    if found.after.problems:
        raise SystemExit(MISFIT)
    print(f"Next: {shlex.join(next_command(args, folder))}")

"""Run the filter on the log of a real flight: estimates, innovations, rejected measurements.

    quad-gym replay flight.csv
    quad-gym replay flight.csv --sensors rtk --smooth
    quad-gym replay flight.ulg --sensors consumer --estimator ekf --output results/replay/first
    quad-gym replay flight.csv --sensors rtk --estimator module:Class

A log is a CSV table, a log of PX4 or ArduPilot, a bag of ROS, or a folder in the format of EuRoC;
some require an extra, such as `pip install 'quad-gym[ulog]'`. docs/log-formats.md describes them.
Without --sensors, the sensors in the log choose a suite. The last lines are the verdict. The exit
code is 1 if units or axes are implausible, the suite's noise model does not fit the log, or the
filter was lost.
"""

import math
import sys
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, cast

import numpy as np
from tyro.conf import Positional, arg

from quad_gym.commands.options import (
    Keywords,
    LogSuite,
    heading_in_degrees,
    refuse_overwriting,
    usage_errors,
)

if TYPE_CHECKING:
    from quad_gym.estimation import Reading, Replay


# --------------------------------------------------------------------------------------------------
# Options and sentences of commands that read logs.
# --------------------------------------------------------------------------------------------------

MISFIT = 1  #: exit code if a suite does not describe a log, or the filter diverged or failed

LogFile = Positional[
    Annotated[
        Path,
        arg(
            metavar="LOG",
            help="table (.csv, .csv.gz), log of PX4 (.ulg) or ArduPilot (.bin), bag, EuRoC folder",
        ),
    ]
]
LogFiles = Positional[
    Annotated[
        tuple[Path, ...],
        arg(
            metavar="LOG [LOG ...]",
            help="logs in the formats of quad-gym replay",
            help_behavior_hint="(required)",
        ),
    ]
]


@dataclass(frozen=True, kw_only=True)
class ReadingArgs:
    """Options of commands that read logs."""

    body: Literal["flu", "frd"] = "flu"
    """axes of IMU and magnetometer in a table: forward, left, up; or forward, right, down"""
    instance: Keywords = field(default_factory=dict)
    """sensors to use where the log has several, such as magnetometer=1; defaults to those that
    the autopilot used or prefers, else those with the most valid data"""
    topic: Keywords = field(default_factory=dict)
    """topics of a ROS bag to use, such as imu=/mavros/imu/data_raw"""
    columns: Path | None = None
    """file (.toml) that maps the columns of a table to those of docs/log-formats.md"""
    from_: Annotated[float | None, arg(name="from")] = None
    """time at which to begin, in the log's clock [s]"""
    until: float | None = None
    """time at which to end [s]"""

    def reading(self) -> "Reading":
        """Return the options as keywords of `read_log`."""
        names = ("body", "instance", "topic", "columns", "from_", "until")
        return cast("Reading", {name: getattr(self, name) for name in names})

    def words(self) -> list[str]:
        """Return the options as words of a command line, as far as they are not the defaults."""
        found = ["--body", self.body] if self.body != "flu" else []
        for name in ("instance", "topic"):
            if pairs := getattr(self, name):
                found += [f"--{name}", *(f"{key}={value}" for key, value in pairs.items())]
        for name in ("columns", "from_", "until"):
            if (value := getattr(self, name)) is not None:
                found += [f"--{name.rstrip('_')}", str(value)]
        return found


def told(notes: Sequence[str]) -> str:
    """Format sentences on what was taken of a log and left out, a line each."""
    return "\n".join(f"{capital(note)}." for note in notes)


def capital(text: str) -> str:
    """Return a text with a capital first letter."""
    return f"{text[0].upper()}{text[1:]}"


# --------------------------------------------------------------------------------------------------
# Run the filter on the log of a real flight: estimates, innovations, rejected measurements.
# --------------------------------------------------------------------------------------------------

RESULT = "replay.json"


@dataclass(frozen=True)
class ReplayArgs(ReadingArgs):
    """Options of the replay."""

    log: LogFile
    sensors: LogSuite = None
    estimator: str = "ukf"
    """filter: ukf, ekf, or module:Class of a quad_gym.Estimator"""
    heading: float | None = None
    """heading of the body x axis at the start, from east toward north [deg]; by default from a
    baseline or a magnetometer, or else unknown"""
    heading_from_north: float | None = None
    """the same heading as a compass shows it, from north toward east [deg]"""
    start_position: tuple[float, float, float] | None = None
    """initial position east, north and up [m], level and at rest, with --heading; required for logs
    without GNSS"""
    course: bool = False
    """use the direction of the first GNSS velocity as heading, for vehicles that fly nose first"""
    window: float = 0.5
    """longest delay of measurements [s]"""
    reported_noise: bool = True
    """use the accuracy reported by the receiver, if the log contains it"""
    smooth: bool = False
    """write the smoothed trajectory as well"""
    samples: Path | None = None
    """file (.csv) to write the filter's inputs to, row by row, for the example of an exported
    filter"""
    figure: bool = True
    """draw a figure"""
    output: Path | None = None
    """folder for the results, created if it is missing; defaults to results/replay/LOG"""
    overwrite: bool = False
    """replace the results of an earlier replay"""


def folder_of(args: ReplayArgs) -> Path:
    """Check the output, and create its folder.

    Raises:
        ValueError: If results exist already, or options contradict each other.
        OSError: If the folder is not writable.
        ImportError: If matplotlib is missing.
    """
    from quad_gym.analysis.plots import require_matplotlib
    from quad_gym.analysis.reports import require_writable

    headings = (args.heading, args.heading_from_north)
    if sum(given is not None for given in headings) + args.course > 1:
        raise ValueError(
            "only one of --heading, --heading-from-north and --course must be given, as each is a "
            "heading: --heading counts from east toward north, --heading-from-north from north "
            "toward east; --heading must not be given with --course"
        )
    if args.start_position is not None and headings == (None, None):
        raise ValueError("--start-position must come with --heading or --heading-from-north")
    if args.smooth and ":" in args.estimator:
        raise ValueError("--smooth must not be given with an --estimator of your own")
    if args.figure:
        require_matplotlib()
    if args.samples is not None:
        refuse_overwriting(args.samples, args.overwrite)
        require_writable("--samples", args.samples.parent)
    folder = args.output or Path("results/replay") / args.log.stem
    refuse_overwriting(folder / RESULT, args.overwrite)
    require_writable("--output", folder)
    return folder


def start_of(args: ReplayArgs) -> dict[str, Any]:
    """Arguments for the start of the filter, from the options."""
    start: dict[str, Any] = {"course": True} if args.course else {}
    if args.heading is not None:
        start["heading"] = math.radians(heading_in_degrees("--heading", args.heading))
    if args.heading_from_north is not None:
        north = heading_in_degrees("--heading-from-north", args.heading_from_north)
        start["heading"] = math.radians(math.remainder(90.0 - north, 360.0))
    if args.start_position is not None:
        start["position"] = args.start_position
    return start


def report_of(result: "Replay") -> str:
    """Format a table of measurements, rejections and NIS, and the verdict."""
    from quad_gym.analysis.reports import text_table
    from quad_gym.logs.plots import sensors_of
    from quad_gym.logs.replaying.results import by_quantity

    rows = []
    for name, measured in sensors_of(result).items():
        nis = measured.nis[np.isfinite(measured.nis)]
        mean = f"{nis.mean() / measured.innovation.shape[1]:.2f}" if len(nis) else "-"
        rows.append((name, f"{len(measured.time)}", f"{int(measured.gated.sum())}", mean))
    heads = ["of", "count", "rejected", "NIS per degree of freedom"]
    table = text_table({"measurements": heads}, rows)
    lines = [f"{len(result)} IMU samples from {result.time[0]:.2f} s to {result.time[-1]:.2f} s."]
    taken = {each["taken"] for each in result.sources.values()} - {"table"}
    if taken:
        sources = (f"{name} {each['taken']}" for name, each in result.sources.items())
        lines.append(f"Read: {', '.join(sources)}.")
    if result.notes:
        lines.append(told(result.notes))
    if result.too_late:
        lines.append(f"Too late for the window: {result.too_late} measurements.")
    if result.unused:
        lines.append(f"Ignored (sensors not in the suite): {', '.join(result.unused)}.")
    return "\n".join([table, *lines, "", *map(capital, by_quantity(result.findings))])


def innovations_of(result: "Replay") -> dict[str, Any]:
    """Columns of all innovations, ordered by sensor."""
    found: dict[str, list[Any]] = {}
    for sensor, measured in result.measured.items():
        count = len(measured.time)
        found.setdefault("sensor", []).append(np.full(count, sensor, object))
        for name in ("time", "received", "innovation", "sigma", "nis", "gate"):
            values = getattr(measured, name)
            if values.ndim == 1:
                found.setdefault(name, []).append(values)
                continue
            wide = np.full((count, 3), np.nan)
            wide[:, : values.shape[1]] = values
            for i in range(3):
                found.setdefault(f"{name}_{i}", []).append(wide[:, i])
    return {name: np.concatenate(values) for name, values in found.items()}


def main(args: ReplayArgs) -> None:
    """Read, filter, draw and write."""
    from quad_gym.analysis.reports import versions, write_csv, write_json
    from quad_gym.estimation import read_log, replay, smooth
    from quad_gym.logs.replaying.measurements import MisfitError
    from quad_gym.logs.replaying.replay import suite_for
    from quad_gym.logs.replaying.results import ADVICE

    smoothed = None
    with usage_errors():
        folder = folder_of(args)
        options: dict[str, Any] = {
            "estimator": args.estimator,
            "start": start_of(args),
            "reported_noise": args.reported_noise,
        }
        try:
            log = read_log(args.log, **args.reading())
            suite, reason = (args.sensors, "") if args.sensors else suite_for(log)
            if reason:
                print(f"Suite: {suite}, as {reason}. --sensors chooses another.")
            options["sensors"] = suite
            result = replay(log, window=args.window, samples=args.samples, **options)
            if args.smooth:
                smoothed = smooth(log, **options)
        except MisfitError as error:
            print(f"error: {error}", file=sys.stderr)
            raise SystemExit(MISFIT) from None
    print(report_of(result))
    files = [write_csv(folder / "estimates.csv", result.columns())]
    files.append(write_csv(folder / "innovations.csv", innovations_of(result)))
    if smoothed is not None:
        files.append(write_csv(folder / "smoothed.csv", smoothed.columns()))
    if args.figure:
        from quad_gym.analysis.plots import house_style, save_figure
        from quad_gym.logs.plots import replay_figure

        with house_style():
            name = result.estimator.upper() if ":" not in args.estimator else result.estimator
            title = f"{args.log.name}, {name}, suite {suite}"
            files += save_figure(replay_figure(result, title), folder / "replay")
    found = {
        **result.summary(),
        "configuration": args,
        "sensors": result.sensors,
        **({} if smoothed is None else {"smoothed": smoothed.consistency()}),
        "versions": versions("numpy", "numba", "scipy", "pyulog"),
    }
    files.append(write_json(folder / RESULT, found))
    print(f"\nWrote {len(files)} files to {folder}.")
    print(f"\n{capital(result.verdict)}.")
    if result.problems:
        print(ADVICE)
        raise SystemExit(MISFIT)

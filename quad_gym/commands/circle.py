"""Reproduce the report's circle experiment: true state, and estimates with and without a camera.

    quad-gym circle
    quad-gym circle --episodes 100 --gains tuned --gnss-rate 10

A quadrotor starts at rest on the ground, below a point that moves on a horizontal circle, and a PD
controller tracks that point at every IMU sample. The controller receives either the true state or
the estimate of an unscented Kalman filter that fuses GNSS, IMU and camera. How much accuracy is
lost by flying on the estimate, and does the camera help? Flights with equal seeds have the same
noise and biases, so cases are compared flight by flight.

Prints a table, and writes figures (PNG and SVG), the numbers of every flight (flights.csv), and a
summary with the whole configuration (summary.json).
"""

import math
import textwrap
import time
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray
from tqdm import tqdm

from quad_gym import PDGains, SensorSuite, TaskParams, pd_gains, sensor_suite, vehicle_params
from quad_gym.analysis import plots
from quad_gym.analysis.metrics import (
    STATE_DIMENSION,
    PairedDifference,
    TrackingSummary,
    chi_square_quantile,
    paired_difference,
    spread,
)
from quad_gym.analysis.plots import require_matplotlib
from quad_gym.analysis.recording import Recording, record_flights
from quad_gym.analysis.reports import (
    require_writable,
    stacked,
    text_table,
    versions,
    write_csv,
    write_json,
)
from quad_gym.batch.flight_batch import FlightBatch
from quad_gym.commands.options import Threads, require_at_least, usage_errors
from quad_gym.records import Source

# --------------------------------------------------------------------------------------------------
# The report's circle, on the true state and on estimates, with and without the camera.
# --------------------------------------------------------------------------------------------------

TRUTH, ESTIMATE, NO_CAMERA = "truth", "estimate", "estimate_without_camera"
LABELS = {TRUTH: "truth", ESTIMATE: "estimate", NO_CAMERA: "estimate, no camera"}
NEES_TAIL = 0.001
"""Probability that the NEES of a consistent filter exceeds the bound in the table"""

Recordings = Mapping[str, Recording]  #: recordings by case


@dataclass(frozen=True, kw_only=True)
class Setup:
    """Setup of the experiment."""

    cases: dict[str, tuple[Source, SensorSuite]]
    gains: PDGains
    task: TaskParams
    seeds: range
    ticks: int
    threads: int | None
    output: Path

    def fly(self, case: str) -> Recording:
        """Fly and record all seeds of one case."""
        source, sensors = self.cases[case]
        given: dict[str, Any] = {"gains": self.gains, "task": self.task, "threads": self.threads}
        batch = FlightBatch(len(self.seeds), sensors=sensors, source=source, **given)
        bar = {"desc": f"{LABELS[case]:19}", "unit": " ticks"}
        return record_flights(batch, self.seeds, self.ticks, progress=lambda x: tqdm(x, **bar))


def error_table(results: Recordings) -> str:
    """Format a table of errors and endings of each case."""

    def cells(summary: TrackingSummary | None, done: NDArray[np.bool_]) -> list[str]:
        if summary is None or not done.any():
            return ["-", "-"]
        spreads = summary.spreads(done).values()
        return [f"{1e3 * s.mean:.1f} ± {1e3 * s.sd:.1f}".replace("nan", "-") for s in spreads]

    means = ["whole flight", "last half"]
    groups = {"": ["evaluated on"], "tracking error [mm]": means, "estimation error [mm]": means}
    rows = [
        [
            LABELS[case],
            *cells(flights.tracking, flights.finished),
            *cells(flights.estimation, flights.finished),
            str(flights.count(filter_failed=False)),
            str(flights.count(filter_failed=True)),
        ]
        for case, flights in results.items()
    ]
    return text_table({**groups, "ended early by": ["crash", "filter"]}, rows)


def consistency_table(results: Recordings) -> str:
    """Format a table of filter consistency."""
    bound, median = (chi_square_quantile(STATE_DIMENSION, p) for p in (1.0 - NEES_TAIL, 0.5))

    def cells(values: NDArray[Any]) -> list[str]:
        values = values[np.isfinite(values)]
        if not values.size:
            return ["-", "-"]
        return [f"{np.median(values):.1f}", f"{(values > bound).mean():.1%}"]

    estimated = {c: flights for c, flights in results.items() if flights.estimation is not None}
    rows = [
        [LABELS[case], *cells(flights.nees[0]), *cells(flights.nees_last_half)]
        for case, flights in estimated.items()
    ]
    columns = ["median", f"beyond {bound:.1f}"]
    first = next(iter(estimated.values())).nees_time[0]
    return text_table(
        {"": ["filter"], f"NEES at {first:g} s": columns, "NEES in the last half": columns},
        [*rows, ["(if consistent)", *2 * [f"{median:.1f}", f"{NEES_TAIL:.1%}"]]],
    )


def differences(results: Recordings) -> dict[tuple[str, str], PairedDifference]:
    """Differences of mean tracking errors of two cases, over flights completed in both [m]."""
    pairs = [(case, TRUTH) for case in results if case != TRUTH]
    pairs += [(ESTIMATE, NO_CAMERA)] if ESTIMATE in results else []
    found = {}
    for first, second in pairs:
        both = results[first].finished & results[second].finished
        errors = (results[case].tracking.mean[both] for case in (first, second))
        found[first, second] = paired_difference(*errors)
    return found


def in_words(results: Recordings, suite: SensorSuite) -> str:
    """Describe the effects of flying on the estimate, and of the camera."""
    found, seen = differences(results), ESTIMATE if ESTIMATE in results else NO_CAMERA
    sentences = [_sentence("Flying on the estimate", found[seen, TRUTH])]
    if seen == ESTIMATE:
        camera = found[ESTIMATE, NO_CAMERA]
        sentences.append(_sentence("Using the camera", camera))
        harmful = camera.significant and camera.spread.mean > 0.0
        if harmful and suite.estimator.bearing_noise_at == "measured":
            sentences.append(
                "The report's model of camera noise makes the filter overconfident, as the NEES "
                "shows; compare with --bearing-noise-at predicted."
            )
    return "\n".join(
        textwrap.fill(text, 98, subsequent_indent="  ", break_on_hyphens=False)
        for text in sentences
    )


def _sentence(what: str, found: PairedDifference) -> str:
    """Describe a difference of mean tracking errors."""
    if found.interval is None:
        return f"{what}: too few flights were completed in both cases for a comparison."
    low, high, mean = (1e3 * x for x in (*found.interval, found.spread.mean))
    change = f"adds {mean:.2f} mm to" if mean > 0.0 else f"subtracts {-mean:.2f} mm from"
    if not found.significant:
        change = "makes no significant difference to"
    return (
        f"{what} {change} the mean tracking error ({found.spread.count:,} pairs, both completed; "
        f"95 % interval {low:+.2f} to {high:+.2f} mm, median {1e3 * found.spread.median:+.2f} mm)."
    )


def write_figures(results: Recordings, setup: Setup) -> list[Path]:
    """Write the figures of the report, and an overview."""
    traces, bands = zip(*((each.trace, each.band) for each in results.values()), strict=True)
    look: dict[str, Any] = {"label": f"seed {setup.seeds[0]}"}
    limits, figures = plots.error_limits(traces, bands), {}
    for case, flights in results.items():
        name, trace = f"evaluated on the {LABELS[case]}", flights.trace
        if case != TRUTH:
            title = f"Path from above, {name}"
            figures[f"path_{case}"] = plots.flight_figure(plots.draw_path, trace, title=title)
            title = f"Height, {name}"
            figures[f"height_{case}"] = plots.flight_figure(plots.draw_height, trace, title=title)
        figures[f"error_{case}"] = plots.flight_figure(
            plots.draw_error, trace, flights.band, title=f"Error, {name}", limits=limits, **look
        )
    seen = ESTIMATE if ESTIMATE in results else NO_CAMERA
    errors = {
        f"Error, evaluated on the {LABELS[case]}": (results[case].trace, results[case].band)
        for case in (seen, TRUTH)
    }
    title = f"Path from above, evaluated on the {LABELS[seen]}"
    figures["overview"] = plots.overview_figure(results[seen].trace, errors, title=title, **look)
    saved = (plots.save_figure(figure, setup.output / name) for name, figure in figures.items())
    return [file for pair in saved for file in pair]


def write_numbers(results: Recordings, setup: Setup, seconds: float, arguments: Any) -> list[Path]:
    """Write a summary of results and configuration, and one row per case and seed."""
    cases, tables = {}, []
    for case, flights in results.items():
        done, nothing = flights.finished, np.full(len(setup.seeds), np.nan)
        estimation = flights.estimation or TrackingSummary(nothing, nothing)
        columns: dict[str, Any] = {"case": [case] * len(setup.seeds), "seed": setup.seeds}
        for name, errors in (("tracking", flights.tracking), ("estimation", estimation)):
            columns |= {f"{name}_error_{k}_m": values for k, values in vars(errors).items()}
        ended = {"ending": flights.ending_names(), "ended_at_s": flights.ended_at}
        tables.append({**columns, **ended})
        cases[case] = {
            "finished": done.sum(),
            "crashed": flights.count(filter_failed=False),
            "filter_failed": flights.count(filter_failed=True),
            "tracking_error": flights.tracking.spreads(done),
        }
        if flights.estimation:
            cases[case]["estimation_error"] = estimation.spreads(done)
            cases[case]["nees_last_half"] = spread(flights.nees_last_half)
    summary = {
        "units": {"errors": "m", "nees": f"none; mean {STATE_DIMENSION} if consistent"},
        "cases": cases,
        "paired_differences_of_mean_tracking_error": {
            " - ".join(pair): found for pair, found in differences(results).items()
        },
        "seeds": {"first": setup.seeds[0], "count": len(setup.seeds)},
        "seconds_taken": seconds,
        "configuration": {
            "arguments": arguments,
            "vehicle": vehicle_params("lab"),
            "gains": setup.gains,
            "task": setup.task,
            "sensors": {case: sensors for case, (_, sensors) in setup.cases.items()},
        },
        "versions": versions("numpy", "scipy", "numba", "matplotlib"),
    }
    return [
        write_json(setup.output / "summary.json", summary),
        write_csv(setup.output / "flights.csv", stacked(tables)),
    ]


# --------------------------------------------------------------------------------------------------
# Reproduce the report's circle experiment: true state, and estimates with and without a camera.
# --------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class CircleArgs:
    """Options of the experiment."""

    episodes: int = 1000
    """number of flights in each case"""
    seed: int = 0
    """seed of the first flight; the others have consecutive seeds"""
    duration: float = 10.0
    """length of a flight [s]"""
    output: Path = Path("results/circle")
    """folder for figures and numbers, created if it is missing; earlier ones there are replaced"""
    threads: Threads = None

    radius: float = 4.0
    """radius of the circle [m]"""
    period: float = 10.0
    """time for one lap [s]"""
    height: float = 1.0
    """height of the circle above the start [m]"""

    gains: Literal["lab", "tuned"] = "lab"
    """gains of the report, or gains tuned for the smallest error"""

    camera: bool = True
    """include the case with the camera"""
    gnss_rate: float | None = None
    """rate of GNSS fixes [Hz]; defaults to the IMU rate"""
    estimator: Literal["ukf", "ekf"] = "ukf"
    """filter: ukf, the report's, or ekf"""
    bearing_noise_at: Literal["measured", "predicted"] = "measured"
    """direction to which the filter assumes camera noise is perpendicular: measured, as in the
    report, makes it overconfident; predicted hardly does"""


def configure(args: CircleArgs) -> Setup:
    """Check all options before the flights."""
    require_at_least(args, episodes=1, seed=0, threads=1)
    task = TaskParams(
        kind="circle",
        start="ground",
        pad=False,  # the report has none
        radius=args.radius,
        period=args.period,
        height=args.height,
        duration=0.0,
        out_of_bounds=3.0 + args.height,  # do not count the climb from the ground as a crash
    )
    suite = sensor_suite("lab").with_rates(gnss=args.gnss_rate)
    estimator = suite.estimator.replace(kind=args.estimator, bearing_noise_at=args.bearing_noise_at)
    suite = suite.replace(estimator=estimator)
    cases = {TRUTH: (Source.TRUTH, suite)}
    if args.camera:
        cases[ESTIMATE] = (Source.ESTIMATE, suite)
    cases[NO_CAMERA] = (Source.ESTIMATE, suite.replace(camera=None))
    if not (math.isfinite(args.duration) and args.duration * suite.imu.rate >= 2.0):
        raise ValueError(
            f"--duration must be at least {2.0 / suite.imu.rate:g} s, two IMU samples, "
            f"got {args.duration:g} s"
        )
    require_matplotlib()
    require_writable("--output", args.output)
    return Setup(
        cases=cases,
        gains=pd_gains(args.gains),
        task=task,
        seeds=range(args.seed, args.seed + args.episodes),
        ticks=round(args.duration * suite.imu.rate),
        threads=args.threads,
        output=args.output,
    )


def main(args: CircleArgs) -> None:
    """Run the experiment."""
    with usage_errors():
        setup = configure(args)
    print(
        f"Circle of radius {args.radius:g} m, period {args.period:g} s, height {args.height:g} m; "
        f"{args.episodes:,} flights of {args.duration:g} s per case, from seed {args.seed}.\n"
    )
    began = time.perf_counter()
    results = {case: setup.fly(case) for case in setup.cases}
    seconds = time.perf_counter() - began
    print(error_table(results))
    print("Mean ± standard deviation over the flights that did not end early (survivors).\n")
    print(consistency_table(results), end="\n\n")
    print(in_words(results, setup.cases[TRUTH][1]), end="\n\n")
    written = write_numbers(results, setup, seconds, args)
    written += write_figures(results, setup)
    print(f"Wrote {len(written)} files to {setup.output} after {seconds:.1f} s.")

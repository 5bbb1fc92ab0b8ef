"""Fly the report's circle on the true state, and on estimates with and without the camera.

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
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from quad_gym import PDGains, SensorSuite, TaskParams, pd_gains, sensor_suite, vehicle_params
from quad_gym.analysis import plots
from quad_gym.analysis.intervals import PairedDifference, paired_difference
from quad_gym.analysis.metrics import (
    STATE_DIMENSION,
    TrackingSummary,
    chi_square_quantile,
    spread,
)
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

TRUTH, ESTIMATE, NO_CAMERA = "truth", "estimate", "estimate_without_camera"
LABELS = {TRUTH: "truth", ESTIMATE: "estimate", NO_CAMERA: "estimate, no camera"}
NEES_TAIL = 0.001  # probability that the NEES of a consistent filter exceeds the bound in the table


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
    """folder for figures and numbers, created if it is missing"""
    threads: Threads = None

    radius: float = 4.0
    """radius of the circle [m]"""
    period: float = 10.0
    """time for one lap [s]"""
    height: float = 1.0
    """height of the circle above the start [m]"""

    gains: Literal["lab", "tuned"] = "lab"
    """gains of the report, or gains tuned for the smallest error"""
    position_gain: float | None = None
    """position gain k, overrides --gains [N/m]"""
    velocity_gain: float | None = None
    """velocity gain kd, overrides --gains [N s/m]"""
    attitude_gain: tuple[float, float, float] | None = None
    """diagonal of the attitude gain K, overrides --gains [N m]"""
    body_rates_gain: tuple[float, float, float] | None = None
    """diagonal of the body rate gain Kd, overrides --gains [N m s]"""

    camera: bool = True
    """include the case with the camera"""
    imu_rate: float = 200.0
    """rate of the IMU, the filter and the controller [Hz]"""
    gnss_rate: float | None = None
    """rate of GNSS fixes [Hz]; if not given, the IMU rate"""
    camera_rate: float | None = None
    """rate of camera images [Hz]; if not given, the IMU rate"""
    bearing_noise_at: Literal["measured", "predicted"] = "measured"
    """direction to which the filter assumes camera noise is perpendicular: measured, as in the
    report, makes it overconfident; predicted hardly does"""


@dataclass(frozen=True)
class Setup:
    """Setup of the experiment that the options select."""

    cases: dict[str, tuple[Source, SensorSuite]]
    gains: PDGains
    task: TaskParams
    seeds: range
    ticks: int
    threads: int | None
    output: Path


def configure(args: CircleArgs) -> Setup:
    """Check all options before the flights."""
    require_at_least(args, episodes=1, seed=0, threads=1)
    if args.camera_rate is not None and not args.camera:
        raise ValueError("--camera-rate has no effect with --no-camera")
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
    wanted = {
        "position": args.position_gain,
        "velocity": args.velocity_gain,
        "attitude": args.attitude_gain,
        "body_rates": args.body_rates_gain,
    }
    gains = pd_gains(args.gains).replace(**{k: v for k, v in wanted.items() if v is not None})
    suite = sensor_suite("lab").with_rates(
        imu=args.imu_rate, gnss=args.gnss_rate, camera=args.camera_rate
    )
    estimator = suite.estimator.replace(bearing_noise_at=args.bearing_noise_at)
    suite = suite.replace(estimator=estimator)
    cases = {TRUTH: (Source.TRUTH, suite), ESTIMATE: (Source.ESTIMATE, suite)}
    cases[NO_CAMERA] = (Source.ESTIMATE, suite.replace(camera=None))
    if not args.camera:
        del cases[ESTIMATE]
    if not (math.isfinite(args.duration) and args.duration * suite.imu.rate >= 2.0):
        raise ValueError(
            f"--duration must be at least {2.0 / suite.imu.rate:g} s, two IMU samples, "
            f"got {args.duration:g} s"
        )
    plots.require_matplotlib()
    import tqdm  # noqa: F401

    require_writable("--output", args.output)
    return Setup(
        cases=cases,
        gains=gains,
        task=task,
        seeds=range(args.seed, args.seed + args.episodes),
        ticks=round(args.duration * suite.imu.rate),
        threads=args.threads,
        output=args.output,
    )


def fly(case: str, setup: Setup) -> Recording:
    """Fly and record all seeds of one case."""
    from tqdm import tqdm

    source, sensors = setup.cases[case]
    batch = FlightBatch(
        len(setup.seeds),
        sensors=sensors,
        gains=setup.gains,
        task=setup.task,
        source=source,
        threads=setup.threads,
    )
    return record_flights(
        batch,
        setup.seeds,
        setup.ticks,
        progress=lambda ticks: tqdm(ticks, desc=f"{LABELS[case]:19}", unit=" ticks"),
    )


def error_table(results: dict[str, Recording]) -> str:
    """Format a table of errors and endings of each case."""

    def cells(summary: TrackingSummary | None, done: NDArray[np.bool_]) -> list[str]:
        if summary is None or not done.any():
            return ["-", "-"]
        return [
            f"{1e3 * s.mean:.1f} ± {'-' if math.isnan(s.sd) else f'{1e3 * s.sd:.1f}'}"
            for s in summary.spreads(done).values()
        ]

    means = ["whole flight", "last half"]
    return text_table(
        {
            "": ["flown on the"],
            "tracking error [mm]": means,
            "estimation error [mm]": means,
            "ended early by": ["crash", "filter"],
        },
        [
            [
                LABELS[case],
                *cells(flights.tracking, flights.finished),
                *cells(flights.estimation, flights.finished),
                str(flights.count(filter_failed=False)),
                str(flights.count(filter_failed=True)),
            ]
            for case, flights in results.items()
        ],
    )


def consistency_table(results: dict[str, Recording]) -> str:
    """Format a table of filter consistency."""
    bound = chi_square_quantile(STATE_DIMENSION, 1.0 - NEES_TAIL)
    median = chi_square_quantile(STATE_DIMENSION, 0.5)

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


def in_words(results: dict[str, Recording], args: CircleArgs) -> str:
    """Describe the effects of flying on the estimate, and of the camera."""
    seen = ESTIMATE if args.camera else NO_CAMERA
    sentences = [in_a_sentence("Flying on the estimate", compare(results, seen, TRUTH))]
    if args.camera:
        found = compare(results, ESTIMATE, NO_CAMERA)
        sentences.append(in_a_sentence("Having the camera", found))
        harmful = found.significant and found.spread.mean > 0.0
        if harmful and args.bearing_noise_at == "measured":
            sentences.append(
                "The report's model of camera noise makes the filter overconfident, as the NEES "
                "shows; compare with --bearing-noise-at predicted."
            )
    return "\n".join(
        textwrap.fill(text, 98, subsequent_indent="  ", break_on_hyphens=False)
        for text in sentences
    )


def compare(results: dict[str, Recording], first: str, second: str) -> PairedDifference:
    """Difference of the mean tracking errors of two cases over flights completed in both [m]."""
    both = results[first].finished & results[second].finished
    return paired_difference(
        results[first].tracking.mean[both], results[second].tracking.mean[both]
    )


def in_a_sentence(what: str, found: PairedDifference) -> str:
    """Describe a difference of mean tracking errors in one sentence."""
    if found.interval is None:
        return f"{what}: too few flights were completed in both cases for a comparison."
    low, high, mean = (1e3 * x for x in (*found.interval, found.spread.mean))
    change = f"adds {mean:.2f} mm to" if mean > 0.0 else f"subtracts {-mean:.2f} mm from"
    verdict = f"{change} the mean tracking error"
    if not found.significant:
        verdict = "makes no significant difference to the mean tracking error"
    return (
        f"{what} {verdict} ({found.spread.count:,} pairs of flights; 95 % interval {low:+.2f} to "
        f"{high:+.2f} mm, median {1e3 * found.spread.median:+.2f} mm)."
    )


def write_figures(results: dict[str, Recording], setup: Setup) -> list[Path]:
    """Write the figures of the report, and an overview."""
    limits = plots.error_limits(
        [flights.trace for flights in results.values()],
        [flights.band for flights in results.values()],
    )
    label = f"seed {setup.seeds[0]}"
    figures: dict[str, Any] = {}
    for case, flights in results.items():
        name, trace = f"flown on the {LABELS[case]}", flights.trace
        if case != TRUTH:
            figures[f"path_{case}"] = plots.path_figure(trace, f"Path from above, {name}")
            figures[f"height_{case}"] = plots.height_figure(trace, f"Height, {name}")
        figures[f"error_{case}"] = plots.error_figure(
            trace, flights.band, f"Error, {name}", label=label, limits=limits
        )
    seen = ESTIMATE if ESTIMATE in results else NO_CAMERA
    errors = {
        f"Error, flown on the {LABELS[case]}": (results[case].trace, results[case].band)
        for case in (seen, TRUTH)
    }
    figures["overview"] = plots.overview_figure(
        results[seen].trace,
        errors,
        title=f"Path from above, flown on the {LABELS[seen]}",
        label=label,
    )
    saved = [plots.save_figure(figure, setup.output / name) for name, figure in figures.items()]
    return [file for pair in saved for file in pair]


def write_numbers(results: dict[str, Recording], setup: Setup) -> Path:
    """Write one row per case and seed."""
    tables = []
    for case, flights in results.items():
        nothing = np.full(len(setup.seeds), np.nan)
        estimation = flights.estimation or TrackingSummary(nothing, nothing)
        table = {
            "case": [case] * len(setup.seeds),
            "seed": setup.seeds,
            "tracking_error_mean_m": flights.tracking.mean,
            "tracking_error_last_half_m": flights.tracking.last_half,
            "estimation_error_mean_m": estimation.mean,
            "estimation_error_last_half_m": estimation.last_half,
            "ending": flights.ending_names(),
            "ended_at_s": flights.ended_at,
        }
        tables.append(table)
    return write_csv(setup.output / "flights.csv", stacked(tables))


def summary_of(
    results: dict[str, Recording], setup: Setup, args: CircleArgs, seconds: float
) -> dict[str, Any]:
    """Summary of all results and the configuration."""
    cases: dict[str, dict[str, Any]] = {}
    for case, flights in results.items():
        done, estimated = flights.finished, flights.estimation
        cases[case] = {
            "finished": done.sum(),
            "crashed": flights.count(filter_failed=False),
            "filter_failed": flights.count(filter_failed=True),
            "tracking_error": flights.tracking.spreads(done),
        }
        if estimated:
            cases[case]["estimation_error"] = estimated.spreads(done)
            cases[case]["nees_last_half"] = spread(flights.nees_last_half)
    pairs = [(case, TRUTH) for case in results if case != TRUTH]
    pairs += [(ESTIMATE, NO_CAMERA)] if ESTIMATE in results else []
    return {
        "units": {"errors": "m", "nees": f"none; mean {STATE_DIMENSION} if consistent"},
        "cases": cases,
        "paired_differences_of_mean_tracking_error": {
            f"{first} - {second}": compare(results, first, second) for first, second in pairs
        },
        "seeds": {"first": setup.seeds[0], "count": len(setup.seeds)},
        "seconds_taken": seconds,
        "configuration": {
            "arguments": args,
            "vehicle": vehicle_params("lab"),
            "gains": setup.gains,
            "task": setup.task,
            "sensors": {case: sensors for case, (_, sensors) in setup.cases.items()},
        },
        "versions": versions("numpy", "scipy", "numba", "matplotlib"),
    }


def main(args: CircleArgs) -> None:
    """Run the experiment."""
    with usage_errors():
        setup = configure(args)
    print(
        f"Circle of radius {args.radius:g} m, period {args.period:g} s, height {args.height:g} m; "
        f"{args.episodes:,} flights of {args.duration:g} s per case, from seed {args.seed}.\n"
    )
    began = time.perf_counter()
    results = {case: fly(case, setup) for case in setup.cases}
    seconds = time.perf_counter() - began

    print(error_table(results))
    print("Mean ± standard deviation over the flights that did not end early.\n")
    print(consistency_table(results), end="\n\n")
    print(in_words(results, args), end="\n\n")

    summary = summary_of(results, setup, args, seconds)
    written = [write_json(setup.output / "summary.json", summary), write_numbers(results, setup)]
    written += write_figures(results, setup)
    print(f"Wrote {len(written)} files to {setup.output} after {seconds:.1f} s.")

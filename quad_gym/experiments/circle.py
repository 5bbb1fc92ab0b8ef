"""The report's circle, on the true state and on estimates, with and without the camera."""

import textwrap
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from tqdm import tqdm

from quad_gym import PDGains, SensorSuite, TaskParams, vehicle_params
from quad_gym.analysis import plots
from quad_gym.analysis.intervals import PairedDifference, paired_difference
from quad_gym.analysis.metrics import STATE_DIMENSION, TrackingSummary, chi_square_quantile, spread
from quad_gym.analysis.recording import Recording, record_flights
from quad_gym.analysis.reports import stacked, text_table, versions, write_csv, write_json
from quad_gym.batch.flight_batch import FlightBatch
from quad_gym.records import Source

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

"""What a comparison found: as a table, in words, in figures, and as a page."""

import base64
import html
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from quad_gym.analysis import plots
from quad_gym.analysis.comparison_plots import (
    error_over_time_figure,
    learning_figure,
    matrix_figure,
    paths_figure,
)
from quad_gym.analysis.intervals import mean_interval, paired_difference
from quad_gym.analysis.metrics import Interval
from quad_gym.analysis.reports import text_table
from quad_gym.experiments.compare_flights import Floats, Flown
from quad_gym.params.suites import contents_of_suite_files, suite_label

NAMES = {
    "PD": "PD, tuned",
    "truth": "trained on truth",
    "noisy": "trained on truth with noise",
    "estimate": "trained on the estimate",
}
_ENGINES = {"sb3": "Stable-Baselines3", "compiled": "the compiled engine"}
MANY_CRASHES = 0.01
"""Share of episodes beyond which errors of those that crashed distort the mean."""
ONE_SEED = (
    "One training seed proves nothing: another seed may turn any of these differences round. "
    "Run with five for intervals."
)


@dataclass(frozen=True, eq=False)
class Setting:
    """What is compared."""

    env_id: str
    algorithm: str
    engine: str
    steps: int
    suites: tuple[str, ...]
    sources: tuple[str, ...]
    seeds: tuple[int, ...]
    episodes: int
    first_episode: int
    environment: Mapping[str, Any]
    plans: Mapping[Any, Any]
    """by suite, source and seed"""
    folder: Path

    def run_folder(self, key: Any) -> Path:
        """Where a training, or PD, is kept."""
        suite, source, seed = key
        place = self.folder / "runs" / suite_label(suite) / source
        return place if seed is None else place / f"seed_{seed}"

    def description(self) -> dict[str, Any]:
        """Everything that the results depend on."""
        some = next(iter(self.plans.values()))
        return {
            "env_id": self.env_id,
            "engine": self.engine,
            "recipe": some.recipe,
            "sensors": self.suites,
            "trained_on": self.sources,
            "training_seeds": self.seeds,
            "episodes": self.episodes,
            "first_episode": self.first_episode,
            "environment": self.environment,
            **contents_of_suite_files(*self.suites),
        }


@dataclass(frozen=True)
class Cell:
    """A row's policies flown on a column's observation; one number per training seed."""

    errors: Floats
    late_errors: Floats
    crash_rates: Floats
    interval: Interval | None
    """of the mean error, 95 % by Student's t: over training seeds, or for PD over episodes; None
    for a single seed"""

    def text(self) -> str:
        """For people: millimeters, and the crashes."""
        mean = 1e3 * float(np.mean(self.errors))
        text = f"{mean:.1f}"
        if self.interval is not None:
            text += f" [{1e3 * self.interval.low:.1f}, {1e3 * self.interval.high:.1f}]"
        return text

    def description(self) -> dict[str, Any]:
        """For JSON."""
        return {
            "mean_error": float(np.mean(self.errors)),
            "interval_95": self.interval,
            "late_error": float(np.mean(self.late_errors)),
            "crash_rate": float(np.mean(self.crash_rates)),
            "mean_error_of_each_seed": self.errors,
        }


@dataclass(frozen=True, eq=False)
class Comparison:
    """All flights of a comparison."""

    setting: Setting
    flown: Mapping[Any, Flown]
    """by suite, what was trained on (or "PD"), seed (PD: None) and what was flown on"""
    curves: Mapping[Any, tuple[Floats, Floats]]
    """steps and mean errors while training, by suite, source and seed"""

    def flights(self, suite: str, source: str, observation: str) -> list[Flown]:
        """The flights of each training seed."""
        seeds = (None,) if source == "PD" else self.setting.seeds
        return [self.flown[suite, source, seed, observation] for seed in seeds]

    def cell(self, suite: str, source: str, observation: str) -> Cell:
        """A cell of the matrix."""
        flights = self.flights(suite, source, observation)
        errors = np.array([f.mean_error for f in flights])
        sample = flights[0].episodes.mean_error if source == "PD" else errors
        return Cell(
            errors,
            np.array([f.late_error for f in flights]),
            np.array([f.crash_rate for f in flights]),
            mean_interval(sample) if len(sample) > 1 else None,
        )


def rows_of(comparison: Comparison) -> tuple[str, ...]:
    """What the matrix has a row for."""
    return ("PD", *comparison.setting.sources)


def matrix_text(comparison: Comparison, suite: str) -> str:
    """The matrix of a sensor suite, for the screen."""
    rows = []
    for source in rows_of(comparison):
        cells = [comparison.cell(suite, source, on) for on in ("truth", "estimate")]
        rows.append(
            [
                NAMES[source],
                *[cell.text() for cell in cells],
                *[f"{1e3 * float(np.mean(cell.late_errors)):.1f}" for cell in cells],
                *[f"{float(np.mean(cell.crash_rates)):.1%}" for cell in cells],
            ]
        )
    flown = ["on truth", "on estimate"]
    groups = {"": ["policy"], "mean error [mm]": flown, "second half [mm]": flown, "crashed": flown}
    return text_table(groups, rows)


def conclusions(comparison: Comparison) -> list[str]:
    """What can be concluded from the intervals, and what cannot."""
    setting = comparison.setting
    sentences = []
    for suite in setting.suites:
        for first, second in _questions(setting.sources):
            cells = [comparison.cell(suite, way.source, way.observation) for way in (first, second)]
            if max(float(cell.crash_rates.max()) for cell in cells) > MANY_CRASHES:
                continue  # errors of episodes that crashed end with them, and do not compare
            # PD has no training seed: its one number stands beside each
            errors = [np.resize(cell.errors, len(setting.seeds)) for cell in cells]
            text = _sentence(first.name, second.name, *errors)
            both = " Both flown on the estimate." if second.observation == "estimate" else ""
            sentences.append(f"Sensors {suite}: {text}{both}")
        for source in rows_of(comparison):
            share = float(comparison.cell(suite, source, "estimate").crash_rates.max())
            if share > MANY_CRASHES:
                sentences.append(
                    f"Sensors {suite}: {NAMES[source]}, up to {share:.0%} of the episodes crashed "
                    "on the estimate, so that the errors are not compared."
                )
    if len(setting.seeds) == 1:
        sentences.append(ONE_SEED)
    return sentences


class _Way(NamedTuple):
    """A cell of the matrix, as sentences call it."""

    name: str
    source: str
    observation: str


def _questions(sources: Sequence[str]) -> list[tuple[_Way, _Way]]:
    """The pairs of cells that answer what a comparison asks."""
    ours = _Way("training on the estimate", "estimate", "estimate")
    pairs = [
        (
            _Way("flying on the estimate", "truth", "estimate"),
            _Way("on the truth", "truth", "truth"),
        ),
        (ours, _Way("training on the truth", "truth", "estimate")),
        (ours, _Way("training on the noisy truth", "noisy", "estimate")),
        (ours, _Way("tuned PD control", "PD", "estimate")),
    ]
    known = {*sources, "PD"}
    return [pair for pair in pairs if all(way.source in known for way in pair)]


def _sentence(first: str, second: str, errors: Floats, others: Floats) -> str:
    """How two ways differ in their mean error, with an interval over training seeds."""
    found = paired_difference(errors, others)
    change, relative = 1e3 * found.spread.mean, found.spread.mean / float(np.mean(others))
    more = f"{abs(change):.2f} mm ({abs(relative):.0%}) {'more' if change > 0.0 else 'less'}"
    if found.interval is None:
        return f"{first} gave {more} error than {second}, with this one seed."
    low, high = (1e3 * x for x in found.interval)
    span = f"{found.spread.count} seeds, 95 % interval {low:+.2f} to {high:+.2f} mm"
    if not found.significant:
        return f"{first} and {second} cannot be told apart ({span})."
    return f"{first} gives {more} error than {second} ({span})."


def write_figures(comparison: Comparison) -> dict[str, list[Path]]:
    """Learning curves, matrices, errors over time, paths; the files of each."""
    setting = comparison.setting
    figures: dict[str, Any] = {}
    for suite in setting.suites:
        sources, label = rows_of(comparison), suite_label(suite)
        curves = {
            NAMES[s]: [
                (x[1:] / 1e6, y[1:])
                for x, y in (comparison.curves[suite, s, k] for k in setting.seeds)
            ]
            for s in setting.sources
        }
        level = {"PD, tuned, on the estimate": comparison.cell(suite, "PD", "estimate").errors[0]}
        title = f"Evaluated on what is trained on, sensors {suite}"
        figures[f"learning_{label}"] = learning_figure(curves, level, title)
        cells = [[comparison.cell(suite, s, on) for on in ("truth", "estimate")] for s in sources]
        figures[f"matrix_{label}"] = matrix_figure(
            np.array([[float(np.mean(cell.errors)) for cell in row] for row in cells]),
            [[cell.text() for cell in row] for row in cells],
            [NAMES[s] for s in sources],
            ["flown on truth", "flown on the estimate"],
            f"Mean position error [mm], sensors {suite}",
        )
        first = {NAMES[s]: comparison.flights(suite, s, "estimate")[0] for s in sources}
        figures[f"errors_{label}"] = error_over_time_figure(
            {name: (f.time, f.percentiles) for name, f in first.items()},
            f"Flown on the estimate, first training seed, sensors {suite}",
        )
        figures[f"paths_{label}"] = paths_figure(
            {name: f.trace for name, f in first.items()},
            f"From above, flown on the estimate, sensors {suite}",
        )
    return {name: plots.save_figure(f, setting.folder / name) for name, f in figures.items()}


_STYLE = """
body { font: 16px/1.5 system-ui, sans-serif; color: #222; max-width: 60rem; margin: 2rem auto;
  padding: 0 1rem; }
table { border-collapse: collapse; margin: 1rem 0; }
th, td { padding: .3rem .8rem; text-align: right; border-bottom: 1px solid #ddd; }
th:first-child, td:first-child { text-align: left; }
figure { margin: 1.5rem 0; } img { max-width: 100%; } figcaption { color: #666; }
pre { background: #f6f6f6; padding: 1rem; overflow-x: auto; }
"""

_CAPTIONS = {
    "learning": "How the error falls while training; thin lines are single seeds.",
    "matrix": "Mean error over whole episodes, with the 95 % interval over training seeds "
    "(Student's t); for PD, over episodes.",
    "errors": "Error over time: median and middle nine tenths of the episodes.",
    "paths": "The first episode of the first training seed.",
}


def write_page(
    comparison: Comparison, figures: Mapping[str, Sequence[Path]], seconds: float
) -> Path:
    """A page with all that was found, figures within, that needs no network."""
    setting = comparison.setting
    parts = [
        f"<h1>{html.escape(setting.env_id)}: what the estimate costs</h1>",
        f"<p>{html.escape(setting.algorithm.upper())} ({_ENGINES[setting.engine]}), "
        f"{setting.steps:,} steps for each of "
        f"{len(setting.plans)} policies, training seeds {', '.join(map(str, setting.seeds))}; "
        f"{seconds / 60:.1f} minutes of training. Each policy flew {setting.episodes:,} episodes "
        "on the truth and on the estimate.</p>",
        "<h2>What this allows one to conclude</h2><ul>",
        *[f"<li>{html.escape(sentence)}</li>" for sentence in conclusions(comparison)],
        "</ul>",
    ]
    for suite in setting.suites:
        parts.append(f"<h2>Sensors {html.escape(suite)}</h2>{_table(comparison, suite)}")
        for name, files in figures.items():
            kind, _, of = name.partition("_")
            if of == suite_label(suite):
                data = base64.b64encode(files[0].read_bytes()).decode()
                parts.append(
                    f'<figure><img alt="{html.escape(_CAPTIONS[kind])}" '
                    f'src="data:image/png;base64,{data}"><figcaption>'
                    f"{html.escape(_CAPTIONS[kind])}</figcaption></figure>"
                )
    page = (
        '<!doctype html><html lang="en"><head><meta charset="utf-8">'
        f"<title>{html.escape(setting.env_id)}</title><style>{_STYLE}</style></head><body>"
        + "\n".join(parts)
        + "</body></html>\n"
    )
    file = setting.folder / "report.html"
    file.write_text(page, encoding="utf-8")
    return file


def _table(comparison: Comparison, suite: str) -> str:
    headings = ["policy"]
    shown = ("error", "second half", "crashed")
    headings += [f"{what} on {on}" for what in shown for on in ("truth", "estimate")]
    lines = []
    for source in rows_of(comparison):
        cells = [comparison.cell(suite, source, on) for on in ("truth", "estimate")]
        texts = [NAMES[source], *[f"{cell.text()} mm" for cell in cells]]
        texts += [f"{1e3 * float(np.mean(cell.late_errors)):.1f} mm" for cell in cells]
        texts += [f"{float(np.mean(cell.crash_rates)):.1%}" for cell in cells]
        lines.append("".join(f"<td>{html.escape(text)}</td>" for text in texts))
    head = "".join(f"<th>{html.escape(text)}</th>" for text in headings)
    return f"<table><tr>{head}</tr>" + "".join(f"<tr>{line}</tr>" for line in lines) + "</table>"

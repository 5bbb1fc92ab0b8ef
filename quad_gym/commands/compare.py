"""Measure the cost of flying on the estimate and the benefit of training on it.

    quad-gym compare                         # the circle, 5 seeds
    quad-gym compare --quick                 # one seed, a few minutes
    quad-gym compare --sensors lab rtk --seeds 5
    quad-gym compare --engine compiled       # several times faster, and without torch

For every seed, PPO is trained on the true state, on the true state with independent noise (the
sensor noise of other packages), and on the filter's estimate. Each policy then flies the same
episodes on the truth and on the estimate, and so does PD control with tuned gains. Prints the
matrix of tracking errors and crash rates with 95 % intervals, and conclusions, and writes figures,
numbers and a report (report.html) that opens without a network.

An interrupted comparison continues where it stopped when it is started again.
"""

import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from itertools import product
from pathlib import Path
from typing import Any, Literal

import numpy as np

from baselines.recipes import Plan, Recipe, first_seed
from quad_gym import IDS
from quad_gym.analysis import plots
from quad_gym.analysis.metrics import Interval, in_brackets, mean_interval, paired_difference
from quad_gym.analysis.reports import (
    Report,
    columns_of,
    require_writable,
    text_table,
    versions,
    write_csv,
    write_json,
)
from quad_gym.batch.threads import resolve_threads
from quad_gym.commands import options
from quad_gym.envs.config import with_effect
from quad_gym.experiments import Experiment, Floats, Flown, Trial, train_all
from quad_gym.params import checks as check
from quad_gym.params.suites import contents_of_suite_files, suite_label

# --------------------------------------------------------------------------------------------------
# Comparison of policies trained on the truth, on noise and on the estimate.
# --------------------------------------------------------------------------------------------------

NAMES = {
    "PD": "PD, tuned",
    "truth": "trained on truth",
    "noisy": "trained on truth with noise",
    "estimate": "trained on the estimate",
}
"""Rows of the matrix."""

FLOWN_ON = ("truth", "estimate")  #: observations of the flights: columns of the matrix
_ON = {"truth": "evaluated on the truth", "estimate": "evaluated on the estimate"}

_ENGINES = {"sb3": "Stable-Baselines3", "compiled": "the compiled engine"}
MANY_CRASHES = 0.01  #: share of crashes above which mean errors are not compared
ONE_SEED = (
    "A single training seed is not conclusive: another seed could reverse any of these "
    "differences. Use five seeds for intervals. With good sensors, as on the circle, no difference "
    "is expected; quad-gym evaluate look_around shows a task in which the estimate matters."
)


@dataclass(frozen=True, eq=False, kw_only=True)
class Comparison(Experiment):
    """Trainings and flights of a comparison."""

    suites: tuple[str, ...]
    sources: tuple[str, ...]
    """Observations in training"""
    recipe: Recipe
    evaluations: int
    """Number of evaluations of each training"""
    engine: str

    @property
    def rows(self) -> tuple[str, ...]:
        """Rows of the matrix, see `NAMES`."""
        return ("PD", *self.sources)

    def cases(self) -> dict[str, Plan]:
        """Plans by `case_of`."""
        names = ("env_id", "recipe", "evaluations", "engine")
        fixed: dict[str, Any] = {"threads": 1, **{name: getattr(self, name) for name in names}}
        plans = {}
        for suite, source in product(self.suites, self.sources):
            keywords = {**self.environment, "observation": source, "sensors": suite}
            plans[case_of(suite, source)] = Plan(environment=with_effect(keywords), **fixed)
        return plans

    def trials(self) -> dict[str, Trial]:
        """Test flights by `case_of`, of all rows on both observations."""
        return {
            case_of(suite, source, observation): self.trial(
                {"observation": observation, "sensors": suite},
                "pd" if source == "PD" else case_of(suite, source),
            )
            for suite, source, observation in product(self.suites, self.rows, FLOWN_ON)
        }

    def description(self) -> dict[str, Any]:
        """Everything that affects the results, for JSON."""
        names = ("env_id", "engine", "recipe", "episodes", "first_episode", "environment")
        return {
            **{name: getattr(self, name) for name in names},
            "sensors": self.suites,
            "trained_on": self.sources,
            "training_seeds": self.seeds,
            **contents_of_suite_files(*self.suites),
        }


def case_of(suite: str, source: str, *flown_on: str) -> str:
    """Name of a case, or of its flights on an observation."""
    return "/".join([suite_label(suite), source, *flown_on])


@dataclass(frozen=True)
class MatrixCell:
    """Cell of the matrix: one number per training seed, (s,)."""

    errors: Floats
    """Mean position errors [m]"""
    late_errors: Floats
    """Mean position errors in the second half of episodes [m]"""
    crash_rates: Floats
    interval: Interval | None
    """95 % interval of the mean error by Student's t: over training seeds, or for PD over episodes;
    None for a single seed"""

    def texts(self) -> tuple[str, str, str]:
        """Error and its interval, late error [mm], and crash rate."""
        error = in_brackets(float(np.mean(self.errors)), self.interval, ".1f", 1e3)
        return error, f"{1e3 * np.mean(self.late_errors):.1f}", f"{np.mean(self.crash_rates):.1%}"

    def in_mm(self) -> tuple[float, tuple[float, float] | None]:
        """Mean error and its interval [mm]."""
        limits = None if self.interval is None else tuple(1e3 * x for x in self.interval)
        return 1e3 * float(np.mean(self.errors)), limits  # type: ignore[return-value]

    def description(self) -> dict[str, Any]:
        """Numbers for JSON."""
        error, late, crashed = map(np.mean, (self.errors, self.late_errors, self.crash_rates))
        means = {"mean_error": error, "late_error": late, "crash_rate": crashed}
        return {**means, "interval_95": self.interval, "mean_error_of_each_seed": self.errors}


@dataclass(frozen=True, eq=False)
class ComparisonResults:
    """Results of a comparison."""

    comparison: Comparison
    flown: Mapping[str, Sequence[Flown]]
    """Flights of each training seed, by `case_of`"""

    def cell(self, suite: str, source: str, observation: str) -> MatrixCell:
        """Cell of the matrix."""
        flown = self.flown[case_of(suite, source, observation)]
        summaries = [each.episodes.summary() for each in flown]
        names = ("mean_error", "late_error", "crash_rate")
        errors, late, crashes = (np.array([each[name] for each in summaries]) for name in names)
        sample = flown[0].episodes.mean_error if source == "PD" else errors
        interval = mean_interval(sample) if len(sample) > 1 else None
        return MatrixCell(errors, late, crashes, interval)

    @property
    def bound(self) -> float:
        """Tracking error with which a crashed episode counts from its crash on [m]."""
        trial = next(iter(self.comparison.trials().values()))
        return float(trial.make(1).unwrapped.flights.task.out_of_bounds)

    def cells(self, suite: str) -> dict[str, list[MatrixCell]]:
        """Rows of the matrix of a suite."""
        rows = self.comparison.rows
        return {source: [self.cell(suite, source, on) for on in FLOWN_ON] for source in rows}

    def texts(self, suite: str) -> list[list[str]]:
        """Table of a suite: policy, errors, late errors, crash rates."""
        return [
            [NAMES[source], *np.array([cell.texts() for cell in row]).T.ravel().tolist()]
            for source, row in self.cells(suite).items()
        ]


def matrix_text(matrix: ComparisonResults, suite: str) -> str:
    """Matrix of a sensor suite, for the screen."""
    flown = ["on truth", "on estimate"]
    means = {"mean error [mm]": flown, "second half [mm]": flown}
    groups = {"": ["policy"], **means, "crashed": flown}
    return text_table(groups, matrix.texts(suite))


def conclusions(matrix: ComparisonResults) -> list[str]:
    """Conclusions that the intervals allow."""
    comparison, sentences = matrix.comparison, []
    for suite in comparison.suites:
        for (first, *ours), (second, *other) in _QUESTIONS:
            if {ours[0], other[0]} - set(comparison.rows):
                continue
            cells = [matrix.cell(suite, *way) for way in (ours, other)]
            if max(float(cell.crash_rates.max()) for cell in cells) > MANY_CRASHES:
                continue  # the means describe the crashes, not the tracking
            # PD has no training seed: its one number is repeated
            errors = [np.resize(cell.errors, len(comparison.seeds)) for cell in cells]
            both = " Both evaluated on the estimate." if other[1] == "estimate" else ""
            sentences.append(f"Sensors {suite}: {_sentence(first, second, *errors)}{both}")
        for source in comparison.rows:
            share = float(matrix.cell(suite, source, "estimate").crash_rates.max())
            if share > MANY_CRASHES:
                sentences.append(
                    f"Sensors {suite}: {NAMES[source]}, up to {share:.0%} of the episodes crashed "
                    "on the estimate, so the errors are not compared."
                )
    return [*sentences, ONE_SEED] if len(comparison.seeds) == 1 else sentences


_Way = tuple[str, str, str]
"""Cell of the matrix: name for sentences, observations in training and in flight."""

_OURS = ("training on the estimate", "estimate", "estimate")
_QUESTIONS: tuple[tuple[_Way, _Way], ...] = (
    (("flying on the estimate", "truth", "estimate"), ("on the truth", "truth", "truth")),
    (_OURS, ("training on the truth", "truth", "estimate")),
    (_OURS, ("training on the noisy truth", "noisy", "estimate")),
    (_OURS, ("tuned PD control", "PD", "estimate")),
)
"""Pairs of cells to compare."""


def _sentence(first: str, second: str, errors: Floats, others: Floats) -> str:
    """Difference of two mean errors, with an interval over training seeds."""
    found = paired_difference(errors, others)
    change, relative = 1e3 * found.spread.mean, found.spread.mean / float(np.mean(others))
    more = f"{abs(change):.2f} mm ({abs(relative):.0%}) {'more' if change > 0.0 else 'less'}"
    if found.interval is None:
        return f"{first} gave {more} error than {second}, with this one seed."
    low, high = (1e3 * x for x in found.interval)
    span = f"{found.spread.count} seeds, 95 % interval {low:+.2f} to {high:+.2f} mm"
    if not found.significant:
        return f"{first} and {second} are statistically indistinguishable ({span})."
    return f"{first} gives {more} error than {second} ({span})."


# ---- files ---------------------------------------------------------------------------------------


def write_report(matrix: ComparisonResults) -> list[Path]:
    """Write numbers, figures and the page; the last file is the page."""
    comparison, trainings = matrix.comparison, matrix.comparison.trainings
    recipe, seconds = comparison.recipe, sum(t.record()["training_seconds"] for t in trainings)
    report = Report(comparison.folder, f"{comparison.env_id}: cost of flying on the estimate")
    report.files += _write_numbers(matrix)
    report.add(
        "p",
        f"{recipe.algorithm.upper()} ({_ENGINES[comparison.engine]}), {recipe.steps:,} "
        f"steps for each of {len(trainings)} policies, training seeds "
        f"{', '.join(map(str, comparison.seeds))}; {seconds / 60:.1f} minutes of training. "
        f"Each policy was evaluated in {comparison.episodes:,} episodes on the truth and on the "
        "estimate.",
    )
    report.add_bullets(conclusions(matrix))
    shown = ("error [mm]", "second half [mm]", "crashed")
    headings = ["policy", *(f"{what}, on {on}" for what in shown for on in FLOWN_ON)]
    for suite in comparison.suites:
        report.add("h2", f"Sensors {suite}")
        report.add_table(headings, matrix.texts(suite))
        _add_figures(report, matrix, suite)
    return report.write()


def _write_numbers(matrix: ComparisonResults) -> list[Path]:
    """Write all numbers as CSV, and the summary as JSON."""
    comparison, rows, cells = matrix.comparison, [], []
    for suite, source, observation in product(comparison.suites, comparison.rows, FLOWN_ON):
        about = {"sensors": suite, "trained_on": source}
        trainings: list[Any] = comparison.trainings_of(case_of(suite, source)) or [None]
        flights = matrix.flown[case_of(suite, source, observation)]
        for training, flown in zip(trainings, flights, strict=True):
            which = {"training_seed": training and training.plan.seed, "flown_on": observation}
            seconds = training and training.record()["training_seconds"]
            numbers = {**flown.episodes.summary(), "training_seconds": seconds}
            rows.append({**about, **which, **numbers})
        cell = matrix.cell(suite, source, observation)
        cells.append({**about, "flown_on": observation, **cell.description()})
    summary = {
        **comparison.description(),
        "matrix": cells,
        "conclusions": conclusions(matrix),
        "versions": versions("numpy", "numba", "scipy", "torch", "stable_baselines3"),
    }
    return [
        write_csv(comparison.folder / "policies.csv", columns_of(rows)),
        write_json(comparison.folder / "summary.json", summary),
    ]


def _add_figures(report: Report, matrix: ComparisonResults, suite: str) -> None:
    """Draw learning curves, matrix, errors over time, and paths of a suite."""
    comparison, cells, label = matrix.comparison, matrix.cells(suite), suite_label(suite)
    curves = {}
    for source in comparison.sources:
        trainings = comparison.trainings_of(case_of(suite, source))
        each = [training.curve("mean_error") for training in trainings]
        curves[NAMES[source]] = [(steps[1:], errors[1:]) for steps, errors in each]
    figure = plots.learning_figure(
        curves,
        {"PD, tuned, on the estimate": float(cells["PD"][1].errors[0])},
        f"Validation error on the training observation, sensors {suite}",
        tests={NAMES[s]: float(np.mean(cells[s][1].errors)) for s in comparison.sources},
    )
    caption = "Error during training, on the observation of the training"
    if len(comparison.seeds) > 1:
        caption += "; thin lines are single seeds, bold ones their median"
    caption += ". Dots: error in the test on the estimate."
    report.add_figure(f"learning_{label}", figure, caption)
    figure = plots.intervals_figure(
        {
            NAMES[source]: {_ON[on]: cell.in_mm() for on, cell in zip(FLOWN_ON, row, strict=True)}
            for source, row in cells.items()
        },
        "mean position error [mm]",
        f"Policies on truth and estimate, sensors {suite}",
    )
    caption = "Mean error over whole episodes, with the 95 % interval over training seeds "
    caption += "(Student's t), if there are several; for PD, over episodes."
    report.add_figure(f"matrix_{label}", figure, caption)
    first = {NAMES[s]: matrix.flown[case_of(suite, s, "estimate")][0] for s in comparison.rows}
    errors = {name: flown.recorded for name, flown in first.items()}
    title = f"Evaluated on the estimate, first training seed, sensors {suite}"
    figure = plots.error_over_time_figure(errors, matrix.bound, title)
    caption = "Error over time: median and middle nine tenths of the episodes. "
    caption += f"A crashed episode counts with {matrix.bound:g} m from its crash on."
    report.add_figure(f"errors_{label}", figure, caption)
    paths = {name: flown.recorded["path"] for name, flown in first.items()}
    title = f"Seen from above, evaluated on the estimate, sensors {suite}"
    figure = plots.paths_figure(paths, title)
    report.add_figure(f"paths_{label}", figure, "The first episode of the first training seed.")


# --------------------------------------------------------------------------------------------------
# Measure the cost of flying on the estimate and the benefit of training on it.
# --------------------------------------------------------------------------------------------------

QUICK_SEEDS, QUICK_EPISODES = 1, 200

Source = Literal["truth", "noisy", "estimate"]
SOURCES: tuple[Source, ...] = ("truth", "noisy", "estimate")


@dataclass(frozen=True)
class CompareArgs:
    """Options of the comparison."""

    env_id: options.TrackingId = "QuadGym/Circle-v0"
    sensors: options.SuiteNames = (options.SENSORS,)
    train_on: tuple[Source, ...] = SOURCES
    """observations in training"""
    seeds: int = 5
    """number of training seeds"""
    quick: bool = False
    """one seed and 200 episodes instead of --seeds and --episodes: only to check that it works"""

    algorithm: Literal["ppo", "sac", "td3", "tqc"] = "ppo"
    """reinforcement learning algorithm"""
    engine: options.Engine = "sb3"
    steps: int | None = None
    """number of environment steps of each training; defaults to the recipe's"""
    n_envs: int | None = None
    """number of parallel flights; defaults to the recipe's"""
    set: options.Parameters = field(default_factory=dict)
    evaluations: int = 20
    """number of evaluations and checkpoints of each training"""
    env: options.Keywords = field(default_factory=dict)
    """keywords of the environment, such as control_rate=100"""
    jobs: int | None = None
    """number of parallel trainings, each with one thread; defaults to one per core"""

    episodes: int = 1000
    """number of episodes of each policy on each observation"""
    seed: int = 0
    """seed of the first episode, and of the first training; no training flies these episodes"""
    output: Path | None = None
    """folder; defaults to results/compare/TASK (with --quick, .../TASK_quick)"""


def configure(args: CompareArgs) -> Comparison:
    """Check all options before training."""
    plots.require_matplotlib()
    args = options.with_full_id(args, options.TRACKING)
    least = {"steps": 1, "n_envs": 1, "evaluations": 1, "seeds": 1, "episodes": 2, "jobs": 1}
    options.require_at_least(args, seed=0, **least)
    for source in args.train_on:
        check.choice("--train-on", source, SOURCES)
    labels = [suite_label(suite) for suite in args.sensors]
    if len(set(labels)) < len(labels):
        raise ValueError(f"--sensors must have different names, got {' '.join(labels)}")
    options.leave(args.env, "sensors", observation="--train-on", threads="--jobs")
    seeds, episodes = (QUICK_SEEDS, QUICK_EPISODES) if args.quick else (args.seeds, args.episodes)
    name = IDS[args.env_id] + ("_quick" if args.quick else "")
    comparison = Comparison(
        env_id=args.env_id,
        suites=args.sensors,
        sources=args.train_on,
        seeds=tuple(range(args.seed, args.seed + seeds)),
        episodes=episodes,
        first_episode=first_seed("test", args.seed, episodes),
        environment=dict(args.env),
        recipe=options.recipe_of(args),
        evaluations=args.evaluations,
        engine=args.engine,
        folder=args.output or Path("results/compare") / name,
    )
    comparison.check()
    require_writable("--output", comparison.folder)
    return comparison


def main(args: CompareArgs) -> int:
    """Compare."""
    began = time.perf_counter()
    with options.usage_errors():
        comparison = configure(args)
    print(
        f"{comparison.env_id}: {len(comparison.trainings)} trainings of "
        f"{comparison.recipe.steps:,} steps, {comparison.episodes:,} episodes with each policy; "
        f"into {comparison.folder}."
    )
    jobs = args.jobs or resolve_threads(None)
    driver = train_all(comparison.trainings, comparison.folder, jobs)
    if code := driver.exit_code():
        return code
    matrix = ComparisonResults(comparison, comparison.fly())
    for suite in comparison.suites:
        print(f"\nSensors {suite}\n\n{matrix_text(matrix, suite)}")
    print("\n" + "\n".join(conclusions(matrix)))
    written = write_report(matrix)
    print(
        f"\nWrote {len(written)} files to {comparison.folder} after "
        f"{(time.perf_counter() - began) / 60:.1f} minutes; open {written[-1]}."
    )
    return 0

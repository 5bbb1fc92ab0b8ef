"""Evaluation of policies on observations: flights, a table, numbers and figures."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from quad_gym.analysis import reports
from quad_gym.analysis.comparison_plots import error_over_time_figure, paths_figure
from quad_gym.analysis.intervals import in_brackets, mean_interval, rate_interval
from quad_gym.analysis.plots import save_figure
from quad_gym.evaluation import Episodes, Policy
from quad_gym.experiments.flown import Flown, flight_of_episode
from quad_gym.rendering.side_by_side import Side

Evaluated = Mapping[tuple[str, str], Flown]  #: episodes by policy and observation

_LABELS = {
    "pd": "PD control",
    "pd:features_when_uncertain": "PD control, facing markers when uncertain",
    "pretrained": "policy trained on the estimate",
    "pretrained:truth": "policy trained on the true state",
}
"""Names of policies for figures and videos"""

_INCLUDED = {
    "look_around": "estimate + standard deviation, reward for certainty",
    "stale_race": "estimate + 15 standard deviations + history",
    "outage_dash": "estimate + normalized uncertainty",
}
"""Names of included policies whose training differs in more than the observation, by task"""


def evaluation_table(results: Evaluated, env: Any) -> str:
    """Format a table of errors and endings; `env` is an environment of the same task."""
    course = gates_of(env) > 0
    rows = [
        [
            f"{reports.short_name(policy)} on {observation}",
            *(_progress(flown.episodes, env) if course else _errors(flown.episodes)),
            f"{1e3 * flown.episodes.estimation_error.mean():.1f}",
            _rate(flown.episodes.crashed),
            f"{flown.episodes.returns.mean():.2f}",
        ]
        for (policy, observation), flown in results.items()
    ]
    tracking = {"tracking error [mm]": ["whole episode", "second half"]}
    if course:
        tracking = {"course": [f"gates of {gates_of(env)}", "completed", "time if completed"]}
    return reports.text_table(
        {"": ["policy"], **tracking, "estimation": ["error [mm]"], " ": ["crashed", "return"]}, rows
    )


def gates_of(env: Any) -> int:
    """Number of gates of a course, or of gaps between walls; 0 for other tasks."""
    flights = env.unwrapped.flights
    if flights.name == "outage_dash":
        return len(flights.batch.world.obstacles) // 2
    return int(flights.task.gate_count) if flights.task.kind == "waypoints" else 0


def label_of(policy: str, task: str) -> str:
    """Name of a policy for figures and videos; `task`: name of the environment's task."""
    if policy == "pretrained" and task in _INCLUDED:
        return _INCLUDED[task]
    return _LABELS.get(policy, reports.short_name(policy))


def telling_episode(results: Evaluated) -> int:
    """Index of the first episode in which some policies crash and others do not; or else 0."""
    crashed = np.mean([flown.episodes.crashed for flown in results.values()], axis=0)
    return int(np.argmax((crashed > 0.0) & (crashed < 1.0)))


def side_of(
    label: str,
    policy: Policy,
    env: Any,
    episodes: Episodes,
    seed: int,
    episode: int,
    about: Mapping[str, Any],
) -> Side:
    """Fly one of the episodes again, for a video."""
    flight = flight_of_episode(policy, env, seed, episode, int(episodes.lengths[episode]), about)
    ending = str(episodes.ending[episode])
    return Side(
        flight=flight,
        label=label,
        ending="finish" if ending == "task" else ending,
        crashed=bool(episodes.crashed[episode]),
        course=("gates", gates_of(env)) if gates_of(env) else None,
    )


def bound_of(env: Any) -> float:
    """Tracking error with which a crashed episode counts from its crash on [m]."""
    return float(env.unwrapped.flights.task.out_of_bounds)


def remark_on_crashes(results: Evaluated, env: Any) -> str:
    """Describe how crashed episodes count in the table; empty without crashes."""
    if gates_of(env) or not any(flown.episodes.crashed.any() for flown in results.values()):
        return ""
    return (
        f"A crashed episode counts with a tracking error of {bound_of(env):g} m, the bound of the "
        "task, from its crash to its time limit. Estimation errors are means up to the crash."
    )


def _progress(episodes: Episodes, env: Any) -> list[str]:
    """Mean number of gates passed, share of complete courses, and their mean time."""
    done = episodes.gates_passed >= gates_of(env)
    passed = [f"{episodes.gates_passed.mean():.2f}", _rate(done)]
    if not any(done):
        return [*passed, "-"]
    return [*passed, f"{episodes.lengths[done].mean() / env.unwrapped.flights.control_rate:.2f} s"]


def _errors(episodes: Episodes) -> list[str]:
    """Tracking error with its interval, and late error [mm]."""
    errors, late = episodes.mean_error, 1e3 * episodes.summary()["late_error"]
    interval = mean_interval(errors) if len(errors) > 1 else None
    return [in_brackets(errors.mean(), interval, ".1f", 1e3), f"{late:.1f}".replace("nan", "-")]


def _rate(happened: Any) -> str:
    low, high = (100.0 * limit for limit in rate_interval(happened.sum(), len(happened)))
    return f"{happened.mean():.1%} [{low:.1f}, {high:.1f}]"


def write_evaluation(
    results: Evaluated, seed: int, folder: Path, about: Mapping[str, Any]
) -> list[Path]:
    """Write the numbers; the summary also contains `about`."""
    count = len(next(iter(results.values())).episodes.returns)
    tables = (
        {
            "policy": [policy] * count,
            "observation": [observation] * count,
            "seed": range(seed, seed + count),
            **flown.episodes._asdict(),
        }
        for (policy, observation), flown in results.items()
    )
    summary = {
        "cases": [
            {"policy": policy, "observation": observation, **flown.episodes.summary()}
            for (policy, observation), flown in results.items()
        ],
        "units": {"errors": "m", "rates": "share of episodes"},
        **about,
        "versions": reports.versions("numpy", "numba", "torch", "stable_baselines3"),
    }
    return [
        reports.write_csv(folder / "episodes.csv", reports.stacked(tables)),
        reports.write_json(folder / "summary.json", summary),
    ]


def write_figures(results: Evaluated, env: Any, folder: Path) -> list[Path]:
    """Write the figures, or raise an ImportError if matplotlib is missing.

    `env` is an environment of the same task.
    """
    task = env.unwrapped.flights.name
    labeled = {f"{label_of(policy, task)}, on {seen}": f for (policy, seen), f in results.items()}
    curves = {label: flown.recorded for label, flown in labeled.items()}
    paths = paths_figure({label: flown.recorded["path"] for label, flown in labeled.items()})
    return [
        *save_figure(paths, folder / "paths"),
        *save_figure(error_over_time_figure(curves, bound_of(env)), folder / "errors"),
    ]

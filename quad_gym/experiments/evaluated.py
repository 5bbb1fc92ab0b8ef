"""Evaluation of policies on observations: flights, a table, numbers and figures."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from quad_gym.analysis import reports
from quad_gym.analysis.comparison_plots import error_over_time_figure, paths_figure
from quad_gym.analysis.intervals import in_brackets, mean_interval, rate_interval
from quad_gym.analysis.plots import save_figure
from quad_gym.evaluation import Episodes
from quad_gym.experiments.flown import Flown, path_of

Evaluated = Mapping[tuple[str, str], Flown]  #: episodes by policy and observation


def evaluation_table(results: Evaluated, env: Any) -> str:
    """Format a table of errors and endings; `env` is an environment of the same task."""
    flights = env.unwrapped.flights
    course = flights.name == "waypoints"
    rows = [
        [
            f"{reports.short_name(policy)} on {observation}",
            *(_progress(flown.episodes, flights) if course else _errors(flown.episodes)),
            f"{1e3 * flown.episodes.estimation_error.mean():.1f}",
            _rate(flown.episodes.crashed),
            f"{flown.episodes.returns.mean():.2f}",
        ]
        for (policy, observation), flown in results.items()
    ]
    tracking = {"tracking error [mm]": ["whole episode", "second half"]}
    if course:
        tracking = {"course": ["gates passed", "time"]}
    return reports.text_table(
        {"": ["policy"], **tracking, "estimation": ["error [mm]"], " ": ["crashed", "return"]}, rows
    )


def _progress(episodes: Episodes, flights: Any) -> list[str]:
    """Share of the gates passed, and mean time of complete courses."""
    done = episodes.ending == "last_gate"
    passed = f"{episodes.gates_passed.mean() / flights.task.gate_count:.1%}"
    if not any(done):
        return [passed, "-"]
    return [passed, f"{episodes.lengths[done].mean() / flights.control_rate:.2f} s"]


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
    """Write numbers and figures; the summary also contains `about`."""
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
    labeled = {
        f"{reports.short_name(policy)} on {seen}": f for (policy, seen), f in results.items()
    }
    curves = {k: (f.recorded["time"], f.recorded["percentiles"]) for k, f in labeled.items()}
    paths = paths_figure({label: path_of(flown) for label, flown in labeled.items()})
    return [
        reports.write_csv(folder / "episodes.csv", reports.stacked(tables)),
        reports.write_json(folder / "summary.json", summary),
        *save_figure(paths, folder / "paths"),
        *save_figure(error_over_time_figure(curves), folder / "errors"),
    ]

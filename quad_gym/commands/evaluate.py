"""Evaluate policies over many episodes by the true state.

    quad-gym evaluate QuadGym/Circle-v0 --policy pd pretrained
    quad-gym evaluate --policy results/train/circle/ppo_seed_0/best.zip --sensors rtk

Every policy flies the same episodes (the same seeds) on each observation. Prints a table, and
writes episodes.csv (one row per episode), summary.json (all numbers and the configuration), and, if
matplotlib is installed, figures of paths and errors over time (PNG and SVG).
"""

import time
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Literal

import gymnasium
import numpy as np
from tqdm import tqdm

from baselines.policies import keywords_of_policy, load_policy
from baselines.recipes import first_seed
from quad_gym import IDS
from quad_gym.analysis import reports
from quad_gym.analysis.metrics import in_brackets, mean_interval, rate_interval
from quad_gym.analysis.plots import error_over_time_figure, paths_figure, save_figure
from quad_gym.analysis.reports import require_writable
from quad_gym.commands import options
from quad_gym.envs.config import with_effect
from quad_gym.evaluation import Episodes, Policy
from quad_gym.experiments import Flown, flight_of_episode, fly
from quad_gym.params.suites import contents_of_suite_files
from quad_gym.rendering.video import Side, checked_video_path, end_of, save_side_by_side

# --------------------------------------------------------------------------------------------------
# Evaluation of policies on observations: flights, a table, numbers and figures.
# --------------------------------------------------------------------------------------------------

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
    "stale_race": "estimate + 15 standard deviations",
    "outage_dash": "estimate + normalized uncertainty, imitation of a rule",
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


# --------------------------------------------------------------------------------------------------
# Evaluate policies over many episodes by the true state.
# --------------------------------------------------------------------------------------------------

VIDEO_RATE, VIDEO_SECONDS = 10.0, 6.5  #: frames per second of a video, and its longest duration


@dataclass(frozen=True)
class EvaluateArgs:
    """Options of the evaluation."""

    env_id: options.EnvId = "QuadGym/Circle-v0"
    policy: tuple[str, ...] | None = None
    """policies: pd (tuned gains), pd:lab (gains of the report), pd:FILE.json (gains of quad-gym
    tune), crazyflie_pid (the cascade of a Crazyflie), pretrained (the included policy for the
    task), pretrained:truth (for Circle and LookAround: the included one that was trained on the
    true state), or files of quad-gym train (.zip or .npz); defaults to pd, and pretrained if it
    fits"""
    observation: tuple[str, ...] = ("truth", "estimate")
    """observations of the policies: truth, estimate, noisy, or measurements (for policies
    trained on raw measurements)"""
    sensors: options.OwnSuite = None
    estimator: options.EstimatorName = None
    normalization: options.Normalized = None
    env: options.Keywords = field(default_factory=dict)
    """further keywords of the environment, such as camera=false control_rate=100"""
    episodes: int = 1000
    """number of episodes of each policy on each observation"""
    seed: int = 0
    """seed of the first episode; the others have consecutive seeds; trainings use different ones"""
    threads: options.Threads = None
    video: Literal["none", "mp4", "gif", "webp"] = "none"
    """format of a video of all policies on the last observation, side by side in one episode: the
    first one in which some of them crash and others do not, or else the first. Long episodes are
    shown in 6.5 s. none: no video"""
    output: Path | None = None
    """folder for figures and numbers; defaults to results/evaluate/TASK, or TASK_2 and so on
    if there are results already"""
    overwrite: bool = False
    """replace earlier results in the folder"""


Pairing = tuple[str, str]  #: a policy and an observation


def configure(args: EvaluateArgs) -> tuple[dict[Pairing, tuple[Policy, Any]], Path]:
    """Check all options, and make every policy with its environment."""
    args = options.with_full_id(args)
    options.require_at_least(args, episodes=1, seed=0, threads=1)
    for name in ("observation", "policy"):
        if getattr(args, name) == ():
            raise ValueError(f"--{name} must have at least one value, got none")
    if args.policy is None and "measurements" in args.observation:
        raise ValueError(
            "--observation measurements contains no state, which PD control needs: select a "
            "--policy that was trained on measurements"
        )
    first_seed("test", args.seed, args.episodes)  # rejects seeds of trainings
    files = [name for name in args.policy or () if Path(name).suffix in (".zip", ".npz")]
    if args.normalization is not None and not files:
        raise ValueError("--normalization needs a --policy that is a file (.zip or .npz)")
    folder = args.output or Path("results/evaluate") / IDS[args.env_id]
    if args.output is None and not args.overwrite:
        folder = options.free_folder(folder, "summary.json")
    options.refuse_overwriting(folder / "summary.json", args.overwrite)
    policies = args.policy or default_policies(args)
    pairs = [(name, seen) for seen in args.observation for name in policies]
    # flights on the truth last: their kernels are compiled together with those of the others
    made = {
        (name, seen): policy_and_flights(args, seen, args.episodes, name)
        for name, seen in sorted(pairs, key=lambda pair: pair[1] == "truth")
    }
    cases = {pair: made[pair] for pair in pairs}
    require_writable("--output", folder)
    if args.video != "none":
        checked_video_path(folder / f"video.{args.video}")
    return cases, folder


def default_policies(args: EvaluateArgs) -> tuple[str, ...]:
    """Tuned PD control, and the included policy if there is one that fits."""
    load_policy("pd", make_flights(args, args.observation[0], 1, "pd"))
    try:
        load_policy("pretrained", make_flights(args, args.observation[0], 1, "pretrained"))
    except ValueError as error:
        print(f"Only PD control is evaluated: {error}.")
        return ("pd",)
    return ("pd", "pretrained")


def policy_and_flights(
    args: EvaluateArgs, observation: str, count: int, policy: str
) -> tuple[Policy, Any]:
    """Load a policy, and make the environment in which it flies."""
    env = make_flights(args, observation, count, policy)
    of_file = Path(policy).suffix in (".zip", ".npz")
    return load_policy(policy, env, args.normalization if of_file else None), env


def make_flights(args: EvaluateArgs, observation: str, count: int, policy: str) -> Any:
    """Make the environment with an observation, for a policy."""
    keywords = keywords_of_flights(args, observation, policy)
    return gymnasium.make_vec(args.env_id, num_envs=count, threads=args.threads, **keywords)


def keywords_of_flights(args: EvaluateArgs, observation: str, policy: str) -> dict[str, Any]:
    """Keywords of the environment with an observation, for a policy."""
    sensors = options.sensors_of(args.env_id, args.sensors)
    given = options.environment_of(args, observation=observation, sensors=sensors)
    return with_effect({**keywords_of_policy(policy, args.env_id), **given})


def write_video(
    cases: dict[Pairing, tuple[Policy, Any]], results: Evaluated, args: EvaluateArgs, folder: Path
) -> Path:
    """Write a video of all policies on the last observation, side by side in one episode."""
    shown = {case: found for case, found in cases.items() if case[1] == args.observation[-1]}
    episode = telling_episode({case: results[case] for case in shown})
    about = {"env_id": args.env_id}
    sides = [
        side_of(
            label_of(case[0], IDS[args.env_id]),
            *found,
            results[case].episodes,
            args.seed,
            episode,
            about,
        )
        for case, found in shown.items()
    ]
    return save_side_by_side(
        sides,
        folder / f"video.{args.video}",
        fps=VIDEO_RATE,
        speed=max(1.0, end_of(sides) / VIDEO_SECONDS),
        progress=lambda times: tqdm(times, desc="rendering", unit=" frames"),
    )


def main(args: EvaluateArgs) -> None:
    """Evaluate."""
    with options.usage_errors((ValueError, OSError, ImportError, RuntimeError)):
        args = options.with_full_id(args)
        cases, folder = configure(args)
    began = time.perf_counter()
    bar = tqdm(cases.items(), desc="evaluating", unit=" cases")
    with options.filter_hints(), bar:
        results = {case: fly(policy, env, args.seed) for case, (policy, env) in bar}
    print(
        f"\n{args.env_id}, sensors {options.sensors_of(args.env_id, args.sensors)}; "
        f"{args.episodes:,} episodes in each case, from seed {args.seed}.\n"
    )
    _, env = next(iter(cases.values()))
    print(evaluation_table(results, env))
    print("In brackets: 95 % interval over episodes, Student's t or Clopper and Pearson's.")
    if remark := remark_on_crashes(results, env):
        print(remark)
    flown = tuple(dict.fromkeys(name for name, _ in results))
    about = {**contents_of_suite_files(args.sensors), "arguments": replace(args, policy=flown)}
    written = write_evaluation(results, args.seed, folder, about)
    try:
        written += write_figures(results, env, folder)
    except ImportError as error:
        print(f"{error}.")
    if args.video != "none":
        written.append(write_video(cases, results, args, folder))
    print(f"\nWrote {len(written)} files to {folder} after {time.perf_counter() - began:.1f} s.")

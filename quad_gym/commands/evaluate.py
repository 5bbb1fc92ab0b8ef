"""Evaluate policies over many episodes by the true state.

    quad-gym evaluate QuadGym/Circle-v0 --policy pd pretrained
    quad-gym evaluate --policy results/train/circle/ppo_seed_0/best.zip --sensors rtk

Every policy flies the same episodes (the same seeds) on each observation. Prints a table, and
writes episodes.csv (one row per episode), summary.json (all numbers and the configuration), and, if
matplotlib is installed, figures of paths and errors over time (PNG and SVG).
"""

import time
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Literal

import gymnasium
from tqdm import tqdm

from baselines.policies import keywords_of_policy, load_policy
from baselines.seeds import first_seed
from quad_gym import IDS
from quad_gym.analysis.reports import require_writable
from quad_gym.commands import options
from quad_gym.envs.config import with_effect
from quad_gym.evaluation import Policy
from quad_gym.experiments.evaluated import (
    Evaluated,
    evaluation_table,
    label_of,
    remark_on_crashes,
    side_of,
    telling_episode,
    write_evaluation,
    write_figures,
)
from quad_gym.experiments.flown import fly
from quad_gym.params.suites import contents_of_suite_files
from quad_gym.rendering.side_by_side import save_side_by_side
from quad_gym.rendering.video import checked_video_path

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
    given = options.leave(args.env, "observation", "sensors", "threads")
    keywords = {
        **keywords_of_policy(policy, args.env_id),
        **options.with_estimator(given, args.estimator),
        "observation": observation,
        "sensors": options.sensors_of(args.env_id, args.sensors),
    }
    return with_effect(keywords)


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
        speed=max(1.0, max(side.end for side in sides) / VIDEO_SECONDS),
        progress=lambda times: tqdm(times, desc="rendering", unit=" frames"),
    )


def main(args: EvaluateArgs) -> None:
    """Evaluate."""
    with options.usage_errors((ValueError, OSError, ImportError, RuntimeError)):
        args = options.with_full_id(args)
        cases, folder = configure(args)
    began = time.perf_counter()
    bar = tqdm(cases.items(), desc="evaluating", unit=" cases")
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

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
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

from baselines.seeds import first_seed
from quad_gym import IDS
from quad_gym.analysis import plots
from quad_gym.analysis.reports import require_writable
from quad_gym.batch.threads import resolve_threads
from quad_gym.commands import options
from quad_gym.experiments import compare
from quad_gym.experiments.driver import train_all
from quad_gym.params import checks as check
from quad_gym.params.suites import suite_label

QUICK_SEEDS, QUICK_EPISODES = 1, 200

Source = Literal["truth", "noisy", "estimate"]
SOURCES: tuple[Source, ...] = ("truth", "noisy", "estimate")


@dataclass(frozen=True)
class CompareArgs:
    """Options of the comparison."""

    env_id: options.TrackingId = "QuadGym/Circle-v0"
    sensors: options.SuiteNames = ("standard",)
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


def configure(args: CompareArgs) -> compare.Comparison:
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
    comparison = compare.Comparison(
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
    matrix = compare.ComparisonResults(comparison, comparison.fly())
    for suite in comparison.suites:
        print(f"\nSensors {suite}\n\n{compare.matrix_text(matrix, suite)}")
    print("\n" + "\n".join(compare.conclusions(matrix)))
    written = compare.write_report(matrix)
    print(
        f"\nWrote {len(written)} files to {comparison.folder} after "
        f"{(time.perf_counter() - began) / 60:.1f} minutes; open {written[-1]}."
    )
    return 0

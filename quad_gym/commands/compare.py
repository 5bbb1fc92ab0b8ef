"""What does a controller lose on the estimate, and does training on the estimate recover it?

    quad-gym compare                         # the circle, 5 seeds
    quad-gym compare --quick                 # one seed, a few minutes
    quad-gym compare --sensors lab rtk --seeds 5
    quad-gym compare --engine compiled       # several times faster, and without torch

For every seed, PPO is trained on the true state, on the true state with independent noise (what
other packages offer as sensor noise), and on the filter's estimate. Each policy then flies the same
episodes on the truth and on the estimate, and so does PD control with tuned gains. Prints the
matrix of tracking errors and crash rates with 95 % intervals, says what can be concluded from them,
and writes figures, numbers and a report (report.html) that opens without a network.

An interrupted comparison continues where it stopped when it is started again.
"""

import multiprocessing
import os
import signal
import threading
import time
from concurrent.futures import FIRST_COMPLETED, ProcessPoolExecutor, wait
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal, NoReturn

import gymnasium
import numpy as np

from baselines.seeds import first_seed
from quad_gym import IDS
from quad_gym.analysis import plots
from quad_gym.analysis.reports import as_json, require_writable, versions, write_csv, write_json
from quad_gym.batch.threads import resolve_threads
from quad_gym.commands.options import (
    TRACKING,
    Keywords,
    SuiteNames,
    TrackingId,
    leave,
    require_at_least,
    usage_errors,
    with_full_id,
    without_idle_filter,
)
from quad_gym.commands.train import require_model
from quad_gym.experiments.compare_flights import Floats, Flown, fly
from quad_gym.experiments.compare_report import (
    Comparison,
    Setting,
    conclusions,
    matrix_text,
    write_figures,
    write_page,
)
from quad_gym.faults.presets import felt_without_sensors
from quad_gym.params import checks as check
from quad_gym.params.suites import sensor_suite, suite_label

QUICK_SEEDS, QUICK_EPISODES = 1, 200
GRACE = 60.0
"""What a training has to write a checkpoint once the comparison is gone [s]."""

FLOWN_ON = ("truth", "estimate")
Source = Literal["truth", "noisy", "estimate"]
SOURCES: tuple[Source, ...] = ("truth", "noisy", "estimate")


@dataclass(frozen=True)
class Args:
    """Options of the comparison."""

    env_id: TrackingId = "QuadGym/Circle-v0"
    sensors: SuiteNames = ("standard",)
    train_on: tuple[Source, ...] = SOURCES
    """what to train on"""
    seeds: int = 5
    """training seeds"""
    quick: bool = False
    """one seed and 200 episodes in place of --seeds and --episodes: shows that it works, proves
    nothing"""

    algorithm: Literal["ppo", "sac", "td3", "tqc"] = "ppo"
    """how to learn"""
    engine: Literal["sb3", "compiled"] = "sb3"
    """what trains: Stable-Baselines3, or the compiled PPO, which is several times faster
    and needs no torch"""
    steps: int | None = None
    """environment steps of each training; if not given, the recipe's"""
    env: Keywords = field(default_factory=dict)
    """keywords of the environment, such as control_rate=100"""
    jobs: int | None = None
    """trainings at a time, each with one thread; if not given, one per core"""

    episodes: int = 1000
    """flown with each policy on each observation"""
    seed: int = 0
    """of the first episode, and of the first training; no training flies these episodes"""
    output: Path | None = None
    """folder; if not given, results/compare/TASK (with --quick, .../TASK_quick)"""


def configure(args: Args) -> Setting:
    """Check all options before anything is trained.

    Raises:
        ValueError: If an option is invalid, or the folder holds another comparison.
        OSError: If nothing can be written to the folder.
        ImportError: If a package is missing.
    """
    from baselines.plans import Plan
    from baselines.recipes import recipe

    plots.require_matplotlib()
    args = with_full_id(args, TRACKING)
    require_at_least(args, seeds=1, episodes=2, seed=0, jobs=1)
    for source in args.train_on:
        check.choice("--train-on", source, SOURCES)
    labels = [suite_label(suite) for suite in args.sensors]
    if len(set(labels)) < len(labels):
        raise ValueError(f"--sensors must have different names, got {' '.join(labels)}")
    leave(args.env, {"observation": "--train-on", "sensors": "--sensors", "threads": "--jobs"})
    chosen = recipe(args.env_id, args.algorithm)
    if args.steps is not None:
        chosen = chosen.replace(steps=args.steps)
    seeds = QUICK_SEEDS if args.quick else args.seeds
    episodes = QUICK_EPISODES if args.quick else args.episodes
    plans = {}
    for seed in range(args.seed, args.seed + seeds):  # the first seed is complete first
        for suite in args.sensors:
            for source in args.train_on:
                environment = with_effect({**args.env, "observation": source, "sensors": suite})
                plan = Plan(
                    env_id=args.env_id,
                    environment=environment,
                    recipe=chosen,
                    seed=seed,
                    threads=1,
                    engine=args.engine,
                )
                if seed == args.seed:
                    require_model(plan)
                    plan.make_judge().close()
                plans[suite, source, seed] = plan
    task = IDS[args.env_id]
    folder = args.output or Path("results/compare") / (f"{task}_quick" if args.quick else task)
    require_writable("--output", folder)
    setting = Setting(
        env_id=args.env_id,
        algorithm=args.algorithm,
        engine=args.engine,
        steps=chosen.steps,
        suites=args.sensors,
        sources=args.train_on,
        seeds=tuple(range(args.seed, args.seed + seeds)),
        episodes=episodes,
        first_episode=first_seed("test", args.seed, episodes),
        environment=dict(args.env),
        plans=plans,
        folder=folder,
    )
    _require_same(setting)
    return setting


def with_effect(given: dict[str, Any]) -> dict[str, Any]:
    """Keywords of an environment without a filter's and faults of sensors where none runs."""
    keywords = without_idle_filter(given)
    if keywords["observation"] == "estimate" or "faults" not in keywords:
        return keywords
    suite = sensor_suite(keywords["sensors"])
    return {**keywords, "faults": felt_without_sensors(keywords["faults"], suite)}


def _require_same(setting: Setting) -> None:
    """Refuse a folder that holds another comparison; note this one where there is none."""
    import json

    file = setting.folder / "comparison.json"
    described = as_json(setting.description())
    if not file.exists():
        write_json(file, described)
        return
    before = {"engine": "sb3"} | json.loads(file.read_text(encoding="utf-8"))  # once the only one
    differing = [k for k in described if before.get(k) != described[k]]
    if differing:
        raise ValueError(
            f"folder {setting.folder} holds another comparison (different: "
            f"{', '.join(differing)}): choose another --output"
        )


def train_all(setting: Setting, jobs: int) -> dict[Any, Any]:
    """Train every policy that is not trained yet; what came of each, by suite, source and seed.

    Raises:
        KeyboardInterrupt: If a training was stopped; it is kept, and goes on the next time.
    """
    from tqdm import tqdm

    def stop(number: int, frame: Any) -> NoReturn:
        for process in multiprocessing.active_children():
            process.terminate()  # as Ctrl-C, which reaches them by itself: it ends their rollout
        raise KeyboardInterrupt

    before = signal.signal(signal.SIGTERM, stop)
    total = setting.steps * len(setting.plans)
    context = multiprocessing.get_context("spawn")  # compiled kernels and torch do not fork well
    with (
        ProcessPoolExecutor(min(jobs, len(setting.plans)), context, end_with_parent) as pool,
        tqdm(total=total, desc="training", unit=" steps", unit_scale=True) as bar,
    ):
        done = {}
        try:
            waiting = {
                pool.submit(train_one, plan, setting.run_folder(key)): key
                for key, plan in setting.plans.items()
            }
            while waiting:
                ended, _ = wait(waiting, timeout=2.0, return_when=FIRST_COMPLETED)
                steps = sum(_steps_done(setting.run_folder(key)) for key in setting.plans)
                bar.n = min(steps, total)  # a training ends with the rollout that it is in
                bar.refresh()
                for future in ended:
                    suite, source, seed = key = waiting.pop(future)
                    done[key] = training = future.result()
                    if not training.finished:
                        raise KeyboardInterrupt
                    bar.write(
                        f"[{len(done)}/{len(setting.plans)}] trained on {source}, sensors {suite}, "
                        f"seed {seed}: {training.seconds:.0f} s"
                    )
        except BaseException:
            pool.shutdown(cancel_futures=True)
            raise
        finally:
            signal.signal(signal.SIGTERM, before)
    return {key: done[key] for key in setting.plans}


def end_with_parent() -> None:
    """Make a process of the pool end when the comparison does, even if that is killed."""
    parent = multiprocessing.parent_process()
    assert parent is not None

    def watch() -> None:
        parent.join()
        os.kill(os.getpid(), signal.SIGTERM)  # a training writes a checkpoint, and ends
        time.sleep(GRACE)
        os._exit(1)

    threading.Thread(target=watch, daemon=True).start()


def train_one(plan: Any, folder: Path) -> Any:
    """Train a policy, or go on with a training that was stopped; in a process of its own."""
    from baselines.training import train

    try:
        return train(plan, folder, resume=True, tensorboard=False, quiet=True)
    finally:
        parent = multiprocessing.parent_process()
        if parent is not None and not parent.is_alive():
            os._exit(1)  # rather than begin with the next one that waits


def _steps_done(folder: Path) -> int:
    """Environment steps at the last evaluation of a run."""
    try:
        last = (folder / "evaluations.csv").read_text(encoding="utf-8").splitlines()[-1]
        return int(float(last.split(",")[0]))
    except (OSError, IndexError, ValueError):  # not begun
        return 0


def fly_all(setting: Setting) -> Comparison:
    """Fly every policy on every observation, unless it was flown before."""
    from tqdm import tqdm

    from baselines.keeping import best_file
    from baselines.policies import load_policy

    flown: dict[Any, Flown] = {}
    cases: list[Any] = [(suite, "PD", None) for suite in setting.suites]
    cases += list(setting.plans)
    for key in tqdm(cases, desc="flying", unit=" policies"):
        suite, source, _ = key
        folder = setting.run_folder(key)
        name = "pd" if source == "PD" else str(best_file(setting.plans[key], folder))
        for observation in FLOWN_ON:
            file = folder / f"flown_on_{observation}.npz"
            if not file.exists():
                keywords = {**setting.environment, "observation": observation, "sensors": suite}
                env = gymnasium.make_vec(
                    setting.env_id, num_envs=setting.episodes, **with_effect(keywords)
                )
                file.parent.mkdir(parents=True, exist_ok=True)
                fly(load_policy(name, env), env, setting.first_episode).save(file)
            flown[(*key, observation)] = Flown.load(file)
    return Comparison(setting, flown, {k: _curve(setting, k) for k in setting.plans})


def _curve(setting: Setting, key: Any) -> tuple[Floats, Floats]:
    """Steps, and mean errors, of the evaluations while training."""
    rows: Any = np.genfromtxt(
        setting.run_folder(key) / "evaluations.csv", delimiter=",", names=True, dtype=np.float64
    )
    return rows["steps"], rows["mean_error"]


def write_numbers(comparison: Comparison, trainings: dict[Any, Any]) -> list[Path]:
    """All numbers as CSV, and the summary as JSON."""
    setting = comparison.setting
    columns: dict[str, list[Any]] = {}
    for (suite, source, seed, observation), flown in comparison.flown.items():
        row = {
            "sensors": suite,
            "trained_on": source,
            "training_seed": seed,
            "flown_on": observation,
            **flown.episodes.summary(),
            "training_seconds": getattr(trainings.get((suite, source, seed)), "seconds", None),
        }
        for name, value in row.items():
            columns.setdefault(name, []).append(value)
    summary = {
        **setting.description(),
        "matrix": [
            {
                "sensors": suite,
                "trained_on": source,
                "flown_on": observation,
                **comparison.cell(suite, source, observation).description(),
            }
            for suite in setting.suites
            for source in ("PD", *setting.sources)
            for observation in FLOWN_ON
        ],
        "conclusions": conclusions(comparison),
        "versions": versions("numpy", "numba", "scipy", "torch", "stable_baselines3"),
    }
    return [
        write_csv(setting.folder / "policies.csv", columns),
        write_json(setting.folder / "summary.json", summary),
    ]


def main(args: Args) -> None:
    """Compare."""
    began = time.perf_counter()
    with usage_errors():
        setting = configure(args)
    print(
        f"{setting.env_id}: {len(setting.plans)} trainings of {setting.steps:,} steps, "
        f"{setting.episodes:,} episodes with each policy; into {setting.folder}."
    )
    try:
        trainings = train_all(setting, args.jobs or resolve_threads(None))
    except KeyboardInterrupt:
        print("\nStopped. Start the same command again to go on from here.")
        raise SystemExit(130) from None
    comparison = fly_all(setting)
    for suite in setting.suites:
        print(f"\nSensors {suite}\n\n{matrix_text(comparison, suite)}")
    print()
    for sentence in conclusions(comparison):
        print(sentence)
    written = write_numbers(comparison, trainings)
    figures = write_figures(comparison)
    written += [file for pair in figures.values() for file in pair]
    seconds = sum(training.seconds for training in trainings.values())
    written.append(write_page(comparison, figures, seconds))
    print(
        f"\nWrote {len(written)} files to {setting.folder} after "
        f"{(time.perf_counter() - began) / 60:.1f} minutes; open {written[-1]}."
    )

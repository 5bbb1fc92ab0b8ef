"""Where does the estimate matter? Train arms with several seeds, and fly the same episodes.

    quad-gym study                                   # LookAround, 5 seeds
    quad-gym study stale_race
    quad-gym study outage_dash --arms truth estimate std --seeds 10
    quad-gym study --video webp                      # with a film of two policies side by side
    quad-gym study --quick                           # minutes: a check that it works, not a result
    quad-gym study --arms-file my_arms.py --arms truth mine

Arms of quad_gym/experiments/arms.py (or of a file like it) are trained with the compiled PPO, or
with another algorithm of Stable-Baselines3 that they name, and every policy flies the same test
episodes on the estimate. Prints a table with means over the seeds and 95 % intervals over seeds and
episodes, and conclusions, and writes figures, numbers and a report. Each training is a folder: an
interrupted study continues where it stopped.
"""

import csv
import runpy
import time
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Annotated, Any, Literal

import gymnasium
import numpy as np
from tyro.conf import arg

from baselines.keeping import EVALUATIONS, RunError
from baselines.plans import Plan
from baselines.recipes import Recipe, recipe
from baselines.seeds import first_seed
from quad_gym import IDS
from quad_gym.analysis import plots
from quad_gym.analysis.reports import require_writable
from quad_gym.commands.options import (
    EnvId,
    Keywords,
    leave,
    one_of,
    require_at_least,
    usage_errors,
    with_full_id,
    without_idle_filter,
)
from quad_gym.experiments.arms import Arm
from quad_gym.experiments.study_flights import Flown, fly
from quad_gym.experiments.study_report import table_text, write_report
from quad_gym.experiments.study_results import Study
from quad_gym.experiments.study_tasks import STUDIED, WITHIN, StudiedTask, stays
from quad_gym.experiments.study_words import conclusions
from quad_gym.params import checks as check

STUDIED_IDS = tuple(env_id for env_id, task in IDS.items() if task in STUDIED)
QUICK_SEEDS, QUICK_EPISODES, QUICK_STEPS = 2, 100, 300_000


@dataclass(frozen=True)
class Args:
    """Options of the study."""

    env_id: Annotated[EnvId, arg(help=one_of(STUDIED_IDS))] = "QuadGym/LookAround-v0"
    arms: tuple[str, ...] = ()
    """names of arms; if not given, those that carry the conclusions, or all of --arms-file"""
    arms_file: Path | None = None
    """a file with a tuple ARMS, as quad_gym/experiments/arms.py has; if not given, that one"""
    seeds: int = 5
    """training seeds"""
    steps: int | None = None
    """environment steps of each training; if not given, the recipe's"""
    set: Keywords = field(default_factory=dict)
    """parameters of the algorithm in place of the recipe's, such as gamma=0.99"""
    env: Keywords = field(default_factory=dict)
    """keywords of the environment, such as duration=30.0"""
    quick: bool = False
    """two seeds of 300,000 steps and 100 episodes: a check that it works, not a result"""

    episodes: int = 1000
    """of the test, the same for every policy"""
    seed: int = 0
    """of the first training"""
    first_episode: int = 0
    """seed of the first test episode; choose others than those that you looked at while choosing
    rewards and parameters"""
    success_within: float | None = None
    """of LookAround: an episode is a success if it is flown to the end, and its mean position error
    in the second half is below this [m]; if not given, 0.5"""
    threads: int | None = None
    """of flights and learning; if not given, one per core; no result depends on them"""
    video: Literal["none", "webp", "gif", "mp4"] = "none"
    """also write a film of this kind: training on truth and on the estimate, side by side in the
    same episode"""
    output: Path | None = None
    """folder; if not given, results/study/TASK (with --quick, .../TASK_quick)"""


def studied(args: Args) -> StudiedTask:
    """What is known of the task, with the options that change it.

    Raises:
        ValueError: If it is not studied, or an option does not belong to it.
    """
    args = with_full_id(args, STUDIED_IDS)
    about = STUDIED[IDS[args.env_id]]
    if args.success_within is None:
        return about
    within = check.positive("--success-within", args.success_within)
    if about.success is not stays:
        raise ValueError(f"--success-within belongs to LookAround, got it with {args.env_id!r}")
    meaning = about.meaning.replace(f"{WITHIN:g} m", f"{within:g} m")
    return replace(about, success=partial(stays, within=within), meaning=meaning)


def arms_of(args: Args) -> tuple[Arm, ...]:
    """The arms that are asked for, in the order of their file.

    Raises:
        ValueError: If there is no such file or arm.
    """
    about = studied(args)
    known: Any = about.arms
    wanted = args.arms or about.carrying
    if args.arms_file is not None:
        if not args.arms_file.is_file():
            raise ValueError(f"--arms-file must be a Python file, got {args.arms_file}")
        try:
            known = runpy.run_path(str(args.arms_file)).get("ARMS")
        except (SyntaxError, ValueError) as error:
            raise ValueError(
                f"--arms-file must be a Python file, got {args.arms_file}: {error}"
            ) from None
        if not (isinstance(known, tuple) and all(isinstance(arm, Arm) for arm in known)):
            raise ValueError(f"--arms-file {args.arms_file} must have a tuple ARMS of Arm")
        wanted = args.arms or tuple(arm.name for arm in known)
    names = [arm.name for arm in known]
    if len(set(names)) != len(names):
        raise ValueError(f"arms must have different names, got {', '.join(names)}")
    for name in wanted:
        check.choice("--arms", name, tuple(names))
    found = tuple(arm for arm in known if arm.name in wanted)
    trained = [arm.name for arm in found if arm.trained]
    for arm in found:
        if arm.flies is not None and arm.flies not in trained:
            raise ValueError(f"--arms must name {arm.flies}, whose policies {arm.name} flies")
    return found


def configure(args: Args) -> Study:
    """Check all options before anything is trained.

    Raises:
        ValueError: If an option is invalid, or the folder holds another study.
        OSError: If nothing can be written to the folder.
        ImportError: If matplotlib is missing, or what a film needs.
    """
    from quad_gym.commands.train import require_model

    plots.require_matplotlib()
    args = with_full_id(args, STUDIED_IDS)
    about = studied(args)
    require_at_least(args, seeds=1, episodes=2, seed=0, first_episode=0, threads=1)
    leave(args.env, {"observation": "--arms", "threads": "--threads"})
    arms = arms_of(args)
    name = IDS[args.env_id]
    study = Study(
        env_id=args.env_id,
        arms=arms,
        seeds=tuple(range(args.seed, args.seed + (QUICK_SEEDS if args.quick else args.seeds))),
        recipes={arm.algorithm: _recipe(args, arm.algorithm) for arm in arms if arm.trained},
        environment=dict(args.env),
        episodes=QUICK_EPISODES if args.quick else args.episodes,
        first_episode=first_seed("test", args.first_episode, args.episodes),
        about=about,
        folder=args.output or Path("results/study") / (f"{name}_quick" if args.quick else name),
        threads=args.threads,
    )
    for arm in study.arms:
        if arm.trained:
            plan = plan_of(study, arm, study.seeds[0])
            require_model(plan)
            plan.make_judge().close()
        test_flights(study, arm, 1).close()
    if args.video != "none":
        from quad_gym.experiments.study_films import require_film

        require_film(study, args.video)
    require_writable("--output", study.folder)
    return study


def _recipe(args: Args, algorithm: str) -> Recipe:
    """The recipe of an algorithm, with the options that change it."""
    chosen = recipe(args.env_id, algorithm)
    steps = args.steps or (QUICK_STEPS if args.quick else chosen.steps)
    return chosen.replace(steps=steps, parameters={**chosen.parameters, **args.set})


def plan_of(study: Study, arm: Arm, seed: int) -> Plan:
    """How an arm is trained."""
    chosen = study.recipes[arm.algorithm]
    return Plan(
        env_id=study.env_id,
        environment=without_idle_filter({**study.environment, **arm.environment, **arm.training}),
        learning=arm.learning,
        recipe=chosen.replace(parameters={**chosen.parameters, **arm.parameters}),
        seed=seed,
        engine=arm.engine,
        threads=study.threads,
        evaluations=study.about.evaluations,
    )


def test_flights(study: Study, arm: Arm, count: int) -> Any:
    """The environment of the test: on the estimate, unless the arm says otherwise."""
    keywords = without_idle_filter(
        {"observation": "estimate", **study.environment, **arm.environment}
    )
    return gymnasium.make_vec(study.env_id, num_envs=count, threads=study.threads, **keywords)


def train_all(study: Study) -> None:
    """Train every policy that is not trained yet, seed by seed.

    Raises:
        KeyboardInterrupt: If a training was stopped; it is kept, and goes on the next time.
        ValueError: If a folder holds another training.
    """
    from baselines.training import train

    wanted = [(seed, arm) for seed in study.seeds for arm in study.arms if arm.trained]
    for done, (seed, arm) in enumerate(wanted, 1):
        folder = study.run_folder(arm, seed)
        training = train(
            plan_of(study, arm, seed), folder, resume=True, tensorboard=False, quiet=True
        )
        if not training.finished:
            raise KeyboardInterrupt
        print(
            f"[{done}/{len(wanted)}] {arm.label}, seed {seed}: {training.seconds:.0f} s, "
            f"best return {training.best['return']:.1f}",
            flush=True,
        )


def fly_all(study: Study) -> dict[Any, Flown]:
    """Fly every policy in the test, unless it was flown before; by arm and seed."""
    from baselines.policies import load_policy

    flown = {}
    for arm in study.arms:
        env: Any = None
        for seed in study.seeds_of(arm):
            file = study.run_folder(arm, seed) / f"flown_{study.test_digest(arm, seed)}.npz"
            if not file.exists():
                env = env or test_flights(study, arm, study.episodes)
                policy = load_policy(study.policy_of(arm, seed), env)
                fly(policy, env, study.first_episode, study.about.traced).save(file)
            flown[arm.name, seed] = Flown.load(file)
    return flown


def curves_of(study: Study) -> dict[Any, Any]:
    """Million steps, and mean returns, of the evaluations while training; by arm and seed."""
    found = {}
    for arm in study.arms:
        for seed in study.seeds_of(arm):
            if arm.trained:
                file = study.run_folder(arm, seed) / EVALUATIONS
                with file.open(encoding="utf-8", newline="") as stream:
                    rows = [(float(r["steps"]), float(r["return"])) for r in csv.DictReader(stream)]
                steps, returns = np.array(rows).T
                found[arm.name, seed] = (steps / 1e6, returns)
    return found


def main(args: Args) -> None:
    """Study."""
    began = time.perf_counter()
    with usage_errors():
        study = configure(args)
    trained = sum(arm.trained for arm in study.arms)
    trainings = f"{trained * len(study.seeds)} trainings of {study.steps()}, "
    print(
        f"{study.env_id}: {len(study.arms)} arms, {trainings if trained else ''}"
        f"{study.episodes:,} episodes with each policy; into {study.folder}."
    )
    try:
        with usage_errors((RunError,)):
            train_all(study)
    except KeyboardInterrupt:
        print("\nStopped. Start the same command again to go on from here.")
        raise SystemExit(130) from None
    results = study.results(fly_all(study), curves_of(study))
    print(f"\n{table_text(results)}\n")
    for sentence in conclusions(results):
        print(sentence)
    film = None
    if args.video != "none":
        from quad_gym.experiments.study_films import write_film

        film = write_film(results, args.video, partial(test_flights, study))
    written = write_report(results, film)
    print(
        f"\nWrote {len(written)} files to {study.folder} after "
        f"{(time.perf_counter() - began) / 60:.1f} minutes; open {written[-1]}."
    )

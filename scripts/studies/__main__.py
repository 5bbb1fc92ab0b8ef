"""Train the arms of a benchmark task with several seeds, and fly the same episodes.

    python -m scripts.studies look_around                  # 5 seeds
    python -m scripts.studies outage_dash --arms truth estimate std --seeds 10
    python -m scripts.studies stale_race --video webp      # with a film of two policies
    python -m scripts.studies look_around --quick          # minutes: a check, not a result
    python -m scripts.studies look_around --arms-file my_arms.py --arms truth mine
    python -m scripts.studies run --all                    # everything behind the pages
    python -m scripts.studies again                        # its policies in other episodes

Arms of scripts/studies/arms.py (or of a file like it) are trained with the compiled PPO, or
with another algorithm of Stable-Baselines3 that they name, and every policy
flies the same test episodes on the estimate. Prints a table with means over the seeds and 95 %
intervals over seeds and episodes, and conclusions, and writes figures, numbers and a report. Each
training is a folder: an interrupted study continues where it stopped.
"""

import sys
import time
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, Literal

from tyro.conf import arg

from baselines.keeping import RunError
from baselines.recipes import Recipe, first_seed, recipe
from baselines.training import train
from quad_gym import IDS
from quad_gym.analysis import plots
from quad_gym.analysis.reports import require_writable
from quad_gym.commands import options
from quad_gym.experiments import progress, stopped
from scripts.studies.arms import Arm, chosen_arms, read_arms
from scripts.studies.films import require_film, write_film
from scripts.studies.report import conclusions, table_text, write_report
from scripts.studies.study import Study
from scripts.studies.tasks import STUDIED

STUDIED_IDS = tuple(env_id for env_id, task in IDS.items() if task in STUDIED)
QUICK_SEEDS, QUICK_EPISODES, QUICK_STEPS = 2, 100, 300_000


@dataclass(frozen=True)
class StudyArgs:
    """Options of the study."""

    env_id: Annotated[options.EnvId, arg(help=options.one_of(STUDIED_IDS))] = (
        "QuadGym/LookAround-v0"
    )
    arms: tuple[str, ...] = ()
    """names of arms; defaults to the arms behind the conclusions, or all of --arms-file"""
    arms_file: Path | None = None
    """a file with a tuple ARMS, as scripts/studies/arms.py has; defaults to that one"""
    seeds: int = 5
    """number of training seeds"""
    steps: int | None = None
    """number of environment steps of each training; defaults to the recipe's"""
    set: options.Parameters = field(default_factory=dict)
    env: options.Keywords = field(default_factory=dict)
    """keywords of the environment, such as duration=30.0"""
    quick: bool = False
    """two seeds of 300,000 steps and 100 episodes: a check that it works, not a result"""

    episodes: int = 1000
    """number of test episodes, the same for every policy"""
    seed: int = 0
    """seed of the first training"""
    first_episode: int = 0
    """seed of the first test episode; use other test episodes than those on which you tuned rewards
    and parameters"""
    threads: options.Threads = None
    video: Literal["none", "webp", "gif", "mp4"] = "none"
    """also render a side-by-side video: policies trained on truth and on the estimate, side by side
    in the same episode"""
    output: Path | None = None
    """folder; defaults to results/study/TASK (with --quick, .../TASK_quick)"""


def arms_of(args: StudyArgs) -> tuple[Arm, ...]:
    """Arms of the study, in the order of their file."""
    about = STUDIED[IDS[args.env_id]]
    if args.arms_file is None:
        return chosen_arms(about.arms, args.arms or about.carrying)
    known = read_arms(args.arms_file)
    return chosen_arms(known, args.arms or [arm.name for arm in known])


def configure(args: StudyArgs) -> Study:
    """Check all options before training."""
    plots.require_matplotlib()
    args = options.with_full_id(args, STUDIED_IDS)
    options.require_at_least(args, seeds=1, episodes=2, seed=0, first_episode=0, threads=1)
    options.leave(args.env, "threads", observation="--arms")
    arms = arms_of(args)
    name = IDS[args.env_id] + ("_quick" if args.quick else "")
    study = Study(
        env_id=args.env_id,
        arms=arms,
        seeds=tuple(range(args.seed, args.seed + (QUICK_SEEDS if args.quick else args.seeds))),
        recipes={arm.algorithm: _recipe(args, arm.algorithm) for arm in arms if arm.trained},
        environment=dict(args.env),
        episodes=QUICK_EPISODES if args.quick else args.episodes,
        first_episode=first_seed("test", args.first_episode, args.episodes),
        about=STUDIED[IDS[args.env_id]],
        folder=args.output or Path("results/study") / name,
        threads=args.threads,
    )
    study.check()
    if args.video != "none":
        require_film(study, args.video)
    require_writable("--output", study.folder)
    return study


def _recipe(args: StudyArgs, algorithm: str) -> Recipe:
    """Recipe of an algorithm, with the options that change it."""
    chosen = recipe(args.env_id, algorithm)
    steps = args.steps or (QUICK_STEPS if args.quick else chosen.steps)
    return chosen.replace(steps=steps, parameters={**chosen.parameters, **args.set})


def complete(study: Study) -> None:
    """Complete the trainings one after the other."""
    for number, training in enumerate(study.trainings, 1):
        done = train(training.plan, training.folder, resume=True, tensorboard=False, quiet=True)
        if not done.finished:
            raise SystemExit(stopped())
        print(progress(number, study.trainings, training), flush=True)


def main(args: StudyArgs) -> None:
    """Study."""
    began = time.perf_counter()
    with options.usage_errors():
        study = configure(args)
    counted = f"{len(study.trainings)} trainings of {study.steps()}, " if study.trainings else ""
    print(
        f"{study.env_id}: {len(study.arms)} arms, {counted}"
        f"{study.episodes:,} episodes with each policy; into {study.folder}."
    )
    with options.usage_errors((RunError,)):
        complete(study)
    results = study.results()
    print(f"\n{table_text(results)}\n")
    print("\n".join(conclusions(results)))
    film = None if args.video == "none" else write_film(results, args.video)
    written = write_report(results, film)
    print(
        f"\nWrote {len(written)} files to {study.folder} after "
        f"{(time.perf_counter() - began) / 60:.1f} minutes; open {written[-1]}."
    )


def run(words: list[str]) -> int:
    """Run the study, or the program that the first word names; return the exit code."""
    if words[:1] not in (["run"], ["again"]):
        main(options.parse(StudyArgs, words, prog="python -m scripts.studies", description=__doc__))
        return 0
    from scripts.studies import again
    from scripts.studies import run as campaign

    program: Any = {"run": campaign, "again": again}[words[0]]
    kind = {"run": campaign.RunArgs, "again": again.AgainArgs}[words[0]]
    prog = f"python -m scripts.studies {words[0]}"
    chosen = options.parse(kind, words[1:], prog=prog, description=program.__doc__)
    return int(program.main(chosen) or 0)


if __name__ == "__main__":
    with options.quiet_end():
        sys.exit(run(sys.argv[1:]))

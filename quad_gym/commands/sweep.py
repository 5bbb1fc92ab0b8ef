"""Train all combinations of environments, keywords, parameters and seeds.

    quad-gym sweep sweep.toml
    quad-gym sweep --engine compiled --env sensors=standard,rtk --set gamma=0.97,0.99 --seeds 5
    quad-gym sweep sweep.toml --steps 300000 --n-envs 64 256 --output results/sweep/short
    quad-gym sweep sweep.toml --dry-run

Several values are separated by commas in key=value, and are lists in the file. Each training has a
folder with the files of quad-gym train. Trainings run as processes of this machine. A training that
dies restarts from its checkpoint; a sweep that was stopped or killed continues when it is started
again; sweeps in one folder, also on several machines, share the work. The tables, trainings.csv,
groups.csv and table.txt, are made from the folders only.
"""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, Literal

import tyro

from quad_gym import IDS
from quad_gym.analysis.reports import require_writable
from quad_gym.batch.threads import resolve_threads
from quad_gym.commands.options import (
    Keywords,
    known_id,
    leave,
    require_at_least,
    usage_errors,
    value_of,
)
from quad_gym.experiments.driver import RETRIES, train_all
from quad_gym.experiments.experiment import Training, check_trainings
from quad_gym.experiments.sweep_plan import DEFAULTS, TABLES, expand, read
from quad_gym.experiments.sweep_table import FILES, row_of, table_text, write_tables


@dataclass(frozen=True)
class SweepArgs:
    """Options of the sweep; they override the file."""

    file: tyro.conf.Positional[
        Annotated[
            Path | None, tyro.conf.arg(help="file (.toml) of the trainings, as in docs/sweeps.md")
        ]
    ] = None
    env_ids: tuple[str, ...] = ()
    """ids of environments, or their short names; defaults to circle"""
    env: Keywords = field(default_factory=dict)
    """keywords of the environment, such as observation=truth sensors=standard,rtk"""
    algorithm: tuple[Literal["ppo", "recurrent_ppo", "sac", "td3", "tqc"], ...] = ()
    """reinforcement learning algorithms; defaults to ppo"""
    engine: Literal["sb3", "compiled"] | None = None
    """training engine; defaults to sb3"""
    steps: tuple[int, ...] = ()
    """number of environment steps of each training; defaults to the recipe's"""
    n_envs: tuple[int, ...] = ()
    """number of parallel flights; defaults to the recipe's"""
    set: Keywords = field(default_factory=dict)
    """parameters of the algorithm that override the recipe's, such as gamma=0.97,0.99"""
    recipe: Keywords = field(default_factory=dict)
    """other fields of the recipe, such as reward_scale=0.1,0.2"""
    seeds: int | None = None
    """number of training seeds; defaults to 1"""
    evaluations: int | None = None
    """number of evaluations and checkpoints of each training; defaults to 20"""
    episodes: int | None = None
    """number of episodes in each evaluation; defaults to 100"""

    output: Path | None = None
    """folder; defaults to results/sweep/NAME, with the name of the file or of the first task"""
    jobs: int | None = None
    """number of parallel trainings; defaults to one per core"""
    threads: int = 1
    """number of threads of each training; it does not affect results"""
    retries: int = RETRIES
    """number of restarts of a training that died"""
    dry_run: bool = False
    """print all trainings, and which are finished, without training"""
    progress: bool = True
    """show a progress bar, on a terminal"""


def configure(args: SweepArgs) -> tuple[list[Training], Path]:
    """Check all options, and expand them to trainings."""
    require_at_least(args, seeds=1, evaluations=1, episodes=1, jobs=1, threads=1, retries=0)
    given = _given(args, {} if args.file is None else read(args.file))
    leave(given["env"], "threads")
    given["env_ids"] = [known_id("env_ids", name) for name in given.get("env_ids", ["circle"])]
    name = IDS[given["env_ids"][0]] if args.file is None else args.file.stem
    folder = args.output or Path("results/sweep") / name
    trainings = expand(given, folder, threads=args.threads)
    check_trainings(trainings)
    return trainings, folder


def _given(args: SweepArgs, found: dict[str, Any]) -> dict[str, Any]:
    """Values of the file, overridden by the options."""
    for name in DEFAULTS:
        value = getattr(args, name)
        if name in TABLES:
            more = {key: _listed(each) for key, each in value.items()}
            found[name] = {**found.get(name, {}), **more}
        elif isinstance(value, tuple) and value:
            listed = len(value) > 1 or name == "env_ids"
            found[name] = list(value) if listed else value[0]
        elif value not in ((), None):
            found[name] = value
    return found


def _listed(given: Any) -> Any:
    """Convert values of an option that are separated by commas to a list."""
    if isinstance(given, tuple):
        return list(given)
    if isinstance(given, str) and "," in given:
        return [value_of(word) for word in given.split(",")]
    return given


def main(args: SweepArgs) -> int:
    """Sweep."""
    with usage_errors():
        trainings, folder = configure(args)
    steps = sum(training.plan.recipe.steps for training in trainings)
    if args.dry_run:
        for training in trainings:
            print(f"{training.folder}{'   finished' if training.finished else ''}")
        print(f"{len(trainings)} trainings, {steps:,} steps.")
        return 0
    with usage_errors():
        require_writable("--output", folder)
    jobs = args.jobs or max(1, resolve_threads(None) // args.threads)
    print(f"{len(trainings)} trainings, {steps:,} steps; into {folder}.", flush=True)
    hidden = None if args.progress else True
    driver = train_all(trainings, folder, jobs, retries=args.retries, hidden=hidden)
    rows = [row_of(training) for training in trainings]
    print(f"\n{table_text(rows)}", flush=True)
    with usage_errors((OSError,)):
        write_tables(rows, folder)
    print(f"Wrote {', '.join(FILES)} to {folder}.")
    return driver.exit_code()

"""Any set of trainings: environments x arms x keywords x parameters x seeds.

    quad-gym sweep sweep.toml
    quad-gym sweep sweep.toml --executor slurm --options slurm_partition=long mem_gb=4
    quad-gym sweep --engine compiled --env sensors=standard,rtk --set gamma=0.97,0.99 --seeds 5
    quad-gym sweep sweep.toml --steps 300000 --n-envs 64 256 --output results/sweep/short
    quad-gym sweep sweep.toml --dry-run

Several values are tried one by one: with key=value they are separated by commas, in the file they
are lists. Each training is a folder
of what quad-gym train writes. Trainings run as processes of this machine, as jobs of Slurm (through
submitit) or as tasks of Ray. One that dies starts again from its checkpoint; a sweep that was
stopped, or killed, continues when it is started again; two sweeps in one folder share the work. The
tables, trainings.csv, groups.csv and table.txt, are made from the folders alone.
"""

import sys
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, Literal

import tyro

from quad_gym import IDS
from quad_gym.commands.options import (
    Keywords,
    known_id,
    leave,
    require_at_least,
    usage_errors,
    value_of,
)


@dataclass(frozen=True)
class Args:
    """Options of the sweep; those of what is trained replace the file's."""

    file: tyro.conf.Positional[
        Annotated[Path | None, tyro.conf.arg(help="what to train, in TOML: see docs/sweeps.md")]
    ] = None
    env_ids: tuple[str, ...] = ()
    """what to fly: ids of environments, or their short names; if not given, circle"""
    arms: tuple[str, ...] = ()
    """names of arms, as quad-gym study has them; if not given, the environment as --env has it"""
    arms_file: Path | None = None
    """a file with a tuple ARMS; if not given, quad_gym/experiments/arms.py"""
    env: Keywords = field(default_factory=dict)
    """keywords of the environment, such as observation=truth sensors=standard,rtk"""
    algorithm: tuple[Literal["ppo", "recurrent_ppo", "sac", "td3", "tqc"], ...] = ()
    """how to learn; if not given, ppo"""
    engine: Literal["sb3", "compiled"] | None = None
    """what trains; if not given, sb3"""
    steps: tuple[int, ...] = ()
    """environment steps of a training; if not given, the recipe's"""
    n_envs: tuple[int, ...] = ()
    """flights at a time; if not given, the recipe's"""
    set: Keywords = field(default_factory=dict)
    """parameters of the algorithm in place of the recipe's, such as gamma=0.97,0.99"""
    recipe: Keywords = field(default_factory=dict)
    """other fields of the recipe, such as reward_scale=0.1,0.2"""
    seeds: int | None = None
    """training seeds; if not given, 1"""
    evaluations: int | None = None
    """evaluations, and checkpoints, of each training; if not given, 20"""
    episodes: int | None = None
    """flown in an evaluation; if not given, 100"""

    output: Path | None = None
    """folder; if not given, results/sweep/NAME, that of the file or of the first task"""
    executor: Literal["local", "slurm", "ray"] = "local"
    """what runs the trainings: processes, Slurm through submitit, or Ray"""
    options: Keywords = field(default_factory=dict)
    """of the executor: parameters of submitit's AutoExecutor, or of ray.init"""
    jobs: int | None = None
    """trainings at a time; if not given, as many as there are cores, or as Slurm or Ray likes"""
    threads: int = 1
    """of each training; no result depends on them"""
    retries: int = 2
    """how often a training that died is started again"""
    dry_run: bool = False
    """print what would be trained, and what of it is done"""
    progress: bool = True
    """show a progress bar, on a terminal"""


def configure(args: Args) -> tuple[list[Any], Path]:
    """Check all options, and expand them to trainings, before anything is trained.

    Raises:
        ValueError: If an option or the file is invalid, or a folder holds another training.
        OSError: If the file cannot be read.
        ImportError: If a package is missing.
    """
    from quad_gym.experiments.sweep_plan import expand, read

    require_at_least(args, seeds=1, evaluations=1, episodes=1, jobs=1, threads=1, retries=0)
    given = _given(args, {} if args.file is None else read(args.file))
    leave(given["env"], {"threads": "--threads"})
    given["env_ids"] = [known_id("env_ids", name) for name in given.get("env_ids", ["circle"])]
    name = IDS[given["env_ids"][0]] if args.file is None else args.file.stem
    folder = args.output or Path("results/sweep") / name
    trainings = expand(given, _arms(given, args), folder, threads=args.threads)
    _check(trainings)
    return trainings, folder


def _given(args: Args, found: dict[str, Any]) -> dict[str, Any]:
    """What the file has, and the options in its place."""
    for name in ("env_ids", "arms", "algorithm"):
        if values := getattr(args, name):
            found[name] = list(values)
    for name in ("steps", "n_envs"):
        if values := getattr(args, name):
            found[name] = list(values) if len(values) > 1 else values[0]
    for name in ("engine", "seeds", "evaluations", "episodes"):
        if (value := getattr(args, name)) is not None:
            found[name] = value
    for name in ("env", "set", "recipe"):
        more = {key: _values(value) for key, value in getattr(args, name).items()}
        found[name] = {**found.get(name, {}), **more}
    return found


def _values(given: Any) -> Any:
    """A list where an option has values separated by commas."""
    if isinstance(given, tuple):
        return list(given)
    if isinstance(given, str) and "," in given:
        return [value_of(word) for word in given.split(",")]
    return given


def _arms(given: dict[str, Any], args: Args) -> dict[str, Any]:
    """Arms by name."""
    if not given.get("arms"):
        return {}
    from quad_gym.commands import study

    asked = study.Args(arms=tuple(given["arms"]), arms_file=args.arms_file)
    return {arm.name: arm for arm in study.arms_of(asked)}


def _check(trainings: list[Any]) -> None:
    """Refuse folders with other trainings, and make the model of every group once."""
    from quad_gym.commands.train import require_model

    checked = set()
    for training in trainings:
        if not training.finished and training.group not in checked:
            checked.add(training.group)
            try:
                require_model(training.plan)
                training.plan.make_judge().close()
            except (TypeError, ValueError) as error:
                raise ValueError(f"{training.group}: {error}") from None


def main(args: Args) -> int:
    """Sweep."""
    from quad_gym.analysis.reports import require_writable
    from quad_gym.batch.threads import resolve_threads

    with usage_errors():
        trainings, folder = configure(args)
    if args.dry_run:
        for training in trainings:
            print(f"{training.folder}{'   finished' if training.finished else ''}")
        print(f"{len(trainings)} trainings, {_steps(trainings):,} steps.")
        return 0
    from tqdm import tqdm

    from quad_gym.experiments.sweep_driver import Driver
    from quad_gym.experiments.sweep_executors import make_executor

    with usage_errors():
        require_writable("--output", folder)
        executor, jobs = make_executor(
            args.executor, folder, args.threads, args.options, resolve_threads(None)
        )
    print(f"{len(trainings)} trainings, {_steps(trainings):,} steps; into {folder}.", flush=True)
    hidden = None if args.progress else True  # None: where nobody looks at a terminal
    with tqdm(total=_steps(trainings), unit=" steps", unit_scale=True, disable=hidden) as bar:
        driver = Driver(trainings, executor, args.jobs or jobs, args.retries, bar.write, bar)
        ended = driver.run()
    written = _report(trainings, folder)
    if driver.failed:
        print(f"{len(driver.failed)} failed; start the same command again to try them again:")
        for training in trainings:
            if training.name in driver.failed:
                print(f"  {training.folder}: {driver.failed[training.name]}")
    if not ended:
        print("Stopped. Start the same command again to go on from here.", file=sys.stderr)
        return 130
    return 1 if driver.failed or not written else 0


def _steps(trainings: list[Any]) -> int:
    return sum(training.plan.recipe.steps for training in trainings)


def _report(trainings: list[Any], folder: Path) -> bool:
    """Print the table, and write it; whether that worked."""
    from quad_gym.experiments.sweep_table import row_of, table_text, write_tables

    rows = [row_of(training) for training in trainings]
    print(f"\n{table_text(rows)}", flush=True)
    try:
        write_tables(rows, folder)
    except OSError as error:
        print(f"error: the tables cannot be written: {error}", file=sys.stderr)
        return False
    print(f"Wrote trainings.csv, groups.csv and table.txt to {folder}.")
    return True

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

import itertools
import os
import tomllib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
import tyro

from baselines.recipes import Plan, Recipe, recipe
from quad_gym import IDS
from quad_gym.analysis.metrics import in_brackets, mean_interval, rate_over_trainings
from quad_gym.analysis.reports import columns_of, require_writable, text_table, write_csv
from quad_gym.batch.threads import resolve_threads
from quad_gym.commands.options import (
    Keywords,
    known_id,
    leave,
    require_at_least,
    usage_errors,
    value_of,
)
from quad_gym.experiments import RETRIES, Training, check_trainings, make_trainings, train_all
from quad_gym.params import checks as check

# --------------------------------------------------------------------------------------------------
# Trainings of a sweep: a file or options, expanded to all combinations of values.
# --------------------------------------------------------------------------------------------------

DEFAULTS: Mapping[str, Any] = {
    "env_ids": ["QuadGym/Circle-v0"],
    "algorithm": "ppo",
    "steps": None,
    "n_envs": None,
    "engine": "sb3",
    "seeds": 1,
    "evaluations": 20,
    "episodes": 100,
    "env": {},
    "set": {},
    "recipe": {},
}
"""Keys of a sweep, see `docs/training.md`; None: as in the recipe."""

TABLES = ("env", "set", "recipe")
_SINGLE = ("algorithm", "steps", "n_envs")  #: fields of a recipe that are separate keys
_ELSEWHERE = {**{name: name for name in _SINGLE}, "parameters": "set"}
"""Keys to use instead of fields of the recipe."""
_RECIPE = tuple(f.name for f in fields(Recipe) if f.name not in (*_ELSEWHERE, "flights", "policy"))

Axis = tuple[str, str]  #: table (empty for a separate key) and key of a value


def read(file: Path) -> dict[str, Any]:
    """Read a sweep file."""
    try:
        found = tomllib.loads(file.read_text(encoding="utf-8"))
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise ValueError(f"{file} is not valid TOML: {error}") from None
    for name, value in found.items():
        check.choice(f"a key of {file}", name, tuple(DEFAULTS))
        if name in TABLES and not isinstance(value, dict):
            raise ValueError(f"{name} in {file} must be a table, got {value!r}")
        names = isinstance(value, list) and all(isinstance(each, str) for each in value)
        if name == "env_ids" and not names:
            raise ValueError(f"{name} must be a list of names, got {value!r}")
    return found


def expand(given: Mapping[str, Any], folder: Path, *, threads: int = 1) -> list[Training]:
    """All trainings of a sweep, with keys of `DEFAULTS`; the first seed of each is first."""
    spec = {**DEFAULTS, **given}
    axes: dict[Axis, Any] = {(table, k): v for table in TABLES for k, v in spec[table].items()}
    axes |= {("", key): spec[key] for key in _SINGLE if spec[key] is not None}
    tried = [value if isinstance(value, list) else [value] for value in axes.values()]
    if [] in tried:
        empty = ".".join(filter(None, list(axes)[tried.index([])]))
        raise ValueError(f"{empty} must have at least one value")
    cases: dict[str, Plan] = {}
    for env_id, values in itertools.product(spec["env_ids"], itertools.product(*tried)):
        chosen = dict(zip(axes, values, strict=True))
        engine = "compiled_" if spec["engine"] == "compiled" else ""
        words = [IDS[env_id], f"{engine}{chosen['', 'algorithm']}"]
        words += [  # values from lists, so that further values do not change it
            f"{axis[1]}={_word(value)}"
            for axis, value in chosen.items()
            if isinstance(axes[axis], list) and axis[1] != "algorithm"
        ]
        name = ",".join(words)
        if name in cases:
            raise ValueError(f"every value of a sweep must be given once, got {name} twice")
        cases[name] = _plan(spec, env_id, chosen, threads)
    return make_trainings(cases, _seeds(spec["seeds"]), folder)


def _seeds(given: Any) -> Sequence[int]:
    if not isinstance(given, list):
        return range(check.whole("seeds", given))
    if not given or len(set(given)) < len(given):
        raise ValueError(f"seeds must be different numbers, at least one, got {given}")
    return [check.whole("seeds", seed, least=0) for seed in given]


def _plan(spec: Mapping[str, Any], env_id: str, chosen: Mapping[Axis, Any], threads: int) -> Plan:
    tables = {t: {k: _frozen(v) for (u, k), v in chosen.items() if u == t} for t in (*TABLES, "")}
    for name in tables["recipe"]:
        if name in _ELSEWHERE:
            raise ValueError(f"recipe must not hold {name}: use {_ELSEWHERE[name]} instead")
        check.choice("recipe", name, _RECIPE)
    base = recipe(env_id, tables[""].pop("algorithm"))
    return Plan(
        env_id=env_id,
        environment=tables["env"],
        recipe=base.replace(
            **tables[""],
            **tables["recipe"],
            parameters={**base.parameters, **tables["set"]},
        ),
        threads=threads,
        **{name: spec[name] for name in ("engine", "evaluations", "episodes")},
    )


def _frozen(value: Any) -> Any:
    """Convert lists to tuples, as keywords and recipes require."""
    return tuple(map(_frozen, value)) if isinstance(value, list) else value


def _word(value: Any) -> str:
    """Value in the name of a folder."""
    if isinstance(value, list | tuple):
        return "x".join(map(_word, value))
    text = str(value).lower() if isinstance(value, bool) else str(value)
    return "".join(c if c.isalnum() or c in "._-+" else "-" for c in text)


# --------------------------------------------------------------------------------------------------
# Tables of a sweep, made from its folders only, without times and paths.
#
# An unfinished training has only its steps.
# --------------------------------------------------------------------------------------------------

SCORES = ("mean_error", "late_error", "crash_rate", "return", "gates_passed")
"""Scores of the best evaluation of a training."""

FILES = ("trainings.csv", "groups.csv", "table.txt")


def row_of(training: Training) -> dict[str, Any]:
    """Row of a training, from its folder."""
    record = training.record()
    finished = bool(record.get("finished"))
    best = record["best"] if finished else {}
    return {
        "group": training.case,
        "seed": training.plan.seed,
        "finished": finished,
        "steps": record["steps"] if finished else training.steps_done(),
        "best_steps": best.get("steps"),
        "episodes": training.plan.episodes,
        **{name: best.get(name) for name in SCORES},
    }


def groups_of(rows: Sequence[dict[str, Any]]) -> list[dict[str, Any]]:
    """Mean of each score over the finished seeds of each group, with its 95 % interval.

    Intervals are Student's t; for crash rates, `rate_over_trainings`.
    """
    found = []
    for group in dict.fromkeys(row["group"] for row in rows):
        those = [row for row in rows if row["group"] == group]
        finished = sum(row["finished"] for row in those)
        summary = {"group": group, "trainings": len(those), "finished": finished}
        for name in SCORES:
            values = np.array([row[name] for row in those if row[name] is not None])
            low = high = None
            if values.size > 1:
                low, high = mean_interval(values)
                if name == "crash_rate":
                    _, low, high = rate_over_trainings(values, those[0]["episodes"])
            summary[name] = float(values.mean()) if values.size else None
            summary[f"{name}_low"], summary[f"{name}_high"] = low, high
        found.append(summary)
    return found


def table_text(rows: Sequence[dict[str, Any]]) -> str:
    """Tables for the screen: groups, then trainings."""

    def cell(row: dict[str, Any], name: str, form: str) -> str:
        if row[name] is None:
            return "-"
        low, high = row.get(f"{name}_low"), row.get(f"{name}_high")
        interval = None if low is None or high is None else (low, high)
        return in_brackets(row[name], interval, form)

    def cells(row: dict[str, Any]) -> list[str]:
        shown = (("mean_error", ".4f"), ("crash_rate", ".1%"), ("return", ".1f"))
        return [cell(row, name, form) for name, form in shown]

    headings = ("error [m]", "crashed", "return")
    groups = [
        [row["group"], f"{row['finished']}/{row['trainings']}", *cells(row)]
        for row in groups_of(rows)
    ]
    single = []
    for row in rows:
        finished = "yes" if row["finished"] else "no"
        name = f"{row['group']}/seed_{row['seed']}"
        single.append([name, finished, f"{row['steps']:,}", *cells(row)])
    mean = "best evaluation: mean over finished seeds [95 % interval, Student's t]"
    first = text_table({"": ("group", "finished"), mean: headings}, groups)
    heads = {"": ("training", "finished", "steps"), "best evaluation": headings}
    return f"{first}\n\n{text_table(heads, single)}\n"


def write_tables(rows: Sequence[dict[str, Any]], folder: Path) -> None:
    """Write `FILES` atomically."""
    parts = [folder / f"{name}.{os.getpid()}.part" for name in FILES]  # of this sweep alone
    for part, table in zip(parts, (rows, groups_of(rows)), strict=False):
        write_csv(part, columns_of(table))
    parts[-1].write_text(table_text(rows), encoding="utf-8")
    for part, name in zip(parts, FILES, strict=True):
        part.replace(folder / name)


# --------------------------------------------------------------------------------------------------
# Train all combinations of environments, keywords, parameters and seeds.
# --------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class SweepArgs:
    """Options of the sweep; they override the file."""

    file: tyro.conf.Positional[
        Annotated[
            Path | None, tyro.conf.arg(help="file (.toml) of the trainings, as in docs/training.md")
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

"""All trainings and flights behind the conclusions of the pages, as data and as cells.

A campaign is a list of parts, the most important conclusion first. A part is the training of some
arms with one number of steps and several seeds, and a cell is one row of a table: a policy, trained
with one seed, and its test episodes. Every cell has its own file, so that several processes can
work on a campaign at once, and an interrupted one continues where it stopped.

The results are in a folder named after the digest of the golden flights: if these have changed,
everything is trained again.
"""

import fnmatch
import hashlib
import json
import os
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

from baselines.recipes import IMITATION, Recipe, description, first_seed, recipe
from baselines.training import train
from quad_gym import IDS
from quad_gym.analysis.reports import as_json, write_json
from quad_gym.envs.config import with_effect
from quad_gym.experiments import PAUSE, Flown, Job, Training, Trial
from quad_gym.records.sizes import PRECISION
from scripts.studies.arms import Arm, chosen_arms
from scripts.studies.rows import FIRST, Rows
from scripts.studies.scores import worst_tenth
from scripts.studies.study import Study
from scripts.studies.tasks import STUDIED, StudiedTask

ROOT = Path(__file__).parents[2]
GOLDEN = ROOT / "tests/golden/flights.json"
DATA = ROOT / "docs/data"  #: folder of the committed tables
OUTPUT = Path("results/studies")  #: folder of trainings and rows

FIRST_EPISODE = 100_000  #: seed of the first test episode
EPISODES = 1000  #: number of test episodes of each policy

SECONDS_PER_MILLION: Mapping[str, float] = {
    "ppo": 16.0,
    "recurrent_ppo": 130.0,
    "sac": 570.0,
    IMITATION: 60.0,
}
"""Processor time of a million steps, by algorithm, until a training has been measured."""
OUTAGE_SECONDS_PER_MILLION: Mapping[str, float] = {
    "ppo": 185.0,
    "recurrent_ppo": 300.0,
    IMITATION: 200.0,
}
"""Processor time of a million steps in OutageDash, whose steps last 0.1 to 0.25 s."""
FLIGHT_SECONDS = 8.0  #: processor time of the test episodes of a policy, until measured


class StoppedError(Exception):
    """Raised when a training was stopped by Ctrl-C or SIGTERM."""


@dataclass(frozen=True, kw_only=True)
class Part:
    """Arms of one task, trained with one number of steps and several seeds."""

    table: str
    """Name of the table, `docs/data/TABLE.csv`"""
    decides: str
    """Conclusion that needs the part, for people who wait for it"""
    env_id: str
    arms: tuple[str, ...]
    """Names of arms; rules among them fly once"""
    steps: int
    seeds: int
    flights: tuple[str, ...]
    """Patterns of the golden flights of its tasks and suites"""
    environment: Mapping[str, Any] = field(default_factory=dict)
    """Keywords of the environment in training and test"""
    parameters: Mapping[str, Any] = field(default_factory=dict)
    """Parameters of the algorithms, of all arms, that override the recipe's"""
    columns: Mapping[str, str] = field(default_factory=dict)
    """Further columns of its rows, and their values"""
    about: StudiedTask | None = None
    """Definition of the studies of the task; None: the one of `STUDIED`"""
    recipes: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)
    """Fields of the recipe of an algorithm that override the task's, such as its steps"""
    recipe_of_task: str | None = None
    """Id whose recipe is used; None: the one of `env_id`"""

    @cached_property
    def digest(self) -> str:
        """Digest of the golden flights of the part."""
        return flights_digest(self.flights)

    @property
    def defined(self) -> StudiedTask:
        """Definition of the studies of the task."""
        return self.about or STUDIED[IDS[self.env_id]]

    def study(self, root: Path, threads: int | None = 1) -> Study:
        """Make the study of the part, with its folder below `root`."""
        arms = chosen_arms(self.defined.arms, self.arms)
        where = "_".join([self.table, *self.columns.values()])
        return Study(
            env_id=self.env_id,
            arms=arms,
            seeds=tuple(range(self.seeds)),
            recipes={arm.algorithm: self.recipe_of(arm.algorithm) for arm in arms if arm.trained},
            environment=self.environment,
            episodes=EPISODES,
            first_episode=first_seed("test", FIRST_EPISODE, EPISODES),
            about=self.defined,
            folder=root / self.digest / where / f"{self.steps}",
            threads=threads,
        )

    def recipe_of(self, algorithm: str) -> Recipe:
        """Recipe of an algorithm."""
        chosen = recipe(self.recipe_of_task or self.env_id, algorithm)
        own: dict[str, Any] = {"steps": self.steps, **self.recipes.get(algorithm, {})}
        parameters = {**chosen.parameters, **self.parameters, **own.pop("parameters", {})}
        changed: Recipe = chosen.replace(**own, parameters=parameters)
        return changed

    def cells(self, root: Path, threads: int | None = 1) -> Iterator["Cell"]:
        """Cells of the part: rules first, then all arms with the first seed, and so on."""
        study = self.study(root, threads)
        trials = study.trials()
        for arm in study.arms:
            if arm.policy is not None:
                yield Cell(self, study, trials[arm.name], arm, None)
        for seed in study.seeds:
            for arm in study.arms:
                if arm.policy is None:
                    yield Cell(self, study, trials[arm.name], arm, seed)


@dataclass(frozen=True, eq=False)
class Cell:
    """One row of a table: a policy and its test episodes."""

    part: Part
    study: Study
    trial: Trial
    arm: Arm
    seed: int | None
    """Seed of the training; None: a fixed rule"""

    @property
    def name(self) -> str:
        """Name of the cell in messages."""
        words = [self.part.table, *self.part.columns.values(), self.arm.name]
        steps = [] if self.seed is None else [f"{self.part.steps:,} steps", f"seed {self.seed}"]
        return ", ".join([*words, *steps])

    @property
    def file(self) -> Path:
        """File of the row."""
        seed = "rule" if self.seed is None else f"seed_{self.seed}"
        return self.study.folder / "rows" / f"{self.arm.name}_{seed}.json"

    @property
    def key(self) -> tuple[Any, ...]:
        """Values of the row's columns that name the cell; see `row_key`."""
        plan = None if self.training is None else self.training.plan
        named = {
            "arm": self.arm.name,
            "seed": self.seed,
            "steps": None if plan is None else plan.recipe.steps,
            "episodes": self.study.episodes,
            "flights": self.part.digest,
        }
        return row_key({**named, **self.part.columns})

    @property
    def row(self) -> dict[str, Any] | None:
        """The row; None before it is measured."""
        if not self.file.exists():
            return None
        found: dict[str, Any] = json.loads(self.file.read_text(encoding="utf-8"))
        return found

    @cached_property
    def training(self) -> Training | None:
        """Training whose policy flies; None for a fixed rule."""
        if self.seed is None:
            return None
        return self.study.trainings_of(self.arm.flies or self.arm.name)[self.seed]

    @property
    def definition(self) -> str:
        """Everything that the numbers follow from, as text: cells that share it have equal rows."""
        flown = {
            "env_id": self.trial.env_id,
            "keywords": with_effect(self.trial.keywords),
            "episodes": self.trial.episodes,
            "first_episode": self.trial.first_episode,
            "policy": self.arm.policy,
            "training": None if self.training is None else description(self.training.plan),
            "precision": self.arm.precision,
            "flights": self.part.digest,
            "columns": tuple(self.study.about.columns),
        }
        return json.dumps(as_json(flown), sort_keys=True)

    def relabeled(self, row: Mapping[str, Any]) -> dict[str, Any]:
        """Row of a cell with the same `definition`, under the names of this one."""
        kept = (*FIRST, "worst_tenth", *self.study.about.columns)
        own = {"arm": self.arm.name, "label": self.arm.label, **self.part.columns}
        seconds = row["seconds"] if self.trains else 0.0
        return {**{name: row[name] for name in kept}, "seconds": seconds, **own}

    @property
    def trains(self) -> bool:
        """True if the cell has a training that is not another arm's."""
        return self.seed is not None and self.arm.flies is None

    @property
    def expected_seconds(self) -> float:
        """Processor time of the cell, until one like it has been measured."""
        steps = self.training.plan.recipe.steps if self.training and self.trains else 0
        rates = OUTAGE_SECONDS_PER_MILLION if "Outage" in self.part.env_id else {}
        rate = rates.get(self.arm.algorithm, SECONDS_PER_MILLION[self.arm.algorithm])
        return FLIGHT_SECONDS + 1e-6 * steps * rate

    def run(self) -> dict[str, Any]:
        """Train, or continue the training, fly, and write the row.

        Raises `StoppedError` if the training was stopped, from where it continues next time.
        """
        precision = self.arm.precision
        seconds = 0.0 if self.training is None else _trained(self.training, precision)
        began = time.process_time()
        policy = self.arm.policy if self.training is None else self.training.best
        assert policy is not None
        flown = self.trial.flown(policy)
        row = self._row(flown, seconds if self.trains else 0.0)
        row["flown_in"] = round(time.process_time() - began, 1)
        self.write(row)
        return row

    def write(self, row: Mapping[str, Any]) -> None:
        """Write the row into its file, at once."""
        self.file.parent.mkdir(parents=True, exist_ok=True)
        write_json(self.file.with_suffix(".part"), row).replace(self.file)

    def _row(self, flown: Flown, seconds: float) -> dict[str, Any]:
        about, returns = self.study.about, flown.episodes.returns
        plan = None if self.training is None else self.training.plan
        return {
            "arm": self.arm.name,
            "label": self.arm.label,
            "seed": self.seed,
            "steps": None if plan is None else plan.recipe.steps,
            "episodes": self.study.episodes,
            "success": float(about.success(flown).mean()),
            "crashed": float(flown.episodes.crashed.mean()),
            "return": float(returns.mean()),
            "return_sd": float(returns.std(ddof=1)),
            "seconds": round(seconds, 1),
            "flights": self.part.digest,
            "worst_tenth": float(worst_tenth(returns)),
            **{name: float(column.of(flown).mean()) for name, column in about.columns.items()},
            **self.part.columns,
        }


def _trained(training: Training, precision: str) -> float:
    """Complete a training; returns its processor time over all sittings [s]."""
    file = training.folder / "processor.json"
    before = json.loads(file.read_text(encoding="utf-8"))["seconds"] if file.exists() else 0.0
    if training.finished:
        return float(before)
    began = _processor_time()
    try:
        if precision == PRECISION:
            done = train(training.plan, training.folder, resume=True, tensorboard=False, quiet=True)
            finished = done.finished
        else:
            finished = _trained_elsewhere(training, precision)
    finally:
        spent = before + _processor_time() - began
        if training.folder.exists():
            write_json(file, {"seconds": spent})
    if not finished:
        raise StoppedError
    return float(spent)


def _processor_time() -> float:
    """Processor time of this process and those that it has waited for [s]."""
    return sum(os.times()[:4])


def _trained_elsewhere(training: Training, precision: str) -> bool:
    """Train in a process with another precision; returns True if all steps are completed."""
    # the new process inherits the variable; this one has already read its own
    os.environ["QUAD_GYM_PRECISION"] = precision
    try:
        job = Job(training.folder / "logs", training)
    finally:
        os.environ["QUAD_GYM_PRECISION"] = PRECISION
    while (ended := job.ended()) is None:
        try:
            time.sleep(PAUSE)
        except KeyboardInterrupt:
            job.stop()
    if ended.kind not in ("finished", "stopped"):
        raise RuntimeError(f"training {training.name} in {precision} precision {ended}")
    return ended.kind == "finished"


def row_key(row: Mapping[str, Any]) -> tuple[Any, ...]:
    """Values of the columns of a row that name its cell in a table."""
    names = ("arm", "seed", "steps", "episodes", "flights", "task", "suite")
    return tuple(
        row.get(name) or None if name in ("task", "suite") else row[name] for name in names
    )


def flights_digest(patterns: Sequence[str]) -> str:
    """Digest of the golden flights whose names match patterns.

    Raises:
        ValueError: If a pattern matches none.
    """
    golden = json.loads(GOLDEN.read_text(encoding="utf-8"))
    chosen: dict[str, str] = {}
    for pattern in patterns:
        names = fnmatch.filter(golden, pattern)
        if not names:
            raise ValueError(f"no golden flight is named {pattern}")
        chosen |= {name: golden[name] for name in names}
    return hashlib.sha256(json.dumps(chosen, sort_keys=True).encode()).hexdigest()[:16]


def tables(cells: Sequence[Cell]) -> dict[str, Rows]:
    """Rows that have been measured, by table."""
    found: dict[str, list[dict[str, Any]]] = {}
    for cell in cells:
        row = cell.row
        if row is not None:
            row.pop("flown_in", None)
            found.setdefault(cell.part.table, []).append(row)
    return {table: Rows(rows) for table, rows in found.items()}


def is_complete(part: Part, rows: Rows) -> bool:
    """True if rows have every arm and seed of a part, with its steps."""
    for arm in chosen_arms(part.defined.arms, part.arms):
        steps = None if arm.policy is not None else part.recipe_of(arm.algorithm).steps
        found = rows.where(**part.columns, flights=part.digest).of(arm.name, steps)
        if found.seeds < (1 if arm.policy is not None else part.seeds):
            return False
    return True

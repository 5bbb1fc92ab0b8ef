"""Experiments: cases and seeds, their trainings, and the test flights of the policies."""

import csv
from abc import ABC, abstractmethod
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from tqdm import tqdm

from baselines.keeping import EVALUATIONS, best_file
from baselines.plans import Plan
from baselines.training import require_model, run_in
from quad_gym.experiments.flown import Flown, Trial

Floats = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Training:
    """Training of one case with one seed."""

    case: str
    """Name of the case, and of its folder below `runs`"""
    plan: Plan
    folder: Path

    @property
    def name(self) -> str:
        """Name of the training in messages."""
        return f"{self.case}/seed_{self.plan.seed}"

    def record(self) -> dict[str, Any]:
        """Contents of `training.json`; empty before the first checkpoint."""
        return run_in(self.folder, self.plan, resume=True) or {}

    @property
    def finished(self) -> bool:
        """True if all steps are completed."""
        return bool(self.record().get("finished"))

    @property
    def best(self) -> str:
        """File of the policy of the best evaluation."""
        return str(best_file(self.plan, self.folder))

    def curve(self, score: str) -> tuple[Floats, Floats]:
        """Steps and scores of the evaluations so far, (k,) each."""
        rows = [(row["steps"], row[score]) for row in read_evaluations(self.folder)]
        steps, scores = np.array(rows).reshape(-1, 2).T
        return steps, scores

    def steps_done(self) -> int:
        """Number of steps at the last evaluation."""
        return int(max(self.curve("steps")[0], default=0))


def read_evaluations(folder: Path) -> list[dict[str, float]]:
    """Evaluations of the training in a folder so far."""
    file = folder / EVALUATIONS
    lines = file.read_text(encoding="utf-8").splitlines() if file.exists() else []
    return [{name: float(x) for name, x in row.items()} for row in csv.DictReader(lines)]


def make_trainings(cases: Mapping[str, Plan], seeds: Sequence[int], folder: Path) -> list[Training]:
    """Trainings of all cases with all seeds; the first seed of every case is first."""
    return [
        Training(case, plan.replace(seed=seed), folder / "runs" / case / f"seed_{seed}")
        for seed in seeds
        for case, plan in cases.items()
    ]


def check_trainings(trainings: Iterable[Training]) -> None:
    """Check all folders, and make model and environment of each unfinished case once."""
    for training in {each.case: each for each in trainings if not each.finished}.values():
        try:
            require_model(training.plan)
            training.plan.make_judge().close()
        except (TypeError, ValueError) as error:
            raise ValueError(f"{training.case}: {error}") from None


@dataclass(frozen=True, eq=False, kw_only=True)
class Experiment(ABC):
    """Cases that are trained with several seeds, and trials in which the policies fly."""

    env_id: str
    seeds: tuple[int, ...]
    episodes: int
    """Number of test episodes"""
    first_episode: int
    """Seed of the first test episode"""
    environment: Mapping[str, Any]
    """Keywords of the environment in training and test"""
    folder: Path
    threads: int | None = None

    @abstractmethod
    def cases(self) -> dict[str, Plan]:
        """Plans of the trainings by name of the case, with any seed."""

    @abstractmethod
    def trials(self) -> dict[str, Trial]:
        """Test flights by name."""

    def trial(
        self, keywords: Mapping[str, Any], policy: str, kind: type[Trial] = Trial, **more: Any
    ) -> Trial:
        """Test flights with keywords of the environment; see `kind` for the other arguments."""
        names = ("env_id", "episodes", "first_episode", "threads")
        shared: dict[str, Any] = {name: getattr(self, name) for name in names}
        keywords = {**self.environment, **keywords}
        return kind(keywords=keywords, policy=policy, **shared, **more)

    @cached_property
    def trainings(self) -> list[Training]:
        """Trainings, the first seed of every case first."""
        return make_trainings(self.cases(), self.seeds, self.folder)

    def trainings_of(self, case: str) -> list[Training]:
        """Trainings of a case, in the order of the seeds."""
        return [training for training in self.trainings if training.case == case]

    def check(self) -> None:
        """Check all plans, folders and environments; raises the errors of `check_trainings`."""
        check_trainings(self.trainings)
        for trial in self.trials().values():
            trial.make(1).close()

    def policies(self, trial: Trial) -> list[str]:
        """Policies that fly a trial: one per seed, or a fixed one."""
        return [training.best for training in self.trainings_of(trial.policy)] or [trial.policy]

    def fly(self) -> dict[str, list[Flown]]:
        """Fly all policies; returns the flights of each policy, by name of the trial."""
        flown = {}
        for name, trial in tqdm(self.trials().items(), desc="evaluating", unit=" runs"):
            flown[name] = [trial.flown(policy) for policy in self.policies(trial)]
        return flown

"""A study: what belongs to it, and its numbers."""

import hashlib
import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from baselines.keeping import SUFFIXES
from baselines.recipes import Recipe
from quad_gym.analysis.intervals import (
    Estimated,
    Score,
    mean,
    mean_over_trainings,
    probability_of_improvement,
    rate_over_trainings,
)
from quad_gym.analysis.reports import as_json
from quad_gym.experiments.arms import Arm
from quad_gym.experiments.study_flights import Flown
from quad_gym.experiments.study_tasks import ALWAYS, StudiedTask
from quad_gym.kernels.compiling.digest import flights_digest
from quad_gym.params.suites import contents_of_suite_files

Floats = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Study:
    """What is trained and flown."""

    env_id: str
    arms: tuple[Arm, ...]
    seeds: tuple[int, ...]
    recipes: Mapping[str, Recipe]
    """by algorithm, of those that train an arm"""
    environment: Mapping[str, Any]
    episodes: int
    first_episode: int
    about: StudiedTask
    """of the task: success, columns, what is kept"""
    folder: Path
    threads: int | None

    def seeds_of(self, arm: Arm) -> tuple[int | None, ...]:
        """The seeds of its trainings; a single None where it is not trained."""
        return self.seeds if arm.policy is None else (None,)

    def run_folder(self, arm: Arm, seed: int | None) -> Path:
        """Where a training, or a fixed rule, is kept."""
        place = self.folder / "runs" / arm.name
        return place if seed is None else place / f"seed_{seed}"

    def policy_folder(self, arm: Arm, seed: int | None) -> Path:
        """Where the training is kept whose policy an arm flies."""
        name = arm.flies or arm.name
        return self.folder / "runs" / name / f"seed_{seed}"

    def policy_of(self, arm: Arm, seed: int | None) -> str:
        """The policy that an arm flies: a rule by name, or the file of a training."""
        engine = next(a.engine for a in self.arms if a.name == (arm.flies or arm.name))
        return arm.policy or str(self.policy_folder(arm, seed) / f"best{SUFFIXES[engine]}")

    def test_digest(self, arm: Arm, seed: int | None) -> str:
        """Of what the test of an arm depends on: the policy, the episodes, the code that flies."""
        about = {**self.environment, **arm.environment}
        policy = Path(self.policy_of(arm, seed))
        trained = hashlib.sha256(policy.read_bytes()).hexdigest() if policy.is_file() else ""
        flight = [self.env_id, about, self.episodes, self.first_episode, arm.policy, trained]
        files = contents_of_suite_files(about.get("sensors"))
        given = as_json([*flight, self.about.traced, flights_digest(), *files.values()])
        return hashlib.sha256(json.dumps(given, sort_keys=True).encode()).hexdigest()[:12]

    def steps(self) -> str:
        """How many environment steps trainings have, for people."""
        counts = {recipe.steps for recipe in self.recipes.values()}
        if len(counts) < 2:
            return f"{counts.pop():,} steps" if counts else ""
        each = [f"{recipe.steps:,} ({name})" for name, recipe in self.recipes.items()]
        return f"{' or '.join(each)} steps"

    def description(self) -> dict[str, Any]:
        """Everything that the results depend on, as JSON has it."""
        names = ("env_id", "arms", "seeds", "recipes", "environment", "episodes")
        about = {name: getattr(self, name) for name in (*names, "first_episode")}
        about["success"] = self.about.meaning
        return as_json(about)  # type: ignore[no-any-return]

    def results(self, flown: Mapping[Any, Flown], curves: Mapping[Any, Any]) -> "Results":
        """The numbers that come of flights."""
        return Results(self, flown, curves, {arm.name: self._row(arm, flown) for arm in self.arms})

    def _row(self, arm: Arm, flown: Mapping[Any, Flown]) -> dict[str, Estimated]:
        """Every column of the table."""
        runs = [flown[arm.name, seed] for seed in self.seeds_of(arm)]

        success = {"success": _estimated([self.about.success(run) for run in runs], mean)}
        return success | {
            name: _estimated([column.of(run) for run in runs], column.score)
            for name, column in {**ALWAYS, **self.about.columns}.items()
        }


def _estimated(values: list[NDArray[Any]], score: Score) -> Estimated:
    """A number of each training and episode, or a truth value, over all of them."""
    x = np.array(values)
    if x.dtype == np.bool_:
        return rate_over_trainings(x.mean(axis=1), x.shape[1])
    return mean_over_trainings(x, score)


@dataclass(frozen=True, eq=False)
class Results:
    """The numbers of a study."""

    study: Study
    flown: Mapping[Any, Flown]
    """by the name of the arm and the seed"""
    curves: Mapping[Any, tuple[Floats, Floats]]
    """steps and mean returns of the evaluations while training, by the same"""
    rows: Mapping[str, Mapping[str, Estimated]]
    """by the name of the arm and the column"""

    def arm(self, name: str) -> Arm:
        """The arm of a name."""
        return next(arm for arm in self.study.arms if arm.name == name)

    def mean_returns(self, name: str) -> list[float]:
        """One per training."""
        seeds = self.study.seeds_of(self.arm(name))
        return [float(self.flown[name, seed].returns.mean()) for seed in seeds]

    def improvement(self, first: str, second: str) -> Estimated:
        """How probable it is that a training of one arm returns more than one of another."""
        return probability_of_improvement(self.mean_returns(first), self.mean_returns(second))

    def fixed(self) -> list[str]:
        """Names of the arms that are not trained."""
        return [arm.name for arm in self.study.arms if arm.policy is not None]

    def trained(self) -> list[str]:
        """Names of those that are."""
        return [arm.name for arm in self.study.arms if arm.trained]

    def best(self, names: list[str]) -> str:
        """The arm of the largest return."""
        return max(names, key=lambda name: self.rows[name]["return"].value)

    def best_validated(self, name: str) -> int:
        """The seed of the training of an arm whose evaluations reached the largest return."""
        return max(self.study.seeds, key=lambda seed: float(self.curves[name, seed][1].max()))

    def description(self) -> dict[str, Any]:
        """For JSON."""
        trained = self.trained()
        return {
            "study": self.study.description(),
            "rows": {
                name: {column: found._asdict() for column, found in row.items()}
                for name, row in self.rows.items()
            },
            "return_of_each_seed": {name: self.mean_returns(name) for name in self.rows},
            "probability_of_improvement": {
                f"{a} over {b}": self.improvement(a, b)._asdict()
                for a in trained
                for b in trained
                if a != b
            },
        }

"""Study of the arms of a task: trainings, flights, and numbers."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import permutations
from typing import Any

import numpy as np
from numpy.typing import NDArray

from baselines.recipes import Plan, Recipe
from quad_gym.analysis.metrics import Estimated, rate_over_trainings
from quad_gym.analysis.reports import as_json
from quad_gym.envs.config import with_effect
from quad_gym.evaluation import Policy
from quad_gym.experiments import Experiment, Floats, Flown, Recorder, Trial
from scripts.studies.arms import Arm
from scripts.studies.rules import RULES
from scripts.studies.scores import Score, mean_over_trainings, probability_of_improvement
from scripts.studies.tasks import StudiedTask
from scripts.studies.traces import SpeedRecorder, ViewRecorder


@dataclass(frozen=True, kw_only=True)
class StudyTrial(Trial):
    """Test episodes that also the rules of `RULES` fly, with traces of the first ones."""

    traced: tuple[str, ...]
    """Names from `TRACES`"""

    def recorder(self) -> Recorder:
        """Make the recorder of the episodes."""
        if hasattr(self.env.unwrapped.flights.batch, "view"):
            return ViewRecorder(self.traced)
        return SpeedRecorder()

    def load(self, policy: str) -> Policy:
        """Load a policy by name or file."""
        return RULES[policy](self.env) if policy in RULES else super().load(policy)


@dataclass(frozen=True, eq=False, kw_only=True)
class Study(Experiment):
    """Trainings and flights of the arms of a task."""

    arms: tuple[Arm, ...]
    recipes: Mapping[str, Recipe]
    """Recipe of each algorithm that trains an arm"""
    about: StudiedTask
    """Task: success, columns of the table, traces"""

    def cases(self) -> dict[str, Plan]:
        """Plans by name of the trained arm."""
        return {arm.name: self._plan(arm) for arm in self.arms if arm.trained}

    def _plan(self, arm: Arm) -> Plan:
        chosen = self.recipes[arm.algorithm]
        return Plan(
            env_id=self.env_id,
            environment=with_effect({**self.environment, **arm.environment, **arm.training}),
            learning=arm.learning,
            recipe=chosen.replace(parameters={**chosen.parameters, **arm.parameters}),
            engine=arm.engine,
            threads=self.threads,
            evaluations=self.about.evaluations,
        )

    def trials(self) -> dict[str, Trial]:
        """Test flights by arm: on the estimate, unless the arm defines another observation."""
        return {
            arm.name: self.trial(
                {"observation": "estimate", **arm.environment},
                arm.policy or arm.flies or arm.name,
                kind=StudyTrial,
                traced=self.about.traced,
            )
            for arm in self.arms
        }

    def results(self) -> "StudyResults":
        """Fly all policies, and compute the table."""
        curves = {
            case: [t.curve("return") for t in self.trainings_of(case)] for case in self.cases()
        }
        return StudyResults(self, self.fly(), curves)

    def steps(self) -> str:
        """Number of environment steps of the trainings, as text."""
        counts = {recipe.steps for recipe in self.recipes.values()}
        if len(counts) < 2:
            return f"{counts.pop():,} steps" if counts else ""
        each = [f"{recipe.steps:,} ({name})" for name, recipe in self.recipes.items()]
        return f"{' or '.join(each)} steps"

    def description(self) -> dict[str, Any]:
        """Everything that affects the results, for JSON."""
        names = ("env_id", "arms", "seeds", "recipes", "environment", "episodes", "first_episode")
        about = {name: getattr(self, name) for name in names}
        return {**as_json(about), "success": self.about.meaning}


@dataclass(frozen=True, eq=False)
class StudyResults:
    """Numbers of a study."""

    study: Study
    flown: Mapping[str, Sequence[Flown]]
    """Flights of each seed by arm; one entry for a fixed rule"""
    curves: Mapping[str, Sequence[tuple[Floats, Floats]]]
    """Steps and mean returns of the evaluations of each training, by arm"""

    @cached_property
    def rows(self) -> dict[str, dict[str, Estimated]]:
        """Table by arm and column."""
        return {
            arm.name: {
                column: _estimated([each.of(run) for run in self.flown[arm.name]], each.score)
                for column, each in self.study.about.table().items()
            }
            for arm in self.study.arms
        }

    def arm(self, name: str) -> Arm:
        """Arm with a name."""
        return next(arm for arm in self.study.arms if arm.name == name)

    def mean_returns(self, name: str) -> list[float]:
        """Mean return of each training of an arm."""
        return [float(flown.episodes.returns.mean()) for flown in self.flown[name]]

    def mean_success(self, name: str) -> list[float]:
        """Share of successful episodes of each training of an arm."""
        return [float(self.study.about.success(flown).mean()) for flown in self.flown[name]]

    def improvement(self, first: str, second: str) -> Estimated:
        """Probability that a training of one arm returns more than one of another."""
        return probability_of_improvement(self.mean_returns(first), self.mean_returns(second))

    def fixed(self) -> list[str]:
        """Names of the fixed rules."""
        return [arm.name for arm in self.study.arms if arm.policy is not None and not arm.learned]

    def trained(self) -> list[str]:
        """Names of the trained arms."""
        return [arm.name for arm in self.study.arms if arm.trained]

    def best(self, names: list[str]) -> str:
        """Name of the arm with the largest return."""
        return max(names, key=lambda name: self.rows[name]["return"].value)

    def best_validated(self, name: str) -> int:
        """Index of the seed of an arm whose evaluations reached the largest return; 0: fixed."""
        best = [returns.max() for _, returns in self.curves.get(name, ())]
        return int(np.argmax(best)) if best else 0

    def description(self) -> dict[str, Any]:
        """Numbers for JSON."""
        return {
            "study": self.study.description(),
            "rows": {
                name: {column: found._asdict() for column, found in row.items()}
                for name, row in self.rows.items()
            },
            "return_of_each_seed": {name: self.mean_returns(name) for name in self.rows},
            "probability_of_improvement": {
                f"{a} over {b}": self.improvement(a, b)._asdict()
                for a, b in permutations(self.trained(), 2)
            },
        }


def _estimated(values: list[NDArray[Any]], score: Score) -> Estimated:
    """Estimate from numbers, or truth values, of each training and episode."""
    x = np.array(values)
    if x.dtype == np.bool_:
        return rate_over_trainings(x.mean(axis=1), x.shape[1])
    return mean_over_trainings(x, score)

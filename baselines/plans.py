"""What is to be trained: a plan, and the flights that belong to it."""

from dataclasses import dataclass, field
from types import MappingProxyType
from typing import TYPE_CHECKING, Any

import gymnasium

import quad_gym
from baselines.recipes import Recipe, recipe, unfreeze
from baselines.seeds import MAX_SEED, first_seed
from quad_gym.analysis.reports import as_json
from quad_gym.params import checks as check
from quad_gym.params.checks import Checked
from quad_gym.params.suites import contents_of_suite_files

if TYPE_CHECKING:
    from baselines.scaled_reward import ScaledReward

ENGINES = ("sb3", "compiled")
"""What trains: Stable-Baselines3, or `baselines.compiled_ppo`."""


@dataclass(frozen=True, kw_only=True)
class Plan(Checked):
    """What is to be trained, and how it is watched."""

    env_id: str = "QuadGym/Circle-v0"
    """one of `quad_gym.IDS`"""
    environment: Any = field(default_factory=dict)
    """keywords of the environment, in training as in evaluation, before those of the recipe"""
    learning: Any = field(default_factory=dict)
    """keywords of the environment in training alone, before all others"""
    recipe: Recipe = field(default_factory=lambda: recipe("QuadGym/Circle-v0"))
    seed: int = 0
    """of the networks; the flights of training and validation have blocks of seeds that follow from
    it, see `baselines.seeds`"""
    threads: int | None = None
    """for the flights; None: as many as there are cores; no result depends on them"""
    engine: str = "sb3"
    """one of ENGINES"""
    evaluations: int = 20
    """how often the policy is evaluated, and kept, over the run"""
    episodes: int = 100
    """flown in each evaluation"""

    def __post_init__(self) -> None:
        self._check(check.choice, "env_id", choices=tuple(quad_gym.IDS))
        self._check(check.choice, "engine", choices=ENGINES)
        self._check(check.whole, "evaluations", "episodes")
        self._check(check.whole, "seed", least=0)
        if self.seed > MAX_SEED:
            raise ValueError(f"Plan.seed must be at most {MAX_SEED}, got {self.seed}")
        check.instance("Plan.recipe", self.recipe, Recipe)
        for name in ("environment", "learning"):
            self._set(name, MappingProxyType(dict(getattr(self, name))))

    def __reduce__(self) -> Any:
        """Plans go to other processes."""
        return unfreeze(self)

    def make_flights(self) -> "ScaledReward":
        """The flights to train on with Stable-Baselines3."""
        from baselines.scaled_reward import ScaledReward

        env = quad_gym.make_sb3_vec_env(
            self.env_id,
            n_envs=self.recipe.n_envs,
            seed=first_seed("training", self.seed, self.recipe.n_envs),
            threads=self.threads,
            **{**self.recipe.flights, **self.environment, **self.learning},
        )
        return ScaledReward(env, self.recipe.reward_scale)

    def make_vector_flights(self) -> gymnasium.vector.VectorEnv[Any, Any, Any]:
        """The same flights for the compiled engine; not yet seeded."""
        return gymnasium.make_vec(
            self.env_id,
            num_envs=self.recipe.n_envs,
            threads=self.threads,
            **{**self.recipe.flights, **self.environment, **self.learning},
            autoreset_mode="SameStep",
        )

    def make_judge(self) -> gymnasium.vector.VectorEnv[Any, Any, Any]:
        """The flights to evaluate on: the task as the id and the keywords have it."""
        return gymnasium.make_vec(
            self.env_id, num_envs=self.episodes, threads=self.threads, **self.environment
        )


@dataclass(frozen=True)
class Linear:
    """A number that goes linearly from its first to its last value while training."""

    first: float
    last: float

    def __call__(self, remaining: float) -> float:
        """The value when a share `remaining` of the training is still ahead."""
        return self.last + (self.first - self.last) * remaining


def description(plan: Plan) -> dict[str, Any]:
    """A plan as JSON has it."""
    found: dict[str, Any] = as_json(plan)
    del found["threads"]  # changes no result
    if not plan.learning:
        del found["learning"]
    given = (plan.environment.get("sensors"), plan.learning.get("sensors"))
    found |= as_json(contents_of_suite_files(*given))
    found["first_flights"] = {
        "training": first_seed("training", plan.seed, plan.recipe.n_envs),
        "validation": first_seed("validation", plan.seed, plan.episodes),
    }
    return found

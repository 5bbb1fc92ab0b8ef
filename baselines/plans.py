"""Plans of trainings, and the environments that they define."""

from dataclasses import dataclass, field
from functools import partial
from typing import TYPE_CHECKING, Annotated, Any

import gymnasium

import quad_gym
from baselines.recipes import ReadOnly, Recipe, recipe, unfreeze
from baselines.seeds import MAX_SEED, first_seed
from quad_gym.analysis.reports import as_json
from quad_gym.params import checks as check
from quad_gym.params.checked import Checked
from quad_gym.params.suites import contents_of_suite_files

if TYPE_CHECKING:
    from baselines.scaled_reward import ScaledReward

ENGINES = ("sb3", "compiled")  #: training engines: Stable-Baselines3, or `baselines.compiled_ppo`


class Plan(Checked):
    """Plan of a training and its evaluations."""

    env_id: Annotated[str, partial(check.choice, choices=tuple(quad_gym.IDS))] = "QuadGym/Circle-v0"
    """Id of the environment, from `quad_gym.IDS`"""
    environment: ReadOnly = field(default_factory=dict)
    """Keywords of the environment in training and evaluation; they override the recipe's"""
    learning: ReadOnly = field(default_factory=dict)
    """Keywords of the environment in training only; they override all others"""
    recipe: Recipe = field(default_factory=lambda: recipe("QuadGym/Circle-v0"))
    seed: Annotated[int, partial(check.whole, least=0, most=MAX_SEED)] = 0
    """Seed of the networks; it also determines the blocks of seeds of the flights in training and
    validation, see `baselines.seeds`"""
    threads: int | None = None
    """Number of threads of the flights; None: one per core. It does not affect results"""
    engine: Annotated[str, partial(check.choice, choices=ENGINES)] = "sb3"
    """Training engine, one of `ENGINES`"""
    evaluations: Annotated[int, check.whole] = 20
    """Number of evaluations, each with a checkpoint, during the training"""
    episodes: Annotated[int, check.whole] = 100
    """Number of episodes in each evaluation"""

    def __reduce__(self) -> Any:
        """Support pickling, to send plans to other processes."""
        return unfreeze(self)

    def make_flights(self) -> "ScaledReward":
        """Make the environment to train in with Stable-Baselines3."""
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
        """Make the environment to train in with the compiled engine; it is not seeded."""
        return gymnasium.make_vec(
            self.env_id,
            num_envs=self.recipe.n_envs,
            threads=self.threads,
            **{**self.recipe.flights, **self.environment, **self.learning},
            autoreset_mode="SameStep",
        )

    def make_judge(self) -> gymnasium.vector.VectorEnv[Any, Any, Any]:
        """Make the environment for evaluations, defined by the id and the keywords."""
        return gymnasium.make_vec(
            self.env_id, num_envs=self.episodes, threads=self.threads, **self.environment
        )


@dataclass(frozen=True)
class Linear:
    """Schedule that changes linearly from a first to a last value during training."""

    first: float
    last: float

    def __call__(self, remaining: float) -> float:
        """Return the value when a share `remaining` of the training remains."""
        return self.last + (self.first - self.last) * remaining


def description(plan: Plan) -> dict[str, Any]:
    """Convert a plan to JSON types."""
    found: dict[str, Any] = as_json(plan)
    del found["threads"]  # does not affect results
    if not plan.learning:
        del found["learning"]
    given = (plan.environment.get("sensors"), plan.learning.get("sensors"))
    found |= as_json(contents_of_suite_files(*given))
    found["first_flights"] = {
        "training": first_seed("training", plan.seed, plan.recipe.n_envs),
        "validation": first_seed("validation", plan.seed, plan.episodes),
    }
    return found

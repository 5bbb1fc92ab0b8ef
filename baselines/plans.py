"""What is to be trained: a plan, and the flights and the untrained model that belong to it."""

from dataclasses import dataclass, field
from pathlib import Path
from types import MappingProxyType
from typing import Any

import gymnasium
import numpy as np
import torch
from stable_baselines3 import PPO, SAC, TD3
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.noise import NormalActionNoise
from stable_baselines3.common.vec_env import VecEnv, VecEnvWrapper

import quad_gym
from baselines.recipes import Recipe, recipe, unfreeze
from baselines.seeds import MAX_SEED, first_seed
from quad_gym.analysis.reports import as_json
from quad_gym.params import checks as check
from quad_gym.params.checks import Checked


@dataclass(frozen=True, kw_only=True)
class Plan(Checked):
    """What is to be trained, and how it is watched."""

    env_id: str = "QuadGym/Circle-v0"
    """one of `quad_gym.IDS`"""
    environment: Any = field(default_factory=dict)
    """keywords of the environment, in training as in evaluation, before those of the recipe"""
    recipe: Recipe = field(default_factory=lambda: recipe("QuadGym/Circle-v0"))
    seed: int = 0
    """of the networks; the flights of training and validation have blocks of seeds that follow from
    it, see `baselines.seeds`"""
    threads: int | None = None
    """for the flights; None: as many as there are cores; no result depends on them"""
    evaluations: int = 20
    """how often the policy is evaluated, and kept, over the run"""
    episodes: int = 100
    """flown in each evaluation"""

    def __post_init__(self) -> None:
        self._check(check.choice, "env_id", choices=tuple(quad_gym.IDS))
        self._check(check.whole, "evaluations", "episodes")
        self._check(check.whole, "seed", least=0)
        if self.seed > MAX_SEED:
            raise ValueError(f"Plan.seed must be at most {MAX_SEED}, got {self.seed}")
        check.instance("Plan.recipe", self.recipe, Recipe)
        self._set("environment", MappingProxyType(dict(self.environment)))

    def __reduce__(self) -> Any:
        """Plans go to other processes."""
        return unfreeze(self)

    def make_flights(self) -> "ScaledReward":
        """The flights to train on."""
        env = quad_gym.make_sb3_vec_env(
            self.env_id,
            n_envs=self.recipe.n_envs,
            seed=first_seed("training", self.seed, self.recipe.n_envs),
            threads=self.threads,
            **{**self.recipe.flights, **self.environment},
        )
        return ScaledReward(env, self.recipe.reward_scale)

    def make_judge(self) -> gymnasium.vector.VectorEnv[Any, Any, Any]:
        """The flights to evaluate on: the task as the id and the keywords have it."""
        return gymnasium.make_vec(
            self.env_id, num_envs=self.episodes, threads=self.threads, **self.environment
        )


class ScaledReward(VecEnvWrapper):
    """Shows the algorithm a multiple of the reward; episode records keep the reward itself."""

    def __init__(self, venv: VecEnv, scale: float) -> None:
        super().__init__(venv)
        self.scale = np.float32(scale)

    def reset(self) -> Any:
        """Begin an episode in every flight."""
        return self.venv.reset()

    def step_wait(self) -> Any:
        """Fly the step."""
        observations, rewards, dones, infos = self.venv.step_wait()
        return observations, rewards * self.scale, dones, infos


def algorithm_class(name: str) -> type[BaseAlgorithm]:
    """The class of an algorithm, by its name in `recipes.ALGORITHMS`."""
    if name in ("recurrent_ppo", "tqc"):
        import sb3_contrib

        return {"recurrent_ppo": sb3_contrib.RecurrentPPO, "tqc": sb3_contrib.TQC}[name]
    return {"ppo": PPO, "sac": SAC, "td3": TD3}[name]


def make_model(plan: Plan, env: VecEnv, tensorboard: Path | None = None) -> BaseAlgorithm:
    """An untrained model as the plan's recipe has it.

    Raises:
        ValueError: If the algorithm does not know one of the recipe's parameters.
    """
    chosen = plan.recipe
    first, last = chosen.learning_rate
    activations = {"relu": torch.nn.ReLU, "tanh": torch.nn.Tanh, "elu": torch.nn.ELU}
    policy = {
        "net_arch": {
            "pi": list(chosen.layers),
            "vf" if "ppo" in chosen.algorithm else "qf": list(chosen.critic_layers),
        },
        "activation_fn": activations[chosen.activation],
        **chosen.policy,
    }
    kind = "MultiInput" if isinstance(env.observation_space, gymnasium.spaces.Dict) else "Mlp"
    kind += "LstmPolicy" if chosen.algorithm == "recurrent_ppo" else "Policy"
    try:
        model = algorithm_class(chosen.algorithm)(
            kind,
            env,
            learning_rate=Linear(first, last),
            policy_kwargs=policy,
            **_exploration(chosen, env),
            seed=plan.seed,
            device="cpu",
            tensorboard_log=None if tensorboard is None else str(tensorboard),
            **chosen.parameters,
        )
    except (TypeError, AssertionError) as error:
        raise ValueError(f"recipe does not fit {chosen.algorithm}: {error}") from None
    # the algorithm has seeded the flights with its own seed, and so with those of a test
    env.seed(first_seed("training", plan.seed, chosen.n_envs))
    return model


def _exploration(chosen: Recipe, env: VecEnv) -> dict[str, Any]:
    """The noise on actions while learning, for TD3, whose policy has none of its own."""
    if chosen.algorithm != "td3":
        return {}
    mean = np.zeros(env.action_space.shape or ())
    return {"action_noise": NormalActionNoise(mean, np.full_like(mean, chosen.action_noise))}


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
    found["first_flights"] = {
        "training": first_seed("training", plan.seed, plan.recipe.n_envs),
        "validation": first_seed("validation", plan.seed, plan.episodes),
    }
    return found

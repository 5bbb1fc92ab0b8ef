"""The untrained models of Stable-Baselines3 that belong to a plan."""

from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import torch
from stable_baselines3 import PPO, SAC, TD3
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.noise import NormalActionNoise
from stable_baselines3.common.vec_env import VecEnv

from baselines.plans import Linear, Plan
from baselines.recipes import Recipe
from baselines.seeds import first_seed


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
    if chosen.parameters.get("critic_only"):
        raise ValueError(
            "critic_only must be 0 with Stable-Baselines3, whose critics see what the actor sees, "
            f'got {chosen.parameters["critic_only"]}: it needs engine="compiled"'
        )
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

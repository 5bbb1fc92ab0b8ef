"""Untrained models of Stable-Baselines3 for a plan."""

import inspect
import math
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
from quad_gym.params import checks as check

_OURS = {"self", "policy", "env", "learning_rate", "policy_kwargs", "action_noise"}
_OURS |= {"seed", "device", "tensorboard_log", "_init_setup_model"}
"""Arguments of algorithms that `make_model` sets, or that recipes must not set."""


def algorithm_class(name: str) -> type[BaseAlgorithm]:
    """Class of an algorithm, by its name in `recipes.ALGORITHMS`."""
    if name in ("recurrent_ppo", "tqc"):
        import sb3_contrib

        return {"recurrent_ppo": sb3_contrib.RecurrentPPO, "tqc": sb3_contrib.TQC}[name]
    return {"ppo": PPO, "sac": SAC, "td3": TD3}[name]


def make_model(plan: Plan, env: VecEnv, tensorboard: Path | None = None) -> BaseAlgorithm:
    """Make the untrained model of a plan's recipe.

    Raises a ValueError if a parameter is unknown to the algorithm, or its value is invalid.
    """
    chosen = plan.recipe
    parameters: dict[str, Any] = {}
    if chosen.parameters.get("critic_only"):
        raise ValueError(
            "critic_only must be 0 with Stable-Baselines3, where actor and critic share inputs, "
            f'got {chosen.parameters["critic_only"]}: it needs engine="compiled"'
        )
    if chosen.algorithm == "td3":  # whose policy is deterministic
        mean = np.zeros(env.action_space.shape or ())
        noise = NormalActionNoise(mean, np.full_like(mean, chosen.action_noise))
        parameters = {"action_noise": noise}
    parameters |= _checked_parameters(chosen)
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
            seed=plan.seed,
            device="cpu",
            tensorboard_log=None if tensorboard is None else str(tensorboard),
            **parameters,
        )
    except (TypeError, AssertionError) as error:
        raise ValueError(f"recipe does not fit {chosen.algorithm}: {error}") from None
    # the algorithm has seeded the flights with its own seed, which are seeds of tests
    env.seed(first_seed("training", plan.seed, chosen.n_envs))
    return model


def _checked_parameters(chosen: Recipe) -> dict[str, Any]:
    """Check the parameters of a recipe against the types of the algorithm's defaults.

    Stable-Baselines3 checks few of them and would fail during training.
    """
    kind = algorithm_class(chosen.algorithm)
    known = {k: v for k, v in inspect.signature(kind).parameters.items() if k not in _OURS}
    check.keywords(chosen.parameters, tuple(known), kind.__name__)
    found = dict(chosen.parameters)
    for name, value in found.items():
        default = known[name].default
        if callable(value) or isinstance(value, tuple):  # a schedule; a frequency of training
            continue
        if isinstance(default, bool):
            check.flag(name, value)
        elif name in ("n_steps", "batch_size", "n_epochs", "buffer_size"):
            found[name] = check.whole(name, value)
        elif isinstance(default, int):
            found[name] = check.whole(name, value, least=-1)  # of gradient_steps: as many as steps
        elif isinstance(default, float):
            share = name in ("gamma", "gae_lambda", "tau")
            check.number(name, value, least=0.0 if share else -math.inf)
            if share and value > 1.0:
                raise ValueError(f"{name} must be at most 1, got {value!r}")
    return found

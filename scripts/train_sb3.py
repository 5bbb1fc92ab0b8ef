"""Train a controller with Stable-Baselines3, on the filter's estimate or on the true state.

    python -m scripts.train_sb3                              # PPO on the estimate: minutes
    python -m scripts.train_sb3 --observation truth --algorithm sac

Copy this file and change it: reward, network, hyperparameters and environment are all below. It
prints the error on unseen episodes, where the policy always flies on the estimate.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
import tyro
from stable_baselines3 import PPO, SAC
from stable_baselines3.common.base_class import BaseAlgorithm

import quad_gym


class Reward(quad_gym.Task):
    """Reward of every step; the environment keeps its observations and endings."""

    def reward(self, view: Any) -> Any:
        """(n,) closeness to the reference, minus the cost of abrupt actions; n flights."""
        closeness = np.exp(-2.0 * view.position_error)
        change = np.sum((view.action - view.last_action) ** 2, axis=1)
        return 0.2 * (closeness - 0.02 * change)


Source = Literal["truth", "estimate", "noisy"]  #: source of observations

NETWORK = {"net_arch": [64, 64], "activation_fn": torch.nn.ReLU}


def make_env(args: "Args", observation: Source, seed: int, n_envs: int, start: Any = None) -> Any:
    """Many flights in one process, as an environment of Stable-Baselines3."""
    return quad_gym.make_sb3_vec_env(
        args.env_id,
        n_envs=n_envs,
        seed=seed,
        observation=observation,
        sensors=args.sensors,
        start=start,  # "ground", "hover", "moving", "mixed"; None: the task's own
        task=Reward(),
    )


def make_model(args: "Args", env: Any) -> BaseAlgorithm:
    """The algorithm with its hyperparameters."""
    if args.algorithm == "sac":
        return SAC(
            "MlpPolicy",
            env,
            learning_rate=1e-3,
            batch_size=1024,
            gamma=0.95,
            gradient_steps=4,
            ent_coef="auto_0.02",  # the reward of a step is about 0.2
            policy_kwargs=dict(NETWORK),
            seed=args.seed,
        )
    return PPO(
        "MlpPolicy",
        env,
        learning_rate=lambda remaining: 1e-4 + 9e-4 * remaining,
        n_steps=32,
        batch_size=1024,
        n_epochs=5,
        gamma=0.97,
        policy_kwargs={**NETWORK, "log_std_init": -1.0},
        seed=args.seed,
    )


def fly(model: Any, env: Any, episodes: int) -> tuple[float, float]:
    """Fly episodes: mean true position error [m] until their ends, and share of crashes."""
    observations, errors = env.reset(), list[float]()
    crashes = list[bool]()
    while len(crashes) < episodes:
        actions, _ = model.predict(observations, deterministic=True)
        observations, _, ended, infos = env.step(actions)
        errors += [info["position_error"] for info in infos]
        crashes += [not info["TimeLimit.truncated"] for info in np.array(infos)[ended]]
    return float(np.mean(errors)), float(np.mean(crashes))


@dataclass
class Args:
    """Options."""

    env_id: str = "QuadGym/Circle-v0"
    observation: Source = "estimate"
    """observation in training"""
    sensors: str = "standard"
    algorithm: Literal["ppo", "sac"] = "ppo"
    steps: int = 1_800_000
    n_envs: int = 256
    seed: int = 0
    output: Path = Path("results/sb3/policy.zip")


def main(args: Args) -> None:
    """Train, save and test a policy."""
    torch.set_num_threads(1)  # small networks: more threads are slower
    seed = 1_000_000_000 + 1_000_000 * args.seed  # of the first flight; tests begin at 0
    model = make_model(args, make_env(args, args.observation, seed, args.n_envs, "mixed"))
    model.learn(args.steps)
    model.save(args.output)
    error, crashed = fly(model, make_env(args, "estimate", 0, 100), episodes=100)
    print(f"On the estimate: {100.0 * error:.1f} cm from the reference, {crashed:.0%} crashed.")


if __name__ == "__main__":
    main(tyro.cli(Args))

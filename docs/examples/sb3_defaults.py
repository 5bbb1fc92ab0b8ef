"""Train Stable-Baselines3 with its default settings, and evaluate the policies.

    python docs/examples/sb3_defaults.py --algorithm sac --env-id QuadGym/Hover-v0 --seed 1

During training, the policy flies test episodes without exploration, which do not change the
training. SAC takes 8 to 15 ms a step.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import gymnasium
import torch
import tyro
from stable_baselines3 import PPO, SAC
from stable_baselines3.common.callbacks import BaseCallback

import quad_gym
from quad_gym.evaluation import roll_out

CLASSES = {"ppo": PPO, "sac": SAC}
FLIGHTS = {"ppo": 16, "sac": 1}
STEPS = {"ppo": 1_000_000, "sac": 300_000}


@dataclass
class Args:
    """Options."""

    algorithm: Literal["ppo", "sac"] = "ppo"
    env_id: str = "QuadGym/Circle-v0"
    start: Literal["ground", "hover", "mixed", "moving"] | None = None
    """start of episodes in training and evaluation; defaults to the default of the task"""
    out_of_bounds: float | None = None
    """distance from the reference at which episodes end [m]; defaults to the default"""
    seed: int = 0
    total_timesteps: int | None = None
    """defaults to 1,000,000 for PPO and 300,000 for SAC"""
    num_envs: int | None = None
    """flights at a time; defaults to 16 for PPO and 1 for SAC"""
    every: int = 25_000
    """steps from one evaluation to the next"""
    evaluate: int = 1000
    """episodes of each evaluation"""
    save: Path | None = None
    """file for the policy, as it is at the last evaluation"""


def keywords_of(args):
    """Keywords of the environment, in training and evaluation; None is the default of the task."""
    return {"start": args.start, "out_of_bounds": args.out_of_bounds}


class Evaluation(BaseCallback):
    """Fly the policy on test episodes, every `args.every` steps and at the end."""

    def __init__(self, args):
        super().__init__()
        self.args, self.due, self.flown = args, args.every, 0

    def _on_step(self):
        if self.num_timesteps >= self.due:
            self.fly()
        return True

    def _on_training_end(self):
        if self.num_timesteps > self.flown:
            self.fly()

    def fly(self):
        """Print error and crash rate of the policy, and save it."""
        self.flown = self.num_timesteps
        self.due = self.flown + self.args.every
        test = gymnasium.make_vec(
            self.args.env_id, num_envs=self.args.evaluate, **keywords_of(self.args)
        )
        found = roll_out(self.model, test, seed=0).summary()
        print(
            f"{self.flown:,} steps: mean error {found['mean_error']:.4f} m, "
            f"{found['crash_rate']:.1%} of {self.args.evaluate} episodes crashed",
            flush=True,
        )
        test.close()
        if self.args.save is not None:
            self.model.save(self.args.save)


def main(args):
    """Train with evaluations."""
    torch.set_num_threads(1)  # the networks are small, and more threads round differently
    count = args.num_envs or FLIGHTS[args.algorithm]
    first_flight = 10**9 + 1000 * args.seed  # seeds below 10^9 are for tests
    env = quad_gym.make_sb3_vec_env(
        args.env_id, n_envs=count, seed=first_flight, **keywords_of(args)
    )
    model = CLASSES[args.algorithm]("MlpPolicy", env, seed=args.seed)
    model.learn(args.total_timesteps or STEPS[args.algorithm], callback=Evaluation(args))


if __name__ == "__main__":
    main(tyro.cli(Args))

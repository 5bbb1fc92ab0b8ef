"""Train on the true state and on the estimate, fly both on both, and print the table.

    python -m scripts.compare_sb3 --seeds 3
    python -m scripts.compare_sb3 --env-id QuadGym/LookAround-v0 --sensors one_wall

Reward, network and algorithm come from `train_sb3.py`, next to this file. One seed proves
nothing: trainings differ. `quad-gym compare` does the same with intervals and figures.
"""

from dataclasses import dataclass
from typing import Literal

import numpy as np
import torch
import tyro

from scripts.train_sb3 import Args, Source, fly, make_env, make_model

SOURCES: tuple[Source, ...] = ("truth", "estimate")


@dataclass
class Comparison:
    """Options."""

    env_id: str = "QuadGym/Circle-v0"
    sensors: str = "standard"
    algorithm: Literal["ppo", "sac"] = "ppo"
    steps: int = 1_800_000
    """steps of each training"""
    n_envs: int = 256
    seeds: int = 1
    """number of trainings on each observation"""
    episodes: int = 100
    """number of test episodes of each policy"""


def errors(options: Comparison, source: Source) -> dict[str, list[tuple[float, float]]]:
    """Train on an observation with each seed; errors and crashes by observation in tests."""
    found: dict[str, list[tuple[float, float]]] = {flown: [] for flown in SOURCES}
    for seed in range(options.seeds):
        names = ("env_id", "sensors", "algorithm", "n_envs")
        args = Args(seed=seed, **{name: getattr(options, name) for name in names})
        first = 1_000_000_000 + 1_000_000 * seed  # seed of the first flight; tests begin at 0
        model = make_model(args, make_env(args, source, first, args.n_envs, "mixed"))
        model.learn(options.steps)
        for flown in SOURCES:
            env = make_env(args, flown, 0, options.episodes)
            found[flown].append(fly(model, env, options.episodes))
    return found


def main(options: Comparison) -> None:
    """Train, fly and print."""
    torch.set_num_threads(1)  # small networks: more threads are slower
    print("trained on   evaluated on   mean error [cm]   crashed")
    for source in SOURCES:
        for flown, results in errors(options, source).items():
            error, crashed = np.mean(results, axis=0)
            print(f"{source:10}   {flown:12}   {100.0 * error:15.1f}   {crashed:7.0%}", flush=True)


if __name__ == "__main__":
    main(tyro.cli(Comparison))

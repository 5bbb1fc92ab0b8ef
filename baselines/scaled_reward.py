"""Scaled reward for algorithms of Stable-Baselines3."""

from typing import Any

import numpy as np
from stable_baselines3.common.vec_env import VecEnv, VecEnvWrapper


class ScaledReward(VecEnvWrapper):
    """Wrapper that multiplies the reward; returns in episode records are not scaled."""

    def __init__(self, venv: VecEnv, scale: float) -> None:
        super().__init__(venv)
        self.scale = np.float32(scale)

    def reset(self) -> Any:
        """Begin an episode in each flight."""
        return self.venv.reset()

    def step_wait(self) -> Any:
        """Return the results of the step, with scaled rewards."""
        observations, rewards, dones, infos = self.venv.step_wait()
        return observations, rewards * self.scale, dones, infos

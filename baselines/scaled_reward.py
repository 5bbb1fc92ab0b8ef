"""The reward that algorithms of Stable-Baselines3 see."""

from typing import Any

import numpy as np
from stable_baselines3.common.vec_env import VecEnv, VecEnvWrapper


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

"""A small environment unrelated to quadrotors, and a recipe, for tests of the compiled PPO."""

import gymnasium
import numpy as np
from gymnasium.vector import AutoresetMode, SyncVectorEnv

from baselines.recipes import Recipe


class Slider(gymnasium.Env):
    """A point on a line that actions move; the reward is highest at 0, an episode has 20 steps."""

    observation_space = gymnasium.spaces.Box(-10.0, 10.0, (3,))
    action_space = gymnasium.spaces.Box(-1.0, 1.0, (2,))

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.x, self.steps = self.np_random.uniform(-2.0, 2.0), 0
        return self.seen(), {}

    def seen(self):
        return np.array([self.x, 1.0, self.steps / 20.0], np.float32)

    def step(self, action):
        self.x += 0.3 * float(action[0])
        self.steps += 1
        fallen = abs(self.x) > 3.0
        return self.seen(), 1.0 - self.x**2, fallen, self.steps >= 20, {}


def sliders(count=8, mode=AutoresetMode.SAME_STEP):
    return SyncVectorEnv([Slider] * count, autoreset_mode=mode)


def small_recipe(policy=None, parameters=None, **changes):
    options = {
        "n_envs": 8,
        "steps": 1000,
        "reward_scale": 0.5,
        "activation": "tanh",
        "layers": (32, 17),
        "critic_layers": (24,),
        "parameters": {"n_steps": 16, "batch_size": 50, "n_epochs": 3, **(parameters or {})},
        "policy": policy or {},
    }
    return Recipe(**{**options, **changes})

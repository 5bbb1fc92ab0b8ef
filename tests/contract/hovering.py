"""Environment for tests in other processes; importing it imports neither torch nor pytest."""

import gymnasium
import numpy as np

SHORT = {"max_episode_steps": 25, "max_tilt": 0.6}


def make_hover():
    """Return an environment with short episodes."""
    return gymnasium.make("quad_gym:QuadGym/Hover-v0", **SHORT)


def next_steps(env, k=3):
    """Return the results of the next steps of nine flights."""
    return [env.step(np.full((9, 4), 0.1))[:4] for _ in range(k)]

"""What a process of another kind is sent: importing it brings in neither torch nor pytest."""

import gymnasium
import numpy as np

SHORT = {"max_episode_steps": 25, "max_tilt": 0.6}


def hover():
    """An environment of short episodes."""
    return gymnasium.make("quad_gym:QuadGym/Hover-v0", **SHORT)


def further(env, k=3):
    """What the next steps of nine flights give."""
    return [env.step(np.full((9, 4), 0.1))[:4] for _ in range(k)]

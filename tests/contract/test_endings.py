"""Terminated and truncated mean the same in every interface, also where a step is both."""

import gymnasium
import numpy as np
import pytest

import quad_gym
from quad_gym import Cylinder, GroundParams, WorldParams

CRASHES = {
    "out of bounds": ("Hover", {"action": "velocity"}, (1.0, 0.0, 0.0, 0.0)),
    "tipped over": ("Hover", {"action": "motor", "max_tilt": 0.5}, (0.3, 0.0, 0.0, 0.3)),
    "ground": (
        "Hover",
        {"action": "motor", "world": WorldParams(ground=GroundParams()), "out_of_bounds": 9.0},
        (-1.0, -1.0, -1.0, -1.0),
    ),
    "obstacle": (
        "Hover",
        {
            "action": "velocity",
            "out_of_bounds": 9.0,
            "world": WorldParams(obstacles=(Cylinder(center_I=(0.0, 0.0, 1.0), radius=2.0),)),
        },
        (1.0, 0.0, 0.0, 0.0),
    ),
}


class Late(quad_gym.Task):
    """Judges as the built-in task, by methods of its own."""

    def terminated(self, view):
        """(n,) whether the built-in task ends the episode."""
        return view.builtin.terminated.copy()

    def truncated(self, view):
        """(n,) whether the built-in task cuts it short."""
        return view.builtin.truncated.copy()


def ended_after(name, keywords, action):
    """Steps until the episode of seed 3 is over, and how each interface tells so."""
    single = gymnasium.make(name, **keywords)
    together = gymnasium.make_vec(name, num_envs=2, **keywords)
    sb3 = quad_gym.make_sb3_vec_env(name, 2, seed=2, **keywords)
    single.reset(seed=3)
    together.reset(seed=[2, 3])
    sb3.reset()
    for k in range(1, 400):
        *_, terminated, truncated, info = single.step(np.array(action))
        *_, ends, cuts, infos = together.step(np.tile(action, (2, 1)))
        *_, done, sb3_infos = sb3.step(np.tile(action, (2, 1)))
        assert (terminated, truncated) == (ends[1], cuts[1])
        assert info["ending"] == infos["ending"][1]
        assert done[1] == (terminated or truncated)
        if done[1]:
            assert sb3_infos[1]["ending"] == info["ending"]
            assert sb3_infos[1]["TimeLimit.truncated"] == (truncated and not terminated)
            return k, terminated, truncated, info["ending"]
    raise AssertionError("the episode does not end")


@pytest.mark.parametrize(
    "own_task", [None, quad_gym.Task(), Late()], ids=["built-in", "own", "late"]
)
@pytest.mark.parametrize("crash", CRASHES)
def test_a_crash_in_the_last_step_of_the_time_limit_is_both(crash, own_task):
    task, keywords, action = CRASHES[crash]
    name = f"QuadGym/{task}-v0"
    if own_task is not None:
        name = f"Test/{task}{type(own_task).__name__}-v0"
        if name not in gymnasium.registry:
            quad_gym.register_task(name, own_task, f"QuadGym/{task}-v0")
    steps, terminated, truncated, ending = ended_after(name, keywords, action)
    assert (terminated, truncated) == (True, False)
    limited = ended_after(name, {**keywords, "max_episode_steps": steps}, action)
    assert limited == (steps, True, True, ending)
    cut = ended_after(name, {**keywords, "max_episode_steps": steps - 1}, action)
    assert cut == (steps - 1, False, True, "time_limit")

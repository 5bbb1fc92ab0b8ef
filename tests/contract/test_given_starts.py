"""Starts that callers give to a reset: those out of bounds of the reference are refused."""

import gymnasium
import numpy as np
import pytest

import quad_gym
from quad_gym.envs.vector import QuadVectorEnv
from tests.contract.comparing import state_of

DRAWN = {"randomize_reference": True}
REFERENCES = [
    *((name, {}) for name in ("Hover", "Circle", "RandomTrajectory", "Waypoints", "Trajectory")),
    *((name, DRAWN) for name in ("Hover", "Circle", "Lemniscate", "Trajectory")),
]


def is_refused(env, place):
    try:
        env.reset(options={"position": place})
    except ValueError as error:
        return "position must be within" in str(error)
    return False


@pytest.mark.parametrize(("task", "keywords"), REFERENCES, ids=str)
def test_a_start_out_of_bounds_of_the_reference_is_refused(task, keywords):
    """Wherever 512 episodes begin, what is refused is out of bounds of all their references."""
    env = gymnasium.make_vec(f"QuadGym/{task}-v0", num_envs=512, observation="truth", **keywords)
    env.reset(seed=1)
    begins = env.unwrapped.flights.batch.read("reference_position")
    bound, refused, rng = env.unwrapped.flights.task.out_of_bounds, 0, np.random.default_rng(2)
    reach = np.linalg.norm(begins, axis=1).max() + bound
    for place in rng.uniform(-reach, reach, (100, 3)):
        nearest = np.linalg.norm(begins - place, axis=1).min()
        if is_refused(env, place):
            refused += 1
            assert nearest > bound
        else:  # some episode may begin there; 512 draws are nearly as near as any
            assert nearest < bound + (2.0 if task == "RandomTrajectory" else 0.6)
    assert refused > 20
    assert not is_refused(env, begins[0] + [0.0, 0.0, 0.9 * bound])


def test_a_refused_start_changes_nothing_in_any_interface():
    far = {"position": (4.0, 0.0, -5.0)}
    single, together = gymnasium.make("QuadGym/Hover-v0"), QuadVectorEnv(2, "hover")
    for env in (single, together):
        env.reset(seed=1)
        before = state_of(env)
        with pytest.raises(ValueError, match=r"out_of_bounds=1.6 m of the reference.*6 m from"):
            env.reset(seed=2, options=far)
        assert state_of(env) == before
    sb3 = quad_gym.make_sb3_vec_env("QuadGym/Hover-v0", 2, seed=1)
    sb3.set_options(far)
    with pytest.raises(ValueError, match=r"out_of_bounds=1.6 m of the reference"):
        sb3.reset()


def test_task_with_its_own_endings_may_start_elsewhere():
    class Patient(quad_gym.Task):
        """Ends no episode."""

        def terminated(self, view):
            """(n,) never."""
            return np.zeros(view.count, bool)

    env = QuadVectorEnv(2, base="hover", task=Patient)
    env.reset(seed=1, options={"position": (-2.0, 0.0, 1.0)})
    assert not env.step(np.zeros((2, 4)))[2].any()

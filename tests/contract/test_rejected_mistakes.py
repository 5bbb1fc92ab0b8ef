"""Common mistakes of environments, none of which is made here."""

import random

import numpy as np
import pytest

import quad_gym
from quad_gym.envs.single import QuadEnv
from quad_gym.envs.vector import QuadVectorEnv
from tests.builders import single_env
from tests.contract.comparing import assert_same

TASKS = tuple(quad_gym.IDS.values())


@pytest.mark.parametrize("task", TASKS)
def test_the_options_of_reset_are_honoured_at_any_time(task):
    env = single_env(task, seed=3)
    place = env.flights.batch.read("reference_position")[0] + [0.2, 0.1, 0.3]
    start = {"position": place, "velocity": [0.1, -0.1, 0.2], "yaw": 0.7}
    for seed in (3, None):
        env.reset(seed=seed, options=start)
        batch = env.flights.batch
        np.testing.assert_array_equal(batch.record("r")[0], start["position"])
        np.testing.assert_array_equal(batch.record("v")[0], start["velocity"])
        w, x, y, z = batch.record("q")[0]
        yaw = np.arctan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))
        assert yaw == pytest.approx(0.7, abs=0.02)
    env.reset()
    assert (env.flights.batch.record("r")[0] != start["position"]).all()


def global_state():
    kind, keys, *rest = np.random.get_state()  # noqa: NPY002 - this state must not change
    return random.getstate(), kind, keys.tobytes(), tuple(rest)


@pytest.mark.parametrize("seed", [None, 4])
def test_interfaces_do_not_change_global_random_state(seed):
    pytest.importorskip("stable_baselines3")  # whose import draws random numbers
    before = global_state()
    single, vector = QuadEnv("random_trajectory"), QuadVectorEnv(3, "hover")
    sb3 = quad_gym.make_sb3_vec_env("QuadGym/Circle-v0", 3, seed=seed)
    for env in (single, vector):
        env.reset(seed=seed)
        env.reset()
    sb3.reset()
    sb3.reset()
    single.step(np.zeros(4))
    vector.step(np.zeros((3, 4)))
    sb3.step(np.zeros((3, 4)))
    assert global_state() == before


def test_flights_do_not_depend_on_global_random_state():
    seen = []
    for seed in (1, 2):
        np.random.seed(seed)  # noqa: NPY002
        random.seed(seed)
        env = QuadEnv("random_trajectory")
        seen.append([env.reset(seed=9)[0], env.step(np.zeros(4))[0], env.reset()[0]])
    assert_same(seen[0], seen[1])

"""Common mistakes of environments, none of which is made here."""

import random

import gymnasium
import numpy as np
import pytest

import quad_gym
from quad_gym.envs.single import QuadEnv
from quad_gym.envs.vector import QuadVectorEnv
from tests.builders import MAKERS, actions_of, flat, single_env
from tests.contract.comparing import IDS, assert_same
from tests.contract.configurations import CONFIGURATIONS

TASKS = tuple(quad_gym.IDS.values())


@pytest.mark.parametrize("name", CONFIGURATIONS)
def test_the_seed_of_reset_is_honoured_at_any_time(name):
    base, keywords = CONFIGURATIONS[name]
    env = QuadEnv(base=base, **keywords)
    first = env.reset(seed=5)
    after = [env.step(action)[:4] for action in actions_of(1, 5)]
    others = [env.reset() for _ in range(4)]
    assert_same(env.reset(seed=5), first)
    assert_same([env.step(action)[:4] for action in actions_of(1, 5)], after)
    assert_same([env.reset() for _ in range(4)], others)
    episodes = [flat(observation) for observation, _ in (first, *others, env.reset(seed=6))]
    assert len({episode.tobytes() for episode in episodes}) == 6


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


NONSENSE = [
    {"frameskip": 1},
    {"world": "storm"},
    {"world": {"wind_I": (1.0, 0.0, 0.0)}},
    {"faults": "storm"},
    {"faults": 3.0},
    {"faults": quad_gym.faults.GnssOutage(), "sensors": "indoor"},
    {"randomization": {"colour": quad_gym.Uniform(0.0, 1.0)}},
    {"randomization": {"mass": quad_gym.Uniform(1.0, 30.0)}},
    {"observations": "truth"},
    {"observation": "camera"},
    {"action": "rates"},
    {"layout": "flat"},
    {"sensors": "phone"},
    {"vehicle": "balloon"},
    {"action_params": "fast"},
    {"include_std": "yes"},
    {"privileged": 1},
    {"camera": None},
    {"control_rate": 30},
    {"control_rate": 400},
    {"substeps": 0},
    {"randomize_reference": "yes"},
    {"true_vehicle": "lab"},
    {"true_sensors": 1},
    {"render_mode": "sketch"},
]


@pytest.mark.parametrize("keywords", NONSENSE, ids=repr)
@pytest.mark.parametrize("maker", MAKERS)
def test_keywords_that_make_no_sense_are_refused_by_name(maker, keywords):
    if maker != "make_sb3_vec_env" and "render_mode" in keywords:
        pytest.skip("Gymnasium itself handles this keyword")
    with pytest.raises(ValueError, match=next(iter(keywords))) as error:
        MAKERS[maker](**keywords)
    if "frameskip" in keywords:  # the error that TorchRL expects
        assert isinstance(error.value, TypeError)
        assert "unexpected keyword argument" in str(error.value)


@pytest.mark.parametrize("env_id", ["QuadGym/Square-v0", "QuadGym/Circle-v1", "Circle", ""])
def test_unknown_ids_are_refused(env_id):
    with pytest.raises(ValueError, match="env_id"):
        quad_gym.make_sb3_vec_env(env_id)
    with pytest.raises(gymnasium.error.Error):
        gymnasium.make(env_id)


@pytest.mark.parametrize("env_id", IDS)
@pytest.mark.parametrize("mode", ["Sometimes", None, 1])
def test_an_unknown_autoreset_mode_is_refused(env_id, mode):
    with pytest.raises(ValueError, match=r"autoreset_mode|AutoresetMode"):
        gymnasium.make_vec(env_id, num_envs=2, autoreset_mode=mode)

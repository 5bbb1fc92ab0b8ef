"""Tests of the properties that algorithms and wrappers of Stable-Baselines3 rely on."""

import gymnasium
import numpy as np
import pytest

pytest.importorskip("stable_baselines3", reason='this needs "quad-gym[train]"')
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import DummyVecEnv, VecEnv, VecMonitor, VecNormalize

import quad_gym
from quad_gym.envs.sb3 import QuadSB3VecEnv
from quad_gym.envs.single import QuadEnv
from quad_gym.records import Ending
from tests.builders import SHORT, actions_for, actions_of
from tests.contract.comparing import assert_same, state_of
from tests.contract.configurations import CONFIGURATIONS

OMITTED = {"ending", "filter_status", "filter_diverged", "gates_passed", "drawn"}
"""Entries of `info` that only the last step of an episode has."""


def plain(observation):
    """Return an observation, with an ordered dictionary as a plain one."""
    return dict(observation) if isinstance(observation, dict) else observation


def make(n_envs=5, env_id="QuadGym/Hover-v0", seed=50, **keywords):
    return quad_gym.make_sb3_vec_env(env_id, n_envs=n_envs, seed=seed, **keywords)


CHOSEN = ("circle", "waypoints", "noisy", "late", "faults", "own estimator", "own task")
"""Configurations of the normal run; all fly in the vector environment that this one wraps."""


@pytest.mark.parametrize(
    "name",
    [pytest.param(n, marks=[pytest.mark.slow] * (n not in CHOSEN)) for n in CONFIGURATIONS],
)
def test_sb3_env_equals_a_dummy_vec_env_of_monitors(name):
    base, keywords = CONFIGURATIONS[name]
    keywords = {**SHORT, "base": base, **keywords}
    env = QuadSB3VecEnv(5, **keywords)
    env.seed(50)
    dummy = DummyVecEnv([lambda: Monitor(QuadEnv(**keywords))] * 5)
    dummy.seed(50)
    assert_same(env.reset(), plain(dummy.reset()))
    for info, expected in zip(env.reset_infos, dummy.reset_infos, strict=True):
        assert_same(info, {key: expected[key] for key in info})
    ended = 0
    for actions in actions_for(range(5), 70):
        mine, other = env.step(actions), dummy.step(actions)
        assert_same(mine[0], plain(other[0]))
        assert_same(mine[1:3], other[1:3])
        for info, expected in zip(mine[3], other[3], strict=True):
            episode, theirs = info.pop("episode", None), expected.pop("episode", None)
            assert_same(info, {key: expected[key] for key in info})
            assert set(expected) - set(info) <= OMITTED
            if theirs:
                ended += 1
                assert info.keys() == expected.keys()
                assert episode["l"] == theirs["l"]
                assert episode["r"] == pytest.approx(theirs["r"], abs=1e-6)
    assert ended > 5


def test_info_at_an_ending_has_the_episode_statistics():
    env = make(3, max_episode_steps=10, observation="truth")
    env.reset()
    errors = np.zeros(3)
    for _ in range(10):
        _, _, dones, infos = env.step(np.zeros((3, 4)))
        errors += [info["position_error"] for info in infos]
    assert dones.all()
    for i, info in enumerate(infos):
        assert info["episode"]["t"] >= 0.0
        assert info["episode"]["e"] == pytest.approx(errors[i] / 10)
        assert info["ending"] == Ending.TIME_LIMIT


def test_a_seed_holds_for_the_next_reset_only():
    env = make(4, seed=None)
    env.seed(9)
    first, second = env.reset(), env.reset()
    assert (first != second).any()
    env.seed(9)
    assert_same(env.reset(), first)
    assert_same(env.reset(), second)


def test_options_hold_for_the_next_reset_only():
    env = make(3)
    env.set_options({"position": [3.5, 1.0, 1.5], "yaw": 1.0})
    env.reset()
    np.testing.assert_array_equal(env.flights.batch.record("r"), np.tile([3.5, 1.0, 1.5], (3, 1)))
    env.reset()
    assert (env.flights.batch.record("r") != [3.5, 1.0, 1.5]).all()
    places = [[4.0, 0.0, 1.5], [4.0, 1.0, 2.0], [4.0, 0.5, 1.0]]
    env.set_options([{"position": place} for place in places])
    env.reset()
    np.testing.assert_array_equal(env.flights.batch.record("r"), places)
    before = state_of(env)
    env.set_options({"height": 2.0})
    with pytest.raises(ValueError, match="height"):
        env.reset()
    assert state_of(env) == before
    env.reset()  # without the options, which were refused
    env.set_options([{"yaw": 1.0}, {}, {"yaw": 1.0, "position": [4.0, 0.0, 1.5]}])
    with pytest.raises(ValueError, match=r"the same names .* got none and position, yaw and yaw"):
        env.reset()


def test_results_have_stated_types_and_share_no_memory():
    env = make(3)
    assert isinstance(env, VecEnv)
    first = env.reset()
    observation, rewards, dones, infos = env.step(np.zeros((3, 4), np.float32))
    assert observation.dtype == rewards.dtype == np.float32
    assert dones.dtype == np.bool_
    assert len(infos) == len({id(info) for info in infos}) == 3
    second = env.step(np.zeros((3, 4), np.float32))
    assert not np.shares_memory(first, observation)
    assert not np.shares_memory(observation, second[0])
    assert not np.shares_memory(rewards, second[1])
    assert not np.shares_memory(dones, second[2])


def test_step_before_reset_and_wait_before_step_are_errors():
    env = make(2)
    with pytest.raises((RuntimeError, gymnasium.error.ResetNeeded), match="reset"):
        env.step(np.zeros((2, 4)))
    env.reset()
    with pytest.raises(RuntimeError, match="step_async"):
        env.step_wait()


def test_attributes_and_methods_are_shared_by_all_flights():
    env = make(3)
    assert env.get_attr("num_envs", indices=[0, 2]) == [3, 3]
    env.set_attr("metadata", {"render_modes": [], "note": 1})
    assert env.get_attr("metadata")[1]["note"] == 1
    with pytest.raises(ValueError, match="indices"):
        env.set_attr("metadata", {}, indices=[0])
    with pytest.raises((ValueError, AttributeError)):
        env.set_attr("no_such_attribute", 1)
    env.note = 1
    env.set_attr("note", 2)
    assert env.note == 2
    for name in ("num_envs", "flights", "action_space", "render_mode", "reset", "step_wait"):
        with pytest.raises(ValueError, match=f"attr_name must be metadata.*{name}.*keywords"):
            env.set_attr(name, 1)
    assert env.env_is_wrapped(Monitor) == [True] * 3
    assert env.env_is_wrapped(gymnasium.wrappers.TimeLimit, indices=1) == [False]
    for indices in (3, [0, 5], -4):
        with pytest.raises(ValueError, match="indices must be below 3, got"):
            env.get_attr("num_envs", indices)
        with pytest.raises(ValueError, match="indices must be below 3, got"):
            env.env_method("seed", 1, indices=indices)
    env.close()
    env.close()


@pytest.mark.filterwarnings("ignore:The environment is already wrapped:UserWarning")
@pytest.mark.parametrize("wrapper", [VecMonitor, VecNormalize])
def test_sb3_wrappers_accept_environment_and_count_episodes(wrapper):
    env = wrapper(make(4, **SHORT))
    env.reset()
    lengths = []
    for k in range(60):
        observation, _, _, infos = env.step(np.stack([actions_of(i, 60)[k] for i in range(4)]))
        assert np.isfinite(observation).all()
        lengths += [info["episode"]["l"] for info in infos if "episode" in info]
    assert max(lengths) == 25

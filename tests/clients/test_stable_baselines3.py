"""Stable-Baselines3 trains from an id, with its own vector environments and with the native one."""

import sys

import pytest

import quad_gym

sb3 = pytest.importorskip("stable_baselines3")
env_util = pytest.importorskip("stable_baselines3.common.env_util")
vec_env = pytest.importorskip("stable_baselines3.common.vec_env")

SMALL = {"n_steps": 32, "batch_size": 32, "n_epochs": 1}


@pytest.fixture(autouse=True)
def _without_pygame(monkeypatch):
    """Hide pygame: Stable-Baselines3 requests rendering but does not use it in training."""
    monkeypatch.setitem(sys.modules, "pygame", None)


def test_ppo_trains_from_an_id():
    model = sb3.PPO("MlpPolicy", "QuadGym/Circle-v0", **SMALL)
    model.learn(64)
    assert model.num_timesteps == 64
    assert model.get_env().render_mode == "rgb_array"


@pytest.mark.parametrize(
    "name",
    ["DummyVecEnv", pytest.param("SubprocVecEnv", marks=pytest.mark.slow)],  # both import torch
)
def test_ppo_trains_in_vector_environments_of_stable_baselines(name):
    envs = env_util.make_vec_env(
        "quad_gym:QuadGym/Circle-v0",  # other processes import the module before the colon
        2,
        seed=0,
        env_kwargs={"max_episode_steps": 10},
        vec_env_cls=getattr(vec_env, name),
    )
    model = sb3.PPO("MlpPolicy", envs, **SMALL)
    model.learn(64)
    assert [episode["l"] for episode in model.ep_info_buffer] == 6 * [10]
    envs.close()


def test_sac_trains_in_the_native_vector_environment():
    envs = quad_gym.make_sb3_vec_env("QuadGym/Hover-v0", 4, seed=0, max_episode_steps=10)
    model = sb3.SAC("MlpPolicy", envs, learning_starts=20, batch_size=8, buffer_size=1000)
    model.learn(60)
    assert len(model.ep_info_buffer) == 4

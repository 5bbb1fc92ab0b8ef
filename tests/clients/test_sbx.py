"""SBX, the algorithms of Stable-Baselines3 on JAX, train from an id and natively."""

import pytest

import quad_gym

sbx = pytest.importorskip("sbx")

SMALL = {"n_steps": 32, "batch_size": 32, "n_epochs": 1}


def test_ppo_trains_from_an_id():
    model = sbx.PPO("MlpPolicy", "QuadGym/Circle-v0", **SMALL)
    model.learn(64)
    assert model.num_timesteps == 64


def test_sac_trains_in_the_native_vector_environment():
    envs = quad_gym.make_sb3_vec_env("QuadGym/Hover-v0", 4, seed=0, max_episode_steps=10)
    model = sbx.SAC("MlpPolicy", envs, learning_starts=20, batch_size=8, buffer_size=1000)
    model.learn(60)
    assert len(model.ep_info_buffer) == 4

"""RLlib trains on the native vector environment."""

import importlib

import gymnasium
import numpy as np
import pytest

from quad_gym.envs.vector import QuadVectorEnv

ppo = pytest.importorskip("ray.rllib.algorithms.ppo")

SHORT = {"max_episode_steps": 20}


def test_rllib_trains_on_the_native_vector_environment():
    config = (
        ppo.PPOConfig()
        .environment("quad_gym:QuadGym/Hover-v0", env_config=SHORT)
        .env_runners(
            num_env_runners=0,
            num_envs_per_env_runner=8,
            gym_env_vectorize_mode=gymnasium.VectorizeMode.VECTOR_ENTRY_POINT,
        )
        .training(train_batch_size_per_learner=400, minibatch_size=200, num_epochs=1)
    )
    assert not config.disable_env_checking
    algorithm = config.build_algo()
    try:
        env = algorithm.env_runner.env.unwrapped
        assert type(env) is QuadVectorEnv
        assert env.num_envs == 8
        result = algorithm.train()["env_runners"]
        assert result["num_env_steps_sampled_lifetime"] == 400
        assert result["episode_len_max"] == SHORT["max_episode_steps"]
        assert np.isfinite(result["episode_return_mean"])
    finally:
        algorithm.stop()
        importlib.import_module("ray").shutdown()

"""TorchRL flies single environments, several of them, and the native vector environment."""

import gymnasium
import numpy as np
import pytest

import quad_gym  # noqa: F401

torch = pytest.importorskip("torch")
envs = pytest.importorskip("torchrl.envs")
check_env_specs = pytest.importorskip("torchrl.envs.utils").check_env_specs

SHORT = {"max_episode_steps": 20}


def test_torchrl_makes_an_environment_by_its_id_with_keywords():
    env = envs.GymEnv("QuadGym/Hover-v0", observation="truth", frame_skip=2)
    check_env_specs(env)
    assert env.rollout(5)["observation"].shape == (5, 28)


def test_torchrl_flies_the_native_vector_environment():
    def make():
        keywords = {"num_envs": 6, "autoreset_mode": "Disabled", **SHORT}
        return gymnasium.make_vec("QuadGym/Hover-v0", **keywords)

    env = envs.GymWrapper(make())
    check_env_specs(env)
    torch.manual_seed(0)
    env.set_seed(5)
    data = env.rollout(45, break_when_any_done=False)
    assert int(data["next", "truncated"].sum()) == 12
    alone = make()
    alone.reset(seed=5)  # as set_seed does
    observation, _ = alone.reset()
    for k in range(20):  # the first episode, flown again
        np.testing.assert_array_equal(data["observation"][:, k], observation)
        observation, reward, *_ = alone.step(data["action"][:, k].numpy())
        np.testing.assert_array_equal(data["next", "reward"][:, k, 0], reward.astype(np.float32))
        np.testing.assert_array_equal(data["next", "observation"][:, k], observation)
    assert (data["observation"][:, 20] != data["next", "observation"][:, 19]).any()  # a new episode


def test_torchrl_flies_single_environments_in_processes():
    keywords = {"observation": "truth", **SHORT}
    env = envs.GymEnv("quad_gym:QuadGym/Hover-v0", num_envs=2, **keywords)
    env.set_seed(5)
    data = env.rollout(45, break_when_any_done=False)
    assert data["next", "observation"].shape == (2, 45, 28)
    assert data["next", "truncated"].sum() == 4
    assert data["next", "ending"].dtype == torch.int64
    assert data["next", "position_error"].isfinite().all()
    env.close()

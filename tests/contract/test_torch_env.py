"""Flights as torch tensors equal those of `make_vec`."""

import gymnasium
import numpy as np
import pytest

import quad_gym

torch = pytest.importorskip("torch")

ENV_ID = "QuadGym/Hover-v0"
SHORT = {"observation": "truth", "max_episode_steps": 5}


@pytest.mark.parametrize("mode", ["NextStep", "SameStep"])
def test_flights_of_torch_tensors_equal_those_of_make_vec(mode):
    envs = quad_gym.make_torch_vec_env(ENV_ID, 9, autoreset_mode=mode, **SHORT)
    others = gymnasium.make_vec(ENV_ID, 9, autoreset_mode=mode, **SHORT)
    seen, _ = envs.reset(seed=4)
    expected, _ = others.reset(seed=4)
    assert np.array_equal(seen.numpy(), expected)
    rng, finals = np.random.default_rng(0), 0
    for _ in range(12):
        actions = rng.uniform(-1.0, 1.0, (9, 4)).astype(np.float32)
        got = envs.step(torch.from_numpy(actions))
        *wanted, infos = others.step(actions)
        assert np.array_equal(got[0].numpy(), wanted[0])
        assert np.array_equal(got[1].numpy(), wanted[1].astype(np.float32))
        assert np.array_equal(got[2].numpy(), wanted[2])
        assert np.array_equal(got[3].numpy(), wanted[3])
        assert np.array_equal(got[4]["position_error"].numpy(), infos["position_error"])
        ended = infos.get("_final_obs", np.zeros(9, bool))
        for i in np.flatnonzero(ended):
            assert np.array_equal(got[4]["final_obs"][i].numpy(), infos["final_obs"][i])
            finals += 1
    assert finals == (18 if mode == "SameStep" else 0)


def test_tensors_of_a_step_are_not_overwritten_by_the_next_one():
    envs = quad_gym.make_torch_vec_env(ENV_ID, 2, **SHORT)
    first, _ = envs.reset(seed=0)
    kept = first.clone()
    second, rewards, *_ = envs.step(torch.zeros(2, 4))
    kept_rewards = rewards.clone()
    envs.step(torch.ones(2, 4))
    assert torch.equal(first, kept)
    assert torch.equal(rewards, kept_rewards)
    assert not torch.equal(first, second)


def test_actions_with_gradients_are_flown_without_them():
    envs = quad_gym.make_torch_vec_env(ENV_ID, 2, **SHORT)
    envs.reset(seed=0)
    observations, rewards, *_ = envs.step(torch.zeros(2, 4, requires_grad=True))
    assert not observations.requires_grad
    assert rewards.dtype == torch.float32


def test_reset_mask_may_be_a_tensor():
    envs = quad_gym.make_torch_vec_env(ENV_ID, 3, autoreset_mode="Disabled", **SHORT)
    envs.reset(seed=0)
    before, *_ = envs.step(torch.zeros(3, 4))
    after, infos = envs.reset(options={"reset_mask": torch.tensor([False, True, False])})
    assert torch.equal(after[[0, 2]], before[[0, 2]])
    assert not torch.equal(after[1], before[1])
    assert infos["_ending"].tolist() == [False, True, False]


def test_privileged_observations_are_a_dictionary_of_tensors():
    envs = quad_gym.make_torch_vec_env(ENV_ID, 2, observation="noisy", privileged=True)
    seen, _ = envs.reset(seed=0)
    assert {name: tuple(part.shape) for name, part in seen.items()} == {
        name: space.shape for name, space in envs.observation_space.items()
    }


@pytest.mark.parametrize("device", ["cudas", "meta", "tpu-9", 3.5])
def test_another_device_is_refused(device):
    with pytest.raises(ValueError, match='device must be "cpu"'):
        quad_gym.make_torch_vec_env(ENV_ID, 2, device=device)


def test_actions_that_are_not_finite_are_refused_before_the_step():
    envs = quad_gym.make_torch_vec_env(ENV_ID, 2, **SHORT)
    envs.reset(seed=0)
    before = envs.flights.batch.read("position")
    with pytest.raises(ValueError, match=r"finite|NaN"):
        envs.step(torch.full((2, 4), torch.nan))
    assert np.array_equal(envs.flights.batch.read("position"), before)

"""Flights as torch tensors equal those of `make_vec`."""

import gymnasium
import numpy as np
import pytest

import quad_gym
from baselines import PDPolicy
from quad_gym.evaluation import roll_out

torch = pytest.importorskip("torch")

ENV_ID = "QuadGym/Hover-v0"
SHORT = {"observation": "truth", "max_episode_steps": 5}


def assert_flights_equal(envs, others, steps=12, last=False, kind=np.float32):
    """Fly tensors and arrays with the same actions; return the number of episodes.

    `last`: where an episode ends and the next begins in a step, errors are those of the end.
    """
    seen, expected, episodes = envs.reset(seed=4)[0], others.reset(seed=4)[0], 0
    rng = np.random.default_rng(0)
    for _ in range(steps):
        assert np.array_equal(seen.cpu().numpy(), expected)
        actions = rng.uniform(-1.2, 1.2, (len(expected), 4)).astype(kind)
        seen, rewards, *over, infos = envs.step(torch.from_numpy(actions).to(envs.device))
        expected, wanted, *ended, known = others.step(actions)
        assert np.array_equal(rewards.cpu().numpy(), wanted.astype(np.float32))
        for flags, truths in zip(over, ended, strict=True):
            assert np.array_equal(flags.cpu().numpy(), truths)
        errors = known["position_error"].copy()
        for i in np.flatnonzero(known.get("_final_obs", [])):
            assert np.array_equal(infos["final_obs"][i].cpu().numpy(), known["final_obs"][i])
            errors[i] = known["final_info"]["position_error"][i] if last else errors[i]
        assert np.array_equal(infos["position_error"].cpu().numpy(), errors)
        episodes += np.logical_or(*ended).sum()
    return episodes


@pytest.mark.parametrize("mode", ["NextStep", "SameStep"])
@pytest.mark.parametrize("kind", [np.float32, np.float64, np.float16])
def test_flights_of_torch_tensors_equal_those_of_make_vec(mode, kind):
    made = {"autoreset_mode": mode, **SHORT}
    envs = quad_gym.make_torch_vec_env(ENV_ID, 9, **made)
    assert assert_flights_equal(envs, gymnasium.make_vec(ENV_ID, 9, **made), kind=kind) == 18


def assert_written_steps_move_the_time_limits(envs):
    """Flights with a limit of five steps, of which k have been flown, end after 5 - k more."""
    envs.reset(seed=0)
    steps = torch.arange(envs.num_envs) % 5
    envs.write_steps(steps)
    first = torch.zeros(envs.num_envs, dtype=torch.long)
    for k in range(1, 6):
        truncated = envs.step(torch.zeros(envs.num_envs, 4))[3].cpu()
        first[truncated & (first == 0)] = k
    assert torch.equal(first, 5 - steps)


def test_written_steps_move_the_time_limits():
    made = {"autoreset_mode": "NextStep", **SHORT}
    assert_written_steps_move_the_time_limits(quad_gym.make_torch_vec_env(ENV_ID, 7, **made))


@pytest.mark.parametrize(
    ("steps", "message"),
    [
        (torch.tensor([1, 2, 3]), r"must have shape \(2,\), got \(3,\)"),
        (torch.tensor(1), r"must have shape \(2,\), got \(\)"),
        (torch.tensor([1.0, torch.nan]), "must be finite, got nan"),
        (torch.tensor([1, -1]), "must be whole numbers of at least 0"),
        (torch.tensor([0.0, 1.5]), "must be whole numbers of at least 0"),
    ],
)
def test_written_steps_that_are_no_counts_change_nothing(steps, message):
    envs = quad_gym.make_torch_vec_env(ENV_ID, 2, **SHORT)
    envs.reset(seed=0)
    before = envs.flights.batch.snapshot().tobytes()
    with pytest.raises(ValueError, match=f"steps {message}"):
        envs.write_steps(steps)
    assert envs.flights.batch.snapshot().tobytes() == before


def test_roll_out_refuses_environments_of_tensors():
    envs = quad_gym.make_torch_vec_env(ENV_ID, 2, **SHORT)
    with pytest.raises(ValueError, match=r"QuadVectorEnv, .* got QuadTorchVecEnv"):
        roll_out(PDPolicy(envs), envs)


def test_actions_in_bfloat16_are_flown():
    envs = quad_gym.make_torch_vec_env(ENV_ID, 2, **SHORT)
    envs.reset(seed=0)
    envs.step(torch.zeros(2, 4, dtype=torch.bfloat16))


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


def assert_mask_begins_one_episode(envs):
    """A mask that is a tensor begins the second of three episodes."""
    envs.reset(seed=0)
    before = envs.step(torch.zeros(3, 4))[0].clone()
    after, infos = envs.reset(options={"reset_mask": torch.tensor([False, True, False])})
    assert torch.equal(after[[0, 2]], before[[0, 2]])
    assert not torch.equal(after[1], before[1])
    return infos


def test_reset_mask_may_be_a_tensor():
    envs = quad_gym.make_torch_vec_env(ENV_ID, 3, autoreset_mode="Disabled", **SHORT)
    infos = assert_mask_begins_one_episode(envs)
    assert infos["_ending"].tolist() == [False, True, False]


def test_privileged_observations_are_a_dictionary_of_tensors():
    envs = quad_gym.make_torch_vec_env(ENV_ID, 2, observation="noisy", privileged=True)
    seen, _ = envs.reset(seed=0)
    assert {name: tuple(part.shape) for name, part in seen.items()} == {
        name: space.shape for name, space in envs.observation_space.items()
    }


def test_actions_that_are_not_finite_are_refused_before_the_step():
    envs = quad_gym.make_torch_vec_env(ENV_ID, 2, **SHORT)
    envs.reset(seed=0)
    before = envs.flights.batch.read("position")
    with pytest.raises(ValueError, match=r"finite|NaN"):
        envs.step(torch.full((2, 4), torch.nan))
    assert np.array_equal(envs.flights.batch.read("position"), before)

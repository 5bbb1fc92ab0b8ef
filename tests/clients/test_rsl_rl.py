"""rsl_rl trains on flights of torch tensors."""

import pytest

import quad_gym

rsl_rl = pytest.importorskip("rsl_rl")
torch = pytest.importorskip("torch")

from rsl_rl.runners import OnPolicyRunner  # noqa: E402

from quad_gym.envs.rsl_rl import RslRlVecEnv  # noqa: E402

NETWORK = {"class_name": "MLPModel", "hidden_dims": [64, 64], "activation": "tanh"}
SETTINGS = {
    "num_steps_per_env": 32,
    "save_interval": 1000,
    "obs_groups": {"actor": ["policy"], "critic": ["critic"]},
    "actor": {
        **NETWORK,
        "distribution_cfg": {"class_name": "GaussianDistribution", "init_std": 0.6},
    },
    "critic": NETWORK,
    "algorithm": {"class_name": "PPO", "learning_rate": 1e-3, "gamma": 0.98, "entropy_coef": 0.0},
}


def hovering(seed, **keywords):
    flights = quad_gym.make_torch_vec_env(
        "QuadGym/Hover-v0", 64, autoreset_mode="SameStep", observation="truth", **keywords
    )
    return RslRlVecEnv(flights, seed=seed)


def crashes(env, act):
    """Fly one episode; return the share of flights that crash."""
    crashed = torch.zeros(env.num_envs, dtype=torch.bool)
    with torch.no_grad():
        for _ in range(env.max_episode_length):
            _, _, ended, extras = env.step(act(env.get_observations()))
            crashed |= ended & ~extras["time_outs"]
    return float(crashed.float().mean())


def test_ppo_learns_to_hover():
    torch.manual_seed(0)
    torch.set_num_threads(1)
    runner = OnPolicyRunner(hovering(10**9), SETTINGS, log_dir=None, device="cpu")
    test = hovering(0)
    assert crashes(test, lambda seen: 0.3 * torch.randn(64, 4)) > 0.5
    runner.learn(40)  # crashes of 0 % were measured
    assert crashes(hovering(0), runner.get_inference_policy(device="cpu")) < 0.1


def test_critic_observes_the_privileged_quantities():
    seen = hovering(0, privileged=True).get_observations()
    assert seen["critic"].shape[1] > seen["policy"].shape[1]
    assert torch.equal(seen["critic"][:, : seen["policy"].shape[1]], seen["policy"])


def test_time_limits_are_time_outs_and_lengths_begin_again():
    env = hovering(0, max_episode_steps=3)
    for step in range(1, 7):
        _, _, ended, extras = env.step(torch.zeros(64, 4))
        assert bool(ended.all()) == (step % 3 == 0) == bool(extras["time_outs"].all())
        assert set(env.episode_length_buf.tolist()) == {step % 3}


def time_outs(env, steps):
    """Fly zero actions; return the step in which each flight first reaches its time limit."""
    first = torch.zeros(env.num_envs, dtype=torch.long)
    for step in range(1, steps + 1):
        _, _, _, extras = env.step(torch.zeros(env.num_envs, 4))
        first[extras["time_outs"] & (first == 0)] = step
    return first


def test_written_lengths_of_episodes_move_the_time_limits():
    env = hovering(0, max_episode_steps=20, out_of_bounds=50.0)
    lengths = torch.arange(64) % 20
    env.episode_length_buf = lengths
    assert torch.equal(time_outs(env, 20), 20 - lengths)
    env.episode_length_buf[:] = 18  # elements, too
    assert torch.equal(time_outs(env, 3), torch.full((64,), 2))


def test_lengths_that_are_not_written_change_nothing():
    env, flights = hovering(0), hovering(0).env
    actions = 0.3 * torch.randn(30, 64, 4, generator=torch.Generator().manual_seed(0))
    for action in actions:
        seen, rewards, *_ = env.step(action)
        expected = flights.step(action)
        assert torch.equal(seen["policy"], expected[0])
        assert torch.equal(rewards, expected[1])


def test_runner_spreads_the_time_limits_of_its_first_episodes():
    torch.manual_seed(0)
    env = hovering(0, max_episode_steps=100, out_of_bounds=50.0)
    OnPolicyRunner(env, SETTINGS, log_dir=None, device="cpu").learn(1, init_at_random_ep_len=True)
    assert len(set(env.episode_length_buf.tolist())) > 20  # before, all had 32


@pytest.mark.parametrize(
    "wrong",
    [
        0,
        torch.zeros(3, dtype=torch.long),
        torch.zeros(64),
        torch.full((64,), 500),
        torch.full((64,), -1),
    ],
)
def test_wrong_lengths_of_episodes_are_refused(wrong):
    env = hovering(0)
    with pytest.raises(ValueError, match="episode_length_buf must be"):
        env.episode_length_buf = wrong


def test_another_autoreset_mode_is_refused():
    flights = quad_gym.make_torch_vec_env("QuadGym/Hover-v0", 2, observation="truth")
    with pytest.raises(ValueError, match="SameStep"):
        RslRlVecEnv(flights)

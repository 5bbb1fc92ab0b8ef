"""Other libraries fly these environments: what they rely on, beyond the examples of the page.

Most need the packages of the extra `clients`, and are skipped without: `make test-clients`.
"""

import importlib

import gymnasium
import numpy as np
import pytest

import quad_gym
from baselines import PDPolicy
from quad_gym.envs.vector import QuadVectorEnv
from tests.examples import example

SHORT = {"max_episode_steps": 20}


@pytest.fixture(scope="module")
def cleanrl():
    """The script in the style of CleanRL, as a module."""
    pytest.importorskip("torch")
    return example("cleanrl_ppo")


def test_the_script_of_cleanrl_trains_evaluates_and_saves(cleanrl, tmp_path, capsys):
    import torch

    file = tmp_path / "weights.pt"
    args = cleanrl.Args(total_timesteps=256, num_steps=64, num_envs=2, num_minibatches=4)
    args.evaluate, args.save = 3, file
    cleanrl.main(args)
    assert "mean_error" in capsys.readouterr().out
    weights = torch.load(file)
    agent = cleanrl.Agent(28, 4)
    agent.load_state_dict(weights)
    assert (weights["variance"] != 1.0).any()  # of the observations that it has seen
    actions, _ = agent.predict(np.zeros((5, 28), np.float32))
    assert actions.shape == (5, 4)
    assert np.abs(actions).max() <= 1.0


def test_advantages_of_the_script_are_returns_less_values(cleanrl):
    import torch

    rng = np.random.default_rng(0)
    rewards, values = rng.normal(size=(2, 6, 3))
    dones = np.zeros((6, 3))
    dones[3, 1] = 1.0  # before step 3, an episode of flight 1 ended
    last = rng.normal(size=3)
    args = cleanrl.Args(num_steps=6, gamma=0.9, gae_lambda=1.0)
    given = [torch.as_tensor(x) for x in (rewards, dones, values, np.zeros(3), last)]
    found = cleanrl.advantages_of(*given, args).numpy()
    for i in range(3):
        total = last[i]
        for t in reversed(range(6)):
            ends = t == 2 and i == 1
            total = rewards[t, i] + 0.9 * (0.0 if ends else total)
            assert found[t, i] == pytest.approx(total - values[t, i])


def test_unknown_keywords_are_refused_in_the_words_that_torchrl_looks_for():
    with pytest.raises(TypeError, match="unexpected keyword argument 'frameskip'"):
        gymnasium.make("QuadGym/Hover-v0", frameskip=1)


def test_rllib_trains_on_the_native_vector_environment():
    ppo = pytest.importorskip("ray.rllib.algorithms.ppo")
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


def test_torchrl_makes_an_environment_by_its_id_with_keywords():
    envs = pytest.importorskip("torchrl.envs")
    from torchrl.envs.utils import check_env_specs

    env = envs.GymEnv("QuadGym/Hover-v0", observation="truth", frame_skip=2)
    check_env_specs(env)
    assert env.rollout(5)["observation"].shape == (5, 28)


def test_torchrl_flies_the_native_vector_environment():
    envs = pytest.importorskip("torchrl.envs")
    import torch
    from torchrl.envs.utils import check_env_specs

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
    assert (data["observation"][:, 20] != data["next", "observation"][:, 19]).any()  # begun anew


def test_minari_keeps_flights_of_pd_and_makes_their_environment_again(tmp_path, monkeypatch):
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path))
    minari = pytest.importorskip("minari")
    env = minari.DataCollector(gymnasium.make("QuadGym/Hover-v0", **SHORT), record_infos=True)
    policy = PDPolicy(env, gains="tuned")
    rows = []
    for seed in (3, 4):
        observation, _ = env.reset(seed=seed)
        over = False
        while not over:
            action, _ = policy.predict(observation)
            observation, reward, terminated, truncated, info = env.step(action)
            rows.append((observation, action, reward, info["position_error"]))
            over = terminated or truncated
    env.create_dataset("quadgym/hover/pd-v0", algorithm_name="PD", eval_env="QuadGym/Hover-v0")
    dataset = minari.load_dataset("quadgym/hover/pd-v0")
    episodes = list(dataset.iterate_episodes())
    assert [len(episode.rewards) for episode in episodes] == [20, 20]
    flown = [np.concatenate(column) for column in zip(*map(columns_of, episodes), strict=True)]
    for mine, kept in zip(zip(*rows, strict=True), flown, strict=True):
        np.testing.assert_array_equal(np.array(mine), kept)
    again = dataset.recover_environment()
    np.testing.assert_array_equal(again.reset(seed=3)[0], episodes[0].observations[0])
    assert again.spec.max_episode_steps == 20
    assert isinstance(again.unwrapped, quad_gym.QuadEnv)


def columns_of(episode):
    """What `rows` holds of a step, as recorded."""
    infos = episode.infos["position_error"][1:]  # the first is that of the reset
    return episode.observations[1:], episode.actions, episode.rewards, infos

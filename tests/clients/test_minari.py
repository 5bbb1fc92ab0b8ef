"""Minari records flights and recreates their environment."""

import gymnasium
import numpy as np
import pytest

import quad_gym
from baselines import PDPolicy
from quad_gym import Ending

minari = pytest.importorskip("minari")

SHORT = {"max_episode_steps": 20}


def test_minari_records_flights_and_recovers_environment(tmp_path, monkeypatch):
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path))
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
    endings = episodes[0].infos["ending"]
    np.testing.assert_array_equal(endings, 20 * [Ending.NONE] + [Ending.TIME_LIMIT])
    again = dataset.recover_environment()
    np.testing.assert_array_equal(again.reset(seed=3)[0], episodes[0].observations[0])
    assert again.spec.max_episode_steps == 20
    assert isinstance(again.unwrapped, quad_gym.QuadEnv)


def columns_of(episode):
    """Return the recorded columns of an episode, in the order of `rows`."""
    infos = episode.infos["position_error"][1:]  # the first is of the reset
    return episode.observations[1:], episode.actions, episode.rewards, infos

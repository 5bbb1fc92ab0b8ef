"""Weights of rewards, and their terms in `info`."""

import gymnasium
import numpy as np
import pytest

import quad_gym
from quad_gym import QuadEnv, QuadVectorEnv, RewardParams, rewards
from tests.builders import actions_of

BASE = {"observation": "truth", "reward_terms": True}
COMMON = {"heading", "action_rate", "body_rates"}
TERMS = dict.fromkeys(quad_gym.IDS.values(), COMMON | {"near", "fine"}) | {
    "waypoints": COMMON | {"progress", "gate_passed"},
    "look_around": {"wide", "near", "heading", "crash"},
    "stale_race": {"progress", "action_rate", "body_rates", "gate_passed", "crash"},
    "outage_dash": {"progress", "action_rate", "body_rates", "crash"},
}


def flown(task, steps=120, n=8, **keywords):
    """Rewards (steps, n) of random actions, terms by name (steps, n), and the environment."""
    env = QuadVectorEnv(n, task, **BASE | keywords)
    env.reset(seed=4)
    paid, terms = [], []
    actions = np.stack([actions_of(i, steps) for i in range(n)], axis=1)
    for action in actions:
        _, reward, _, _, info = env.step(action)
        paid.append(reward)
        terms.append({name: v for name, v in info["reward_terms"].items() if name[0] != "_"})
    return np.array(paid), {name: np.array([t[name] for t in terms]) for name in terms[0]}, env


def test_terms_of_one_flight_are_numbers():
    env = QuadEnv("hover", **BASE)
    _, info = env.reset(seed=1)
    assert "reward_terms" not in info
    _, reward, _, _, info = env.step(np.full(4, 0.1))
    assert all(type(term) is float for term in info["reward_terms"].values())
    assert sum(info["reward_terms"].values()) == reward
    plain = QuadEnv("hover", observation="truth")
    plain.reset(seed=1)
    assert "reward_terms" not in plain.step(np.zeros(4))[4]


@pytest.mark.parametrize(
    ("keywords", "message"),
    [
        ({"task": "circle", "reward_params": {"near": 1.0}}, "reward_params must be a RewardP"),
        ({"task": "circle", "reward_params": RewardParams(progress=2.0)}, "progress has no effect"),
        ({"task": "waypoints", "reward_params": RewardParams(fine_decay=9.0)}, "fine_decay has no"),
        ({"task": "look_around", "reward_params": RewardParams()}, "reward_params has no effect"),
        ({"task": "circle", "reward_terms": 1}, "reward_terms must be True or False"),
    ],
    ids=str,
)
def test_weights_without_effect_are_refused(keywords, message):
    with pytest.raises(ValueError, match=message):
        QuadEnv(**keywords)


def test_own_task_shows_the_terms_that_it_returns():
    def reward(view):
        return {"near": rewards.Tracking()(view), "crash": -5.0 * rewards.Crash()(view)}

    down = np.tile([-1.0, 0.0, 0.0, 0.0], (2, 1))
    env = QuadVectorEnv(2, base="hover", task=quad_gym.Task.of(reward=reward), **BASE)
    env.reset(seed=0)
    crashes = 0
    for _ in range(100):
        _, paid, terminated, _, info = env.step(down)
        terms = info["reward_terms"]
        np.testing.assert_array_equal(terms["near"] + terms["crash"], paid)
        np.testing.assert_array_equal(terms["crash"], np.where(terminated, -5.0, 0.0))
        crashes += terminated.sum()
    assert crashes > 0


def test_terms_of_the_last_step_are_in_the_final_info_too():
    """The terms in `info` stay, as the reward is their sum, if the next episode begins at once."""
    env = QuadVectorEnv(3, "hover", autoreset_mode="SameStep", max_episode_steps=5, **BASE)
    env.reset(seed=4)
    for _ in range(5):
        _, reward, _, _, info = env.step(np.full((3, 4), 0.1))
    ended, now = info["final_info"]["reward_terms"], info["reward_terms"]
    assert info["_final_info"].all()
    assert {name for name in ended if name[0] != "_"} == TERMS["hover"]
    for name in TERMS["hover"]:
        np.testing.assert_array_equal(ended[name], now[name])
        assert ended[f"_{name}"].all()
    np.testing.assert_array_equal(sum(ended[name] for name in ended if name[0] != "_"), reward)


def test_own_task_has_one_term_or_terms_of_its_base():
    task = quad_gym.Task.of(reward=rewards.Heading())
    paid, terms, _ = flown(task, 5, base="hover")
    np.testing.assert_array_equal(terms["reward"], paid)
    assert set(terms) == {"reward"}
    _, terms, _ = flown(quad_gym.Task(), 5, base="hover")
    assert set(terms) == TERMS["hover"]


@pytest.mark.parametrize(
    ("terms", "message"),
    [
        ({}, "at least one term"),
        ({"a": np.zeros(3)}, r"shape \(2,\), one number per flight for 'a', got \(3,\)"),
        ({"a": "x"}, "numbers for 'a'"),
        ({"a": np.full(2, np.nan)}, "finite rewards"),
    ],
)
def test_wrong_terms_of_an_own_task_are_refused(terms, message):
    env = gymnasium.make_vec(
        "QuadGym/Hover-v0", num_envs=2, task=quad_gym.Task.of(reward=lambda view: terms)
    )
    env.reset(seed=0)
    with pytest.raises(quad_gym.TaskError, match=message):
        env.step(np.zeros((2, 4)))

"""Weights of rewards, and their terms in `info`."""

import gymnasium
import numpy as np
import pytest

import quad_gym
from quad_gym import QuadEnv, QuadVectorEnv, RewardParams, rewards
from quad_gym.envs.benchmarks import BENCHMARKS
from tests.builders import actions_of

PERIOD = 1 / 50
BASE = {"observation": "truth", "reward_terms": True}
COMMON = {"heading", "action_rate", "body_rates"}
TERMS = dict.fromkeys(quad_gym.IDS.values(), COMMON | {"near", "fine"}) | {
    "waypoints": COMMON | {"progress", "gate_passed"},
    "look_around": {"wide", "near", "heading", "crash"},
    "stale_race": {"progress", "action_rate", "body_rates", "gate_passed", "crash"},
    "outage_dash": {"progress", "action_rate", "body_rates", "crash"},
}
KINDS = [kind for kind in TERMS if kind not in BENCHMARKS]


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


@pytest.mark.parametrize("mode", ["NextStep", "SameStep"])
@pytest.mark.parametrize("per", ["step", "second"])
@pytest.mark.parametrize("task", list(TERMS))
def test_sum_of_terms_is_the_reward(task, per, mode):
    paid, terms, _ = flown(task, reward_per=per, autoreset_mode=mode, max_episode_steps=70)
    assert set(terms) == TERMS[task]
    np.testing.assert_allclose(sum(terms.values()), paid, rtol=1e-12, atol=1e-12)
    assert (paid != 0.0).mean() > 0.9


def test_terms_of_one_flight_are_numbers():
    env = QuadEnv("hover", **BASE)
    _, info = env.reset(seed=1)
    assert "reward_terms" not in info
    _, reward, _, _, info = env.step(np.full(4, 0.1))
    assert all(type(term) is float for term in info["reward_terms"].values())
    assert sum(info["reward_terms"].values()) == pytest.approx(reward, abs=1e-12)
    plain = QuadEnv("hover", observation="truth")
    plain.reset(seed=1)
    assert "reward_terms" not in plain.step(np.zeros(4))[4]


@pytest.mark.parametrize("task", KINDS)
def test_doubled_weight_doubles_its_term_and_no_other(task):
    _, plain, _ = flown(task, steps=30, n=2)
    for name in TERMS[task]:
        doubled = RewardParams(**{name: 2.0 * getattr(RewardParams(), name)})
        paid, terms, _ = flown(task, steps=30, n=2, reward_params=doubled)
        for other, values in plain.items():
            np.testing.assert_array_equal(terms[other], (1.0 + (other == name)) * values)
        np.testing.assert_allclose(sum(terms.values()), paid, rtol=1e-12, atol=1e-12)


def test_passed_gates_are_a_term():
    env = QuadVectorEnv(
        8, "waypoints", gate_radius=3.0, reward_params=RewardParams(gate_passed=2.0), **BASE
    )
    env.reset(seed=0)
    before = np.zeros(8)
    for _ in range(100):
        *_, info = env.step(np.zeros((8, 4)))
        passed = info["gates_passed"] - before
        before = info["gates_passed"]
        on = passed >= 0  # not in a step that begins an episode
        np.testing.assert_allclose(
            info["reward_terms"]["gate_passed"][on], 2.0 * passed[on] / PERIOD
        )
    assert before.max() > 0


@pytest.mark.parametrize("bad", [-0.1, np.nan, np.inf, "1", None])
@pytest.mark.parametrize("name", ["near", "fine_decay", "gate_passed", "body_rates"])
def test_invalid_weight_is_refused_by_name(name, bad):
    with pytest.raises(ValueError, match=rf"RewardParams\.{name} must be"):
        RewardParams(**{name: bad})


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


def test_own_task_has_one_term_or_those_of_its_base():
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

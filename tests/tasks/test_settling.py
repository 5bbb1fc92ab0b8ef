"""Rewards and endings of a task in results and records, against a plain reference."""

import numpy as np
import pytest

import quad_gym
from quad_gym.records import Ending
from tests.builders import vec_env

FLIGHTS, STEPS, LIMIT = 13, 60, 40


class RandomAnswers:
    """Random return values of a task for every step."""

    def __init__(self, methods):
        self.rng, self.methods = np.random.default_rng(7), methods

    def draw(self):
        rng = self.rng
        self.reward = rng.normal(size=FLIGHTS)
        self.terminated, self.truncated = (rng.random(FLIGHTS) < p for p in (0.02, 0.05))

    def task(self):
        answers = {name: lambda view, name=name: getattr(self, name) for name in self.methods}
        return quad_gym.Task.of(**answers)


def expected_endings(random_answers, plain):
    """Return terminated, truncated and ending by the rules, from built-in results."""
    crashed = plain.result("terminated") > 0.0
    late, failed = plain.result("episode_steps") >= LIMIT, plain.result("filter_status") > 0.0
    terminated = random_answers.terminated if "terminated" in random_answers.methods else crashed
    truncated = random_answers.truncated if "truncated" in random_answers.methods else late | failed
    why, cut = np.where(terminated | truncated, float(Ending.TASK), 0.0), truncated & ~terminated
    why[cut & late] = Ending.TIME_LIMIT
    why[cut & failed] = Ending.FILTER_FAILED
    why = np.where(terminated & crashed, plain.result("ending"), why)
    return terminated, truncated, why


@pytest.mark.parametrize(
    "methods",
    [("reward",), ("terminated",), ("truncated", "reward"), ("reward", "terminated", "truncated")],
)
@pytest.mark.parametrize("per", ["step", "second"])
def test_results_and_records_have_rewards_and_endings_of_task(methods, per):
    random_answers = RandomAnswers(methods)
    keywords = {"autoreset_mode": "Disabled", "max_episode_steps": LIMIT, "max_tilt": 0.5}
    keywords["reward_per"] = per
    own, plain = (
        vec_env(count=FLIGHTS, seed=5, task=task, **keywords).flights.batch
        for task in (random_answers.task(), None)
    )
    rng, returns, endings = np.random.default_rng(2), np.zeros(FLIGHTS), set()
    for _ in range(STEPS):
        actions = rng.uniform(-0.6, 0.7, (FLIGHTS, 4))
        random_answers.draw()
        own.step(actions)
        plain.step(actions)
        terminated, truncated, why = expected_endings(random_answers, plain)
        reward = plain.result("reward")
        if "reward" in methods:
            reward = random_answers.reward * (0.02 if per == "second" else 1.0)
        returns = returns + reward
        for name, values in {
            "terminated": terminated,
            "truncated": truncated,
            "ending": why,
            "reward": reward,
            "episode_return": returns,
        }.items():
            np.testing.assert_array_equal(own.result(name), values, name)
            np.testing.assert_array_equal(own.record(name), values, name)
        endings |= set(why.astype(int))
    assert len(endings) >= 3, "too few kinds of endings occurred"


def test_returns_after_a_restore_continue():
    random_answers = RandomAnswers(("reward",))
    batch = vec_env(count=FLIGHTS, task=random_answers.task()).flights.batch
    batch.reset(seeds=range(FLIGHTS))
    actions = np.full((FLIGHTS, 4), 0.05)
    random_answers.draw()
    batch.step(actions)
    instant, returns = batch.snapshot(), batch.record("episode_return")
    batch.step(actions)
    batch.restore(instant)
    batch.step(actions)
    np.testing.assert_array_equal(batch.record("episode_return"), returns + random_answers.reward)
    mask = np.arange(FLIGHTS) < 4
    batch.reset(mask=mask)
    batch.step(actions)
    np.testing.assert_array_equal(batch.record("episode_return")[mask], random_answers.reward[mask])

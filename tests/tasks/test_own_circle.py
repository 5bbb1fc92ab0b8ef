"""The reward, endings and observation of the circle as a task: bitwise equal episodes."""

import numpy as np
import pytest

from quad_gym.experiments.benchmark.own_task import OwnCircle
from tests.builders import actions_for, vec_env

STEPS, FLIGHTS = 120, 5


def fly(mode, task):
    made = {"task": task, "autoreset_mode": mode, "randomize_reference": True}
    env = vec_env("circle", FLIGHTS, **made)
    observations, _ = env.reset(seed=3)
    rows, rewards = [observations], []
    for action in actions_for(range(FLIGHTS), STEPS):
        observations, reward, terminated, truncated, infos = env.step(action)
        rows += [observations, terminated, truncated, infos["ending"]]
        rewards.append(reward)
    records = {name: env.flights.batch.record(name) for name in "rvqwL"}
    return rows, np.array(rewards), records


@pytest.mark.parametrize("mode", ["NextStep", "SameStep"])
def test_own_circle_flies_the_same_episodes(mode):
    shipped, own = (fly(mode, task) for task in (None, OwnCircle()))
    for one, other in zip(shipped[0], own[0], strict=True):
        assert np.array_equal(one, other)
    assert sum(np.sum(terminated) for terminated in shipped[0][2::4]) > 0, "no episode ended"
    # sums of a different order differ in the last bits
    np.testing.assert_allclose(own[1], shipped[1], rtol=1e-12, atol=1e-14)
    for name, values in shipped[2].items():
        assert np.array_equal(values, own[2][name]), name

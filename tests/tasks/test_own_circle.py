"""The circle's reward, endings and observation written anew: the same episodes, bit for bit."""

import numpy as np
import pytest

from quad_gym.envs.vector import QuadVectorEnv
from quad_gym.experiments.benchmark.own_task import OwnCircle
from tests.contract.comparing import actions_of

STEPS, FLIGHTS = 120, 5


def fly(mode, own, randomize):
    env = QuadVectorEnv(
        FLIGHTS, base="circle", autoreset_mode=mode, randomize_reference=randomize, **own
    )
    actions = np.stack([actions_of(flight, STEPS) for flight in range(FLIGHTS)], axis=1)
    observations, _ = env.reset(seed=3)
    rows, rewards = [observations], []
    for action in actions:
        observations, reward, terminated, truncated, infos = env.step(action)
        rows += [observations, terminated, truncated, infos["ending"]]
        rewards.append(reward)
    return (
        rows,
        np.array(rewards),
        {name: env.unwrapped.flights.batch.record(name) for name in "rvqwL"},
    )


@pytest.mark.parametrize("mode", ["NextStep", "SameStep"])
def test_a_circle_of_ones_own_flies_the_same_episodes(mode):
    shipped, own = (fly(mode, own, True) for own in ({}, {"task": OwnCircle()}))
    for one, other in zip(shipped[0], own[0], strict=True):
        assert np.array_equal(one, other)
    assert sum(np.sum(terminated) for terminated in shipped[0][2::4]) > 0, "no episode ended"
    # sums of a different order differ in the last bits
    np.testing.assert_allclose(own[1], shipped[1], rtol=1e-12, atol=1e-14)
    for name, values in shipped[2].items():
        assert np.array_equal(values, own[2][name]), name

"""Tasks without changes fly as the built-in task, in all modes; resets and snapshots."""

import gymnasium
import numpy as np
import pytest

import quad_gym
from quad_gym.envs.config import BENCHMARKS
from scripts.benchmarks.own_task import OwnCircle
from tests.builders import SHORT, actions_for, vec_env
from tests.contract.comparing import assert_same
from tests.contract.configurations import CONFIGURATIONS
from tests.tasks.tasks import Chase, Same

MODES = ("NextStep", "SameStep", "Disabled")


class Empty(quad_gym.Task):
    """Task without methods."""


class Repeated(Same):
    """Task that observes the built-in observation."""

    replaces_observation = True

    def observe(self, view):
        return {"repeated": view.observation}


def fields_of(env):
    batch = env.flights.batch
    names = set(batch._blocks.dtype.names) - {"idle", "configuration"}
    return {name: batch.record(name) for name in sorted(names)}


def fly(env, seeds):
    """Return all results of a vector environment, and all fields in every sixth step."""
    rows, over = [env.reset(seed=list(seeds))], np.zeros(env.num_envs, bool)
    for k, action in enumerate(actions_for(range(env.num_envs))):
        if env.autoreset_mode.value == "Disabled" and over.any():
            rows.append(env.reset(options={"reset_mask": over}))
        rows.append(env.step(action))
        over = rows[-1][2] | rows[-1][3]
        if k % 6 == 2:
            rows.append(fields_of(env))
    return rows


WITHOUT_TASK = {
    name: (base, keywords)
    for name, (base, keywords) in CONFIGURATIONS.items()
    if base not in BENCHMARKS and "task" not in keywords
}
WITHOUT_TASK["per second"] = ("circle", {"reward_per": "second", "privileged": True})


@pytest.mark.parametrize(
    ("name", "mode"), [(name, MODES[k % 3]) for k, name in enumerate(WITHOUT_TASK)]
)
def test_task_equal_to_builtin_task_gives_same_flights(name, mode):
    base, keywords = WITHOUT_TASK[name]
    made = {"autoreset_mode": mode, **SHORT, **keywords}
    plain = fly(vec_env(base, 5, **made), range(5))
    repeats = () if "observation" in keywords else (Repeated(),)
    for own in (Empty(), *(() if name == "per second" else (Same(), *repeats))):
        env = vec_env(base, 5, task=own, **made)
        assert_same(fly(env, range(5)), plain, type(own).__name__)


def test_snapshot_of_another_task_is_refused():
    own = vec_env(count=3, seed=4, task=Chase()).flights.batch
    with pytest.raises(ValueError, match="snapshot must be one of a batch with Chase"):
        own.restore(vec_env(count=3).flights.batch.snapshot())


def test_options_of_reset_precede_the_start_of_the_task():
    env = gymnasium.make_vec("QuadGym/Hover-v0", num_envs=3, task=Chase())
    env.reset(seed=1, options={"position": np.array([4.0, 0.0, 1.0])})
    batch = env.unwrapped.flights.batch
    np.testing.assert_array_equal(batch.record("r"), np.tile([4.0, 0.0, 1.0], (3, 1)))
    reference = gymnasium.make_vec("QuadGym/Hover-v0", num_envs=3, task=Chase())
    reference.reset(seed=1)
    np.testing.assert_array_equal(
        batch.record("q"), reference.unwrapped.flights.batch.record("q"), strict=True
    )


def test_masked_reset_keeps_the_state_of_other_flights():
    env = vec_env(count=4, seed=1, autoreset_mode="Disabled", task=Chase())
    state, mask = env.flights.batch.view.state, np.array([True, False, True, False])
    before = state.rows()
    env.reset(options={"reset_mask": mask})
    for name in ("target", "velocity"):
        changed = (getattr(state, name) != before[name]).any(axis=1)
        np.testing.assert_array_equal(changed, mask)


STEPS, FIVE = 120, 5


def episodes(mode, task):
    made = {"task": task, "autoreset_mode": mode, "randomize_reference": True}
    env = vec_env("circle", FIVE, **made)
    observations, _ = env.reset(seed=3)
    rows, rewards = [observations], []
    for action in actions_for(range(FIVE), STEPS):
        observations, reward, terminated, truncated, infos = env.step(action)
        rows += [observations, terminated, truncated, infos["ending"]]
        rewards.append(reward)
    records = {name: env.flights.batch.record(name) for name in "rvqwL"}
    return rows, np.array(rewards), records


@pytest.mark.parametrize("mode", ["NextStep", "SameStep"])
def test_own_circle_flies_the_same_episodes(mode):
    shipped, own = (episodes(mode, task) for task in (None, OwnCircle()))
    for one, other in zip(shipped[0], own[0], strict=True):
        assert np.array_equal(one, other)
    assert sum(np.sum(terminated) for terminated in shipped[0][2::4]) > 0, "no episode ended"
    # sums of a different order differ in the last bits
    np.testing.assert_allclose(own[1], shipped[1], rtol=1e-12, atol=1e-14)
    for name, values in shipped[2].items():
        assert np.array_equal(values, own[2][name]), name

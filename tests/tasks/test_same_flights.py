"""Equal flights of a task in all interfaces and modes, and of the built-in task without changes."""

import gymnasium
import numpy as np
import pytest

import quad_gym
from quad_gym.envs.configuration import TASK_DEFAULTS
from quad_gym.records import Ending
from tests.builders import SHORT, actions_for, vec_env
from tests.contract.comparing import assert_same
from tests.tasks.tasks import Chase, Same

FLIGHTS = 11
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
    """Everything that a vector environment returns, and often all that its flights are."""
    rows, over = [env.reset(seed=list(seeds))], np.zeros(env.num_envs, bool)
    for k, action in enumerate(actions_for(range(env.num_envs))):
        if env.autoreset_mode.value == "Disabled" and over.any():
            rows.append(env.reset(options={"reset_mask": over}))
        rows.append(env.step(action))
        over = rows[-1][2] | rows[-1][3]
        if k % 6 == 2:
            rows.append(fields_of(env))
    return rows


@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize("task", TASK_DEFAULTS)
def test_task_without_changes_changes_no_flight(task, mode):
    made = {"autoreset_mode": mode, **SHORT}
    plain = fly(vec_env(task, FLIGHTS, **made), range(FLIGHTS))
    for own in (Empty(), Same(), Repeated()):
        env = vec_env(task, FLIGHTS, task=own, **made)
        assert_same(fly(env, range(FLIGHTS)), plain, type(own).__name__)


@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize(
    "keywords",
    [
        {"observation": "noisy", "start": "mixed"},
        {"sensors": "rtk", "innovations": True, "truncate_when_diverged": True},
        {"observation": "measurements", "privileged": True, "reward_per": "second"},
        {"sensors": "consumer", "randomization": {"mass": quad_gym.Uniform(0.5, 1.0)}},
        {"faults": "rotor_loss", "include_std": True, "filter_start": "warm"},
    ],
    ids=lambda keywords: "+".join(keywords),
)
def test_task_without_changes_with_options_changes_no_flight(keywords, mode):
    made = {"autoreset_mode": mode, **SHORT, **keywords}
    plain = fly(vec_env("circle", **made), range(5))
    for own in (Empty(), None if "reward_per" in keywords else Same()):
        assert_same(fly(vec_env("circle", task=own, **made), range(5)), plain)


def test_endings_have_their_reasons():
    env = vec_env(count=FLIGHTS, seed=0, task=Chase(), max_episode_steps=100, max_tilt=np.pi)
    found = set()
    for action in actions_for(range(FLIGHTS)):
        *_, terminated, truncated, info = env.step(action)
        assert ((info["ending"] != Ending.NONE) == (terminated | truncated)).all()
        assert (info["ending"][truncated] == Ending.TIME_LIMIT).all()
        found |= set(info["ending"][terminated])
    assert Ending.TASK in found


def test_restored_snapshot_restores_the_state_of_the_task():
    env = vec_env(count=3, seed=4, task=Chase(), **SHORT)
    batch = env.flights.batch
    for action in actions_for(range(3))[:12]:
        env.step(action)
    instant = batch.snapshot()
    after = [env.step(action) for action in actions_for(range(3))[12:18]]
    batch.restore(instant)
    assert batch.snapshot().tobytes() == instant.tobytes()
    env._over[:] = False
    assert_same([env.step(action) for action in actions_for(range(3))[12:18]], after)
    with pytest.raises(ValueError, match="snapshot must be one of a batch with Chase"):
        batch.restore(vec_env(count=3).flights.batch.snapshot())


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
    before = state.copies()
    env.reset(options={"reset_mask": mask})
    for name in ("target", "velocity"):
        changed = (getattr(state, name) != before[name]).any(axis=1)
        np.testing.assert_array_equal(changed, mask)

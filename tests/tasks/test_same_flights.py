"""A task flies the same in every interface and mode; one that changes nothing, as what ships."""

import copy
import pickle

import gymnasium
import numpy as np
import pytest

import quad_gym
from quad_gym.envs.configuration import TASK_DEFAULTS
from quad_gym.envs.sb3 import QuadSB3VecEnv
from quad_gym.envs.single import QuadEnv
from quad_gym.envs.vector import QuadVectorEnv
from tests.contract.comparing import actions_of, assert_same
from tests.tasks.chase import Chase

STEPS, FLIGHTS = 45, 11
SHORT = {"max_episode_steps": 20, "max_tilt": 0.6}
MODES = ("NextStep", "SameStep", "Disabled")


class Empty(quad_gym.Task):
    """Leaves everything out."""


class Shipped(quad_gym.Task):
    """Says what ships, method by method."""

    def reward(self, view):
        return view.builtin.reward

    def terminated(self, view):
        return super().terminated(view)

    def truncated(self, view):
        return view.builtin.truncated


class Repeated(Shipped):
    """Observes what ships, as its own."""

    replaces_observation = True

    def observe(self, view):
        return {"repeated": view.observation}


def actions(flights=FLIGHTS):
    return np.stack([actions_of(flight, STEPS) for flight in range(flights)], axis=1)


def fields_of(env):
    batch = env.flights.batch
    names = set(batch._blocks.dtype.names) - {"idle", "configuration"}
    return {name: batch.record(name) for name in sorted(names)}


def fly(env, seeds):
    """Everything that a vector environment returns, and often all that its flights are."""
    rows, over = [env.reset(seed=list(seeds))], np.zeros(env.num_envs, bool)
    for k, action in enumerate(actions(env.num_envs)):
        if env.autoreset_mode.value == "Disabled" and over.any():
            rows.append(env.reset(options={"reset_mask": over}))
        rows.append(env.step(action))
        over = rows[-1][2] | rows[-1][3]
        if k % 6 == 2:
            rows.append(fields_of(env))
    return rows


@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize("task", TASK_DEFAULTS)
def test_a_task_that_changes_nothing_flies_what_ships(task, mode):
    plain = fly(QuadVectorEnv(FLIGHTS, task, autoreset_mode=mode, **SHORT), range(FLIGHTS))
    for own in (Empty(), Shipped(), Repeated()):
        env = QuadVectorEnv(FLIGHTS, base=task, autoreset_mode=mode, task=own, **SHORT)
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
def test_a_task_that_changes_nothing_flies_what_ships_with_options(keywords, mode):
    made = {"base": "circle", "autoreset_mode": mode, **SHORT, **keywords}
    plain = fly(QuadVectorEnv(5, **made), range(5))
    for own in (Empty(), None if "reward_per" in keywords else Shipped()):
        assert_same(fly(QuadVectorEnv(5, task=own, **made), range(5)), plain)


def columns(rows):
    return tuple(np.array(column) for column in zip(*rows, strict=True))


def fly_single(flight, *, wait):
    env = QuadEnv(base="hover", task=Chase(), **SHORT)
    rows, over = [(env.reset(seed=flight)[0], 0.0, False, False)], False
    for action in actions_of(flight, STEPS):
        if over:
            rows.append((env.reset()[0], 0.0, False, False))
            over = False
            continue
        observation, reward, terminated, truncated, _ = env.step(action)
        over = terminated or truncated
        if over and not wait:
            observation, over = env.reset()[0], False
        rows.append((observation, reward, terminated, truncated))
    return columns(rows)


def fly_vector(mode, threads=1, flights=FLIGHTS):
    env = QuadVectorEnv(
        flights, base="hover", autoreset_mode=mode, threads=threads, task=Chase, **SHORT
    )
    nothing = np.zeros(flights, bool)
    rows = [(env.reset(seed=0)[0], np.zeros(flights), nothing, nothing)]
    rows += [env.step(action)[:4] for action in actions(flights)]
    return columns(rows)


@pytest.mark.parametrize("mode", ["NextStep", "SameStep"])
def test_a_flight_in_a_batch_is_the_flight_alone(mode):
    together = fly_vector(mode)
    assert (together[2] | together[3]).sum() >= 2 * FLIGHTS
    assert together[2].any()
    assert together[3].any()
    for flight in range(FLIGHTS):
        alone = fly_single(flight, wait=mode == "NextStep")
        assert_same(tuple(column[:, flight].copy() for column in together), alone, f"{flight}")


def test_neither_the_size_of_the_batch_nor_threads_change_a_flight():
    few, many = fly_vector("SameStep"), fly_vector("SameStep", threads=2, flights=100)
    assert_same(tuple(column[:, :FLIGHTS].copy() for column in many), few)


def test_stable_baselines_flies_the_same():
    env = QuadSB3VecEnv(FLIGHTS, base="hover", task=Chase(), **SHORT)
    env.seed(0)
    vector = QuadVectorEnv(FLIGHTS, base="hover", autoreset_mode="SameStep", task=Chase(), **SHORT)
    np.testing.assert_array_equal(env.reset(), vector.reset(seed=0)[0])
    returns = np.zeros(FLIGHTS)
    for action in actions():
        observations, rewards, dones, infos = env.step(action)
        theirs, their_rewards, terminated, truncated, info = vector.step(action)
        np.testing.assert_array_equal(observations, theirs)
        np.testing.assert_array_equal(rewards, their_rewards.astype(np.float32))
        np.testing.assert_array_equal(dones, terminated | truncated)
        returns += their_rewards
        for i in np.flatnonzero(dones):
            np.testing.assert_array_equal(infos[i]["terminal_observation"], info["final_obs"][i])
            assert infos[i]["ending"] == info["final_info"]["ending"][i]
            assert infos[i]["TimeLimit.truncated"] == (truncated[i] and not terminated[i])
            assert infos[i]["episode"]["r"] == pytest.approx(returns[i], rel=1e-12)
            returns[i] = 0.0


def test_the_endings_say_why():
    env = QuadVectorEnv(
        FLIGHTS, base="hover", task=Chase(), **SHORT | {"max_episode_steps": 100, "max_tilt": np.pi}
    )
    env.reset(seed=0)
    found = set()
    for action in actions():
        *_, terminated, truncated, info = env.step(action)
        assert ((info["ending"] != "none") == (terminated | truncated)).all()
        assert (info["ending"][truncated] == "time_limit").all()
        found |= set(info["ending"][terminated])
    assert "task" in found


@pytest.mark.parametrize("copied", [copy.deepcopy, lambda env: pickle.loads(pickle.dumps(env))])
@pytest.mark.parametrize(
    "count", [3, 256]
)  # NumPy unpickles small arrays and large ones differently
def test_a_copy_flies_on_as_the_original(count, copied):
    env = QuadVectorEnv(count, base="hover", task=Chase(), **SHORT)
    env.reset(seed=4)
    for action in actions(count)[:15]:
        env.step(action)
    other = copied(env)
    for action in actions(count)[15:]:
        assert_same(env.step(action), other.step(action))


def test_a_snapshot_brings_back_what_the_task_keeps():
    env = QuadVectorEnv(3, base="hover", task=Chase(), **SHORT)
    env.reset(seed=4)
    batch = env.flights.batch
    for action in actions(3)[:12]:
        env.step(action)
    instant = batch.snapshot()
    after = [env.step(action) for action in actions(3)[12:18]]
    batch.restore(instant)
    assert batch.snapshot().tobytes() == instant.tobytes()
    env._over[:] = False
    assert_same([env.step(action) for action in actions(3)[12:18]], after)
    with pytest.raises(ValueError, match="snapshot must be one of a batch with Chase"):
        batch.restore(QuadVectorEnv(3, "hover").flights.batch.snapshot())


def test_options_of_a_reset_come_before_the_start_of_the_task():
    env = gymnasium.make_vec("QuadGym/Hover-v0", num_envs=3, task=Chase())
    env.reset(seed=1, options={"position": np.array([4.0, 0.0, 1.0])})
    batch = env.unwrapped.flights.batch
    np.testing.assert_array_equal(batch.record("r"), np.tile([4.0, 0.0, 1.0], (3, 1)))
    reference = gymnasium.make_vec("QuadGym/Hover-v0", num_envs=3, task=Chase())
    reference.reset(seed=1)
    np.testing.assert_array_equal(
        batch.record("q"), reference.unwrapped.flights.batch.record("q"), strict=True
    )


def test_a_reset_of_some_leaves_what_the_task_keeps_of_the_others():
    env = QuadVectorEnv(4, base="hover", autoreset_mode="Disabled", task=Chase())
    env.reset(seed=1)
    state, mask = env.flights.batch.view.state, np.array([True, False, True, False])
    before = state.copies()
    env.reset(options={"reset_mask": mask})
    for name in ("target", "velocity"):
        changed = (getattr(state, name) != before[name]).any(axis=1)
        np.testing.assert_array_equal(changed, mask)

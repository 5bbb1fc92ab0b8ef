"""The vector environment follows Gymnasium's rules and equals its SyncVectorEnv bitwise."""

import gymnasium
import numpy as np
import pytest
from gymnasium.vector import AutoresetMode, SyncVectorEnv

import quad_gym
from quad_gym.envs.single import QuadEnv
from quad_gym.envs.vector import QuadVectorEnv
from tests.builders import SHORT, STEPS, actions_for, actions_of, vec_env
from tests.contract.comparing import assert_same, assert_same_results, state_of
from tests.contract.configurations import CONFIGURATIONS

MODES = ("NextStep", "SameStep", "Disabled")


def both(name, count, mode):
    """Return our vector environment and Gymnasium's SyncVectorEnv of a configuration."""
    base, keywords = CONFIGURATIONS[name]
    keywords = {**SHORT, "base": base, **keywords}
    envs = [lambda: QuadEnv(**keywords)] * count
    ours = QuadVectorEnv(count, autoreset_mode=mode, threads=2, **keywords)
    return ours, SyncVectorEnv(envs, autoreset_mode=AutoresetMode(mode))


def fly_both(ours, theirs, steps, seed):
    """Step and compare both; return the numbers of terminated and truncated episodes."""
    actions = actions_for(range(ours.num_envs), steps)
    assert_same_results(ours.reset(seed=seed), theirs.reset(seed=seed), "start")
    ended = np.zeros(2, int)
    for k in range(steps):
        mine, other = ours.step(actions[k]), theirs.step(actions[k])
        assert_same_results(mine, other, f"step {k}")
        ended += mine[2].sum(), mine[3].sum()
        over = mine[2] | mine[3]
        if ours.metadata["autoreset_mode"] == AutoresetMode.DISABLED and over.any():
            chosen = {"reset_mask": over}
            assert_same_results(
                ours.reset(options={**chosen}), theirs.reset(options={**chosen}), f"reset {k}"
            )
    return ended


IN_ALL_MODES = ("circle", "noisy", "faults", "own task")
ROTATED = [
    (name, mode)
    for k, name in enumerate(CONFIGURATIONS)
    for i, mode in enumerate(MODES)
    if name in IN_ALL_MODES or i == k % 3
]
"""Each configuration in one mode, and some in all."""


@pytest.mark.parametrize(("name", "mode"), ROTATED)
def test_vector_env_equals_sync_vector_env_of_gymnasium(name, mode):
    terminated, truncated = fly_both(*both(name, 6, mode), steps=STEPS, seed=5)
    assert terminated + truncated > 6


@pytest.mark.parametrize("name", CONFIGURATIONS)
def test_results_are_in_spaces_and_have_stated_types(name):
    base, keywords = CONFIGURATIONS[name]
    env = QuadVectorEnv(6, base=base, **keywords)
    single = QuadEnv(base=base, **keywords)
    assert env.single_observation_space == single.observation_space
    assert env.single_action_space == single.action_space
    assert env.action_space.shape == (6, 4)
    observation, _ = env.reset(seed=1)
    assert observation in env.observation_space
    observation, reward, terminated, truncated, info = env.step(env.action_space.sample())
    assert observation in env.observation_space
    assert (reward.dtype, reward.shape) == (np.float64, (6,))
    assert terminated.dtype == truncated.dtype == np.bool_
    for entry in ("position_error", "estimation_error", "ending", "filter_status", "gates_passed"):
        assert info[entry].shape == (6,)
        assert info[f"_{entry}"].all()


def arrays_in(value):
    if isinstance(value, dict):
        return [array for part in value.values() for array in arrays_in(part)]
    if isinstance(value, (tuple, list)):
        return [array for part in value for array in arrays_in(part)]
    if isinstance(value, np.ndarray) and value.dtype == object:
        return [value, *(array for part in value for array in arrays_in(part))]
    return [value] if isinstance(value, np.ndarray) else []


@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize("privileged", [False, True])
def test_every_call_returns_fresh_arrays(mode, privileged):
    env = QuadVectorEnv(5, "hover", autoreset_mode=mode, privileged=privileged, max_episode_steps=4)
    returned = arrays_in(env.reset(seed=2))
    for _ in range(3):
        returned += arrays_in(env.step(np.zeros((5, 4))))
    returned += arrays_in(env.step(np.zeros((5, 4))))
    returned += arrays_in(env.reset(seed=2))
    for k, array in enumerate(returned):
        assert not any(np.shares_memory(array, other) for other in returned[:k])


def test_changes_to_returned_arrays_do_not_reach_flights():
    env, twin = (QuadVectorEnv(9, "circle", max_episode_steps=6) for _ in range(2))
    env.reset(seed=8)
    twin.reset(seed=8)
    actions = np.stack([actions_of(i, 20) for i in range(9)], axis=1)
    for k in range(20):
        given = actions[k].copy()
        corrupt = env.step(given)
        assert_same(corrupt, twin.step(actions[k]))
        assert_same(given, actions[k])
        for array in arrays_in(corrupt):
            array[...] = None if array.dtype == object else 1


def test_flight_with_seed_none_continues_its_random_stream():
    env, goes_on = (QuadVectorEnv(3, "hover") for _ in range(2))
    env.reset(seed=6)
    goes_on.reset(seed=6)
    mixed, _ = env.reset(seed=[100, None, 101])
    onward, _ = goes_on.reset()
    fresh, _ = QuadVectorEnv(3, "hover").reset(seed=[100, 0, 101])
    assert_same(mixed[1], onward[1])
    assert_same(mixed[::2].copy(), fresh[::2].copy())
    assert (onward != env.reset()[0]).any()


def test_flights_without_a_seed_differ():
    first, second = (QuadVectorEnv(4, "hover").reset()[0] for _ in range(2))
    assert len({row.tobytes() for row in np.concatenate([first, second])}) == 8


@pytest.mark.parametrize("seed", [[1, 2], [1, 2, 3, 4], "abcd"])
def test_seeds_that_do_not_fit_are_refused(seed):
    with pytest.raises(ValueError, match=r"seed|int"):
        QuadVectorEnv(3, "hover").reset(seed=seed)


@pytest.mark.parametrize(
    ("mask", "error"),
    [
        ([True, False, True], TypeError),
        (np.array([1, 0, 1]), TypeError),
        (np.array([True, False]), ValueError),
        (np.array([[True, False, True]]), ValueError),
        (np.zeros(3, bool), ValueError),
        (np.array([1.0, 0.0, 1.0]), TypeError),
    ],
)
def test_a_reset_mask_that_is_invalid_changes_nothing(mask, error):
    env = vec_env(count=3, seed=1, autoreset_mode="Disabled")
    before = state_of(env)
    with pytest.raises(error, match="reset_mask"):
        env.reset(seed=9, options={"reset_mask": mask})
    assert state_of(env) == before


@pytest.mark.parametrize("mode", MODES)
def test_a_reset_mask_touches_no_other_flight(mode):
    env, twin = (QuadVectorEnv(12, "circle", autoreset_mode=mode) for _ in range(2))
    mask = np.arange(12) % 3 == 1
    for each in (env, twin):
        each.reset(seed=3)
        each.step(np.full((12, 4), 0.1))
    observation, info = env.reset(options={"reset_mask": mask})
    np.testing.assert_array_equal(info["_position_error"], mask)
    mine, other = env.step(np.full((12, 4), 0.2)), twin.step(np.full((12, 4), 0.2))
    np.testing.assert_array_equal(mine[0][~mask], other[0][~mask])
    assert (mine[0][mask] != other[0][mask]).any(axis=1).all()
    assert (observation[mask] != other[0][mask]).any(axis=1).all()


def test_finished_episode_with_autoreset_disabled_needs_a_reset():
    env = vec_env(count=4, seed=0, autoreset_mode="Disabled", max_episode_steps=2)
    env.step(np.zeros((4, 4)))
    *_, truncated, _ = env.step(np.zeros((4, 4)))
    assert truncated.all()
    before = state_of(env)
    with pytest.raises(gymnasium.error.ResetNeeded):
        env.step(np.zeros((4, 4)))
    mask = np.array([True, True, False, True])
    env.reset(options={"reset_mask": mask})
    with pytest.raises(gymnasium.error.ResetNeeded, match="2"):
        env.step(np.zeros((4, 4)))
    assert state_of(env) != before
    options = {"reset_mask": ~mask, "yaw": 0.3}
    env.reset(options=options)
    assert set(options) == {"reset_mask", "yaw"}
    env.step(np.zeros((4, 4)))
    env.close()
    env.close()
    with pytest.raises(gymnasium.error.ResetNeeded):
        QuadVectorEnv(2, "hover").step(np.zeros((2, 4)))


@pytest.mark.parametrize("count", [0, 1.5, "two", None, True, 10**8])
def test_invalid_number_of_environments_is_refused(count):
    for make in (gymnasium.make_vec, quad_gym.make_sb3_vec_env):
        with pytest.raises(ValueError, match=r"^num_envs must be"):
            make("QuadGym/Hover-v0", count)

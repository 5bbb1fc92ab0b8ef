"""Variants of `LookAround` that arms of a study learn in, recomputed from the flights."""

import gymnasium
import numpy as np
import pytest

ID = "QuadGym/LookAround-v0"


def make(name, count=6, **keywords):
    custom = f"baselines.arm_tasks:{name}"
    env = gymnasium.make_vec(
        ID, num_envs=count, autoreset_mode="Disabled", custom=custom, **keywords
    )
    observations, _ = env.reset(seed=3)
    return env, observations


def part(env, observations, name):
    field = next(f for f in env.unwrapped.flights.table if f.name == name)
    return observations[:, field.slice]


def largest_sigma(env):
    L = env.unwrapped.flights.batch.read("L")
    return np.sqrt(np.diagonal(L @ L.transpose(0, 2, 1), axis1=1, axis2=2)[:, :3]).max(axis=1)


def test_doubt_is_the_logarithm_of_the_largest_standard_deviation_of_the_position():
    env, observations = make("Doubting")
    for _ in range(30):
        expected = np.log10(largest_sigma(env) / 0.03)
        found = part(env, observations, "log_sigma")[:, 0]
        np.testing.assert_allclose(found, expected, atol=1e-5)
        observations, *_ = env.step(np.zeros((6, 4), np.float32))


@pytest.mark.parametrize("observation", ["truth", "noisy"])
def test_a_controller_on_the_truth_has_no_doubt(observation):
    env, observations = make("Doubting", observation=observation)
    np.testing.assert_array_equal(part(env, observations, "log_sigma"), -1.0)


def test_memory_holds_every_tenth_observation_newest_first():
    env, observations = make("Remembering")
    names = ("position_error", "velocity_error", "up", "heading", "body_rates")
    seen = []
    np.testing.assert_array_equal(part(env, observations, "past"), 0.0)
    for step in range(1, 35):
        observations, *_ = env.step(np.full((6, 4), 0.01, np.float32))
        if step % 10 == 0:
            now = [part(env, observations, name) for name in (*names, "features_direction")]
            seen.insert(0, np.concatenate(now, axis=1))
        past = part(env, observations, "past").reshape(6, 4, 18)
        for k in range(4):
            expected = seen[k] if k < len(seen) else np.zeros((6, 18))
            np.testing.assert_allclose(past[:, k], expected, atol=1e-5)


def test_being_sure_is_paid_for():
    (plain, _), (paid, _) = make("Doubting"), make("Sure")
    for _ in range(40):
        actions = np.zeros((6, 4), np.float32)
        actions[:, 3] = 1.0  # turning, so that markers come and go
        reward, with_pay = plain.step(actions)[1], paid.step(actions)[1]
        expected = reward - 0.3 * np.minimum(largest_sigma(paid) / 0.5, 1.0)
        np.testing.assert_allclose(with_pay, expected, atol=1e-12)

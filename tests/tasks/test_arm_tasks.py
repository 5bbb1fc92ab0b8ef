"""Variants of tasks that arms of a study learn in, recomputed from the flights."""

import gymnasium
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from quad_gym.faults import GnssOutage

ID = "QuadGym/LookAround-v0"


def make(name, count=6, task=ID, **keywords):
    custom = f"baselines.arm_tasks:{name}"
    env = gymnasium.make_vec(
        task, num_envs=count, autoreset_mode="Disabled", custom=custom, **keywords
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


@pytest.mark.parametrize(("name", "told"), [("TOLD_HALF", 0.5), ("TOLD_FOURFOLD", 4.0)])
def test_a_controller_may_be_told_another_standard_deviation(name, told):
    (plain, a), (misled, b) = make("Doubting"), make(name)
    change = part(misled, b, "log_sigma") - part(plain, a, "log_sigma")
    np.testing.assert_allclose(change, np.log10(told), atol=1e-5)


def test_what_is_recalled_in_a_race_is_every_fifth_observation_newest_first():
    env, observations = make("RecallingRace", task="QuadGym/StaleRace-v0")
    names, seen = ("position_error", "velocity_error", "up", "body_rates"), []
    for step in range(1, 27):
        observations, *_ = env.step(np.full((6, 4), 0.01, np.float32))
        if step % 5 == 0:
            now = [part(env, observations, name) for name in names]
            seen.insert(0, np.concatenate(now, axis=1))
        past = part(env, observations, "past").reshape(6, 4, 12)
        for k in range(4):
            expected = seen[k] if k < len(seen) else np.zeros((6, 12))
            np.testing.assert_allclose(past[:, k], expected, atol=1e-5)


def test_a_race_seen_without_residuals_is_the_shipped_observation():
    (plain, a), (own, b) = (
        make(name, task="QuadGym/StaleRace-v0") for name in ("RecallingRace", "SeenRace")
    )
    for _ in range(20):
        for name in ("position_error", "velocity_error", "up", "heading", "body_rates"):
            np.testing.assert_allclose(part(own, b, name), part(plain, a, name), atol=1e-5)
        for name in ("preview_1", "preview_2", "last_action"):
            np.testing.assert_allclose(part(own, b, name), part(plain, a, name), atol=1e-5)
        action = np.full((6, 4), 0.05, np.float32)
        a, b = plain.step(action)[0], own.step(action)[0]


def test_residuals_of_a_race_are_what_the_model_draws():
    env, b = make("ResidualRace", task="QuadGym/StaleRace-v0", observation="truth")
    batch = env.unwrapped.flights.batch
    for _ in range(30):
        b, *_ = env.step(np.zeros((6, 4), np.float32))
        residual = batch.view.state.residual
        R = Rotation.from_rotvec(residual[:, 6:9].copy()).as_matrix() @ batch.view.R_BI
        gap = batch.view.reference_position - batch.read("r") - residual[:, :3]
        expected = (R @ gap[:, :, np.newaxis])[:, :, 0]
        np.testing.assert_allclose(part(env, b, "position_error"), expected, atol=1e-4)
    assert np.abs(residual).max() > 1e-3


def next_width(env):
    walls = env.unwrapped.flights.batch.read("obstacle_center")[:, :4, 1]
    return np.stack([walls[:, k] - walls[:, k + 1] - 30.0 for k in (0, 2)], axis=1)


def test_doubt_says_whether_two_standard_deviations_fit_through_the_gap():
    env, observations = make("Wary", task="QuadGym/OutageDash-v0")
    for _ in range(10):
        room = 0.5 * next_width(env) - 0.5
        expected = np.log2(2.0 * largest_sigma(env)[:, np.newaxis] / room)
        np.testing.assert_allclose(part(env, observations, "doubt"), expected, atol=1e-4)
        observations, *_ = env.step(np.zeros((6, 4), np.float32))
    env, observations = make("Wary", task="QuadGym/OutageDash-v0", observation="truth")
    np.testing.assert_array_equal(part(env, observations, "doubt"), -8.0)


def test_waiting_is_paid_for_standing_still_while_unsure():
    faults = [GnssOutage(start=0.0)]
    plain, waiting = (
        make(name, task="QuadGym/OutageDash-v0", faults=faults)[0] for name in ("Steady", "Waiting")
    )
    batch, cases = waiting.unwrapped.flights.batch, set()
    action = np.zeros((6, 4), np.float32)
    action[:, 0] = 0.05
    for _ in range(400):
        reward = plain.step(action)[1]
        observed, paid, *_ = waiting.step(action)
        if not plain.unwrapped.flights.batch.view.shipped.terminated.any():
            unsure = part(waiting, observed, "doubt")[:, 0] > 0.0
            v = batch.read("v")
            lost = 0.1 * (np.minimum(np.linalg.norm(v, axis=1), 5.0) + np.minimum(-v[:, 0], 5.0))
            np.testing.assert_allclose(paid, reward - np.where(unsure, lost, 0.0), atol=1e-9)
            cases |= set(unsure.tolist())
        else:
            break
    assert cases == {True, False}


def test_a_steady_crash_forfeits_nothing():
    plain, steady = (
        make(name, task="QuadGym/OutageDash-v0", observation="truth")[0]
        for name in ("Wary", "Steady")
    )
    action = np.full((6, 4), -0.5, np.float32)
    for _ in range(200):
        _, a, over, *_ = plain.step(action)
        b = steady.step(action)[1]
        earned = plain.unwrapped.flights.batch.view.state.earned
        np.testing.assert_allclose(b, a + np.where(over, earned, 0.0), atol=1e-9)
        if over.any():
            return
    raise AssertionError("nobody crashed")


def test_being_sure_is_paid_for():
    (plain, _), (paid, _) = make("Doubting"), make("Sure")
    for _ in range(40):
        actions = np.zeros((6, 4), np.float32)
        actions[:, 3] = 1.0  # turning, so that markers come and go
        reward, with_pay = plain.step(actions)[1], paid.step(actions)[1]
        expected = reward - 0.3 * np.minimum(largest_sigma(paid) / 0.5, 1.0)
        np.testing.assert_allclose(with_pay, expected, atol=1e-12)

"""`StaleRace`: recomputed reward, and the effect of late measurements."""

import gymnasium
import numpy as np

import quad_gym
from baselines import PDPolicy

ID = "QuadGym/StaleRace-v0"


def make(count=16, **keywords):
    return gymnasium.make_vec(ID, num_envs=count, **keywords)


def test_defaults_equal_documented_values():
    flights = make(1).unwrapped.flights
    assert flights.task.kind == "waypoints"
    assert (flights.task.gate_count, flights.task.gate_radius) == (8, 0.6)
    suite = flights.batch.sensors
    assert (suite.gnss.latency, suite.camera.latency) == (0.12, 0.01)
    assert suite.estimator.delay_compensation == "none"


def test_reward_equals_documented_equation():
    env, rng = make(observation="truth"), np.random.default_rng(1)
    observation, _ = env.reset(seed=0)
    policy, batch = PDPolicy(env), env.unwrapped.flights.batch
    gates, last = np.zeros(16), np.zeros((16, 4))
    target, before = batch.record("ref_center"), batch.record("r")
    began, passed_in_all = np.zeros(16, bool), 0
    for _ in range(300):
        actions = policy.predict(observation)[0] + rng.normal(0.0, 0.02, (16, 4))
        actions = np.clip(actions, -1.0, 1.0).astype(np.float32)
        observation, reward, terminated, truncated, info = env.step(actions)
        far, near = (np.linalg.norm(target - r, axis=1) for r in (before, batch.record("r")))
        passed = info["gates_passed"] > gates
        crashed = terminated & (info["gates_passed"] < 8)
        change = ((actions - last) ** 2).sum(axis=1)
        costs = 0.02 * change + 0.002 * (batch.record("w") ** 2).sum(axis=1)
        expected = 0.1 * (far - near) * 50.0 - costs + passed - 5.0 * crashed
        np.testing.assert_allclose(reward[~began], expected[~began], atol=1e-6)
        passed_in_all += passed[~began].sum()
        began, gates, last = terminated | truncated, info["gates_passed"], actions
        last = np.where(began[:, np.newaxis], batch.record("action"), last)
        target, before = batch.record("ref_center"), batch.record("r")
    assert passed_in_all > 20


def test_latency_compensation_reduces_estimation_errors():
    stale = quad_gym.sensor_suite("stale")
    told = stale.replace(estimator=stale.estimator.replace(delay_compensation="retrodict"))
    errors = {}
    for name, suite in (("stale", stale), ("told", told)):
        env = make(64, sensors=suite)
        observation, _ = env.reset(seed=3)
        policy, worst = PDPolicy(env), np.zeros(64)
        for _ in range(150):
            observation, _, _, _, info = env.step(policy.predict(observation)[0])
            worst = np.maximum(worst, info["estimation_error"])
        errors[name] = np.median(worst)
    assert errors["told"] < 0.05
    assert errors["stale"] > 3.0 * errors["told"]

"""PD control that plans with predicted covariances."""

import gymnasium
import numpy as np
import pytest

import quad_gym
from baselines.policies import load_policy
from quad_gym.evaluation import roll_out
from scripts.studies.planning import PlanningPolicy, _markers, _measured
from tests.builders import vec_env

LOOK, DASH = "QuadGym/LookAround-v0", "QuadGym/OutageDash-v0"


def make(env_id, count):
    return gymnasium.make_vec(env_id, num_envs=count, include_std=True)


def crash_rate(env_id, policy, count, **keywords):
    env = make(env_id, count)
    flown = PlanningPolicy(env) if policy == "planning" else load_policy(policy, env)
    return roll_out(flown, env, seed=0).crashed.mean()


def test_plan_that_looks_at_the_markers_crashes_less_than_tracking_of_the_heading():
    assert crash_rate(LOOK, "pd", 24) > 0.4
    assert crash_rate(LOOK, "planning", 24) < 0.15


@pytest.mark.slow
def test_plan_that_waits_crashes_less_than_flying_on():
    assert crash_rate(DASH, "planning", 60) < crash_rate(DASH, "pd", 60) - 0.1


def test_heading_is_the_rewarded_one_if_certain_and_toward_markers_if_uncertain():
    env = make(LOOK, 4)
    observation, _ = env.reset(seed=0)
    policy = PlanningPolicy(env)
    parts = {f.name: f.slice for f in env.unwrapped.flights.table}
    rows = np.array(observation, np.float64)
    for name in parts:
        if name.endswith("sigma"):
            rows[:, parts[name]] = 1e-6
    certain = policy._read(rows).heading
    np.testing.assert_allclose(certain, rows[:, parts["heading"]], atol=1e-6)
    rows[:, parts["position_sigma"]] = 2.0
    toward, up = rows[:, parts["features_direction"]], rows[:, parts["up"]]
    toward = toward - (toward * up).sum(axis=1, keepdims=True) * up
    toward /= np.linalg.norm(toward, axis=1, keepdims=True)
    cosine = (policy._read(rows).heading * toward).sum(axis=1)
    assert (cosine > np.cos(np.radians(50.0))).all()  # some markers are in view


def test_predicted_covariances_are_the_matrix_product():
    policy = PlanningPolicy(make(LOOK, 1))
    root = np.random.default_rng(0).normal(size=(3, 3))
    P, T, places = root @ root.T, 0.7, np.triu_indices(3)
    F = np.array([[1.0, T, T**2 / 2.0], [0.0, 1.0, T], [0.0, 0.0, 1.0]])
    b = np.array([T / 2.0, 1.0, 0.0])
    expected = F @ P @ F.T + policy._white * T * np.outer(b, b)
    np.testing.assert_allclose(policy._moved(P[places], T), expected[places], rtol=1e-12)
    updated = np.linalg.inv(np.linalg.inv(P) + np.diag([5.0 / 0.3, 0.0, 0.0]))
    np.testing.assert_allclose(_measured(P[places], 0.3, 5.0), updated[places], rtol=1e-9)


def test_marker_geometry_agrees_with_the_map():
    (angles, share), variance = _markers(quad_gym.sensor_suite("one_wall").camera)
    found = np.interp(np.radians([0.0, 9.0, 11.0, 38.0, 52.0, 180.0]), angles, share)
    np.testing.assert_allclose(found, [1.0, 1.0, 0.75, 0.25, 0.0, 0.0])  # 7.1 and 20.6 degrees
    assert 1e-3 < np.sqrt(variance) < 0.02


def test_environments_without_uncertainty_are_refused():
    with pytest.raises(ValueError, match="env must observe features_direction"):
        PlanningPolicy(vec_env(include_std=True, seed=0))
    with pytest.raises(ValueError, match=r"env must observe position_sigma"):
        PlanningPolicy(gymnasium.make_vec(DASH, num_envs=1))

"""`LookAround`: recomputed reward, observation and features in view, and results of policies."""

import gymnasium
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import quad_gym
from baselines import PDPolicy
from baselines.pd import UNCERTAIN
from baselines.policies import keywords_of_policy, load_policy
from quad_gym.commands.main import main
from quad_gym.experiments import fly
from quad_gym.tasks.look_around import LookAround
from scripts.studies.traces import ViewRecorder
from tests.builders import part, run_python

ID = "QuadGym/LookAround-v0"
WALL = np.array([(-8.0, y, z) for y in (-3.0, -1.0, 1.0, 3.0) for z in (0.8, 2.8)])


def make(count=20, **keywords):
    return gymnasium.make_vec(ID, num_envs=count, autoreset_mode="Disabled", **keywords)


def actions(rng, count):
    return np.clip(rng.normal(0.0, 0.15, (count, 4)), -1.0, 1.0).astype(np.float32)


@pytest.mark.parametrize(
    ("weight", "options"), [(0.15, {}), (0.3, {"sensors": "indoor"})], ids=["default", "others"]
)
def test_reward_equals_documented_equation(weight, options):
    task = {"task": LookAround(heading_weight=weight)} if options else {}
    env, rng = make(**options, **task), np.random.default_rng(0)
    env.reset(seed=0)
    batch, crashes = env.unwrapped.flights.batch, 0
    over = np.zeros(20, bool)
    for _ in range(200):
        _, reward, terminated, truncated, _ = env.step(actions(rng, 20) + 0.1)
        view = batch.view
        e = np.linalg.norm(batch.record("r") - view.reference_position, axis=1)
        w, x, y, z = batch.record("q").T
        forward = Rotation.from_quat(np.stack([x, y, z, w], axis=1)).apply([1.0, 0.0, 0.0])
        h = (forward * view.reference_heading).sum(axis=1)
        expected = 0.1 * np.exp(-e) + 0.1 * np.exp(-5.0 * e) + weight * h - 2.0 * terminated
        np.testing.assert_allclose(reward[~over], expected[~over], atol=1e-12)
        crashes += terminated.sum()
        over = terminated | truncated
        if over.any():
            env.reset(options={"reset_mask": over})
            over[:] = False
    assert crashes > 5  # the cost of a crash was compared, too


@pytest.mark.parametrize("observation", ["estimate", "truth", "noisy"])
def test_features_direction_is_computed_from_the_observed_state(observation):
    env, rng = make(observation=observation), np.random.default_rng(1)
    observed, _ = env.reset(seed=5)
    batch = env.unwrapped.flights.batch
    for _ in range(60):
        gap = WALL.mean(axis=0) - batch.record("r_seen")
        turned = Rotation.from_matrix(batch.record("R_seen")).apply(gap)
        expected = turned / np.linalg.norm(turned, axis=1, keepdims=True)
        np.testing.assert_allclose(part(env, observed, "features_direction"), expected, atol=1e-6)
        observed, *_ = env.step(actions(rng, 20))


def test_features_in_view_are_within_the_camera_angles():
    env, rng = make(60), np.random.default_rng(2)
    env.reset(seed=9)
    batch, camera = env.unwrapped.flights.batch, quad_gym.sensor_suite("one_wall").camera
    half = np.arctan(np.array([1920.0, 1080.0]) / camera.focal_length)
    seen = 0
    for _ in range(50):
        env.step(actions(rng, 60))
        w, x, y, z = batch.record("q").T
        body = Rotation.from_quat(np.stack([x, y, z, w], axis=1))  # body to inertial
        eye = batch.record("r") + body.apply(camera.position_B)
        for k, point in enumerate(WALL):
            ahead, left, up = body.inv().apply(point - eye).T  # the camera looks along body x
            azimuth, elevation = np.arctan2(left, ahead), np.arctan2(up, ahead)
            expected = (ahead > 0) & (np.abs(azimuth) < half[0]) & (np.abs(elevation) < half[1])
            np.testing.assert_array_equal(batch.view.truth.features_in_view[:, k], expected)
            seen += expected.sum()
    assert 0 < seen < 60 * 50 * 8


@pytest.fixture(scope="module")
def facing():
    """Flights of the rule that always looks at the features."""
    env = gymnasium.make_vec(ID, num_envs=60)
    return fly(PDPolicy(env, faces="features"), env, 0, ViewRecorder(["sigma"]))


def test_rule_that_never_looks_crashes_more_than_one_that_does(facing):
    env = gymnasium.make_vec(ID, num_envs=60)
    blind = fly(PDPolicy(env), env, 0, ViewRecorder(["sigma"]))
    # 64 % of 500 flights crash; at most 24 crashes in 60 flights have p < 1e-4
    assert blind.episodes.crashed.mean() > 0.4
    assert not facing.episodes.crashed.any()
    assert facing.recorded["in_view"].mean() > 0.9 > 0.7 > blind.recorded["in_view"].mean()
    assert facing.episodes.returns.mean() > blind.episodes.returns.mean()
    assert facing.episodes.mean_error.mean() < 0.1


def test_rule_that_looks_when_uncertain_earns_more(facing):
    env = gymnasium.make_vec(ID, num_envs=60, include_std=True)
    rule = fly(PDPolicy(env, faces="features_when_uncertain"), env, 0, ViewRecorder(["sigma"]))
    assert rule.episodes.returns.mean() > facing.episodes.returns.mean()
    assert UNCERTAIN < np.nanmax(rule.recorded["sigma"]) < 3.0
    assert rule.episodes.crashed.mean() < 0.1


def test_policy_without_features_in_its_observation_is_refused():
    circle = gymnasium.make("QuadGym/Circle-v0")
    with pytest.raises(ValueError, match='must observe features_direction for faces="features"'):
        PDPolicy(circle, faces="features")
    with pytest.raises(ValueError, match="include_std=True"):
        PDPolicy(make(1), faces="features_when_uncertain")
    with pytest.raises(ValueError, match="faces must be one of"):
        PDPolicy(circle, faces="north")


def test_other_weights_are_accepted_and_invalid_ones_refused():
    quad_gym.register_task("Test/LookMore-v0", LookAround(heading_weight=0.2), ID)
    flights = gymnasium.make_vec("Test/LookMore-v0", num_envs=2).unwrapped.flights
    assert (flights.name, flights.task.duration) == ("look_around", 15.0)
    for bad in (-1.0, np.nan, "much"):
        for name in ("heading_weight", "crash_cost"):
            with pytest.raises(ValueError, match=f"{name} must be"):
                LookAround(**{name: bad})


@pytest.mark.parametrize("keywords", [{"camera": False}, {"sensors": "consumer"}], ids=str)
def test_sensors_without_a_camera_are_refused(keywords):
    for make in (gymnasium.make, gymnasium.make_vec):
        with pytest.raises(ValueError, match="sensors must have a camera for LookAround"):
            make(ID, **keywords)


def test_tasks_are_not_imported_before_use():
    code = (
        "import sys, gymnasium, quad_gym; gymnasium.make('QuadGym/Circle-v0'); "
        "print([m for m in sys.modules if m.startswith('quad_gym.tasks') or 'baselines' in m])"
    )
    assert run_python("-c", code).stdout.strip() == "[]"


def test_pretrained_policy_earns_more_than_the_facing_rule(facing):
    shown = keywords_of_policy("pretrained", ID)
    env = gymnasium.make_vec(ID, num_envs=60, **shown)
    learned = fly(load_policy("pretrained", env), env, 0)
    assert learned.episodes.crashed.mean() < 0.1
    assert learned.episodes.returns.mean() > facing.episodes.returns.mean()
    assert learned.episodes.mean_error.mean() < 0.25


def test_pretrained_policy_flies_by_command(tmp_path, capsys):
    line = f"evaluate {ID} --policy pd pretrained --observation estimate --episodes 3 --output"
    assert main([*line.split(), str(tmp_path)]) == 0
    assert "sensors one_wall" in capsys.readouterr().out
    line = "fly look_around --policy pretrained --duration 0.5 --observation estimate --output"
    assert main([*line.split(), str(tmp_path / "flight.npz")]) == 0
    assert quad_gym.Flight.load(tmp_path / "flight.npz").scene.observation == "estimate"

"""Rewards, endings and starts of the tasks, recomputed in NumPy from the true state."""

import math

import numpy as np
import pytest

from baselines import PDPolicy
from quad_gym import RewardParams
from quad_gym.envs.single import QuadEnv
from quad_gym.envs.vector import QuadVectorEnv
from quad_gym.records import Ending
from tests.builders import actions_of, single_env, vec_env

SECONDS = 1 / 50
"""Control period [s]."""
UNBOUNDED = {"out_of_bounds": 50.0, "max_tilt": np.pi, "min_height": -50.0}


def body_axes(q):
    """Return R_BI (n, 3, 3) of quaternions (n, 4), body to inertial; rows are body axes in I."""
    w, x, y, z = q.T
    return np.stack(
        [
            np.stack([1 - 2 * (y * y + z * z), 2 * (x * y + w * z), 2 * (x * z - w * y)], -1),
            np.stack([2 * (x * y - w * z), 1 - 2 * (x * x + z * z), 2 * (y * z + w * x)], -1),
            np.stack([2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)], -1),
        ],
        axis=1,
    )


def unit(v):
    return v / np.linalg.norm(v, axis=-1, keepdims=True)


def level(v):
    return unit(v * [1.0, 1.0, 0.0])


def reference_of(task, t, batch):
    """Return r* and x* (n, 3) at the time t of an episode, by the task's description."""
    w, n = 2 * np.pi / 10.0, batch.count
    if task == "hover":
        r = np.array([4.0, 0.0, 1.0])
        heading = level(-r)
    elif task == "circle":
        r = np.array([4 * np.cos(w * t), 4 * np.sin(w * t), 1.0])
        heading = level(-r)
    elif task == "lemniscate":
        r = np.array([3 * np.sin(w * t), 1.5 * np.sin(2 * w * t), 1.0])
        heading = level(np.array([3 * w * np.cos(w * t), 3 * w * np.cos(2 * w * t), 0.0]))
    else:
        k = np.arange(1, 7)[np.newaxis, :, np.newaxis]
        phase = k * batch.record("ref_omega")[:, np.newaxis, np.newaxis] * t
        waves = batch.record("ref_cos") * np.cos(phase) + batch.record("ref_sin") * np.sin(phase)
        return batch.record("ref_center") + waves.sum(axis=1), level(
            batch.record("ref_heading_point")
        )
    return np.tile(r, (n, 1)), np.tile(heading, (n, 1))


DOCUMENTED = {"near": 1.0, "near_decay": 2.0, "fine": 0.5, "fine_decay": 20.0, "progress": 1.0}
DOCUMENTED |= {"gate_passed": 1.0, "heading": 0.1, "action_rate": 0.02, "body_rates": 0.002}
OTHERS = {"near": 0.7, "near_decay": 1.5, "fine": 0.4, "fine_decay": 9.0, "progress": 0.8}
OTHERS |= {"gate_passed": 3.0, "heading": 0.3, "action_rate": 0.05, "body_rates": 0.01}
"""Default weights, and others."""


def weights_for(task, weights):
    """Return keywords of an environment with these weights; none for the default ones."""
    others = ("near", "near_decay", "fine", "fine_decay")
    others = others if task == "waypoints" else ("progress", "gate_passed")
    mine = {name: weight for name, weight in weights.items() if name not in others}
    return {} if weights is DOCUMENTED else {"reward_params": RewardParams(**mine)}


def common_terms(weights, action, last_action, batch, aligned):
    return {
        "heading": weights["heading"] * aligned,
        "action_rate": -weights["action_rate"] * ((action - last_action) ** 2).sum(axis=1),
        "body_rates": -weights["body_rates"] * (batch.record("w") ** 2).sum(axis=1),
    }


def assert_terms(info, reward, expected, atol):
    for name, value in expected.items():
        np.testing.assert_allclose(info["reward_terms"][name], value, rtol=1e-9, atol=atol)
    np.testing.assert_allclose(reward, sum(expected.values()), rtol=1e-9, atol=atol)


@pytest.mark.parametrize("weights", [DOCUMENTED, OTHERS], ids=["default", "others"])
@pytest.mark.parametrize("task", ["hover", "circle", "lemniscate", "random_trajectory"])
def test_the_reward_of_a_tracking_task_is_the_documented_formula(task, weights):
    n, W = 20, weights
    made = {"reward_terms": True, **weights_for(task, weights), **UNBOUNDED}
    env = QuadVectorEnv(n, task, autoreset_mode="Disabled", **made)
    batch = env.flights.batch
    env.reset(seed=12)
    last = np.zeros((n, 4))
    actions = np.stack([actions_of(i, 25) for i in range(n)], axis=1)
    for k in range(25):
        given = actions[k] * 1.7  # sometimes out of bounds
        _, reward, _, _, info = env.step(given)
        action = np.clip(given.astype(float), -1.0, 1.0)
        r_ref, x_ref = reference_of(task, (k + 1) * SECONDS, batch)
        e = np.linalg.norm(r_ref - batch.record("r"), axis=1)
        aligned = (body_axes(batch.record("q"))[:, 0] * x_ref).sum(axis=1)
        expected = common_terms(W, action, last, batch, aligned)
        expected["near"] = W["near"] * np.exp(-W["near_decay"] * e)
        expected["fine"] = W["fine"] * np.exp(-W["fine_decay"] * e)
        assert_terms(info, reward, expected, atol=1e-12)
        np.testing.assert_allclose(info["position_error"], e, rtol=1e-9)
        seen = np.linalg.norm(batch.record("r_hat") - batch.record("r"), axis=1)
        np.testing.assert_allclose(info["estimation_error"], seen, rtol=1e-9, atol=1e-12)
        last = action


@pytest.mark.parametrize("weights", [DOCUMENTED, OTHERS], ids=["default", "others"])
def test_the_reward_of_waypoints_is_the_documented_formula(weights):
    n = 40
    made = {"reward_terms": True, "gate_count": 4, **weights_for("waypoints", weights)}
    env = QuadVectorEnv(n, "waypoints", autoreset_mode="Disabled", **made)
    batch, policy = env.flights.batch, PDPolicy(env, gains="lab")
    observation, info = env.reset(seed=3)
    gates, passed = batch.record("gates"), np.zeros(n, int)
    last, rows = np.zeros((n, 4)), np.arange(n)
    np.testing.assert_allclose(
        info["position_error"], np.linalg.norm(gates[:, 0] - batch.record("r"), axis=1)
    )
    for _ in range(500):
        before = np.linalg.norm(gates[rows, passed] - batch.record("r"), axis=1)
        action, _ = policy.predict(observation)
        observation, reward, terminated, truncated, info = env.step(action)
        distance = np.linalg.norm(gates[rows, passed] - batch.record("r"), axis=1)
        through = distance < 0.3
        passed += through
        aligned = body_axes(batch.record("q"))[:, 0, 0]  # body x along east
        action = action.astype(float)
        expected = common_terms(weights, action, last, batch, aligned)
        expected["progress"] = weights["progress"] * (before - distance) / SECONDS
        expected["gate_passed"] = weights["gate_passed"] * through / SECONDS
        assert_terms(info, reward, expected, atol=1e-7)
        np.testing.assert_array_equal(info["gates_passed"], passed)
        np.testing.assert_array_equal(terminated, passed == 4)
        last = action
        if (terminated | truncated).any():
            break
    assert info["gates_passed"].max() == 4
    assert set(info["ending"][terminated]) == {Ending.LAST_GATE}


def last_step(env, action, *, start=None, seed=1):
    env.reset(seed=seed, options=start)
    for _ in range(2000):
        result = env.step(action)
        if result[2] or result[3]:
            return result
    raise AssertionError("the episode does not end")


STILL = np.zeros(4)


BOUNDS = {"hover": 1.6, "circle": 3.0, "lemniscate": 3.0, "random_trajectory": 3.0}


@pytest.mark.parametrize("task", BOUNDS)
def test_flight_beyond_its_bound_is_out_of_bounds(task):
    start = single_env(task, seed=1)
    r_ref, _ = reference_of(task, 0.0, start.flights.batch)
    for speed, over in ((0.0, False), (20.0, True)):  # 0.4 m in a step
        env = QuadEnv(task)
        place = r_ref[0] + [0, 0, BOUNDS[task] - 0.2]
        options = {"position": place, "velocity": [0, 0, speed]}
        env.reset(seed=1, options=options)
        _, _, terminated, truncated, info = env.step(STILL)
        assert (terminated, truncated) == (over, False)
        assert info["ending"] == (Ending.OUT_OF_BOUNDS if over else Ending.NONE)


def test_no_hovering_start_is_out_of_bounds():
    flights = QuadVectorEnv(20_000, "hover", observation="truth").flights.batch
    flights.reset(seeds=range(20_000))
    away = np.abs(flights.record("r") - reference_of("hover", 0.0, flights)[0])
    farthest = np.linalg.norm(away.max(axis=0))  # each axis reaches its limit
    np.testing.assert_allclose(farthest, 0.9 * math.sqrt(3.0), rtol=1e-12)
    assert farthest < flights.task.out_of_bounds


def test_a_course_has_wider_bounds():
    env = QuadEnv("waypoints")
    env.reset(seed=1, options={"position": [0.0, 0.0, 9.0]})
    assert not env.step(STILL)[2]
    env.reset(seed=1, options={"position": [0.0, 0.0, 13.8]})  # near enough to some gates
    assert env.step(STILL)[4]["ending"] == Ending.OUT_OF_BOUNDS


def test_more_than_a_hundred_degrees_of_tilt_is_tipped_over():
    env = QuadEnv("hover", action="motor", out_of_bounds=100.0, min_height=-100.0)
    *_, terminated, truncated, info = last_step(env, np.array([0.2, -0.2, -0.2, 0.2]))
    assert (terminated, truncated, info["ending"]) == (True, False, Ending.TIPPED_OVER)
    up = body_axes(env.flights.batch.record("q"))[0, 2, 2]
    assert up < np.cos(np.radians(100.0))


@pytest.mark.parametrize(
    ("task", "options"),
    [("hover", {"out_of_bounds": 3.0}), ("circle", {"pad": False}), ("waypoints", {})],
)
def test_flight_half_a_meter_below_origin_ends_below_min_height(task, options):
    env = QuadEnv(task, **options)
    *_, terminated, truncated, info = last_step(env, np.array([-1.0, 0.0, 0.0, 0.0]))
    assert (terminated, truncated, info["ending"]) == (True, False, Ending.BELOW_MIN_HEIGHT)
    assert -1.0 < env.flights.batch.record("r")[0, 2] < -0.5


def test_the_last_gate_terminates():
    env = single_env("waypoints", seed=1, gate_count=1)
    gate = env.flights.batch.record("gates")[0, 0]
    env.reset(seed=1, options={"position": gate, "velocity": [0, 0, 0]})
    _, reward, terminated, truncated, info = env.step(STILL)
    assert (terminated, truncated, info["ending"]) == (True, False, Ending.LAST_GATE)
    assert info["gates_passed"] == 1
    assert 0.9 < SECONDS * reward < 1.1


@pytest.mark.parametrize("privileged", [False, True])
def test_failed_filter_truncates_with_finite_observations(privileged):
    env = single_env(seed=1, privileged=privileged, include_std=True)
    batch = env.flights.batch
    instant = batch.snapshot()
    instant["P"] = np.nan  # what does not fit into a float
    batch.restore(instant)
    observation, reward, terminated, truncated, info = env.step(STILL)
    assert (terminated, truncated, info["ending"]) == (False, True, Ending.FILTER_FAILED)
    assert info["filter_status"] > 0
    assert observation in env.observation_space
    assert np.isfinite(reward)
    _, info = env.reset(seed=2)
    assert info["filter_status"] == 0
    assert not any(env.step(STILL)[2:4])


def test_a_hovering_start_has_the_documented_spread():
    n = 6000
    env = vec_env(count=n, seed=1, observation="truth")
    batch = env.flights.batch
    offset = batch.record("r") - [4.0, 0.0, 1.0]
    axes = body_axes(batch.record("q"))
    yaw = np.arctan2(axes[:, 0, 1], axes[:, 0, 0])
    tilts = axes[:, :2, 2]
    off_yaw = (yaw - np.pi + np.pi) % (2 * np.pi) - np.pi
    for values, sigma in ((offset[:, :2], 0.3), (off_yaw, 0.2), (tilts, 0.03)):
        np.testing.assert_allclose(values.std(axis=0), sigma, rtol=0.05)
        assert (abs(values.mean(axis=0)) < 4.5 * sigma / np.sqrt(n)).all()
    assert (batch.record("r")[:, 2] >= 0.1).all()
    assert (abs(batch.record("v")) < 0.2).all()
    assert not batch.record("w").any()
    lift = (6.11e-8 / 0.104719755**2 * batch.record("rotor_speeds") ** 2).sum(axis=1)
    np.testing.assert_allclose(lift, 0.78 * 9.8, rtol=1e-9)


def test_the_circle_starts_on_the_ground_or_hovering():
    env = vec_env("circle", 2000, seed=1, observation="truth")
    batch = env.flights.batch
    grounded = (batch.record("r") == [4.0, 0.0, 0.0]).all(axis=1)
    assert abs(grounded.mean() - 0.5) < 5.0 * 0.5 / np.sqrt(2000)
    assert not batch.record("rotor_speeds")[grounded].any()
    assert (batch.record("rotor_speeds")[~grounded] > 0.0).all()
    off = np.linalg.norm(batch.record("r")[~grounded] - [4.0, 0.0, 1.0], axis=1)
    assert off.max() < 0.3 * 6.0


@pytest.mark.parametrize("task", ["circle", "lemniscate", "hover"])
def test_randomize_draws_phase_radius_period_and_sense(task):
    n = 2000
    plain, drawn = (
        QuadVectorEnv(n, task, randomize_reference=flag, out_of_bounds=99) for flag in (False, True)
    )
    first, second = plain.reset(seed=1), drawn.reset(seed=1)
    assert first[0].shape == second[0].shape
    size = 3.0 if task == "lemniscate" else 4.0
    assert np.ptp(np.abs(plain.flights.batch.record("ref_omega"))) == 0.0
    batch = drawn.flights.batch
    harmonic = batch.record("ref_center") if task == "hover" else batch.record("ref_cos")[:, 0]
    harmonic = batch.record("ref_sin")[:, 0] if task == "lemniscate" else harmonic
    radius = np.linalg.norm(harmonic[:, :2], axis=1)
    assert 0.5 * size <= radius.min() < 0.55 * size
    assert 1.2 * size < radius.max() <= 1.25 * size
    phase = np.arctan2(harmonic[:, 1], harmonic[:, 0])
    assert abs(np.corrcoef(phase, radius)[0, 1]) < 5.0 / math.sqrt(n)
    assert abs(np.exp(1j * phase).mean()) < 0.1
    if task != "hover":
        period = 2 * np.pi / batch.record("ref_omega")
        assert 8.0 <= period.min() < 8.2
        assert 14.8 < period.max() <= 15.0
    if task == "circle":
        turn = np.cross(batch.record("ref_cos")[:, 0], batch.record("ref_sin")[:, 0])[:, 2]
        assert 0.4 < (turn > 0).mean() < 0.6

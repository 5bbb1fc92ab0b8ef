"""The same seed and actions give the same flight, whoever flies it, where, and beside whom."""

import copy
import hashlib
import os
import pickle
import subprocess
import sys

import gymnasium
import numpy as np
import pytest

import quad_gym
from quad_gym.envs.single import QuadEnv
from quad_gym.envs.vector import QuadVectorEnv
from tests.contract.comparing import actions_of, assert_same, state_of

STEPS = 60
SHORT = {"max_episode_steps": 25, "max_tilt": 0.6}
"""Episodes end by the time limit and by tipping over, at different steps in different flights."""

LAB = quad_gym.sensor_suite("lab")
STANDARD = quad_gym.sensor_suite("standard")
SLOW = STANDARD.with_rates(gnss=10.0, camera=25.0)
QUIETER = STANDARD.replace(camera=STANDARD.camera.replace(pixel_sigma=19.0))
AVERAGES = LAB.replace(
    imu=LAB.imu.replace(samples="average"),
    estimator=LAB.estimator.replace(integration="midpoint"),
)


def fly_single(task, flight, *, wait, **keywords):
    """What flight `flight` goes through: observations, rewards, terminated, truncated.

    With `wait` a new episode takes a step to begin, else it begins in the step that ends the last.
    """
    env = QuadEnv(task, **SHORT, **keywords)
    observation, _ = env.reset(seed=1000 + flight)
    rows, over = [(observation, 0.0, False, False)], False
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
    return tuple(np.array(column) for column in zip(*rows, strict=True))


def fly_vector(task, flights, *, mode="NextStep", threads=1, **keywords):
    """The same columns for several flights at once, (steps, n, ...)."""
    env = QuadVectorEnv(
        len(flights), task, autoreset_mode=mode, threads=threads, **SHORT, **keywords
    )
    observation, _ = env.reset(seed=[1000 + flight for flight in flights])
    nothing = np.zeros(len(flights), bool)
    rows = [(observation, np.zeros(len(flights)), nothing, nothing)]
    actions = np.stack([actions_of(flight, STEPS) for flight in flights], axis=1)
    rows += [env.step(action)[:4] for action in actions]
    return tuple(np.array(column) for column in zip(*rows, strict=True))


@pytest.mark.parametrize("mode", ["NextStep", "SameStep"])
@pytest.mark.parametrize("task", list(quad_gym.IDS.values()))
def test_a_flight_in_a_batch_is_the_flight_alone(task, mode):
    flights = list(range(7))
    together = fly_vector(task, flights, mode=mode)
    assert (together[2] | together[3]).sum() >= 2 * len(flights)
    for i in flights:
        alone = fly_single(task, i, wait=mode == "NextStep")
        assert_same(tuple(column[:, i].copy() for column in together), alone, f"flight {i}")


@pytest.mark.parametrize(
    "keywords",
    [
        {"observation": "noisy", "action": "attitude"},
        {"observation": "measurements", "sensors": SLOW, "action": "motor"},
        {"observation": "truth", "action": "velocity", "randomize_reference": True},
        {"include_std": True, "layout": "absolute", "action": "wrench"},
        {"camera": False, "control_rate": 100},
        {"sensors": AVERAGES.with_rates(gnss=20.0)},
    ],
    ids=lambda keywords: "+".join(map(str, keywords)),
)
def test_whatever_is_observed_and_commanded(keywords):
    together = fly_vector("circle", range(3), mode="SameStep", **keywords)
    for i in range(3):
        alone = fly_single("circle", i, wait=False, **keywords)
        assert_same(tuple(column[:, i].copy() for column in together), alone, f"flight {i}")


@pytest.fixture(scope="module")
def thousand():
    return fly_vector("hover", list(range(1000)), threads=2)


@pytest.mark.parametrize("threads", [1, 2])
@pytest.mark.parametrize("count", [1, 2, 7, 64, 1000])
def test_the_size_of_the_batch_and_the_number_of_threads_change_nothing(count, threads, thousand):
    flown = fly_vector("hover", list(range(count)), threads=threads)
    assert_same(flown, tuple(column[:, :count].copy() for column in thousand))


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_the_order_of_the_flights_changes_nothing(seed, thousand):
    order = np.random.default_rng(seed).permutation(1000)[:100]
    flown = fly_vector("hover", order.tolist(), threads=seed)
    assert_same(flown, tuple(column[:, order].copy() for column in thousand))


def test_what_a_neighbor_does_changes_nothing():
    env, twin = (QuadVectorEnv(8, "circle", out_of_bounds=50.0) for _ in range(2))
    env.reset(seed=2)
    twin.reset(seed=2)
    calm = np.stack([0.1 * actions_of(i, 50) for i in range(8)], axis=1)
    wild = np.where(np.arange(8)[:, np.newaxis] == 3, np.sign(calm), calm)
    for k in range(50):
        mine, other = env.step(calm[k])[0], twin.step(wild[k])[0]
        np.testing.assert_array_equal(np.delete(mine, 3, axis=0), np.delete(other, 3, axis=0))


@pytest.mark.parametrize("n_envs", [1, 7, 64])
def test_stable_baselines3_sees_the_same_flights(n_envs):
    expected = fly_vector("hover", list(range(n_envs)), mode="SameStep")
    env = quad_gym.make_sb3_vec_env("QuadGym/Hover-v0", n_envs=n_envs, seed=1000, **SHORT)
    observation = env.reset()
    assert_same(observation, expected[0][0].copy())
    actions = np.stack([actions_of(flight, STEPS) for flight in range(n_envs)], axis=1)
    for k in range(STEPS):
        observation, reward, done, infos = env.step(actions[k])
        assert_same(observation, expected[0][k + 1].copy(), f"step {k}")
        np.testing.assert_array_equal(reward, expected[1][k + 1].astype(np.float32))
        np.testing.assert_array_equal(done, expected[2][k + 1] | expected[3][k + 1])
        cut = [info["TimeLimit.truncated"] for info in infos]
        np.testing.assert_array_equal(cut, expected[3][k + 1] & ~expected[2][k + 1])


def digest():
    flown = fly_vector("random_trajectory", list(range(9)), mode="SameStep")
    return hashlib.sha256(b"".join(column.tobytes() for column in flown)).hexdigest()


def test_another_process_flies_the_same():
    code = "from tests.contract.test_same_flights import digest; print(digest())"
    other = subprocess.run(
        [sys.executable, "-c", code],
        capture_output=True,
        text=True,
        check=True,
        env={**os.environ, "PYTHONHASHSEED": "7"},
    )
    assert other.stdout.strip() == digest()


# ---- copies in mid-episode -----------------------------------------------------------------------


def pickled(env):
    return pickle.loads(pickle.dumps(env))


def future_of(env, count, vector):
    """What the next 80 steps and a further reset bring."""
    seen = []
    for k in range(80):
        action = actions_of(k, 1)[0]
        result = env.step(np.tile(action, (count, 1)) if vector else action)
        seen.append(result)
        if not vector and (result[2] or result[3]):
            seen.append(env.reset())
    return [*seen, env.reset(), env.reset(seed=4)]


@pytest.mark.parametrize("twin_of", [pickled, copy.deepcopy], ids=["pickled", "copied"])
@pytest.mark.parametrize("wrapped", [False, True])
def test_a_copy_of_a_single_environment_has_the_same_future(twin_of, wrapped):
    env = gymnasium.make("QuadGym/Hover-v0", max_tilt=0.6)
    env = env if wrapped else env.unwrapped
    env.reset(seed=6)
    for action in actions_of(1, 4):
        env.step(action)
    twin = twin_of(env)
    past = state_of(twin)
    future = future_of(env, 1, vector=False)
    assert state_of(twin) == past
    assert_same(future, future_of(twin, 1, vector=False))


@pytest.mark.parametrize("twin_of", [pickled, copy.deepcopy], ids=["pickled", "copied"])
@pytest.mark.parametrize("mode", ["NextStep", "SameStep"])
@pytest.mark.parametrize("count", [1, 5, 70])
def test_a_copy_of_a_vector_environment_has_the_same_future(twin_of, mode, count):
    env = QuadVectorEnv(count, "circle", autoreset_mode=mode, threads=2, **SHORT)
    env.reset(seed=6)
    for k in range(25):
        env.step(np.stack([actions_of(i, 25)[k] for i in range(count)]))
    twin = twin_of(env)
    past = state_of(twin)
    future = future_of(env, count, vector=True)
    assert state_of(twin) == past
    assert_same(future, future_of(twin, count, vector=True))


@pytest.mark.parametrize("twin_of", [pickled, copy.deepcopy], ids=["pickled", "copied"])
def test_a_copy_of_the_stable_baselines3_interface_has_the_same_future(twin_of):
    env = quad_gym.make_sb3_vec_env("QuadGym/Circle-v0", n_envs=9, seed=3, **SHORT)
    env.reset()
    for k in range(7):
        env.step(np.tile(actions_of(k, 1), (9, 1)))
    twin = twin_of(env)
    for k in range(40):
        actions = np.tile(actions_of(k, 1), (9, 1))
        mine, other = env.step(actions), twin.step(actions)
        for info in (*mine[3], *other[3]):
            info.get("episode", {}).pop("t", None)
        assert_same(mine, other)
    assert_same(env.reset(), twin.reset())


@pytest.mark.parametrize("count", [1, 5, 70])
def test_a_restored_snapshot_has_the_same_future(count):
    env = QuadVectorEnv(count, "circle", autoreset_mode="SameStep", threads=2, **SHORT)
    batch = env.flights.batch
    env.reset(seed=8)
    for k in range(10):
        env.step(np.tile(actions_of(k, 1), (count, 1)))
    instant = batch.snapshot()
    future = future_of(env, count, vector=True)
    batch.restore(instant)
    assert_same(future, future_of(env, count, vector=True))
    fresh = QuadVectorEnv(count, "circle", autoreset_mode="SameStep", **SHORT)
    fresh.reset(seed=99)
    fresh.flights.batch.restore(instant)
    assert_same(future, future_of(fresh, count, vector=True))


def test_a_snapshot_of_another_batch_is_refused():
    small, large = QuadVectorEnv(2, "hover"), QuadVectorEnv(20, "hover")
    with pytest.raises(ValueError, match="snapshot"):
        small.flights.batch.restore(large.flights.batch.snapshot())
    with pytest.raises(ValueError, match="snapshot"):
        small.flights.batch.restore(np.zeros(1))


@pytest.mark.parametrize(
    ("task", "keywords"),
    [
        ("circle", {}),
        ("waypoints", {}),
        ("hover", {"estimator": "ekf"}),
        ("hover", {"sensors": "lab"}),
        ("hover", {"sensors": QUIETER}),
        ("hover", {"control_rate": 100}),
        ("hover", {"autoreset_mode": "SameStep"}),
        ("hover", {"world": quad_gym.WorldParams(wind_I=(1.0, 0.0, 0.0))}),
        ("hover", {"randomization": {"motor_time_constant": quad_gym.Uniform(0.04, 0.06)}}),
        ("hover", {"randomization": {"mass": quad_gym.Uniform(0.7, 0.9)}}),
    ],
    ids=str,
)
def test_a_snapshot_of_another_configuration_is_refused(task, keywords):
    drawn = {"randomization": {"mass": quad_gym.Uniform(0.7, 0.8)}}
    mine = QuadVectorEnv(2, "hover", **(drawn if "randomization" in keywords else {})).flights.batch
    other = QuadVectorEnv(2, task, **keywords).flights.batch
    mine.reset(seeds=[1, 2])
    before = mine.snapshot()
    other.reset(seeds=[1, 2])
    with pytest.raises(ValueError, match="snapshot must be from a batch of 2 flights with the"):
        mine.restore(other.snapshot())
    assert mine.snapshot().tobytes() == before.tobytes()


def test_a_snapshot_is_that_of_any_time_limit_and_number_of_threads():
    mine = QuadVectorEnv(9, "hover", threads=1, max_episode_steps=7).flights.batch
    other = QuadVectorEnv(9, "hover", threads=2).flights.batch
    other.reset(seeds=range(9))
    mine.restore(pickle.loads(pickle.dumps(other.snapshot())))
    assert_same(mine.read("position"), other.read("position"))

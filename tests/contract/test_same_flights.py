"""Equal seeds and actions give equal flights, in any interface, batch, process and copy."""

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
from tests.builders import SHORT, actions_for, actions_of, chosen, together, vec_env
from tests.contract.comparing import assert_same, future_of, state_of
from tests.contract.configurations import CONFIGURATIONS

STANDARD = quad_gym.sensor_suite("standard")
QUIETER = STANDARD.replace(camera=STANDARD.camera.replace(pixel_sigma=19.0))


@pytest.mark.parametrize("name", CONFIGURATIONS)
def test_size_order_and_threads_do_not_change_flights(name):
    base, keywords = CONFIGURATIONS[name]
    many = together(base, range(40), mode="SameStep", threads=2, **keywords)
    order = np.random.default_rng(1).permutation(40)[:11]
    few = together(base, order.tolist(), mode="SameStep", **keywords)
    assert_same(few, chosen(many, order))


def test_actions_of_one_flight_do_not_change_others():
    env, twin = (vec_env("circle", 8, seed=2, out_of_bounds=50.0) for _ in range(2))
    calm = 0.1 * actions_for(range(8), 50)
    wild = np.where(np.arange(8)[:, np.newaxis] == 3, np.sign(calm), calm)
    for k in range(50):
        mine, other = env.step(calm[k])[0], twin.step(wild[k])[0]
        np.testing.assert_array_equal(np.delete(mine, 3, axis=0), np.delete(other, 3, axis=0))


def digest():
    flown = together("random_trajectory", range(9), mode="SameStep")
    return hashlib.sha256(b"".join(column.tobytes() for column in flown)).hexdigest()


def test_another_process_flies_the_same_flights():
    code = "from tests.contract.test_same_flights import digest; print(digest())"
    other = subprocess.run(
        [sys.executable, "-c", code],
        capture_output=True,
        text=True,
        check=True,
        env={**os.environ, "PYTHONHASHSEED": "7"},
    )
    assert other.stdout.strip() == digest()


def pickled(env):
    return pickle.loads(pickle.dumps(env))


@pytest.mark.parametrize("twin_of", [pickled, copy.deepcopy], ids=["pickled", "copied"])
@pytest.mark.parametrize("wrapped", [False, True])
def test_copied_environment_has_the_same_future(twin_of, wrapped):
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


def in_mid_episode(name, count=5, seed=6, steps=25, **more):
    """A vector environment of a configuration after some steps."""
    base, keywords = CONFIGURATIONS[name]
    env = vec_env(
        count=count, seed=seed, **{**SHORT, "base": base, "threads": 2, **keywords, **more}
    )
    for action in actions_for(range(count), steps):
        env.step(action)
    return env


@pytest.mark.parametrize("twin_of", [pickled, copy.deepcopy], ids=["pickled", "copied"])
@pytest.mark.parametrize(
    ("name", "count"), [*((name, 5) for name in CONFIGURATIONS), ("circle", 1), ("circle", 256)]
)
def test_copied_vector_environment_has_the_same_future(name, count, twin_of):
    env = in_mid_episode(name, count)
    twin = twin_of(env)
    past = state_of(twin)
    future = future_of(env, count, vector=True)
    assert state_of(twin) == past
    assert_same(future, future_of(twin, count, vector=True))


@pytest.mark.parametrize("twin_of", [pickled, copy.deepcopy], ids=["pickled", "copied"])
def test_copied_sb3_environment_has_the_same_future(twin_of):
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


@pytest.mark.parametrize(
    ("name", "count"), [*((name, 5) for name in CONFIGURATIONS), ("circle", 1), ("circle", 70)]
)
def test_restored_snapshot_has_the_same_future(name, count):
    made = {"autoreset_mode": "SameStep", "count": count}
    env, fresh = in_mid_episode(name, **made), in_mid_episode(name, seed=99, steps=1, **made)
    instant = env.flights.batch.snapshot()
    future = future_of(env, count, vector=True)
    for other in (env, fresh):
        other.flights.batch.restore(instant)
        assert_same(future, future_of(other, count, vector=True))


def test_snapshot_of_another_batch_is_refused():
    small, large = vec_env(count=2), vec_env(count=20)
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
def test_snapshot_of_another_configuration_is_refused(task, keywords):
    drawn = {"randomization": {"mass": quad_gym.Uniform(0.7, 0.8)}}
    mine = vec_env(count=2, **(drawn if "randomization" in keywords else {})).flights.batch
    other = vec_env(task, 2, **keywords).flights.batch
    mine.reset(seeds=[1, 2])
    before = mine.snapshot()
    other.reset(seeds=[1, 2])
    with pytest.raises(ValueError, match="snapshot must be from a batch of 2 flights with the"):
        mine.restore(other.snapshot())
    assert mine.snapshot().tobytes() == before.tobytes()


def test_snapshot_fits_any_time_limit_and_number_of_threads():
    mine = vec_env(count=9, threads=1, max_episode_steps=7).flights.batch
    other = vec_env(count=9, threads=2).flights.batch
    other.reset(seeds=range(9))
    mine.restore(pickle.loads(pickle.dumps(other.snapshot())))
    assert_same(mine.read("position"), other.read("position"))

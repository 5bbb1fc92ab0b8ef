"""Equal seeds and actions give equal flights, in any interface, batch, process and copy."""

import copy
import hashlib
import pickle

import gymnasium
import numpy as np
import pytest

import quad_gym
from quad_gym import packing
from tests.builders import SHORT, actions_for, flat, run_python, vec_env
from tests.contract.comparing import assert_same, state_of
from tests.contract.configurations import CONFIGURATIONS
from tests.tasks.tasks import Chase

STANDARD = quad_gym.sensor_suite("standard")
QUIETER = STANDARD.replace(camera=STANDARD.camera.replace(pixel_sigma=19.0))
MANY, HALF = range(24), 30
SOME = np.random.default_rng(1).permutation(24)[:7].tolist()


def twin_of(env, pickled):
    return pickle.loads(pickle.dumps(env)) if pickled else copy.deepcopy(env)


def made(name, count, **more):
    """A vector environment of a configuration, whose episodes end at different steps."""
    base, keywords = CONFIGURATIONS[name]
    return vec_env(base, count, **{**SHORT, "autoreset_mode": "SameStep", **keywords, **more})


def begun(env, flights, last=HALF):
    """Results of a reset with a seed for each flight, and of the first steps."""
    start = env.reset(seed=[1000 + flight for flight in flights])
    return [start[:1], *(env.step(action) for action in actions_for(flights)[:last])]


def future(env):
    """Results of the following steps of MANY flights, and of two resets."""
    later = [env.step(action) for action in actions_for(MANY)[HALF:]]
    return [*later, env.reset(), env.reset(seed=4)]


def columns(rows, flights=slice(None)):
    """Observations, rewards and endings of some flights."""
    return [[flat(part)[flights] for part in row[:4]] for row in rows]


@pytest.mark.parametrize("name", CONFIGURATIONS)
def test_flights_depend_on_their_seeds_and_actions_only(name):
    """Not on size, order and threads of the batch, on copies, snapshots or earlier episodes."""
    env = made(name, len(MANY), threads=2)
    first = begun(env, MANY)
    instant, past = env.flights.batch.snapshot(), state_of(env)
    twin = twin_of(env, pickled=len(name) % 2)
    onward = future(env)
    assert state_of(twin) == past
    assert_same(future(twin), onward)
    for other in (env, made(name, len(MANY), seed=99)):
        other.flights.batch.restore(instant)
        assert_same(future(other), onward)
    few = begun(made(name, len(SOME), threads=1), SOME, last=None)
    assert_same(columns(few), columns([*first, *onward[:-2]], SOME))
    assert_same(begun(env, MANY), first)
    assert (flat(env.reset(seed=7)[0]) != flat(first[0][0])).any(axis=1).all()


def test_actions_of_one_flight_do_not_change_others():
    env, twin = (vec_env("circle", 8, seed=2, out_of_bounds=50.0) for _ in range(2))
    calm = 0.1 * actions_for(range(8), 50)
    wild = np.where(np.arange(8)[:, np.newaxis] == 3, np.sign(calm), calm)
    for k in range(50):
        mine, other = env.step(calm[k])[0], twin.step(wild[k])[0]
        np.testing.assert_array_equal(np.delete(mine, 3, axis=0), np.delete(other, 3, axis=0))


def digest():
    flown = columns(begun(made("random_trajectory", 9), range(9)))
    return hashlib.sha256(b"".join(part.tobytes() for row in flown for part in row)).hexdigest()


def test_another_process_flies_the_same_flights():
    code = "from tests.contract.test_same_flights import digest; print(digest())"
    other = run_python("-c", code, PYTHONHASHSEED="7")
    assert other.stdout.strip() == digest()


@pytest.mark.parametrize("pickled", [True, False])
@pytest.mark.parametrize("kind", ["single", "wrapped", "sb3"])
def test_copied_environment_has_the_same_future(kind, pickled):
    if kind == "sb3":
        env = quad_gym.make_sb3_vec_env("QuadGym/Circle-v0", n_envs=9, seed=3, **SHORT)
        env.reset()
    else:
        env = gymnasium.make("QuadGym/Hover-v0", max_tilt=0.6)
        env = env.unwrapped if kind == "single" else env
        env.reset(seed=6)
    actions = actions_for(range(9))

    def onward(env, chosen):
        seen = []
        for action in actions[chosen]:
            seen.append(env.step(action if kind == "sb3" else action[0])[: 3 + (kind != "sb3")])
            if kind != "sb3" and (seen[-1][2] or seen[-1][3]):
                seen.append(env.reset())
        return seen

    onward(env, slice(4))
    twin = twin_of(env, pickled)
    past, mine = state_of(twin), [*onward(env, slice(4, 60)), env.reset()]
    assert state_of(twin) == past
    assert_same([*onward(twin, slice(4, 60)), twin.reset()], mine)


@pytest.mark.parametrize("kind", ["environment", "filter"])
def test_pickle_of_another_version_is_refused(kind, monkeypatch):
    """A pickle names no compiled stage, and is refused where records have another form."""
    if kind == "environment":
        thing = gymnasium.make("QuadGym/Hover-v0").unwrapped
        thing.reset(seed=1)
    else:
        thing = quad_gym.UnscentedKalmanFilter(quad_gym.sensor_suite("lab"))
    pickled = pickle.dumps(thing)
    assert b"quad_gym.kernels" not in pickled
    assert pickle.loads(pickled)
    monkeypatch.setattr(packing, "form_of_records", lambda: "that of a later version")
    with pytest.raises(ValueError, match="must be unpickled with the version of quad_gym"):
        pickle.loads(pickled)


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


@pytest.mark.parametrize("kind", ["single", "vector", "sb3"])
def test_environment_that_was_never_reset_goes_on_from_a_snapshot(kind):
    """Its flights have begun: steps, masked resets and streams are those of the original."""
    if kind == "single":
        env, fresh = (gymnasium.make("QuadGym/Hover-v0").unwrapped for _ in range(2))
    elif kind == "vector":
        env, fresh = (vec_env(count=3, autoreset_mode="Disabled") for _ in range(2))
    else:
        env, fresh = (quad_gym.make_sb3_vec_env("QuadGym/Hover-v0", n_envs=3) for _ in range(2))
    env.reset()
    fresh.flights.batch.restore(env.flights.batch.snapshot())
    options = {"options": {"reset_mask": np.arange(3) == 1}} if kind == "vector" else {}
    action, futures = np.zeros(4 if kind == "single" else (3, 4)), []
    for one in (env, fresh):
        stepped, again = one.step(action)[:3], one.reset(**options)
        futures.append([*stepped, again if kind == "sb3" else again[0], state_of(one)])
    assert_same(*futures)


@pytest.mark.parametrize("task", [None, Chase], ids=["built-in task", "own task"])
@pytest.mark.parametrize("make", [gymnasium.make, gymnasium.make_vec], ids=["single", "vector"])
def test_end_of_an_episode_is_restored_with_it(make, task):
    """An environment whose episodes do not begin by themselves flies on from each other instant."""
    words = {} if make is gymnasium.make else {"num_envs": 2, "autoreset_mode": "Disabled"}
    env, fresh = (make("QuadGym/Hover-v0", task=task, **words).unwrapped for _ in range(2))
    env.reset(seed=1)
    action, instants, rewards, over = np.ones(env.action_space.shape), [], [], False
    while not np.any(over):
        instants.append(env.flights.batch.snapshot())
        _, reward, terminated, truncated, _ = env.step(action)
        over = np.asarray(terminated) | truncated
        rewards.append(reward)
    end = env.flights.batch.snapshot()
    for other in (env, fresh):  # one whose episode is over, and one that was never reset
        other.flights.batch.restore(instants[3])
        np.testing.assert_array_equal([other.step(action)[1] for _ in rewards[3:]], rewards[3:])
    env.reset(seed=2)
    env.flights.batch.restore(end)
    with pytest.raises(gymnasium.error.ResetNeeded):
        env.step(action)

"""With a world and a randomization at their fullest: the same flights in every interface."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import quad_gym
from quad_gym import LogUniform, Normal, Randomization, Uniform
from quad_gym.batch.flight_batch import FlightBatch
from quad_gym.envs.single import QuadEnv
from quad_gym.envs.vector import QuadVectorEnv
from tests.contract.comparing import actions_of, assert_same
from tests.contract.test_same_flights import SHORT, STEPS, fly_single, fly_vector, future_of

EVERYTHING = {
    "world": "fresh_breeze",
    "privileged": True,
    "randomization": {
        "mass": Uniform(0.8, 1.2, relative=True),
        "inertia": LogUniform(0.7, 1.4, relative=True),
        "center_of_mass_B": Uniform(-0.005, 0.005),
        "rotor_efficiency": Uniform(0.9, 1.0),
        "motor_time_constant": LogUniform(0.5, 2.0, relative=True),
        "wind_speed": Uniform(0.0, 5.0),
        "wind_direction": Uniform(-np.pi, np.pi),
        "gust_wind_speed": Uniform(0.0, 5.0),
        "battery_charge": Uniform(0.3, 1.0),
        "accel_noise_density": LogUniform(0.5, 5.0, relative=True),
        "position_sigma_I": LogUniform(0.5, 5.0, relative=True),
        "primary_antenna_B": Normal(0.0, 0.005, offset=True),
        "camera_rotation": Normal(0.0, 0.005),
        "start_velocity_I": Normal(0.0, 0.5),
    },
}
KNOWN = {**EVERYTHING, "randomization": Randomization(EVERYTHING["randomization"], known=True)}


def flat(observations):
    """Both parts of dictionaries, side by side."""
    first = observations[0]
    if not isinstance(first, dict):
        return np.array(observations)
    return np.stack([np.concatenate([o[k] for k in first], axis=-1) for o in observations])


def columns(flown, i=None):
    parts = (flat(list(flown[0])), *flown[1:])
    return tuple((part if i is None else part[:, i]).copy() for part in parts)


@pytest.mark.parametrize("keywords", [EVERYTHING, KNOWN], ids=["unknown", "known"])
@pytest.mark.parametrize("mode", ["NextStep", "SameStep"])
@pytest.mark.parametrize("task", ["hover", "waypoints"])
def test_a_flight_in_a_batch_is_the_flight_alone(task, mode, keywords):
    together = fly_vector(task, list(range(5)), mode=mode, **keywords)
    for i in range(5):
        alone = fly_single(task, i, wait=mode == "NextStep", **keywords)
        assert_same(columns(together, i), columns(alone), f"flight {i}")


@pytest.fixture(scope="module")
def hundred():
    return columns(fly_vector("circle", list(range(100)), threads=2, **EVERYTHING))


@pytest.mark.parametrize(("count", "threads"), [(1, 1), (9, 2), (64, 2), (100, 1), (100, 3)])
def test_size_and_threads_change_nothing(count, threads, hundred):
    flown = columns(fly_vector("circle", list(range(count)), threads=threads, **EVERYTHING))
    assert_same(flown, tuple(column[:, :count].copy() for column in hundred))


@given(st.permutations(range(100)))
@settings(max_examples=5, deadline=None)
def test_order_changes_nothing(hundred, order):
    flown = columns(fly_vector("circle", order[:17], threads=2, **EVERYTHING))
    assert_same(flown, tuple(column[:, order[:17]].copy() for column in hundred))


def test_info_tells_every_interface_the_same_draws():
    names = set(EVERYTHING["randomization"])
    env = QuadVectorEnv(3, "hover", autoreset_mode="SameStep", **SHORT, **EVERYTHING)
    sb3 = quad_gym.make_sb3_vec_env("QuadGym/Hover-v0", 3, seed=7, **SHORT, **EVERYTHING)
    singles = [QuadEnv("hover", **SHORT, **EVERYTHING) for _ in range(3)]
    _, info = env.reset(seed=7)
    sb3.reset()
    drawn = [single.reset(seed=7 + i)[1]["drawn"] for i, single in enumerate(singles)]
    assert set(info["drawn"]) == names | {f"_{name}" for name in names}
    for k in range(STEPS):
        for name in names:
            for i in range(3):
                np.testing.assert_array_equal(info["drawn"][name][i], drawn[i][name])
                if k == 0:
                    np.testing.assert_array_equal(sb3.reset_infos[i]["drawn"][name], drawn[i][name])
        actions = np.stack([actions_of(i, STEPS)[k] for i in range(3)])
        before = drawn
        info = env.step(actions)[4]
        sb3_infos, drawn = sb3.step(actions)[3], []
        for i, single in enumerate(singles):
            *_, terminated, truncated, mine = single.step(actions[i])
            if terminated or truncated:
                assert_same(mine["drawn"], before[i])  # the last info speaks of its own episode
                assert_same(sb3_infos[i]["drawn"], before[i])
                for name in names:
                    final = info["final_info"]["drawn"][name][i]
                    np.testing.assert_array_equal(final, before[i][name])
                mine = single.reset()[1]
                assert any((mine["drawn"][name] != before[i][name]).any() for name in ("inertia",))
            drawn.append(mine["drawn"])


def test_without_draws_info_says_nothing_of_them():
    assert "drawn" not in QuadEnv("hover").reset(seed=1)[1]
    assert "drawn" not in QuadVectorEnv(2, "hover", world="breeze").reset(seed=1)[1]


def test_the_privileged_truth_ends_with_wind_and_draws():
    env = QuadVectorEnv(4, "hover", **EVERYTHING)
    batch, table = env.flights.batch, env.flights.table
    observation, _ = env.reset(seed=3)
    for _ in range(5):
        observation = env.step(np.zeros((4, 4)))[0]
    start = observation["policy"].shape[1]
    truth = {f.name: observation["privileged"][:, f.slice.start - start : f.slice.stop - start]
             for f in table if f.slice.start >= start}  # fmt: skip
    R_BI = quad_gym.rotations.quaternion_to_dcm(batch.record("q"))
    wind_B = np.einsum("nij,nj->ni", R_BI, batch.record("wind"))
    np.testing.assert_allclose(truth["wind"], wind_B, atol=1e-5)
    mass = (batch.read("mass") - 0.78) / (0.2 * 0.78)
    np.testing.assert_allclose(truth["drawn_mass"][:, 0], mass, atol=1e-6)
    antenna = (batch.read("primary_antenna_B") - [0.1013, -0.0004, 0.0472]) / 0.005
    np.testing.assert_allclose(truth["drawn_primary_antenna_B"], antenna, atol=1e-5)
    assert list(truth)[-1] == "drawn_start_velocity_I"
    for name, values in truth.items():
        assert values.size, name
    assert observation["privileged"].shape == env.observation_space["privileged"].shape
    assert env.observation_space.contains(observation)


def test_a_calm_privileged_truth_is_what_it_was():
    calm, windy = (QuadEnv("hover", privileged=True, world=world) for world in ("calm", "breeze"))
    assert calm.observation_space["privileged"].shape == (25,)
    assert windy.observation_space["privileged"].shape == (28,)


def test_a_restored_snapshot_has_the_same_future():
    env = QuadVectorEnv(9, "circle", autoreset_mode="SameStep", threads=2, **SHORT, **EVERYTHING)
    env.reset(seed=8)
    for k in range(10):
        env.step(np.tile(actions_of(k, 1), (9, 1)))
    instant = env.flights.batch.snapshot()
    future = future_of(env, 9, vector=True)
    fresh = QuadVectorEnv(9, "circle", autoreset_mode="SameStep", **SHORT, **EVERYTHING)
    fresh.reset(seed=99)
    fresh.flights.batch.restore(instant)
    assert_same(future, future_of(fresh, 9, vector=True))


def test_bad_worlds_and_draws_are_refused_by_every_interface():
    for make in (
        lambda **k: QuadEnv("hover", **k),
        lambda **k: QuadVectorEnv(2, "hover", **k),
        lambda **k: quad_gym.make_sb3_vec_env("QuadGym/Hover-v0", 2, **k),
        lambda **k: FlightBatch(2, **k),
    ):
        with pytest.raises(ValueError, match="world must be"):
            make(world="storm")
        with pytest.raises(ValueError, match="world must be"):
            make(world={"wind_I": (1.0, 0.0, 0.0)})
        with pytest.raises(ValueError, match="'colour' is unknown"):
            make(randomization={"colour": Uniform(0.0, 1.0)})
        with pytest.raises(ValueError, match="light enough to hover"):
            make(randomization={"mass": Uniform(1.0, 30.0)})

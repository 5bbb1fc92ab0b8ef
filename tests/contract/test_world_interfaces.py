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
from tests.builders import SHORT, STEPS, actions_of, chosen, together
from tests.contract.comparing import (
    assert_alone_as_together,
    assert_same,
    assert_snapshot_restores,
)

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


@pytest.mark.parametrize("keywords", [EVERYTHING, KNOWN], ids=["unknown", "known"])
@pytest.mark.parametrize("mode", ["NextStep", "SameStep"])
@pytest.mark.parametrize("task", ["hover", "waypoints"])
def test_flight_in_a_batch_is_the_flight_alone(task, mode, keywords):
    assert_alone_as_together(task, 5, mode, **keywords)


@pytest.fixture(scope="module")
def hundred():
    return together("circle", range(100), threads=2, **EVERYTHING)


@pytest.mark.parametrize(("count", "threads"), [(1, 1), (9, 2), (64, 2), (100, 1), (100, 3)])
def test_batch_size_and_threads_do_not_change_flights(count, threads, hundred):
    few = together("circle", range(count), threads=threads, **EVERYTHING)
    assert_same(few, chosen(hundred, range(count)))


@given(st.permutations(range(100)))
@settings(max_examples=5, deadline=None)
def test_order_of_flights_does_not_change_them(hundred, order):
    few = together("circle", order[:17], threads=2, **EVERYTHING)
    assert_same(few, chosen(hundred, order[:17]))


def test_info_has_the_same_draws_in_every_interface():
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


def test_info_without_draws_has_no_entry():
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


def test_privileged_truth_of_a_calm_world_has_no_wind():
    calm, windy = (QuadEnv("hover", privileged=True, world=world) for world in ("calm", "breeze"))
    assert calm.observation_space["privileged"].shape == (25,)
    assert windy.observation_space["privileged"].shape == (28,)


def test_restored_snapshot_has_the_same_future():
    assert_snapshot_restores(9, **EVERYTHING)


def test_invalid_worlds_and_draws_are_refused():
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

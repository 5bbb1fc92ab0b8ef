"""Draws and wind in `info` and in the privileged observation."""

import numpy as np

import quad_gym
from quad_gym.envs.single import QuadEnv
from quad_gym.envs.vector import QuadVectorEnv
from tests.contract.configurations import DRAWN


def test_the_privileged_truth_ends_with_wind_and_draws():
    env = QuadVectorEnv(4, "hover", **DRAWN)
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

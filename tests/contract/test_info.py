"""`info` and the privileged observation: faults, innovations, draws and wind."""

import numpy as np

import quad_gym
from quad_gym.envs.single import QuadEnv
from quad_gym.envs.vector import QuadVectorEnv
from quad_gym.records import FEATURE_BLOCKS, Aid, FaultKind, GateDecision
from tests.builders import SHORT, actions_for, vec_env
from tests.contract.configurations import DRAWN, FAULTY


def test_info_has_every_fault_of_the_suite_by_name():
    names = {kind.name.lower() for kind in FaultKind}
    lacking = tuple(f"{aid.name.lower()}_" for aid in Aid)  # sensors that this suite lacks
    names = {name for name in names if not name.startswith(lacking)}
    env = vec_env(count=3, seed=7, **SHORT, **FAULTY)
    seen = {name: set() for name in names}
    for action in actions_for(range(3)):
        faults = env.step(action)[4]["faults"]
        assert set(faults) == names | {f"_{name}" for name in names}
        for name in names:
            assert faults[name].dtype == bool
            seen[name] |= set(faults[name].tolist())
    assert all(values == {True, False} for values in seen.values())


def test_info_has_the_innovations_and_decisions_of_the_gate():
    keywords = {"sensors": "rtk", "innovations": True, "faults": "gnss_outliers"}
    keywords |= {"out_of_bounds": 1e3, "min_height": -1e3, "max_tilt": np.pi}
    env, rejected, measured = vec_env(count=3, seed=7, **keywords), 0, 0
    for _ in range(200):
        info = env.step(np.zeros((3, 4)))[4]["innovations"]
        blocks, has = FEATURE_BLOCKS + 12, info["measured"]
        assert info["nis"].shape == has.shape == (3, blocks)
        assert info["innovation"].shape == info["sigma"].shape == (3, blocks, 3)
        assert np.isfinite(info["nis"][has]).all()
        assert (info["gate"][has] != GateDecision.NONE).all()
        measured += has[:, 0].sum()
        rejected += (has[:, 0] & (info["gate"][:, 0] == GateDecision.REJECTED)).sum()
    assert info["rejections"][:, 0].sum() == rejected
    assert 0 < rejected < measured / 5


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

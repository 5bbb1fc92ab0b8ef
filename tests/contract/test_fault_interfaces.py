"""With every fault there is: the same flights in every interface; `info` tells what is wrong."""

import numpy as np
import pytest

import quad_gym
from quad_gym.batch.flight_batch import FlightBatch
from quad_gym.envs.single import QuadEnv
from quad_gym.envs.vector import QuadVectorEnv
from quad_gym.faults import GnssOutage, RotorLoss
from quad_gym.faults.presets import faults_of
from quad_gym.records import FEATURE_BLOCKS, Aid, FaultKind, GateDecision
from tests.builders import SHORT, STEPS, actions_of, chosen, together
from tests.contract.comparing import (
    assert_alone_as_together,
    assert_same,
    assert_snapshot_restores,
)

OFTEN = tuple(
    type(fault)(rate=4.0, duration=(0.02, 0.2))
    for fault in faults_of("all", quad_gym.sensor_suite("rtk"))
)
EVERYTHING = {
    "sensors": "rtk",
    "faults": OFTEN,
    "world": "breeze",
    "randomization": {"rotor_efficiency": quad_gym.Uniform(0.9, 1.0)},
}


@pytest.mark.parametrize("mode", ["NextStep", "SameStep"])
@pytest.mark.parametrize("task", ["hover", "waypoints"])
def test_flight_in_a_batch_is_the_flight_alone(task, mode):
    assert_alone_as_together(task, 10, mode, threads=2, **EVERYTHING)


def test_a_weak_rotor_of_one_block_leaves_the_next_alone():
    """Without draws, too, each block has rotors of its own."""
    keywords = {"faults": RotorLoss(rate=4.0, duration=0.2, share=(0.2, 0.6))}
    many = together("hover", range(40), threads=2, **keywords)
    assert_same(chosen(many, range(32, 40)), together("hover", range(32, 40), **keywords))


def test_restored_snapshot_has_the_same_future():
    assert_snapshot_restores(9, **EVERYTHING)


@pytest.mark.parametrize("mode", ["NextStep", "SameStep"])
def test_info_has_the_same_faults_in_every_interface(mode):
    names = {kind.name.lower() for kind in FaultKind}
    names -= {f"{aid.name.lower()}_loss" for aid in Aid}  # sensors that this suite lacks
    env = QuadVectorEnv(3, "hover", autoreset_mode=mode, **SHORT, **EVERYTHING)
    sb3 = quad_gym.make_sb3_vec_env("QuadGym/Hover-v0", 3, seed=7, **SHORT, **EVERYTHING)
    singles = [QuadEnv("hover", **SHORT, **EVERYTHING) for _ in range(3)]
    _, info = env.reset(seed=7)
    sb3.reset()
    mine = [single.reset(seed=7 + i)[1]["faults"] for i, single in enumerate(singles)]
    over, seen = [False] * 3, {name: set() for name in names}
    assert set(info["faults"]) == names | {f"_{name}" for name in names}
    assert mine == [info["faults"] for info in sb3.reset_infos]
    for k in range(STEPS):
        actions = np.stack([actions_of(i, STEPS)[k] for i in range(3)])
        info, sb3_infos = env.step(actions)[4], sb3.step(actions)[3]
        for i, single in enumerate(singles):
            if over[i] and mode == "NextStep":
                over[i], mine[i] = False, single.reset()[1]["faults"]
            else:
                *_, terminated, truncated, told = single.step(actions[i])
                over[i], mine[i] = terminated or truncated, told["faults"]
                if mode == "SameStep":
                    assert sb3_infos[i]["faults"] == mine[i]
                if over[i] and mode == "SameStep":
                    final = info["final_info"]["faults"]
                    assert {name: final[name][i] for name in names} == mine[i]
                    mine[i] = single.reset()[1]["faults"]
            for name in names:
                assert info["faults"][name][i] == mine[i][name]
                assert type(mine[i][name]) is bool
                seen[name].add(mine[i][name])
    assert all(values == {True, False} for values in seen.values())


def test_info_without_faults_has_no_entry():
    assert not {"faults", "innovations"} & set(QuadEnv("hover").reset(seed=1)[1])
    assert not {"faults", "innovations"} & set(QuadVectorEnv(2, "hover").reset(seed=1)[1])


def test_info_has_the_same_innovations_in_every_interface():
    keywords = {"sensors": "rtk", "innovations": True, "faults": "gnss_outliers"}
    keywords |= {"out_of_bounds": 1e3, "min_height": -1e3, "max_tilt": np.pi}
    env = QuadVectorEnv(3, "hover", **keywords)
    sb3 = quad_gym.make_sb3_vec_env("QuadGym/Hover-v0", 3, seed=7, **keywords)
    singles = [QuadEnv("hover", **keywords) for _ in range(3)]
    env.reset(seed=7)
    sb3.reset()
    for i, single in enumerate(singles):
        single.reset(seed=7 + i)
    rejected = measured = 0
    for _ in range(200):
        actions = np.zeros((3, 4))
        info, sb3_infos = env.step(actions)[4]["innovations"], sb3.step(actions)[3]
        for i, single in enumerate(singles):
            mine = single.step(actions[i])[4]["innovations"]
            assert_same(mine, sb3_infos[i]["innovations"])
            for name, values in mine.items():
                np.testing.assert_array_equal(values, info[name][i])
            assert mine["nis"].shape == (FEATURE_BLOCKS + 12,)
            assert mine["innovation"].shape == mine["sigma"].shape == (FEATURE_BLOCKS + 12, 3)
            has = mine["measured"]
            assert np.isfinite(mine["nis"][has]).all()
            assert (mine["gate"][has] != GateDecision.NONE).all()
            measured += has[0]
            rejected += has[0] and mine["gate"][0] == GateDecision.REJECTED
    assert info["rejections"][:, 0].sum() == rejected
    assert 0 < rejected < measured / 5


@pytest.mark.parametrize("own_task", [None, quad_gym.Task()], ids=["built-in", "own"])
def test_final_info_with_same_step_autoreset_has_the_innovations(own_task):
    keywords = {"sensors": "rtk", "innovations": True, "task": own_task, "base": "hover", **SHORT}
    env = QuadVectorEnv(3, autoreset_mode="SameStep", **keywords)
    sb3_id, told = "QuadGym/Hover-v0", 0
    if own_task is not None:
        sb3_id = "Test/Watched-v0"
        quad_gym.register_task(sb3_id, own_task, "QuadGym/Hover-v0")
    sb3_keywords = {name: keywords[name] for name in ("sensors", "innovations", *SHORT)}
    sb3 = quad_gym.make_sb3_vec_env(sb3_id, 3, seed=7, **sb3_keywords)
    singles = [QuadEnv("hover", **sb3_keywords) for _ in range(3)]
    env.reset(seed=7)
    sb3.reset()
    for i, single in enumerate(singles):
        single.reset(seed=7 + i)
    for k in range(STEPS):
        actions = np.stack([actions_of(i, STEPS)[k] for i in range(3)])
        info, sb3_infos = env.step(actions)[4], sb3.step(actions)[3]
        for i, single in enumerate(singles):
            *_, terminated, truncated, mine = single.step(actions[i])
            assert_same(mine["innovations"], sb3_infos[i]["innovations"])
            if terminated or truncated:
                told += 1
                final = info["final_info"]["innovations"]
                for name, values in mine["innovations"].items():
                    np.testing.assert_array_equal(values, final[name][i])
                    assert final[f"_{name}"][i]
                mine = single.reset()[1]
            for name, values in mine["innovations"].items():
                np.testing.assert_array_equal(values, info["innovations"][name][i])
    assert told > 3


def test_invalid_faults_are_refused():
    for make in (
        lambda **k: QuadEnv("hover", **k),
        lambda **k: QuadVectorEnv(2, "hover", **k),
        lambda **k: quad_gym.make_sb3_vec_env("QuadGym/Hover-v0", 2, **k),
        lambda **k: FlightBatch(2, **k),
    ):
        with pytest.raises(ValueError, match="faults must be one of none, gnss_outage"):
            make(faults="storm")
        with pytest.raises(ValueError, match="faults must be faults or names of presets"):
            make(faults=3.0)
        with pytest.raises(ValueError, match="needs GNSS, which this sensor suite does not have"):
            make(sensors="indoor", faults=GnssOutage())

"""`info` of environments with faults and innovations."""

import numpy as np

from quad_gym.records import FEATURE_BLOCKS, Aid, FaultKind, GateDecision
from tests.builders import SHORT, actions_for, vec_env
from tests.contract.configurations import FAULTY


def test_info_has_every_fault_of_the_suite_by_name():
    names = {kind.name.lower() for kind in FaultKind}
    names -= {f"{aid.name.lower()}_loss" for aid in Aid}  # sensors that this suite lacks
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

"""Ordinary Numba, which serves where Numba's internals are others: the same flights to the bit."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from tests.unit.compiling.parts import RIGHT, Parts

SCRIPT = """
import sys
import numpy as np
import quad_gym
from quad_gym.kernels import single
from quad_gym.kernels.compiling import decorators
from quad_gym.kernels.compiling.stages import STAGE_TABLE
from quad_gym.kernels.vehicle.dynamics import move_stage
from quad_gym.packing.flight import params_block, params_record
from quad_gym.records import FLIGHT_BLOCK, SETTINGS, WORK_BLOCK, aligned_zeros

assert decorators.LEAN == (sys.argv[1] == "lean")
rng = np.random.default_rng(1)
R_BI = np.empty((20, 3, 3))
for k in range(20):
    v_I, v_B = rng.normal(size=(2, 5, 3))
    single.wahba_of_vectors(rng.random(5), v_I, v_B, R_BI[k])

params = params_block(params_record(quad_gym.vehicle_params("lab"), quad_gym.sensor_suite("lab")))
blocks, work = aligned_zeros(1, FLIGHT_BLOCK), aligned_zeros(1, WORK_BLOCK)
settings, table = np.zeros(1, SETTINGS), np.zeros(1, STAGE_TABLE)
settings["substeps"] = 3
for name in ("r", "v", "w", "rotor_speeds", "voltages", "disturbance"):
    blocks[name] = rng.normal(5.0, 1.0, blocks[name].shape)
blocks["q"] = rng.normal(size=blocks["q"].shape)
blocks["q"] /= np.linalg.norm(blocks["q"], axis=1, keepdims=True)
work["mask"] = 1.0
before = blocks.copy()
for _ in range(10):
    move_stage(blocks[0], params[0], params[0], settings[0], work[0], table[0], 0)
assert (blocks["r"] != before["r"]).all()
assert np.isfinite(blocks["r"]).all()
sys.stdout.write(R_BI.tobytes().hex() + " " + blocks.tobytes().hex())
"""


def computed(way, tmp_path, **environment):
    done = subprocess.run(
        [sys.executable, "-c", SCRIPT, way],
        env=os.environ
        | {"PYTHONPATH": str(Path(__file__).parents[3]), "NUMBA_CACHE_DIR": str(tmp_path)}
        | environment,
        capture_output=True,
        text=True,
        check=False,
        timeout=300,
    )
    assert done.returncode == 0, done.stderr
    return done.stdout.split(), done.stderr


def test_small_parts_compile_with_ordinary_numba(tmp_path):
    parts = Parts(tmp_path)
    output, said = parts.run(processes=1, QUAD_GYM_ORDINARY_NUMBA="1")
    assert output == RIGHT
    assert "compiling" in said
    assert len(parts.files("code")) == 3
    assert parts.compiled() == ["a", "b", "c"]


@pytest.mark.slow  # compiles two large kernels in both ways
def test_ordinary_numba_computes_the_same_to_the_bit(tmp_path):
    """An entry in floats and a stage in lanes; and neither finds what the other has cached."""
    lean, _ = computed("lean", tmp_path)
    ordinary, said = computed("ordinary", tmp_path, QUAD_GYM_ORDINARY_NUMBA="1")
    assert len(lean) == 2
    assert ordinary == lean
    assert "compiling move_stage" in said
    assert computed("ordinary", tmp_path, QUAD_GYM_ORDINARY_NUMBA="1") == (lean, "")


@pytest.mark.parametrize("lanes", ["3", "16", "eight"])
def test_a_number_of_lanes_that_there_is_not_is_refused(lanes):
    done = subprocess.run(
        [sys.executable, "-c", "import quad_gym.records"],
        env=os.environ | {"PYTHONPATH": str(Path(__file__).parents[3]), "QUAD_GYM_LANES": lanes},
        capture_output=True,
        text=True,
        check=False,
    )
    assert f"QUAD_GYM_LANES must be 2, 4 or 8, got '{lanes}'" in done.stderr

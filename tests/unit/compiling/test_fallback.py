"""Ordinary Numba, which serves where Numba's internals are others: the same flights to the bit."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from tests.unit.compiling.parts import RIGHT, Parts

FLIGHT = """
import json
from quad_gym.kernels.compiling import decorators
from tests.golden.flights import DIGESTS, cases, fly
assert not decorators.LEAN
assert fly(cases()["Hover, lab"]) == json.loads(DIGESTS.read_text())["Hover, lab"]
"""


@pytest.mark.slow  # compiles the kernels of a flight
def test_ordinary_numba_flies_a_golden_flight():
    environment = os.environ | {"QUAD_GYM_ORDINARY_NUMBA": "1"}
    root = Path(__file__).parents[3]
    subprocess.run([sys.executable, "-c", FLIGHT], cwd=root, env=environment, check=True)


def test_small_parts_compile_with_ordinary_numba(tmp_path):
    parts = Parts(tmp_path)
    output, said = parts.run(processes=1, QUAD_GYM_ORDINARY_NUMBA="1")
    assert output == RIGHT
    assert "compiling" in said
    assert len(parts.files("code")) == 3
    assert parts.compiled() == ["a", "b", "c"]


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

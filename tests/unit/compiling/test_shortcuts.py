"""Shortcuts through Numba: kernels have the same machine code with and without them."""

import pytest

from quad_gym.kernels.compiling import shortcuts
from tests.builders import run_python

COMPILE = r"""
import re
import sys

from quad_gym.kernels.compiling import shortcuts
from quad_gym.kernels.compiling.workers import dispatcher_of

if sys.argv[1] == "with":
    assert shortcuts.take()
for name in sys.argv[2:]:
    entry = dispatcher_of(name)
    entry.compile(entry.signature)
    code = next(iter(entry.overloads.values())).library.get_asm_str()
    # numbers of functions and types, in the order of their creation
    code = re.sub(r"B\d+v\d+|Li\d+E", "", code)
    # sizes of texts with such numbers, and variables of functions, which Numba declares unused
    print(re.sub(r"\n\t\.(comm|size|type)\t.*", "", code))
"""
SMALL = ["vehicle.control:control_stage", "single:nearest_obstacles"]
LARGE = ["filter.update:update_stage", "sensors.camera:camera_stage", "batch:fly"]


def assembly(how, names, folder):
    """The machine code, in words, of entries that a new process compiles."""
    where = folder / how
    process = run_python(
        "-c",
        COMPILE,
        how,
        *(f"quad_gym.kernels.{name}" for name in names),
        NUMBA_CACHE_DIR=str(where),
    )
    assert process.returncode == 0, process.stderr
    assert len(list(where.rglob("*.code"))) == len(names)  # nothing came from another cache
    return process.stdout


@pytest.mark.parametrize("names", [SMALL, pytest.param(LARGE, marks=pytest.mark.slow)])
def test_code_is_the_same_with_shortcuts(names, tmp_path):
    """Stages with lanes, and entries with arrays, whose references are counted."""
    plain = assembly("without", names, tmp_path)
    assert plain.count("ret") >= len(names)
    assert assembly("with", names, tmp_path) == plain


def test_every_shortcut_takes_the_place_of_a_function():
    code = "\n".join(
        [
            "from quad_gym.kernels.compiling import shortcuts",
            "found = lambda: [vars(owner).get(name) for owner, name, _ in shortcuts._SHORTCUTS]",
            "before, taken = found(), shortcuts.take()",
            "print(taken, all(old and new is not old for old, new in zip(before, found())))",
        ]
    )
    assert run_python("-c", code).stdout == "True True\n"


@pytest.mark.parametrize("version", ["0.62.1", "0.69.0", "1.0", "0.6"])
def test_other_versions_of_numba_are_left_as_they_are(version):
    before = [vars(owner)[name] for owner, name, _ in shortcuts._SHORTCUTS]
    assert not shortcuts.take(version)
    assert [vars(owner)[name] for owner, name, _ in shortcuts._SHORTCUTS] == before

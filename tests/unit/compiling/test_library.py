"""The library of compiled kernels: conditions of its use, and flights equal to Numba's."""

from pathlib import Path

import pytest

from quad_gym.kernels import library as libraries
from quad_gym.kernels.compiling import building
from quad_gym.kernels.library import Library, file_of, library, machine
from quad_gym.kernels.sources import MARK, digest_in, sources_digest
from quad_gym.records import WIDTH
from tests.builders import run_python

PACKAGE = Path(libraries.__file__).parents[1]
HUNDRED_STEPS = """
import sys, gymnasium, quad_gym
env = gymnasium.make("QuadGym/Circle-v0")
env.reset(seed=0)
for _ in range(100):
    if any(env.step(env.action_space.sample())[2:4]):
        env.reset()
assert "numba" not in sys.modules and "llvmlite" not in sys.modules
"""


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """An empty folder of libraries, with no choice of kernels in the environment."""
    monkeypatch.setattr(libraries, "FOLDER", tmp_path)
    monkeypatch.delenv("QUAD_GYM_KERNELS", raising=False)
    library.cache_clear()
    yield tmp_path
    library.cache_clear()


def write_stale():
    file_of(WIDTH).write_bytes(b"code" + MARK + b"0" * 64 + b"\0code")


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (None, ""),
        (b"code" + MARK + b"0" * 64 + b"\0code", "belongs to other sources"),
        (b"not a library" + MARK + b"DIGEST\0", "cannot be loaded: "),
    ],
    ids=["missing", "stale", "damaged"],
)
def test_library_that_cannot_be_used_falls_back_to_numba(folder, capsys, content, message):
    if content is not None:
        digest = sources_digest(PACKAGE).encode()
        file_of(WIDTH).write_bytes(content.replace(b"DIGEST", digest))
    assert library() is None
    said = capsys.readouterr().err
    assert (f"Numba compiles, as {file_of(WIDTH).name} {message}" if message else "") in said
    assert said.count("\n") == bool(message)


def test_name_of_library_has_system_processor_and_lanes(monkeypatch):
    monkeypatch.setattr("platform.machine", lambda: "ARM64")
    monkeypatch.setattr("sys.platform", "darwin")
    assert file_of(2).name == "kernels_darwin_aarch64_2.so"
    with pytest.raises(ValueError, match=r"libraries for linux on .*; got darwin on aarch64"):
        building.build()


@pytest.mark.parametrize(
    "why", ["there is no kernels_", "belongs to other sources", "does not run"]
)
def test_library_that_is_demanded_and_cannot_be_used_is_an_error(folder, monkeypatch, why):
    if not why.startswith("there"):
        write_stale()
    if why == "does not run":  # its registers are wider than the processor's
        monkeypatch.setattr(libraries, "runs_lanes", lambda lanes: False)
    monkeypatch.setenv("QUAD_GYM_KERNELS", "library")
    with pytest.raises(ImportError, match=why):
        library()


def test_library_is_needed_where_numba_is_missing(folder, monkeypatch):
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    with pytest.raises(ImportError, match=r"there is no kernels_.*quad-gym\[compile\]"):
        library()
    monkeypatch.setenv("QUAD_GYM_KERNELS", "other")
    with pytest.raises(ValueError, match="QUAD_GYM_KERNELS must be library or numba, got 'other'"):
        library()


def test_digest_depends_on_the_sources_of_kernels_and_records(tmp_path):
    for name in ("kernels/a.py", "records/b.py", "params/c.py"):
        (tmp_path / name).parent.mkdir()
        (tmp_path / name).write_text("x = 1\n")
    before = sources_digest(tmp_path)
    (tmp_path / "params/c.py").write_text("x = 2\n")
    assert sources_digest(tmp_path) == before
    (tmp_path / "records/b.py").write_text("x = 2\n")
    assert sources_digest(tmp_path) != before
    before = sources_digest(tmp_path)
    (tmp_path / "params/sensor_table.py").write_text("from quad_gym.params.c import CParams\n")
    table = sources_digest(tmp_path)
    (tmp_path / "params/c.py").write_text("x = 3\n")
    assert len({before, table, sources_digest(tmp_path)}) == 3
    before = table
    assert digest_in(b"other " + MARK + before.encode() + b"\0") == before
    assert digest_in(b"none") == ""


def test_building_for_an_unsupported_number_of_lanes_is_refused():
    with pytest.raises(ValueError, match=r"there are libraries for .* got .* with \[3\]"):
        building.build([3])


def test_missing_compiler_is_named(monkeypatch):
    monkeypatch.setenv("CC", "no-such-compiler")
    with pytest.raises(RuntimeError, match="there is no no-such-compiler: install one"):
        building.require_compiler()


@pytest.mark.parametrize("lanes", ["3", "16", "eight"])
def test_unsupported_number_of_lanes_in_the_environment_is_refused(lanes):
    done = run_python("-c", "import quad_gym.records", QUAD_GYM_LANES=lanes)
    assert f"QUAD_GYM_LANES must be 2, 4 or 8, got '{lanes}'" in done.stderr


# ---- with libraries, which take minutes to build, or seconds if most code is cached -----------


def run(lanes, *words):
    """Run a process with the library of a number of lanes."""
    return run_python(*words, QUAD_GYM_KERNELS="library", QUAD_GYM_LANES=str(lanes))


@pytest.fixture(params=sorted(building.PROCESSORS.get(machine(), {})))
def lanes(request):
    """A number of lanes that this processor runs, with its library built."""
    if not libraries.runs_lanes(request.param):
        pytest.skip(f"this processor has no registers of {request.param} lanes")
    (file,) = building.build([request.param])
    assert digest_in(file.read_bytes()) == sources_digest(PACKAGE)
    return request.param


@pytest.mark.slow
def test_golden_flights_are_the_same_through_the_library(lanes):
    done = run(lanes, "-m", "tests.golden.flights")
    assert done.returncode == 0, done.stdout + done.stderr
    assert "golden flights are as they were" in done.stdout


@pytest.mark.slow
def test_hundred_steps_through_the_library_import_no_numba(lanes):
    done = run(lanes, "-c", HUNDRED_STEPS)
    assert done.returncode == 0, done.stderr
    assert done.stderr == ""


@pytest.mark.slow
def test_library_has_every_entry_and_stage(lanes):
    from quad_gym.kernels.entries import ENTRIES
    from quad_gym.kernels.stages import SOURCES

    loaded = Library(file_of(lanes))
    for name, entry in ENTRIES.items():
        assert loaded.function_of(name, len(entry.arguments), entry.returns)
    assert all(loaded.address_of(source.name) for source in SOURCES)

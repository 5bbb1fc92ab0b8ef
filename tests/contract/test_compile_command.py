"""The command that compiles ahead of the first use."""

import re
import shutil
from pathlib import Path

import pytest

from quad_gym.commands.compile import names_of_kinds
from quad_gym.commands.main import main
from quad_gym.kernels.compiling import cache as caches
from quad_gym.kernels.compiling import workers
from quad_gym.kernels.compiling.decorators import EntryDispatcher
from quad_gym.kernels.compiling.workers import dispatcher_of
from quad_gym.kernels.stages import SOURCES, Stage
from tests.builders import run_python

ROOT = Path(__file__).parents[2]
FIRST_RESET = """
import gymnasium, quad_gym
gymnasium.make_vec("QuadGym/Circle-v0", 3, observation="truth").reset(seed=0)
"""


def run(folder, *words):
    """Run Python in a process with a separate cache."""
    return run_python(*words, NUMBA_CACHE_DIR=str(folder))


def fill(folder, names, monkeypatch):
    """Copy compiled code into a cache in another folder."""
    dispatchers = [dispatcher_of(name) for name in names]
    for dispatcher in dispatchers:
        dispatcher.compile(dispatcher.signature)
    with monkeypatch.context() as patch:
        patch.setattr(caches.config, "CACHE_DIR", str(folder))
        places = [caches.CodeCache(dispatcher.py_func).folder for dispatcher in dispatchers]
    for dispatcher, place in zip(dispatchers, places, strict=True):
        place.mkdir(parents=True, exist_ok=True)
        cache = dispatcher._cache
        shutil.copy(cache.folder / cache._name(dispatcher.signature, dispatcher.targetctx), place)


@pytest.mark.parametrize("count", [2, pytest.param(None, marks=pytest.mark.slow)])
def test_parts_compiled_ahead_are_not_compiled_again(tmp_path, monkeypatch, count):
    """Two functions, or all, are missing in the cache."""
    names = names_of_kinds(["truth"])
    missing = names if count is None else names[-count:]
    fill(tmp_path, [name for name in names if name not in missing], monkeypatch)
    words = ("-m", "quad_gym", "compile", "--stages", "truth")
    first = run(tmp_path, *words)
    assert first.returncode == 0, first.stderr
    *listed, summary = first.stdout.splitlines()
    assert listed == [f"{'compiled' if n in missing else 'in cache'}  {n}" for n in names]
    assert summary.startswith(f"{len(missing)} of {len(names)} functions compiled in ")
    plural = "" if len(missing) == 1 else "s"
    assert f"quad_gym: compiling {len(missing)} kernel{plural} for" in first.stderr
    environment = run(tmp_path, "-c", FIRST_RESET)
    assert environment.returncode == 0, environment.stderr
    assert environment.stderr == ""  # it would list compiled functions


def test_kinds_are_sets_of_stages_and_entries():
    names = names_of_kinds(["all"])
    assert len(set(names)) == len(names)
    assert {source.name for source in SOURCES} < set(names)
    truth, plain, single = (set(names_of_kinds([k])) for k in ("truth", "plain", "single"))
    assert truth | plain | single < set(names)
    filters = {source.name for source in SOURCES if source.stage in (Stage.UPDATE, Stage.PREDICT)}
    assert len(filters & plain) == 2
    assert not filters & truth


def test_libraries_and_modules_for_gpus_are_built_without_torch():
    code = (
        "import sys; sys.modules['torch'] = None\n"
        "from quad_gym.commands.compile import _default_plans\n"
        "from quad_gym.kernels.compiling.building import build\n"
        "assert next(_default_plans()).stages"
    )
    done = run_python("-c", code)
    assert done.returncode == 0, done.stderr


def test_compile_fails_if_code_cannot_be_written_to_cache(monkeypatch, capsys):
    monkeypatch.setattr(EntryDispatcher, "is_cached", lambda self: False)
    monkeypatch.setattr(workers, "prepare", lambda names, processes: None)
    monkeypatch.setattr("quad_gym.commands.compile._is_kept", lambda dispatcher: False)
    assert main(["compile", "--stages", "truth"]) == 1
    count = len(names_of_kinds(["truth"]))
    assert f"error: {count} of them could not be written" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("stage", "kernel", "reason"),
    [
        ("missing_argument", "_sum, .*:17: return _range", "missing a required .* 'anchor_I'"),
        ("missing_field", "missing_field_stage, .*flight.altitude", "attribute 'altitude'"),
        ("wrong_type", r"_range, .*: offset = r_I - anchor_I", r"sub\(vector, number\)"),
        ("record", r"_vertical, .*: return R_BI\.T\[2\]", "'T'"),
        ("missing_name", "missing_name_stage, .*metres", "name 'metres' is not defined"),
        ("barometer", r"measure_first, .*\(x, y, z\), _ = measure", "values: expected 3, got 2"),
    ],
)
def test_wrong_stage_is_reported_by_kernel_line_and_reason(stage, kernel, reason, capsys):
    assert main(["compile", "--stage", f"tests.wrong_stages:{stage}"]) == 1
    lines = capsys.readouterr().err.splitlines()
    first = next(k for k, line in enumerate(lines) if line.startswith("error: "))
    assert len(lines) - first <= 10
    assert f"{stage}_stage does not compile" in lines[first]
    assert re.search(f"kernel: {kernel}", lines[first + 1])
    assert re.search(f"reason: .*{reason}", lines[first + 2])


def test_single_stage_is_compiled_by_its_name(capsys):
    assert main(["compile", "--stage", "sensors.barometer:barometer"]) == 0
    said = capsys.readouterr().out
    assert said == "compiled  quad_gym.kernels.sensors.barometer:barometer_stage\n"


@pytest.mark.parametrize(
    ("stage", "message"),
    [
        ("sensors.barometre:barometer", "MODULE:KERNEL of quad_gym.kernels"),
        ("sensors.barometer:barometre", "got barometre_stage; did you mean barometer_stage"),
        ("sensors.barometer:aid", "must be a stage of .*, got aid_stage"),
        ("sensors.barometer:", "must be a stage of .*, got _stage"),
        (".sensors.barometer:barometer", "MODULE:KERNEL of quad_gym.kernels, got '.sensors"),
        ("", "MODULE:KERNEL of quad_gym.kernels, got ''"),
    ],
)
def test_unknown_stage_is_refused(stage, message, capsys):
    with pytest.raises(SystemExit) as ended:
        main(["compile", "--stage", stage])
    assert ended.value.code == 2
    assert re.search(message, capsys.readouterr().err)


@pytest.mark.parametrize(
    ("line", "reason"),
    [
        ("from quad_gym.records import Aid; Aid['DEPTH']", "KeyError: 'DEPTH'"),
        ("from quad_gym.records import Depth", "ImportError: cannot import name 'Depth'"),
        ("import quad_gym.depth", "No module named 'quad_gym.depth'"),
        ("depth = (1.0", "SyntaxError: '\\(' was never closed"),
    ],
)
def test_module_that_cannot_be_imported_is_reported_by_its_line(
    line, reason, tmp_path, monkeypatch, capsys
):
    (tmp_path / "depth_sensor.py").write_text(f'"Depth."\n{line}\n')
    monkeypatch.syspath_prepend(tmp_path)
    assert main(["compile", "--stage", "depth_sensor:depth"]) == 1
    said = capsys.readouterr().err
    assert re.search(f"error: depth_sensor cannot be imported\n(.*\n)?  reason: .*{reason}", said)
    assert "depth_sensor.py" in said
    assert "2" in said
    assert "Traceback" not in said

"""The benchmark's script runs and writes what it says; no test asserts on a clock."""

import importlib.util
import json
import sys
from pathlib import Path

import pytest

from quad_gym.cli import parse

SCRIPT = Path(__file__).parents[2] / "scripts" / "benchmark.py"


@pytest.fixture(scope="module")
def script():
    spec = importlib.util.spec_from_file_location("benchmark", SCRIPT)
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module
    path = list(sys.path)
    spec.loader.exec_module(module)
    sys.path[:] = path
    return module


def run(script, folder, *options):
    script.main(parse(script.Args, ["--quick", "--output", str(folder), *options]))
    return json.loads((folder / "benchmark.json").read_text())


def test_the_filter_section_compares_all_filters(script, tmp_path, capsys):
    found = run(script, tmp_path / "new", "--only", "filter", "--batch", "16")
    assert set(found) == {"sections", "configuration", "processor", "versions"}
    assert list(found["sections"]) == ["filter"]
    rows = found["sections"]["filter"]
    kinds = {(row["kind"], row["measurements"]) for row in rows}
    assert {(kind, n) for kind in ("lanes", "scalar", "plain NumPy") for n in (6, 12)} <= kinds
    for row in rows:
        assert set(row) == {"name", "seconds", "spread", "kind", "measurements", "times_lanes"}
        assert row["seconds"] > 0.0
        assert row["spread"] >= 0.0
        assert row["times_lanes"] > 0.0
        assert (row["times_lanes"] == 1.0) == (row["kind"] == "lanes")
    assert found["configuration"]["batch"] == 16
    assert found["versions"]["numba"]
    printed = capsys.readouterr()
    assert "plain NumPy, 12 measurements" in printed.out
    assert "plain NumPy, 12 measurements" in printed.err


def test_the_tick_section_names_every_part(script, tmp_path):
    rows = run(script, tmp_path, "--only", "tick", "--batch", "16")["sections"]["tick"]
    names = [row["name"] for row in rows]
    parts = ["control", "dynamics", "sensors", "task", "filter"]
    assert names == ["whole tick", *parts, "sum of parts"]
    assert rows[-1]["seconds"] == pytest.approx(sum(row["seconds"] for row in rows[1:-1]))


def test_the_rendering_section_has_every_task_and_view(script, tmp_path, capsys):
    pytest.importorskip("pygame")
    rows = run(script, tmp_path, "--only", "rendering")["sections"]["rendering"]
    assert len({(row["task"], row["view"]) for row in rows}) == len(rows) == 10
    assert "frames/s" in capsys.readouterr().out


def test_the_options_section_compares_each_with_everything_off(script, tmp_path):
    found = run(script, tmp_path, "--only", "options", "--batch", "16")
    rows = {row["name"]: row for row in found["sections"]["options"]}
    assert next(iter(rows)) == "everything off"
    assert {"gate", "gusts", "suite rtk", "extended Kalman filter"} < set(rows)
    off = rows["everything off"]
    for row in rows.values():
        assert row["times_off"] == pytest.approx(row["seconds"] / off["seconds"])
        assert row["seconds"] > 0.0


@pytest.mark.parametrize(
    "options",
    [
        ["--batch", "12"],
        ["--batch", "0"],
        ["--envs", "0"],
        ["--repeats", "0"],
        ["--seconds", "0"],
        ["--seconds", "nan"],
        ["--threads", "0"],
        ["--only", "speed"],
    ],
    ids=" ".join,
)
def test_options_that_make_no_sense_are_one_line_and_exit_code_2(script, options, capsys):
    with pytest.raises(SystemExit) as caught:
        parse(script.Args, options)
    assert caught.value.code == 2
    printed = capsys.readouterr()
    assert printed.out == ""
    assert len(printed.err.strip().splitlines()) == 1
    assert options[0] in printed.err

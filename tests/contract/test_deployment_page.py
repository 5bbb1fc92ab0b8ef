"""Tests of docs/deployment.md and of the files that `quad-gym export` writes."""

import ctypes
import re
import shutil
import subprocess
from pathlib import Path

import gymnasium
import numpy as np
import pytest

import quad_gym
from baselines.exporting import controller_of
from quad_gym.commands.main import main
from tests.console_commands import refused

PAGE = (Path(__file__).parents[2] / "docs" / "deployment.md").read_text(encoding="utf-8")
COMPILER = shutil.which("cc") or shutil.which("gcc") or shutil.which("clang")


def test_action_numbers_of_page_equal_default_scales():
    fields = controller_of("pretrained", "QuadGym/Circle-v0").action_fields
    assert "thrust 7.644 (1 + a[0]) N" in PAGE
    assert fields[0].formula(0).startswith("thrust = 7.644 (1 + a[0]) N")
    assert [field.scale for field in fields[1:]] == [6.0, 6.0, 3.0]


@pytest.mark.skipif(COMPILER is None, reason="there is no C compiler here")
def test_c_code_of_page_computes_observation_of_environment(tmp_path):
    """The C code receives state and reference from the absolute layout."""
    (tmp_path / "it.c").write_text(re.search(r"```c\n(.*?)```", PAGE, re.DOTALL)[1])
    flags = ["-std=c99", "-Wall", "-Wextra", "-Werror", "-shared", "-fPIC"]
    library = tmp_path / "it.so"
    subprocess.run([COMPILER, *flags, str(tmp_path / "it.c"), "-o", str(library)], check=True)
    observe = ctypes.CDLL(str(library)).observe
    keywords = {"num_envs": 3, "start": "hover", "randomize_reference": True}
    absolute, relative = (
        gymnasium.make_vec("QuadGym/Circle-v0", layout=layout, **keywords)
        for layout in ("absolute", "relative")
    )
    places = {f.name: f.slice for f in quad_gym.observation_layout(layout="absolute")}
    (seen, _), (want, _) = absolute.reset(seed=0), relative.reset(seed=0)
    rng = np.random.default_rng(0)
    for _ in range(25):
        for flight in range(3):
            row, found = seen[flight], np.full(28, np.nan, np.float32)
            state = [row[places[n]] for n in ("position", "velocity", "R_BI", "body_rates")]
            start, stop = places["reference_position"].start, places["preview_2"].stop
            # R_BI is row by row; the reference has the order of the structure
            inputs = (np.concatenate(state), row[start:stop].copy(), row[places["last_action"]])
            observe(*(a.ctypes.data_as(ctypes.c_void_p) for a in (*map(np.copy, inputs), found)))
            np.testing.assert_allclose(found, want[flight], rtol=0.0, atol=5e-6)
        action = rng.uniform(-0.2, 0.2, (3, 4))
        seen, want = absolute.step(action)[0], relative.step(action)[0]


@pytest.fixture(autouse=True)
def elsewhere(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)


def test_a_policy_becomes_a_c_file_named_after_its_task(tmp_path, capsys):
    assert main(["export", "policy", "pretrained", "QuadGym/Hover-v0", "--to", "c"]) == 0
    file = tmp_path / "results" / "export" / "hover.c"
    assert "int hover(const float observation[28], float action[4])" in file.read_text()
    told = capsys.readouterr().out
    assert "results/export/hover.c" in told
    assert "hover(observation, action) 50 times per second" in told


def test_export_replaces_file_only_with_overwrite(tmp_path, capsys):
    line = "export policy pretrained QuadGym/Hover-v0 --output it.c"
    assert main(line.split()) == 0
    before = (tmp_path / "it.c").read_text()
    (tmp_path / "it.c").write_text("mine")
    assert "it.c exists: use --overwrite" in refused(line, capsys)
    assert (tmp_path / "it.c").read_text() == "mine"
    assert main([*line.split(), "--overwrite"]) == 0
    assert (tmp_path / "it.c").read_text() == before


def test_a_policy_becomes_an_onnx_model(tmp_path, capsys):
    pytest.importorskip("onnx")
    pytest.importorskip("onnxruntime")
    assert main(["export", "policy", "pretrained", "QuadGym/Waypoints-v0", "--to", "onnx"]) == 0
    assert (tmp_path / "results" / "export" / "waypoints.onnx").stat().st_size > 10_000
    assert "differ from the policy's by at most" in capsys.readouterr().out


def test_names_of_files_become_names_of_functions(tmp_path):
    main(["export", "policy", "pretrained", "QuadGym/Hover-v0", "--output", "2nd-try.c"])
    assert "int policy_2nd_try(" in (tmp_path / "2nd-try.c").read_text()

"""`quad-gym export`: what it writes, what it says, what it refuses."""

import pytest

from quad_gym.commands.main import main
from tests.console_commands import refused


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


def test_a_file_is_replaced_only_when_told(tmp_path, capsys):
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


def test_a_filter_becomes_a_folder_with_a_library(tmp_path, capsys):
    assert main(["export", "filter", "--sensors", "indoor", "--target", "aarch64"]) == 0
    folder = tmp_path / "results" / "export" / "filter_indoor_aarch64"
    names = ["CMakeLists.txt", "README.md", "libquad_gym_filter.a", "main.c", "quad_gym_filter.h"]
    assert sorted(file.name for file in folder.iterdir()) == names
    assert "int qg_update_pixels(" in (folder / "quad_gym_filter.h").read_text()
    assert "README.md" in capsys.readouterr().out
    line = "export filter --sensors indoor --target aarch64"
    assert "libquad_gym_filter.a exists: use --overwrite" in refused(line, capsys)

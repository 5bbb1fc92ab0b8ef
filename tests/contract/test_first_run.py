"""What a newcomer stumbles over: helpful errors, results that stay, figures that can be read."""

import pytest

from quad_gym.commands.main import main
from tests.console_commands import refused


def test_evaluate_replaces_results_only_when_told(tmp_path, capsys, monkeypatch):
    pytest.importorskip("matplotlib")
    monkeypatch.chdir(tmp_path)
    few = "--policy pd --observation truth --episodes 2 --env duration=0.4"
    line = ["evaluate", "hover", *few.split()]
    main(line)
    folder = tmp_path / "results" / "evaluate"
    file = folder / "hover" / "summary.json"
    before = file.read_text()
    main([*line, "--seed", "5"])
    assert (folder / "hover_2" / "summary.json").exists()
    assert "--overwrite" in refused([*line, "--output", str(file.parent)], capsys)
    assert file.read_text() == before
    main([*line, "--seed", "5", "--overwrite"])
    assert file.read_text() != before
    assert not (folder / "hover_3").exists()


def test_the_compiled_engine_writes_files_for_tensorboard(tmp_path):
    accumulator = pytest.importorskip("tensorboard.backend.event_processing.event_accumulator")
    from baselines.compiled_ppo.run import Events

    events = Events(tmp_path / "run")
    for step in (0, 100):
        events.add(step, {"evaluation/mean_error": 0.5 + step, "train/loss": 0.25})
    events.close()
    found = accumulator.EventAccumulator(str(tmp_path / "run"))
    found.Reload()
    assert sorted(found.Tags()["scalars"]) == ["evaluation/mean_error", "train/loss"]
    errors = found.Scalars("evaluation/mean_error")
    assert [(e.step, e.value) for e in errors] == [(0, 0.5), (100, 100.5)]

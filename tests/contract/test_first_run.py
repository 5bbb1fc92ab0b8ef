"""What a newcomer stumbles over: helpful errors, results that stay, figures that can be read."""

import numpy as np
import pytest

from quad_gym.commands import tune
from quad_gym.commands.main import main
from tests.console_commands import refused


@pytest.fixture(autouse=True)
def elsewhere(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)


def test_evaluate_replaces_results_only_when_told(tmp_path, capsys):
    pytest.importorskip("matplotlib")
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


@pytest.mark.parametrize("candidates", [1, 2, 10, 45])
def test_tune_flies_as_many_candidates_as_it_says(candidates, tmp_path, monkeypatch):
    """Errors of the search are replaced by a function of the gains; its least is found."""

    def cost(self, x):
        gains = self.knobs.gains(np.asarray(x))
        error = float(np.exp(np.square(np.asarray(x) - 0.3).sum()))
        self.rows.append({"relative_error": error})
        self.flown.append(gains)
        return np.log(error)

    monkeypatch.setattr(tune.Search, "cost", cost)
    args = tune.TuneArgs(env_ids=("hover",), candidates=candidates, episodes=1, output=tmp_path)
    found = tune.configure(args)
    best = tune.search(args, found)
    errors = [row["relative_error"] for row in found.rows]
    assert len(errors) == candidates
    assert best == found.flown[int(np.argmin(errors))]


@pytest.mark.parametrize("length", [3, 20, 45, 75])
@pytest.mark.parametrize("count", [2, 4, 9])
def test_a_legend_is_within_its_figure_and_no_higher_than_needed(count, length):
    pytest.importorskip("matplotlib")
    from matplotlib.backends.backend_agg import FigureCanvasAgg

    from quad_gym.analysis.comparison_plots import learning_figure

    curve = [(np.linspace(0.0, 1.0, 5), np.linspace(0.0, 9.0, 5))]
    figure = learning_figure({f"{k}".rjust(length, "n"): curve for k in range(count)}, {})
    canvas = FigureCanvasAgg(figure)
    canvas.draw()
    (legend,) = figure.legends
    box = legend.get_window_extent(canvas.get_renderer())
    assert figure.bbox.x0 <= box.x0
    assert box.x1 <= figure.bbox.x1
    rows = {text.get_window_extent().y0 for text in legend.get_texts()}
    assert (len(rows) < count) == (length < 45)


def test_the_compiled_engine_writes_files_for_tensorboard(tmp_path):
    accumulator = pytest.importorskip("tensorboard.backend.event_processing.event_accumulator")
    from baselines.compiled_ppo.events import Events

    events = Events(tmp_path / "run")
    for step in (0, 100):
        events.add(step, {"evaluation/mean_error": 0.5 + step, "train/loss": 0.25})
    events.close()
    found = accumulator.EventAccumulator(str(tmp_path / "run"))
    found.Reload()
    assert sorted(found.Tags()["scalars"]) == ["evaluation/mean_error", "train/loss"]
    errors = found.Scalars("evaluation/mean_error")
    assert [(e.step, e.value) for e in errors] == [(0, 0.5), (100, 100.5)]

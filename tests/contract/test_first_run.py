"""What a newcomer stumbles over: helpful errors, results that stay, figures that can be read."""

import gymnasium
import numpy as np
import pytest

from quad_gym.commands import tune
from quad_gym.commands.main import main
from tests.console import plain


@pytest.fixture(autouse=True)
def elsewhere(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)


def refused(words, capsys):
    """The message of a command line that ends with a usage error."""
    with pytest.raises(SystemExit) as end:
        main(words)
    assert end.value.code == 2
    return plain(capsys.readouterr().err)


@pytest.mark.parametrize(
    ("task", "keyword", "value"),
    [
        ("Hover", "period", 5.0),
        ("Waypoints", "period", 5.0),
        ("Waypoints", "preview", (0.1, 0.2)),
        ("Circle", "gate_count", 3),
        ("Hover", "max_speed", 1.0),
    ],
)
def test_keywords_that_a_task_does_not_use_are_refused(task, keyword, value):
    with pytest.raises(ValueError, match=f"{keyword} (has no effect on|belongs to) the task"):
        gymnasium.make(f"QuadGym/{task}-v0", **{keyword: value})


@pytest.mark.parametrize(
    ("given", "meant"),
    [
        ("sensor", "sensors"),
        ("fault", "faults"),
        ("randomise", "randomize_reference"),
        ("rate", "control_rate"),
    ],
)
def test_unknown_keywords_are_answered_with_what_may_be_meant(given, meant):
    with pytest.raises(TypeError, match=f"did you mean {meant}"):
        gymnasium.make_vec("QuadGym/Circle-v0", num_envs=1, **{given: 1})


@pytest.mark.parametrize("keyword", ["radius", "control_rate", "max_episode_steps", "action_delay"])
def test_strings_are_no_numbers(keyword):
    with pytest.raises(ValueError, match=f"{keyword} must be a number, got '2'"):
        gymnasium.make("QuadGym/Circle-v0", **{keyword: "2"})


def test_evaluate_replaces_results_only_when_told(tmp_path, capsys):
    pytest.importorskip("matplotlib")
    line = [
        "evaluate",
        "hover",
        "--policy",
        "pd",
        "--observation",
        "truth",
        "--episodes",
        "2",
        "--env",
        "duration=0.4",
    ]
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


def test_tune_replaces_gains_only_when_told(tmp_path, capsys):
    (tmp_path / "gains.json").write_text("mine")
    assert "--overwrite" in refused(["tune", "--output", str(tmp_path)], capsys)
    assert (tmp_path / "gains.json").read_text() == "mine"


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
    args = tune.Args(env_ids=("hover",), candidates=candidates, episodes=1, output=tmp_path)
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


@pytest.mark.parametrize("points", ["at rest", "moving"])
def test_no_legend_covers_paths(points):
    """It stands below the pictures; all pictures have one scale; a reference at rest has a mark."""
    pytest.importorskip("matplotlib")
    from matplotlib.backends.backend_agg import FigureCanvasAgg

    from quad_gym.analysis.comparison_plots import paths_figure
    from quad_gym.analysis.plots import Trace

    time = np.linspace(0.0, 1.0, 50)
    line = np.stack([time, 2.0 * time, 0.0 * time], axis=1)
    reference = 0.0 * line if points == "at rest" else line
    traces = {
        name: Trace(
            time=time,
            position=scale * line,
            heading=np.tile([1.0, 0.0], (50, 1)),
            reference=reference,
            error=time,
        )
        for name, scale in (("one", 1.0), ("two", 0.5), ("three", 0.2), ("four", 0.1))
    }
    figure = paths_figure(traces)
    canvas = FigureCanvasAgg(figure)
    canvas.draw()
    (legend,) = figure.legends
    box = legend.get_window_extent(canvas.get_renderer())
    for axes in figure.axes:
        assert axes.get_legend() is None
        assert not box.overlaps(axes.get_window_extent())
        assert axes.get_xlim() == figure.axes[0].get_xlim()
        assert (axes.lines[1].get_marker() == "+") == (points == "at rest")


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


def test_the_bar_of_a_training_begins_after_compiling(tmp_path, monkeypatch, capsys):
    """Its speed would count the time of compiling, and it would stand still for that long."""
    from baselines.compiled_ppo.ppo import CompiledPPO
    from baselines.compiled_ppo.run import run
    from baselines.plans import Plan
    from baselines.recipes import recipe

    prepared = []
    prepare = CompiledPPO.prepare

    def watched(self):
        prepare(self)
        prepared.append(capsys.readouterr().err)

    monkeypatch.setattr(CompiledPPO, "prepare", watched)
    small = recipe("QuadGym/Hover-v0").replace(n_envs=2, steps=64)
    plan = Plan(
        env_id="QuadGym/Hover-v0",
        environment={"duration": 0.2},
        recipe=small.replace(parameters={**small.parameters, "batch_size": 64}),
        threads=1,
        evaluations=1,
        episodes=2,
    )
    run(plan, tmp_path, plan.make_judge(), tensorboard=False, quiet=False)
    assert "steps" not in prepared[0]
    assert "64.0/64.0" in capsys.readouterr().err

"""Figures, tables and files contain the given data; the look of figures is not tested."""

import dataclasses
import json
import sys
from pathlib import Path

import numpy as np
import pytest

from quad_gym.analysis import plots
from quad_gym.analysis.reports import as_json, text_table, write_csv, write_json

pytest.importorskip("matplotlib")


def circle(n=201, duration=10.0, gap=0.1):
    """A flight on a circle at some distance from its reference, looking at the center."""
    time = np.linspace(0.0, duration, n)
    c, s = np.cos(2 * np.pi * time / duration), np.sin(2 * np.pi * time / duration)
    reference = np.stack([4.0 * c, 4.0 * s, np.ones(n)], axis=1)
    return plots.Trace(
        time=time,
        position=reference - [0.0, 0.0, gap],
        heading=np.stack([-c, -s], axis=1),
        reference=reference,
        error=np.full(n, gap),
    )


def axes_of(figure):
    (axes,) = figure.axes
    return axes


def test_figures_show_the_flight_and_its_reference():
    trace = circle()
    axes = axes_of(plots.flight_figure(plots.draw_path, trace, title="Title"))
    assert (axes.get_aspect(), axes.get_title(loc="left")) == (1.0, "Title")
    flown, reference, start = axes.lines
    np.testing.assert_array_equal(flown.get_xydata(), trace.position[:, :2])
    np.testing.assert_array_equal(reference.get_xydata(), trace.reference[:, :2])
    np.testing.assert_array_equal(start.get_xydata(), trace.position[:1, :2])
    axes = axes_of(plots.flight_figure(plots.draw_height, trace))
    np.testing.assert_array_equal(axes.lines[0].get_ydata(), trace.position[:, 2])
    np.testing.assert_array_equal(axes.lines[1].get_ydata(), trace.reference[:, 2])
    band = plots.Band(low=0.5 * trace.error, high=2.0 * trace.error, label="range")
    axes = axes_of(plots.flight_figure(plots.draw_error, trace, band, label="seed 7"))
    assert [text.get_text() for text in axes.get_legend().get_texts()] == ["seed 7", "range"]
    np.testing.assert_array_equal(axes.lines[0].get_ydata(), trace.error)
    assert len(axes.collections) == 1


def figure():
    return plots.flight_figure(plots.draw_height, circle())


@pytest.mark.parametrize(
    ("interval", "names"), [((1.0, 3.0), ["a", "95 % interval"]), (None, ["a"])]
)
def test_figure_of_intervals_names_its_bars_if_there_are_any(interval, names):
    figure = plots.intervals_figure({"one": {"a": (2.0, interval)}, "two": {"a": (4.0, None)}}, "m")
    (legend,) = figure.legends
    assert [text.get_text() for text in legend.get_texts()] == names


def test_saves_png_and_svg_with_the_same_bytes_each_time(tmp_path):
    import matplotlib

    before = dict(matplotlib.rcParams)
    first = plots.save_figure(figure(), tmp_path / "first")
    second = plots.save_figure(figure(), tmp_path / "second")
    assert [file.name for file in first] == ["first.png", "first.svg"]
    assert first[0].read_bytes()[:4] == b"\x89PNG"
    assert b"<svg" in first[1].read_bytes()
    for one, other in zip(first, second, strict=True):
        assert one.read_bytes() == other.read_bytes()
    assert dict(matplotlib.rcParams) == before


def test_missing_matplotlib_is_explained(monkeypatch):
    monkeypatch.setitem(sys.modules, "matplotlib.figure", None)
    with pytest.raises(ImportError, match=r'pip install "quad-gym\[plot\]"'):
        plots.flight_figure(plots.draw_path, circle())


@dataclasses.dataclass
class Point:
    x: float
    where: Path


def test_json_holds_values_of_all_types(tmp_path):
    value = {1: Point(np.nan, Path("a/b")), "array": np.arange(2), "flag": np.bool_(True)}
    file = write_json(tmp_path / "a.json", value)
    want = {"1": {"x": None, "where": "a/b"}, "array": [0, 1], "flag": True}
    assert json.loads(file.read_text()) == want
    assert as_json((1.5, np.float64("inf"))) == [1.5, None]


def test_csv_leaves_unknown_cells_empty(tmp_path):
    columns = {"a": np.array([1.0, np.nan]), "b": ["x", None]}
    assert write_csv(tmp_path / "a.csv", columns).read_text() == "a,b\n1.0,x\n,\n"
    with pytest.raises(ValueError, match="shorter"):
        write_csv(tmp_path / "a.csv", {"a": [1, 2], "b": [1]})


def test_text_table_aligns_columns_under_their_headings():
    table = text_table(
        {"": ["name"], "a long heading": ["x", "y"], "z": ["value"]},
        [["one", "1", "2", "3.25"], ["three", "10", "20", "-"]],
    )
    assert table.splitlines() == [
        "      | a long heading |   z",
        "name  |  x           y | value",
        "------+----------------+------",
        "one   |  1           2 |  3.25",
        "three | 10          20 |     -",
    ]

"""Figures: that they show what they are given; how they look is for eyes."""

import sys

import numpy as np
import pytest

from quad_gym.analysis import plots

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


def band(trace, low=0.5, high=2.0):
    return plots.Band(low=low * trace.error, high=high * trace.error, label="range")


def axes_of(figure):
    (axes,) = figure.axes
    return axes


class TestPath:
    def test_shows_path_reference_and_start_to_scale(self):
        trace = circle()
        axes = axes_of(plots.flight_figure(plots.draw_path, trace, title="Title"))
        assert axes.get_aspect() == 1.0
        assert axes.get_title(loc="left") == "Title"
        assert "[m]" in axes.get_xlabel()
        assert "[m]" in axes.get_ylabel()
        flown, reference, start = axes.lines
        np.testing.assert_array_equal(flown.get_xydata(), trace.position[:, :2])
        np.testing.assert_array_equal(reference.get_xydata(), trace.reference[:, :2])
        np.testing.assert_array_equal(start.get_xydata(), trace.position[:1, :2])


class TestHeight:
    def test_shows_height_and_reference(self):
        trace = circle()
        axes = axes_of(plots.flight_figure(plots.draw_height, trace))
        flown, reference, _ = axes.lines
        np.testing.assert_array_equal(flown.get_ydata(), trace.position[:, 2])
        np.testing.assert_array_equal(reference.get_ydata(), trace.reference[:, 2])
        assert axes.get_xlabel() == "time [s]"
        assert axes.get_ylabel() == "height z [m]"


class TestError:
    def labels(self, axes):
        return [text.get_text() for text in axes.get_legend().get_texts()]

    def test_shows_flight_and_band(self):
        trace = circle()
        axes = axes_of(plots.flight_figure(plots.draw_error, trace, band(trace), label="seed 7"))
        assert self.labels(axes) == ["seed 7", "range"]
        np.testing.assert_array_equal(axes.lines[0].get_ydata(), trace.error)
        assert len(axes.collections) == 1
        assert axes.get_yscale() == "log"


def test_saves_png_and_svg_with_the_same_bytes_each_time(tmp_path):
    first = plots.save_figure(plots.flight_figure(plots.draw_height, circle()), tmp_path / "first")
    second = plots.save_figure(
        plots.flight_figure(plots.draw_height, circle()), tmp_path / "second"
    )
    assert [file.name for file in first] == ["first.png", "first.svg"]
    assert first[0].read_bytes()[:4] == b"\x89PNG"
    assert b"<svg" in first[1].read_bytes()
    for one, other in zip(first, second, strict=True):
        assert one.read_bytes() == other.read_bytes()


def test_leaves_the_users_matplotlib_settings_alone(tmp_path):
    import matplotlib

    before = dict(matplotlib.rcParams)
    plots.save_figure(plots.flight_figure(plots.draw_path, circle()), tmp_path / "path")
    assert dict(matplotlib.rcParams) == before


def test_missing_matplotlib_is_explained(monkeypatch):
    monkeypatch.setitem(sys.modules, "matplotlib.figure", None)
    with pytest.raises(ImportError, match=r'pip install "quad-gym\[plot\]"'):
        plots.flight_figure(plots.draw_path, circle())

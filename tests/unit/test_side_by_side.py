"""Flights side by side: what each half shows, when it stops, and words that do not cross."""

import itertools

import numpy as np
import pytest

from quad_gym.rendering import Side, SideBySide, colors, record_flight, save_side_by_side
from quad_gym.rendering.canvas import Canvas
from quad_gym.rendering.side_by_side import SIDE, _wrapped

pytest.importorskip("pygame")


class Still:
    """Commands the same all the time."""

    def __init__(self, thrust):
        self.thrust = thrust

    def predict(self, observation, state=None, episode_start=None, deterministic=True):
        return np.tile([self.thrust, 0.0, 0.0, 0.0], (len(observation), 1)), None


def side_of(task, steps, label="trained on truth", crashed=False, course=None):
    flight = record_flight(Still(0.0), f"QuadGym/{task}-v0", seed=1, max_episode_steps=steps)
    return Side(flight, label, "collision" if crashed else "time_limit", crashed, course)


@pytest.fixture(scope="module")
def sides():
    return [side_of("LookAround", 10, crashed=True), side_of("LookAround", 25, "trained on more")]


def has(frame, color):
    return bool((abs(frame.astype(int) - color) < 8).all(axis=-1).any())


def test_a_flight_that_is_over_stays_as_it_ended(sides):
    film = SideBySide(sides)
    assert film.end == sides[1].end > sides[0].end
    width = SIDE[0]
    early, first_end, last_end = (film.draw(t) for t in (0.1, sides[0].end, film.end))
    np.testing.assert_array_equal(first_end[:, :width], last_end[:, :width])
    assert (first_end[:, width:] != last_end[:, width:]).any()
    assert (early[:, :width] != first_end[:, :width]).any()
    assert film.draw(film.end).shape == (SIDE[1], 2 * width, 3)


@pytest.fixture
def written(monkeypatch):
    """All words that are drawn."""
    words = []
    write = Canvas.text
    monkeypatch.setattr(
        Canvas, "text", lambda self, text, *more: words.append(text) or write(self, text, *more)
    )
    return words


def test_words_say_how_a_flight_ended_once_it_is_over(sides, written):
    film = SideBySide(sides)
    film.draw(sides[0].end - 0.02)
    assert not any("crashed" in words for words in written)
    film.draw(film.end)
    assert f"crashed at {sides[0].end:.1f} s: collision" in written
    assert f"ended at {sides[1].end:.1f} s: time limit" in written
    assert {"trained on truth", "trained on more", f"{film.end:.1f} s"} <= set(written)
    words = next(words for words in reversed(written) if words.startswith("filter sigma "))
    last = sides[1].flight["covariance"][-1]
    sigma = max(last[k, k] ** 0.5 for k in range(3))
    assert words == f"filter sigma {100.0 * sigma:.1f} cm"


def test_truth_and_estimate_have_their_colors(sides):
    frame = SideBySide(sides).draw(0.1)
    scene = frame[130:320]
    for half in (scene[:, : SIDE[0]], scene[:, SIDE[0] :]):
        assert has(half, colors.BLUE)
        assert has(half, colors.VERMILLION)


def test_a_course_shows_progress_in_place_of_the_error_and_when_gnss_fails(written):
    side = side_of("OutageDash", 100, course=("gaps", 10))
    failing = side.flight["faults"] > 0
    assert failing.any()  # from a time within 2 to 8 s on
    film, first = SideBySide([side]), float(side.flight["time"][np.argmax(failing)])
    film.draw(first - 0.05)
    assert not any("fault" in words for words in written)
    film.draw(first)
    assert "fault: GNSS outage" in written
    assert any(words.startswith("0 of 10 gaps, ") for words in written)
    assert not any("position error" in words for words in written)


@pytest.mark.parametrize(
    ("task", "course"),
    [("LookAround", None), ("StaleRace", ("gates", 8)), ("OutageDash", ("gaps", 10))],
)
def test_no_words_cross_others(task, course, monkeypatch):
    label = "trained on estimate + standard deviation, reward for certainty"
    film = SideBySide([side_of(task, 25, label, crashed=True, course=course)])
    places = []
    write = Canvas.text

    def text(self, words, x, y, size, color=colors.INK, anchor=0.0):
        width = self.width_of(words, size)
        left = x - anchor * width
        if size > 15 or y < 0.0:  # not the labels of the scene, which lie where things are
            places.append((words, left, left + width, y, y + 0.6 * self.line_height(size)))
        return write(self, words, x, y, size, color, anchor)

    monkeypatch.setattr(Canvas, "text", text)
    film.draw(film.end)
    assert len(places) > 8
    for (a, *p), (b, *q) in itertools.combinations(places, 2):
        apart = p[1] <= q[0] or q[1] <= p[0] or p[3] <= q[2] or q[3] <= p[2]
        assert apart, f"{a!r} crosses {b!r}"
    assert all(left >= 0.0 and right <= SIDE[0] for _, left, right, *_ in places)


def test_long_labels_break_after_commas_or_else_between_words():
    canvas = Canvas(320, 240)
    assert _wrapped(canvas, "short", 19, 300.0) == ["short"]
    words = "estimate and standard deviation, reward for certainty"
    assert _wrapped(canvas, words, 19, 300.0) == [
        "estimate and standard deviation,",
        "reward for certainty",
    ]
    lines = _wrapped(canvas, words, 19, 150.0)
    assert " ".join(lines) == words
    assert max(canvas.width_of(line, 19) for line in lines) <= 150.0


def test_wrong_arguments_are_refused(sides, tmp_path):
    with pytest.raises(ValueError, match="sides must be at least one"):
        SideBySide([])
    blind = record_flight(Still(0.0), "QuadGym/Hover-v0", observation="truth", max_episode_steps=3)
    with pytest.raises(ValueError, match="sides must have an estimate, 'a' has none"):
        SideBySide([Side(blind, "a", "time_limit", False)])
    for wrong in ({"fps": 0.0}, {"speed": -1.0}):
        with pytest.raises(ValueError, match=next(iter(wrong))):
            save_side_by_side(sides, tmp_path / "film.webp", **wrong)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("kind", ["webp", "gif", "mp4"])
def test_all_kinds_of_film_are_written(kind, sides, tmp_path):
    pytest.importorskip("imageio_ffmpeg" if kind == "mp4" else "PIL")
    film = save_side_by_side(sides, tmp_path / f"new/film.{kind}", fps=10.0, speed=2.0)
    assert film.stat().st_size > 1000

"""Films of flights side by side: frames, ends, refused arguments and file formats."""

import numpy as np
import pytest

from quad_gym.rendering import Side, SideBySide, record_flight, save_side_by_side, video
from quad_gym.rendering.canvas import GREEN, VERMILLION
from quad_gym.rendering.video import LEGEND, SIDE
from tests.builders import Still

pytest.importorskip("pygame")


def side_of(task, steps, label="trained on truth", crashed=False):
    flight = record_flight(Still(), f"QuadGym/{task}-v0", seed=1, max_episode_steps=steps)
    return Side(flight, label, "collision" if crashed else "time_limit", crashed)


@pytest.fixture(scope="module")
def sides():
    return [side_of("LookAround", 10, crashed=True), side_of("LookAround", 25, "trained on more")]


def test_flight_that_has_ended_keeps_its_last_frame(sides):
    film = SideBySide(sides)
    assert film.end == sides[1].end > sides[0].end
    width = SIDE[0]
    early, first_end, last_end = (film.draw(t) for t in (0.1, sides[0].end, film.end))
    np.testing.assert_array_equal(first_end[:-LEGEND, :width], last_end[:-LEGEND, :width])
    assert (first_end[:, width:] != last_end[:, width:]).any()
    assert (early[:, :width] != first_end[:, :width]).any()
    assert film.draw(film.end).shape == (SIDE[1], 2 * width, 3)


def test_film_ends_soon_after_the_last_crash(sides, monkeypatch):
    monkeypatch.setattr(video, "AFTER", 0.1)
    film = SideBySide(sides, speed=2.0)
    assert film.end == pytest.approx(sides[0].end + 0.1)
    band = film.draw(film.end)[2, [5, SIDE[0] + 5]]
    np.testing.assert_array_equal(band, [VERMILLION, GREEN])  # crashed; flew on to its end
    unhurt = [side_of("LookAround", 10), sides[1]]
    assert SideBySide(unhurt).end == sides[1].end


def test_wrong_arguments_are_refused(sides, tmp_path):
    with pytest.raises(ValueError, match="sides must be at least one"):
        SideBySide([])
    for wrong in ({"fps": 0.0}, {"speed": -1.0}):
        with pytest.raises(ValueError, match=next(iter(wrong))):
            save_side_by_side(sides, tmp_path / "film.webp", **wrong)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("kind", ["webp", "gif", "mp4"])
def test_all_kinds_of_film_are_written(kind, sides, tmp_path):
    pytest.importorskip("imageio_ffmpeg" if kind == "mp4" else "PIL")
    film = save_side_by_side(sides, tmp_path / f"new/film.{kind}", fps=10.0, speed=2.0)
    assert film.stat().st_size > 1000

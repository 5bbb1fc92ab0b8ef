"""Films of a study: choice of policies and episode, and agreement with the test."""

import numpy as np
import pytest

from quad_gym.rendering.video import HOLD, SIDE
from scripts.studies import __main__ as command
from scripts.studies.films import RATE, pair_of, side_of
from tests.scripts.running import run

pytest.importorskip("pygame")
Image = pytest.importorskip("PIL.Image")
pytestmark = pytest.mark.slow  # a study of four trainings; frames are in test_side_by_side.py

DURATION = 0.6
QUICK = ["--quick", "--steps", "4096", "--env", f"duration={DURATION}", "--arms", "truth", "std"]


@pytest.fixture(scope="module")
def filmed(tmp_path_factory):
    """Return the folder of a tiny study with a film, and its command line."""
    folder = tmp_path_factory.mktemp("film")
    words = ["look_around", *QUICK, "--video", "webp", "--output", str(folder / "out")]
    run(words)
    return folder, words


def seconds_of(film):
    """Return the duration of a film [s]."""
    total = 0
    for k in range(film.n_frames):
        film.seek(k)
        film.load()
        total += film.info["duration"]
    return 1e-3 * total


def test_film_lasts_as_long_as_the_episode_and_loops(filmed):
    folder, _ = filmed
    with Image.open(folder / "out/film.webp") as film:
        pictures = int(np.ceil(DURATION * RATE)) + 1  # including the end
        assert film.n_frames == pictures
        assert film.size == (2 * SIDE[0], SIDE[1])
        assert film.info["loop"] == 0  # endless
        assert seconds_of(film) == pytest.approx((pictures + round(HOLD * RATE)) / RATE)


def test_film_shows_same_flights_as_evaluation(filmed):
    folder, _ = filmed
    study = command.configure(
        command.StudyArgs(
            "look_around",
            ("truth", "std"),
            quick=True,
            steps=4096,
            env={"duration": DURATION},
            output=folder / "out",
        )
    )
    results = study.results()
    for name, k in pair_of(results).trainings.items():
        for episode in (0, 7):
            side = side_of(results, name, k, episode)
            tested = results.flown[name][k]
            crashed, time = tested.episodes.crashed[episode], tested.recorded["time"]
            kept = tested.recorded["estimation_error"][:, episode]
            count = np.isfinite(kept).sum()
            assert len(side.flight) == count + crashed
            np.testing.assert_array_equal(side.flight["time"][:count], time[:count])
            np.testing.assert_array_equal(side.flight["estimation_error"][:count], kept[:count])
            assert side.crashed == crashed

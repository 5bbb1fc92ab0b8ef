"""Films of a study: choice of policies and episode, and agreement with the test."""

import numpy as np
import pytest

from quad_gym.commands import study as command
from quad_gym.commands.main import main
from quad_gym.experiments.arms import chosen_arms
from quad_gym.experiments.flown import Flown
from quad_gym.experiments.study import StudyResults
from quad_gym.experiments.study_films import RATE, pair_of, side_of
from quad_gym.experiments.study_tasks import STUDIED
from quad_gym.rendering.side_by_side import HOLD, SIDE
from tests.contract import test_study

pytest.importorskip("pygame")
Image = pytest.importorskip("PIL.Image")

DURATION = 0.6
QUICK = ["--quick", "--steps", "4096", "--env", f"duration={DURATION}", "--arms", "truth", "std"]


@pytest.fixture(scope="module")
def filmed(tmp_path_factory):
    """The folder of a tiny study with a film, and its words."""
    folder = tmp_path_factory.mktemp("film")
    words = ["study", "look_around", *QUICK, "--video", "webp", "--output", str(folder / "out")]
    assert main(words) == 0
    return folder, words


def seconds_of(film):
    """How long a film runs [s]."""
    total = 0
    for k in range(film.n_frames):
        film.seek(k)
        film.load()
        total += film.info["duration"]
    return 1e-3 * total


def test_film_lasts_as_long_as_the_episode_and_loops(filmed):
    folder, _ = filmed
    with Image.open(folder / "out/film.webp") as film:
        pictures = int(np.ceil(DURATION * RATE)) + 1  # the end among them
        assert film.n_frames == pictures
        assert film.size == (2 * SIDE[0], SIDE[1])
        assert film.info["loop"] == 0  # without end
        assert seconds_of(film) == pytest.approx((pictures + round(HOLD * RATE)) / RATE)


def test_film_shows_the_episode_of_the_test(filmed):
    folder, _ = filmed
    study = command.configure(
        command.StudyArgs(
            *("look_around", ("truth", "std")),
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


def study_of(task, names, tmp_path):
    arms = chosen_arms(STUDIED[task].arms, names)
    return test_study.study_of(task, arms, tmp_path, seeds=(0, 1, 2))


def flown(returns, crashed, traces):
    tested = test_study.flown(np.full(4, returns), crashed, 0.1)
    return Flown(tested.episodes, {**tested.recorded, **traces})


def curves(*tops):
    """Evaluations of three seeds with these largest returns."""
    steps = np.array([1.0, 2.0, 3.0])
    return [(steps, np.array([0.0, top, -1.0])) for top in tops]


def test_pace_shows_best_trainings_and_first_crash_on_truth(tmp_path):
    study = study_of("stale_race", ("truth", "std"), tmp_path)
    speed = {"speed": np.ones((2, 4))}
    crashes = [[True] * 4, [True] * 4, [False, False, True, True]]
    found = {
        "truth": [flown(1.0, each, speed) for each in crashes],
        "std": 3 * [flown(3.0, [True] * 4, speed)],
    }
    seen = {"truth": curves(5.0, 6.0, 7.0), "std": curves(2.0, 4.0, 3.0)}
    pair = pair_of(StudyResults(study, found, seen))
    assert pair.trainings == {"truth": 2, "std": 1}
    assert pair.episode == 2


def test_glance_shows_the_first_episode_with_a_far_heading(tmp_path):
    study = study_of("look_around", ("truth", "std"), tmp_path)
    off = np.radians([30.0, -99.0, 179.0, 150.0])
    traces = {"off_wall": np.tile(off, (2, 1)), "off_reward": np.zeros((2, 4))}
    traces["off_wall"][1, 0] = np.nan  # the episode has ended
    found = dict.fromkeys(("truth", "std"), 3 * [flown(1.0, [False] * 4, traces)])
    seen = dict.fromkeys(found, curves(1.0, 1.0, 0.0))
    pair = pair_of(StudyResults(study, found, seen))
    assert pair.trainings == {"truth": 0, "std": 0}
    assert pair.episode == 2

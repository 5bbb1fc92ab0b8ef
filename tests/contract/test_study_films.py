"""Films of a study: which policies and episode they show, and that they show what was tested."""

import sys
from functools import partial

import numpy as np
import pytest

from baselines.recipes import recipe
from quad_gym.commands import study as command
from quad_gym.commands.main import main
from quad_gym.experiments.study_films import RATE, side_of
from quad_gym.experiments.study_flights import Flown
from quad_gym.experiments.study_pair import pair_of
from quad_gym.experiments.study_results import Study
from quad_gym.experiments.study_tasks import STUDIED
from quad_gym.rendering.side_by_side import HOLD, SIDE

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


def test_a_film_lasts_as_long_as_the_episode_and_loops(filmed):
    folder, _ = filmed
    with Image.open(folder / "out/film.webp") as film:
        pictures = int(np.ceil(DURATION * RATE)) + 1  # the end among them
        assert film.n_frames == pictures
        assert film.size == (2 * SIDE[0], SIDE[1])
        assert film.info["loop"] == 0  # without end
        assert seconds_of(film) == pytest.approx((pictures + round(HOLD * RATE)) / RATE)


def test_report_shows_the_film(filmed):
    folder, _ = filmed
    report = (folder / "out/report.html").read_text()
    assert report.count("data:image/webp;base64,") == 1
    assert "training with the best validation" in report


def test_a_film_of_the_same_study_is_the_same(filmed):
    folder, words = filmed
    before = (folder / "out/film.webp").read_bytes()
    (folder / "out/film.webp").unlink()
    assert main(words) == 0
    assert (folder / "out/film.webp").read_bytes() == before


def test_a_film_shows_the_episode_of_the_test(filmed):
    folder, _ = filmed
    study = command.configure(
        command.Args(
            *("look_around", ("truth", "std")),
            quick=True,
            steps=4096,
            env={"duration": DURATION},
            output=folder / "out",
        )
    )
    results = study.results(command.fly_all(study), command.curves_of(study))
    for name, seed in pair_of(results).trainings.items():
        for episode in (0, 7):
            side = side_of(results, name, seed, episode, partial(command.test_flights, study))
            tested = results.flown[name, seed]
            kept = tested.traces["estimation_error"][:, episode]
            count = np.isfinite(kept).sum()
            assert len(side.flight) == count + tested.crashed[episode]
            np.testing.assert_array_equal(side.flight["time"][:count], tested.time[:count])
            np.testing.assert_array_equal(side.flight["estimation_error"][:count], kept[:count])
            assert side.crashed == tested.crashed[episode]


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--arms", "pd_features", "truth"], "--video needs the arm truth and another trained one"),
        (["--arms", "std", "estimate"], "--video needs the arm truth and another trained one"),
        (["--video", "avi"], "--video"),
    ],
)
def test_a_film_that_cannot_be_made_ends_the_study_before_it_begins(
    words, message, tmp_path, capsys
):
    with pytest.raises(SystemExit) as ended:
        main(["study", "--video", "webp", *words, "--output", str(tmp_path / "none")])
    assert ended.value.code == 2
    assert message in capsys.readouterr().err
    assert not (tmp_path / "none").exists()


@pytest.mark.parametrize(
    ("module", "kind", "message"),
    [
        ("pygame", "webp", "Rendering needs pygame"),
        ("PIL.Image", "webp", "videos need PIL.Image"),
        ("imageio_ffmpeg", "mp4", "videos need imageio_ffmpeg"),
    ],
)
def test_what_a_film_lacks_is_said_before_anything_is_trained(
    module, kind, message, tmp_path, capsys, monkeypatch
):
    monkeypatch.setitem(sys.modules, module, None)
    words = ["study", "--video", kind, "--output", str(tmp_path / "none")]
    with pytest.raises(SystemExit) as ended:
        main(words)
    assert ended.value.code == 2
    error = capsys.readouterr().err
    assert message in error
    assert 'pip install "quad-gym[render]"' in error
    assert not (tmp_path / "none").exists()
    assert command.configure(command.Args(output=tmp_path / "plain")).arms  # without a film


def study_of(task, env_id, names, tmp_path):
    arms = tuple(arm for arm in STUDIED[task].arms if arm.name in names)
    return Study(
        *(env_id, arms, (0, 1, 2), {"ppo": recipe(env_id)}),
        *({}, 4, 0, STUDIED[task], tmp_path, None),
    )


def flown(returns, crashed, traces):
    few = np.zeros(4)
    return Flown(
        *(np.full(4, returns), np.array(crashed), few, few, few, few.astype(int), few),
        *(np.zeros(2), traces),
    )


def curves(best):
    """Evaluations of three seeds with these largest returns."""
    steps = np.array([1.0, 2.0, 3.0])
    return {seed: (steps, np.array([0.0, top, -1.0])) for seed, top in enumerate(best)}


def test_races_show_the_best_validated_trainings_and_the_first_crash_on_truth(tmp_path):
    study = study_of("stale_race", "QuadGym/StaleRace-v0", ("truth", "estimate", "std"), tmp_path)
    speed = {"speed": np.ones((2, 4))}
    crashes = {0: [True] * 4, 1: [True] * 4, 2: [False, False, True, True]}
    found, seen = {}, {}
    for name, level, tops in (
        ("truth", 1.0, (5.0, 6.0, 7.0)),
        ("estimate", 2.0, (9.0, 1.0, 1.0)),
        ("std", 3.0, (2.0, 4.0, 3.0)),
    ):
        for seed, curve in curves(tops).items():
            found[name, seed] = flown(
                level, crashes[seed] if name == "truth" else [True] * 4, speed
            )
            seen[name, seed] = curve
    pair = pair_of(study.results(found, seen))
    assert pair.trainings == {"truth": 2, "std": 1}
    assert pair.episode == 2


def test_look_around_shows_the_first_episode_with_a_far_heading(tmp_path):
    study = study_of("look_around", "QuadGym/LookAround-v0", ("truth", "std"), tmp_path)
    off = np.radians([30.0, -99.0, 179.0, 150.0])
    traces = {"off_wall": np.tile(off, (2, 1)), "off_reward": np.zeros((2, 4))}
    traces["off_wall"][1, 0] = np.nan  # it ended there
    found = {
        (name, seed): flown(1.0, [False] * 4, traces)
        for name in ("truth", "std")
        for seed in range(3)
    }
    seen = {key: curves((1.0, 1.0, 0.0))[key[1]] for key in found}
    pair = pair_of(study.results(found, seen))
    assert pair.trainings == {"truth": 0, "std": 0}
    assert pair.episode == 2


def test_without_truth_there_is_no_pair(tmp_path):
    study = study_of("look_around", "QuadGym/LookAround-v0", ("std",), tmp_path)
    found = {("std", seed): flown(1.0, [False] * 4, {}) for seed in range(3)}
    assert pair_of(study.results(found, {})) is None

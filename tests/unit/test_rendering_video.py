"""Videos of flights, and the content of their frames."""

import numpy as np
import pytest

import quad_gym
from quad_gym.faults import GnssOutliers
from quad_gym.records import GateDecision
from quad_gym.rendering import Renderer, canvas, record_flight, save_video, tile
from quad_gym.rendering.scene import inset_box, last_image, place_in_inset
from tests.builders import Still

pygame = pytest.importorskip("pygame")


@pytest.fixture(scope="module")
def flight():
    return record_flight(Still(), "QuadGym/Hover-v0", seed=1, max_episode_steps=30)


def color_near(frame, at, radius, color, tolerance=40):
    """Return true if a color occurs within `radius` of a pixel."""
    x, y = np.round(at).astype(int)
    part = frame[max(y - radius, 0) : y + radius + 1, max(x - radius, 0) : x + radius + 1]
    return bool((abs(part.astype(int) - color) < tolerance).all(axis=-1).any())


def test_features_and_reference_are_drawn_where_they_project(flight):
    renderer = Renderer("fixed", (640, 480))
    frame, view = renderer.draw(flight), renderer._view_of(flight)
    for feature in flight.scene.features_I:
        assert color_near(frame, view.project(feature)[0], 5, canvas.INK, 90)  # perhaps an outline
    assert color_near(frame, view.project(flight["position"][-1])[0], 25, canvas.BLUE)
    start = record_flight(Still(), "QuadGym/Circle-v0", max_episode_steps=1)  # 1 m too low
    renderer = Renderer("fixed", (640, 480))
    frame = renderer.draw(start)
    at = renderer._view_of(start).project(start["reference_position"][-1])[0]
    assert color_near(frame, at, 8, canvas.GREEN)


@pytest.mark.parametrize("task", ["Circle", "Trajectory"])
@pytest.mark.parametrize("size", [(320, 240), (480, 360), (640, 480)])
def test_the_legend_hides_nothing_of_the_reference(task, size):
    options = {"max_episode_steps": 1, "about": {"policy": "pd"}}
    flight = record_flight(Still(), f"QuadGym/{task}-v0", **options)
    scene, shown, plain = flight.scene, Renderer("fixed", size), Renderer("fixed", size)
    reference = scene.reference(np.linspace(0.0, scene.reference_period, 200))
    pixels = shown._view_of(flight).project(reference)[0]
    plain._write_legend = lambda flight: None
    rows = np.flatnonzero((shown.draw(flight) != plain.draw(flight)).any(axis=(1, 2)))
    assert (pixels > (0.0, rows.max())).all()
    assert (pixels < size).all()


def test_a_film_shows_the_whole_path_and_loses_only_a_vehicle_that_goes_astray(flight):
    away = flight["position"].copy()
    away[:, 0] += np.linspace(0.0, 2.9, len(away))
    view = Renderer("fixed", (640, 480), path_I=away)._view_of(flight)
    pixels = view.project(away)[0]
    assert ((pixels > 0.0) & (pixels < (640.0, 480.0))).all()
    cut = Renderer("fixed", (640, 480))._view_of(flight).project(away)[0]
    assert not ((cut > 0.0) & (cut < (640.0, 480.0))).all()
    away[-1] = 1e6
    far = Renderer("fixed", (640, 480), path_I=away)._view_of(flight)
    away[-1] = np.nan
    assert np.linalg.norm(far.eye) < 3.0 * np.linalg.norm(view.eye)
    assert np.isfinite(Renderer("fixed", (640, 480), path_I=away)._view_of(flight).eye).all()


def test_the_inset_is_drawn_where_the_camera_measured(flight):
    frame = Renderer("fixed", (640, 480)).draw(flight)
    box = inset_box(flight.scene, 632.0, 8.0, 0.27 * 640)
    seen = flight["pixels"][-1][np.isfinite(flight["pixels"][-1]).all(axis=1)]
    assert len(seen)
    for pixel in seen:
        assert color_near(frame, place_in_inset(pixel, flight.scene, box), 2, canvas.INK)


def test_an_image_is_shown_until_the_next_one_is_due():
    suite = quad_gym.sensor_suite("standard").with_rates(camera=10.0)
    options = {"sensors": suite, "max_episode_steps": 30}
    flight = record_flight(Still(), "QuadGym/Hover-v0", seed=2, **options)
    images = np.flatnonzero(np.isfinite(flight["pixels"]).all(axis=(1, 2)))
    np.testing.assert_array_equal(images, np.arange(0, 31, 5))
    for k in range(31):
        shown = last_image(flight.until(flight["time"][k]))
        assert shown["time"] == flight["time"][k - k % 5]


def test_rejected_fix_is_drawn_in_gray():
    faults = GnssOutliers(share=1.0, size=100.0, start=0.3)
    options = {"sensors": "rtk", "faults": faults, "max_episode_steps": 30}
    flight = record_flight(Still(), "QuadGym/Hover-v0", seed=1, **options)
    view = Renderer("fixed", (640, 480))._view_of(flight)
    measured = np.flatnonzero(np.isfinite(flight["gnss_position"][:, 0]))
    decisions = flight["gnss_decision"][measured[[2, -1]], 0].tolist()
    assert decisions == [GateDecision.ACCEPTED, GateDecision.REJECTED]
    for k, is_purple in ((measured[2], True), (measured[-1], False)):
        frame = Renderer("fixed", (640, 480)).draw(flight.until(flight["time"][k]))
        at = view.project(flight["gnss_position"][k])[0]
        assert color_near(frame, at, 8, canvas.PURPLE) == is_purple
        assert color_near(frame, at, 3, canvas.GREY) or is_purple


def test_replayed_frames_equal_live_frames(flight):
    import gymnasium

    for view in ("fixed", "chase"):
        made = {"render_mode": "rgb_array", "render_view": view, "max_episode_steps": 30}
        env = gymnasium.make_vec("QuadGym/Hover-v0", num_envs=1, **made)
        env.reset(seed=1)
        replayed = Renderer(view)
        for k in range(30):
            (live,) = env.render()
            time = flight["time"][k]
            np.testing.assert_array_equal(replayed.draw(flight.until(time)), live)
            env.step(np.zeros((1, 4)))


def test_tiles_fill_a_grid():
    frames = [np.full((2, 3, 3), k, np.uint8) for k in range(5)]
    sheet = tile(frames)
    assert sheet.shape == (4, 9, 3)
    assert (sheet[:2, 3:6] == 1).all()
    assert (sheet[2:, 3:6] == 4).all()
    assert (sheet[2:, 6:] == 255).all()
    with pytest.raises(ValueError, match="frames must be at least one"):
        tile([])


def test_an_mp4_has_the_frames_of_the_flight(flight, tmp_path):
    imageio_ffmpeg = pytest.importorskip("imageio_ffmpeg")
    file = save_video(flight, tmp_path / "new" / "hover.mp4", size=(320, 240), fps=20.0)
    reader = imageio_ffmpeg.read_frames(str(file))
    about = next(reader)
    frames = [np.frombuffer(raw, np.uint8).reshape(240, 320, 3) for raw in reader]
    assert about["size"] == (320, 240)
    assert about["fps"] == pytest.approx(20.0)
    assert len(frames) == round(20.0 * flight["time"][-1]) + 1
    drawn = Renderer("fixed", (320, 240)).draw(flight)
    assert abs(frames[-1].astype(int) - drawn).mean() < 6.0  # compression is lossy


@pytest.mark.parametrize("ending", ["gif", "webp"])
def test_animations_have_the_frames_of_the_flight(flight, tmp_path, ending):
    image = pytest.importorskip("PIL.Image")
    file = save_video(flight, tmp_path / f"hover.{ending}", size=(320, 240), fps=10.0, speed=0.5)
    with image.open(file) as picture:
        assert picture.n_frames == round(10.0 * flight["time"][-1] / 0.5) + 1
        assert picture.size == (320, 240)
        picture.seek(picture.n_frames - 1)
        last = np.asarray(picture.convert("RGB")).astype(int)
    assert abs(last - Renderer("fixed", (320, 240)).draw(flight)).mean() < 6.0


@pytest.mark.parametrize(("ending", "unit"), [("gif", 10), ("webp", 1)])
def test_animation_keeps_time_where_its_pictures_last_no_whole_units(
    flight, tmp_path, ending, unit
):
    image = pytest.importorskip("PIL.Image")
    file = save_video(flight, tmp_path / f"hover.{ending}", size=(320, 240), fps=30.0)
    lasting = 0
    with image.open(file) as picture:
        for k in range(picture.n_frames):
            picture.seek(k)
            picture.load()
            lasting += picture.info["duration"]
        assert abs(lasting - 1000.0 / 30.0 * picture.n_frames) <= unit


@pytest.mark.parametrize("ending", ["mp4", "gif", "webp"])
def test_interrupted_video_leaves_an_earlier_file_unchanged(flight, tmp_path, ending):
    def interrupted(times):
        for k, time in enumerate(times):
            if k == 3:
                raise KeyboardInterrupt
            yield time

    file = tmp_path / f"hover.{ending}"
    for before in (None, b"an earlier video"):
        if before is not None:
            file.write_bytes(before)
        with pytest.raises(KeyboardInterrupt):
            save_video(flight, file, size=(320, 240), fps=10.0, progress=interrupted)
        assert {f.name: f.read_bytes() for f in tmp_path.iterdir()} == (
            {} if before is None else {file.name: before}
        )


@pytest.mark.parametrize(
    ("name", "keywords"),
    [
        ("ending", {"path": "hover.avi"}),
        ("fps", {"fps": 0.0}),
        ("fps must be at most 50 for a .gif video, got 60", {"fps": 60.0}),
        ("fps must be a number", {"fps": "25"}),
        ("speed", {"speed": -1.0}),
        ("speed must be at least .* has 1,000,000 frames, got 1e-09", {"speed": 1e-9}),
        ("speed must be at least .* has 1,000,000 frames", {"fps": 1e12, "path": "hover.mp4"}),
        ("render_view", {"view": "top"}),
        ("render_size", {"size": (321, 240)}),
    ],
)
def test_invalid_video_options_are_refused_before_writing(flight, tmp_path, name, keywords):
    path = tmp_path / "folder" / keywords.pop("path", "hover.gif")
    with pytest.raises(ValueError, match=name):
        save_video(flight, path, **keywords)
    assert not path.parent.exists()

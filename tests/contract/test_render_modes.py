"""Every interface renders as Gymnasium specifies, and rendering does not change a flight."""

import copy
import pickle
import sys

import gymnasium
import numpy as np
import pytest
from gymnasium.wrappers import RecordVideo

import quad_gym
from quad_gym.envs.single import QuadEnv
from quad_gym.envs.vector import QuadVectorEnv
from tests.builders import actions_of, run_python, vec_env
from tests.contract.comparing import IDS, assert_same, state_of

pytest.importorskip("pygame")

SMALL = {"render_size": (320, 240)}
VIEWS = ("fixed", "chase")


def flown(env, steps=3, seed=0):
    env.reset(seed=seed)
    for action in actions_of(seed, steps):
        env.step(action)
    return env


@pytest.mark.parametrize(
    ("env_id", "view"), [(env_id, VIEWS[k % 2]) for k, env_id in enumerate(IDS)]
)
def test_every_task_has_frames(env_id, view):
    env = flown(gymnasium.make(env_id, render_mode="rgb_array", render_view=view))
    frame = env.render()
    assert frame.shape == (480, 640, 3)
    assert frame.dtype == np.uint8
    colors = frame.astype(int) @ [65536, 256, 1]
    assert len(np.unique(colors)) > 100  # the picture is not blank
    assert not np.array_equal(frame[:, ::-1], frame)
    np.testing.assert_array_equal(frame, env.render())
    env.step(np.zeros(4, np.float32))
    assert (frame != env.render()).any()


def test_metadata_has_render_modes_and_frame_rate():
    assert QuadEnv.metadata["render_modes"] == ["human", "rgb_array", "rgb_array_list"]
    env = QuadEnv("hover", control_rate=100.0, render_mode="rgb_array")
    assert env.metadata["render_fps"] == 100
    assert QuadEnv.metadata["render_fps"] == 50
    vector = QuadVectorEnv(2, "hover")
    assert vector.metadata["render_modes"] == QuadEnv.metadata["render_modes"]


def test_frame_list_has_all_frames_since_last_render():
    env = QuadEnv("hover", render_mode="rgb_array_list", **SMALL)
    one = QuadEnv("hover", render_mode="rgb_array", **SMALL)
    env.reset(seed=1), one.reset(seed=1)
    expected = [one.render()]
    for action in actions_of(1, 3):
        env.step(action), one.step(action)
        expected.append(one.render())
    assert_same(env.render(), expected)
    assert env.render() == []
    env.step(np.zeros(4)), env.reset()
    assert len(env.render()) == 1


def test_without_a_render_mode_there_is_a_warning_and_no_frame(capfd):
    env = flown(QuadEnv("hover"))
    with pytest.warns(UserWarning, match="render_mode"):
        assert env.render() is None


def test_render_before_reset_raises_reset_needed():
    for env in (
        QuadEnv("hover", render_mode="rgb_array"),
        QuadVectorEnv(2, "hover", render_mode="rgb_array"),
    ):
        with pytest.raises(gymnasium.error.ResetNeeded, match="reset"):
            env.render()


WRONG = [("render_mode", "ansi"), ("render_view", "side")]
WRONG += [("render_size", size) for size in ((10, 10), (641, 480), 640, (640.5, 480))]


@pytest.mark.parametrize(("name", "value"), WRONG)
def test_invalid_rendering_option_is_refused_by_name(name, value):
    keywords = {"render_mode": "rgb_array", name: value}
    for make in (QuadEnv, lambda task, **more: QuadVectorEnv(2, task, **more)):
        with pytest.raises(ValueError, match=name):
            make("hover", **keywords)
    for flights in ((2,), (-1,), (), (0.5,)):
        with pytest.raises(ValueError, match="flight"):
            QuadVectorEnv(2, "hover", render_mode="rgb_array", render_flights=flights)


@pytest.mark.parametrize(
    ("name", "value"),
    [("render_view", "chase"), ("render_size", (320, 240)), ("render_flights", (0,))],
)
def test_rendering_options_need_a_mode(name, value):
    single = "gymnasium.make_vec takes it" if name == "render_flights" else "needs a render_mode"
    with pytest.raises(ValueError, match=f"{name} .*{single}|{name} {single}"):
        QuadEnv("hover", **{name: value})
    with pytest.raises(ValueError, match=f"{name} needs a render_mode"):
        QuadVectorEnv(2, "hover", **{name: value})


@pytest.mark.parametrize("env_id", IDS)
def test_rendering_never_changes_a_flight(env_id):
    plain = gymnasium.make(env_id)
    rendered = gymnasium.make(env_id, render_mode="rgb_array_list", **SMALL)
    assert_same(plain.reset(seed=3), rendered.reset(seed=3))
    for action in actions_of(3, 20):
        assert_same(plain.step(action), rendered.step(action))
        rendered.render()
    assert state_of(plain) == state_of(rendered)


def test_vector_environment_renders_same_frames_as_single_ones():
    env = vec_env("circle", 4, seed=5, render_mode="rgb_array", render_flights=(3, 0), **SMALL)
    plain = vec_env("circle", 4, seed=5)
    ones = [QuadEnv("circle", render_mode="rgb_array", **SMALL) for _ in range(2)]
    for one, seed in zip(ones, (8, 5), strict=True):
        one.reset(seed=seed)
    for action in actions_of(0, 5):
        for each in (env, plain):
            each.step(np.tile(action, (4, 1)))
        for one in ones:
            one.step(action)
        assert_same(list(env.render()), [one.render() for one in ones])
    assert state_of(env) == state_of(plain)


def test_a_new_episode_begins_a_new_trail():
    env = vec_env(count=1, seed=0, render_mode="rgb_array", max_episode_steps=5, **SMALL)
    lengths = []
    for _ in range(8):
        env.step(np.zeros((1, 4)))
        lengths.append(len(env.rendering.flights[0]))
    assert lengths == [2, 3, 4, 5, 6, 1, 2, 3]


def test_picture_after_a_restored_snapshot_shows_its_instant():
    env, fresh = (vec_env(count=1, render_mode="rgb_array", **SMALL) for _ in range(2))
    env.reset(seed=0)
    for _ in range(4):
        env.step(np.ones((1, 4)))
    (shown,), instant = env.render(), env.flights.batch.snapshot()
    for _ in range(4):
        env.step(np.ones((1, 4)))
    assert (env.render()[0] != shown).any()
    env.flights.batch.restore(instant)
    np.testing.assert_array_equal(env.render()[0], shown)
    fresh.flights.batch.restore(instant)
    assert fresh.render()[0].shape == shown.shape  # without the trail, which was flown elsewhere
    assert len(fresh.rendering.flights[0]) == 1
    np.testing.assert_array_equal(
        fresh.rendering.flights[0]["position"][-1], env.rendering.flights[0]["position"][-1]
    )


def test_stable_baselines_gets_one_picture_of_all_tiles():
    env = quad_gym.make_sb3_vec_env("QuadGym/Hover-v0", 4, 0, render_mode="rgb_array", **SMALL)
    env.reset()
    assert env.render().shape == (480, 640, 3)
    assert [image.shape for image in env.get_images()] == [(240, 320, 3)] * 4
    env.close()
    with pytest.raises(ValueError, match="render_mode"):
        quad_gym.make_sb3_vec_env("QuadGym/Hover-v0", 4, 0, render_mode="rgb_array_list")


def test_gymnasium_records_videos(tmp_path):
    pytest.importorskip("moviepy")
    made = {"render_mode": "rgb_array", "max_episode_steps": 5, **SMALL}
    single = gymnasium.make("QuadGym/Hover-v0", **made)
    vector = gymnasium.make_vec("QuadGym/Hover-v0", num_envs=2, **made)
    recorders = (RecordVideo, gymnasium.wrappers.vector.RecordVideo)
    for k, (env, recorder) in enumerate(zip((single, vector), recorders, strict=True)):
        env = recorder(env, str(tmp_path / f"{k}"), disable_logger=True)
        env.reset(seed=0)
        for _ in range(5):
            env.step(np.zeros(env.action_space.shape))
        env.close()
        (video,) = (tmp_path / f"{k}").glob("*.mp4")
        assert video.stat().st_size > 2000


def run_code(code, **environment):
    """Run code in a process without a display."""
    hidden = dict.fromkeys(("DISPLAY", "WAYLAND_DISPLAY", "SDL_VIDEODRIVER"))
    return run_python("-c", code, **hidden | environment)


def test_pygame_is_imported_at_the_first_drawing():
    """Environment variables do not change, either."""
    done = run_code(
        """
import os, sys, gymnasium, numpy as np, quad_gym
from quad_gym.flights import FlightRecorder
import quad_gym.rendering
env = gymnasium.make("QuadGym/Hover-v0")
env.reset(seed=0), env.step(np.zeros(4, np.float32))
assert "pygame" not in sys.modules
before = dict(os.environ)
env = gymnasium.make("QuadGym/Hover-v0", render_mode="rgb_array")
env.reset(seed=0), env.step(np.zeros(4, np.float32))
assert "pygame" not in sys.modules
assert env.render().shape == (480, 640, 3)
env.close(), env.close()
import pygame
assert not pygame.display.get_init() and not pygame.mixer.get_init()
assert not pygame.joystick.get_init()
assert dict(os.environ) == before
"""
    )
    assert (done.returncode, done.stdout) == (0, ""), done.stderr


def test_rendering_without_pygame_raises_a_hint():
    """Stable-Baselines3 requests "rgb_array" for every environment that it makes from an id."""
    done = run_code(
        """
import sys
sys.modules["pygame"] = None
import gymnasium, numpy as np, quad_gym
made = dict(render_mode="rgb_array", observation="truth")
env = gymnasium.make("QuadGym/Hover-v0", **made)
vector = gymnasium.make_vec("QuadGym/Hover-v0", num_envs=2, **made)
env.reset(seed=0), env.step(np.zeros(4)), vector.reset(seed=0), vector.step(np.zeros((2, 4)))
try:
    gymnasium.make("QuadGym/Hover-v0", render_mode="rgb_array", render_view="side")
except ValueError as error:
    print(error)
for e in (env, vector):
    try:
        e.render()
    except ImportError as error:
        print(error)
"""
    )
    assert "render_view must be one of" in done.stdout, done.stderr
    assert done.stdout.count('pip install "quad-gym[render]"') == 2


def test_a_window_shows_the_flight_and_closes_twice():
    done = run_code(
        """
import numpy as np, pygame
from tests.builders import single_env
env = single_env(seed=0, observation="truth", render_mode="human", render_size=(320, 240))
for _ in range(3):
    env.step(np.zeros(4))
assert env.render() is None
assert pygame.display.get_surface().get_size() == (320, 240)
env.close(), env.close()
assert not pygame.display.get_init()
""",
        SDL_VIDEODRIVER="dummy",
    )
    assert done.returncode == 0, done.stderr


OPEN_A_WINDOW = """
from quad_gym.envs.single import QuadEnv
env = QuadEnv("hover", observation="truth", render_mode="human")
try:
    env.reset(seed=0)
except RuntimeError as error:
    print(error)
"""


@pytest.mark.skipif(sys.platform != "linux", reason="other systems always have a display")
@pytest.mark.parametrize("variables", [{}, {"SDL_VIDEODRIVER": "x11"}])
def test_window_without_a_display_is_refused(variables):
    """SDL silently falls back to a driver without a display, and flights would not end."""
    done = run_code(OPEN_A_WINDOW, **variables)
    assert "cannot open a window: " in done.stdout, done.stderr
    assert 'render_mode="rgb_array"' in done.stdout
    assert "SDL_VIDEODRIVER=dummy" in done.stdout


def test_environments_that_render_can_be_copied():
    env = flown(QuadEnv("hover", render_mode="rgb_array", **SMALL))
    frame = env.render()
    for twin in (copy.deepcopy(env), pickle.loads(pickle.dumps(env))):
        np.testing.assert_array_equal(twin.render(), frame)
        assert_same(twin.step(np.zeros(4)), copy.deepcopy(env).step(np.zeros(4)))

"""Words in pictures: the wording that fits, and none across another."""

import dataclasses
import itertools

import gymnasium
import numpy as np
import pytest

import quad_gym
from baselines.pd import PDPolicy
from quad_gym.rendering import Renderer, record_flight
from quad_gym.rendering.canvas import Canvas


def test_the_first_wording_that_fits_is_chosen():
    canvas = Canvas(320, 240)
    long, short = "camera: no feature in view", "no feature"
    width = canvas.width_of(long, 16)
    assert canvas.fitting((long, short), 16, width) == long
    assert canvas.fitting((long, short), 16, width - 1) == short
    assert canvas.fitting((long, short), 16, 1.0) == short


@pytest.mark.parametrize(
    ("policy", "words"),
    [("pd", "flown by pd"), ("results/circle/ppo_seed_0/best.zip", "flown by ppo_seed_0/best")],
)
def test_the_legend_names_the_policy(monkeypatch, policy, words):
    flight = record_flight(
        PDPolicy(gymnasium.make_vec("QuadGym/Hover-v0", num_envs=1)),
        "QuadGym/Hover-v0",
        about={"policy": policy},
        max_episode_steps=2,
    )
    written, write = [], Canvas.text

    def text(self, words, x, y, *more):
        written.append((words, y))
        return write(self, words, x, y, *more)

    monkeypatch.setattr(Canvas, "text", text)
    named = Renderer().draw(flight)
    places = dict(written)
    assert places["hover on the estimate"] < places[words] < places["truth"]
    plain = Renderer().draw(dataclasses.replace(flight, about={}))
    assert named.shape == plain.shape
    assert (named != plain).any()


@pytest.mark.parametrize("size", [(320, 240), (480, 270), (640, 480), (1280, 720)])
@pytest.mark.parametrize("task", ["circle", "waypoints"])
def test_no_words_of_the_strip_cross_others(monkeypatch, size, task):
    written = []

    def text(self, words, x, y, size, color=(0, 0, 0), anchor=0.0):
        width = self.width_of(words, size)
        left = x - anchor * width
        written.append((words, left, left + width, y, y + 0.6 * self.line_height(size)))
        return width

    monkeypatch.setattr(Canvas, "text", text)
    env = quad_gym.QuadEnv(task, render_mode="rgb_array", render_size=size)
    env.reset(seed=0)
    for _ in range(30):
        env.step(np.zeros(4, np.float32))
    env.render()
    strip = [entry for entry in written if entry[3] > 0.765 * size[1] and entry[0]]
    assert len(strip) > 10
    for a, b in itertools.combinations(strip, 2):
        apart = a[2] <= b[1] or b[2] <= a[1] or a[4] <= b[3] or b[4] <= a[3]
        assert apart, (a, b)
    assert all(left >= 0.0 and right <= size[0] for _, left, right, _, _ in strip), strip

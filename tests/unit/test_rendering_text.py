"""Words in pictures: the wording that fits, and none across another."""

import itertools

import numpy as np
import pytest

import quad_gym
from quad_gym.rendering.canvas import Canvas


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

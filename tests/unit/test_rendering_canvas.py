"""Canvas: pictures with a stored background equal those that are drawn and halved as a whole."""

import numpy as np
import pytest

from quad_gym.rendering.canvas import BLUE, GREEN, INK, SKY, VERMILLION, Canvas

pytest.importorskip("pygame")

SIZES = [(320, 240), (642, 482)]  # the second one is no multiple of a tile


def draw_background(canvas):
    canvas.clear(SKY)
    canvas.line(np.array([[-30.0, 5.0], [700.0, 470.0]]), INK, 3.0)


def draw_foreground(canvas, rng):
    """Draw one of everything at random places, some of them outside."""

    def places(count):
        return rng.uniform(-40.0, 40.0, (count, 2)) + rng.uniform(0.0, 640.0, 2)

    canvas.line(places(5), BLUE, 2.6)
    canvas.segments(places(6).reshape(3, 2, 2), GREEN)
    canvas.dashes(places(3), INK)
    canvas.polygon(places(5), VERMILLION, 0.3)
    canvas.polygon(places(4), BLUE)
    canvas.disc(places(1)[0], 9.0, GREEN, 2.0)
    canvas.crosses(places(3), 4.0, VERMILLION)
    canvas.inside((50.5, 40.0, 61.0, 33.0))
    canvas.box(45.0, 30.0, 90.0, 90.0, BLUE, 2.0)
    canvas.inside(None)
    canvas.box(*places(1)[0], 17.0, 9.0, INK)


@pytest.mark.parametrize("size", SIZES)
def test_pictures_on_a_stored_background_equal_pictures_drawn_as_a_whole(size):
    with_background = Canvas(*size)
    draw_background(with_background)
    with_background.keep_background()
    for k in range(30):
        with_background.show_background()
        draw_foreground(with_background, np.random.default_rng(k))
        with_background.finish()
        with_background.text(f"picture {k}", 7.0, 9.0, 14)

        whole = Canvas(*size)
        draw_background(whole)
        draw_foreground(whole, np.random.default_rng(k))
        large = np.array(whole._pygame.surfarray.pixels3d(whole._large), float).swapaxes(0, 1)
        whole.finish()
        whole.text(f"picture {k}", 7.0, 9.0, 14)
        np.testing.assert_array_equal(with_background.pixels(), whole.pixels())

        # below the text each pixel is the mean of the four that it was drawn from
        mean = large.reshape(size[1], 2, size[0], 2, 3).mean(axis=(1, 3))
        assert abs(whole.pixels() - mean)[40:].max() <= 2.0

"""Pictures are readable with any kind of color vision: contrast, and differences of colors."""

from itertools import combinations

import numpy as np
import pytest

from quad_gym.rendering import canvas

BACKGROUNDS = {"white": canvas.WHITE, "sky": canvas.SKY, "ground": canvas.GROUND}
TEXT = {name: getattr(canvas, name) for name in ("INK", "BLUE", "VERMILLION", "GREY")}
THINGS = {
    "reference": canvas.GREEN,
    "truth": canvas.BLUE,
    "estimate": canvas.VERMILLION,
    "fix": canvas.PURPLE,
    "ray": canvas.LIGHT_BLUE,
}

# G. M. Machado, M. M. Oliveira, L. A. F. Fernandes, A physiologically-based model for simulation of
# color vision deficiency, IEEE Trans. Visualization and Computer Graphics 15(6), 2009: severity 1
VISIONS = {
    "all cones": np.eye(3),
    "protanopia": [
        [0.152286, 1.052583, -0.204868],
        [0.114503, 0.786281, 0.099216],
        [-0.003882, -0.048116, 1.051998],
    ],
    "deuteranopia": [
        [0.367322, 0.860646, -0.227968],
        [0.280085, 0.672501, 0.047413],
        [-0.011820, 0.042940, 0.968881],
    ],
    "tritanopia": [
        [1.255528, -0.076749, -0.178779],
        [-0.078411, 0.930809, 0.147602],
        [0.004733, 0.691367, 0.303900],
    ],
}


def linear(color):
    """Linear light of an sRGB color (IEC 61966-2-1)."""
    c = np.array(color) / 255.0
    return np.where(c <= 0.04045, c / 12.92, ((c + 0.055) / 1.055) ** 2.4)


def contrast(a, b):
    """Contrast ratio of WCAG 2.1."""
    low, high = sorted(linear(c) @ (0.2126, 0.7152, 0.0722) + 0.05 for c in (a, b))
    return high / low


def lab(light):
    """CIE L*a*b* of linear light, D65."""
    to_xyz = [[0.4124, 0.3576, 0.1805], [0.2126, 0.7152, 0.0722], [0.0193, 0.1192, 0.9505]]
    t = np.array(to_xyz) @ np.clip(light, 0.0, 1.0) / (0.9505, 1.0, 1.089)
    f = np.where(t > (6 / 29) ** 3, np.cbrt(t), t / (3 * (6 / 29) ** 2) + 4 / 29)
    return np.array([116 * f[1] - 16, 500 * (f[0] - f[1]), 200 * (f[1] - f[2])])


@pytest.mark.parametrize("name", TEXT)
def test_text_has_sufficient_contrast_to_white(name):
    assert contrast(TEXT[name], canvas.WHITE) >= 4.5  # WCAG 2.1, level AA


@pytest.mark.parametrize("background", BACKGROUNDS)
@pytest.mark.parametrize("name", [name for name in THINGS if name != "ray"])
def test_graphical_objects_have_sufficient_contrast_to_each_background(name, background):
    assert contrast(THINGS[name], BACKGROUNDS[background]) >= 3.0  # WCAG 2.1, graphical objects


@pytest.mark.parametrize("vision", VISIONS)
@pytest.mark.parametrize("pair", list(combinations(THINGS, 2)), ids=" ".join)
def test_colors_of_objects_differ_for_every_kind_of_color_vision(pair, vision):
    a, b = (lab(VISIONS[vision] @ linear(THINGS[name])) for name in pair)
    assert np.linalg.norm(a - b) > 18.0  # a just noticeable difference is 2.3

"""Canvas with smooth lines, translucent areas and text, on pygame's software surfaces.

No window, display or audio device is opened, and no environment variable is needed or set: a
surface is memory. Lines and areas are drawn at twice their size and then halved for anti-aliasing;
text is drawn at four times its size, which spaces letters evenly.
"""

import contextlib
import io
import math
from collections.abc import Callable, Iterator, Sequence
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from quad_gym.params import checks as check

# --------------------------------------------------------------------------------------------------
# Colors, based on the palette of Okabe and Ito.
#
# People with a color vision deficiency can distinguish them; they are darker, for contrast on a
# pale ground, and shifted to remain distinct.
# --------------------------------------------------------------------------------------------------

Color = tuple[int, int, int]  #: red, green and blue, from 0 to 255

WHITE: Color = (255, 255, 255)
SKY: Color = (250, 251, 253)
GROUND: Color = (236, 239, 243)
GRID: Color = (206, 211, 218)
PALE: Color = (221, 221, 221)
GREY: Color = (118, 118, 118)
INK: Color = (34, 34, 34)
BLUE: Color = (0, 95, 165)
LIGHT_BLUE: Color = (86, 180, 233)
VERMILLION: Color = (198, 81, 0)
GREEN: Color = (0, 145, 80)
PURPLE: Color = (190, 90, 150)
PALE_PURPLE: Color = (218, 176, 204)


# --------------------------------------------------------------------------------------------------
# Canvas with smooth lines, translucent areas and text, on pygame's software surfaces.
# --------------------------------------------------------------------------------------------------

Floats = NDArray[np.float64]
Label = tuple[str, Floats, Color]  #: text, its place (2,) [pixels], and its color
Mark = tuple[Literal["line", "cross", "box"], Color]  #: shape and color of a part in a legend

OVERSAMPLING, TEXT_OVERSAMPLING = 2, 4
TILE = 32  #: side of the tiles that are halved and restored where something was drawn [pixels]
_RGBX = (0xFF, 0xFF00, 0xFF0000, 0)
_RGBA = (0xFF, 0xFF00, 0xFF0000, 0xFF000000)
"""Bytes of a pixel in memory: red, green, blue, and an unused one, or the opacity. Pygame blends
surfaces thirty times as fast if their bytes have the same order."""
_CROSS = np.array([[[-1.0, -1.0], [1.0, 1.0]], [[-1.0, 1.0], [1.0, -1.0]]])
_FAR = 20000.0  #: limit of coordinates [pixels]: pygame's integers overflow


def load_pygame() -> Any:
    """Import pygame without its greeting, or raise an ImportError."""
    with contextlib.redirect_stdout(io.StringIO()):
        pygame = check.package("pygame", "Rendering", "render")
        check.package("pygame.font", "Rendering", "render")
    return pygame


class Canvas:
    """Picture to draw on, of a width and a height [pixels]."""

    def __init__(self, width: int, height: int) -> None:
        self._pygame = load_pygame()
        self._pygame.font.init()
        self.width, self.height = width, height
        size = (OVERSAMPLING * width, OVERSAMPLING * height)
        self._large = self._pygame.Surface(size, 0, 32, _RGBX)
        self._layer = self._pygame.Surface(size, self._pygame.SRCALPHA, 32, _RGBA)
        self.surface = self._pygame.Surface((width, height), 0, 32, _RGBX)
        self._packed = self._pygame.Surface((width, height), 0, 24, _RGBX)
        self._background: Any = None
        self._halved: Any = None
        self._drawn = np.zeros((-(-size[1] // TILE), 2 + -(-size[0] // TILE)), bool)
        """Tiles of the large surface that differ from the background, between two empty columns."""
        self._panel: tuple[Any, Any] = (None, None)
        self._fonts: dict[int, Any] = {}
        self._words: dict[tuple[str, int, Color], Any] = {}

    def __reduce__(self) -> Any:
        return Canvas, (self.width, self.height)

    # ---- lines and areas ----------------------------------------------------------------------

    def clear(self, color: Color, top: float = 0.0, bottom: float = np.inf) -> None:
        """Clear the picture within `inside`, between two heights [pixels]."""
        top, bottom = np.clip((top, bottom), 0.0, self.height)
        self.box(0.0, top, self.width, bottom - top, color)

    def keep_background(self) -> None:
        """Store the picture so far, as the background of later pictures."""
        self.finish()
        self._background, self._halved = self._large.copy(), self.surface.copy()
        self._drawn[:] = False

    def show_background(self) -> None:
        """Copy the stored background, where the last picture differs from it."""
        for box in self._boxes():
            self._large.blit(self._background, box, box)
        self.surface.blit(self._halved, (0, 0))
        self._drawn[:] = False

    def line(self, points: Floats, color: Color, width: float = 1.0, closed: bool = False) -> None:
        """Draw a line through points (n, 2) [pixels], interrupted at points that are NaN."""
        for run in _runs(points):
            if len(run) > 1:
                thickness = max(1, round(OVERSAMPLING * width))
                points = _large(run)
                self._touch(self._pygame.draw.lines(self._large, color, closed, points, thickness))

    def segments(self, segments: Floats, color: Color, width: float = 1.0) -> None:
        """Draw line segments (n, 2, 2) [pixels]."""
        thickness = max(1, round(OVERSAMPLING * width))
        for start, end in _large(segments):
            self._touch(self._pygame.draw.line(self._large, color, start, end, thickness))

    def dashes(
        self, points: Floats, color: Color, width: float = 1.0, dash: float = 6.0, gap: float = 5.0
    ) -> None:
        """Draw a dashed line through points (n, 2) [pixels]."""
        for run in _runs(points):
            if len(run) < 2:
                continue
            steps = np.linalg.norm(np.diff(run, axis=0), axis=1)
            length = np.concatenate([[0.0], np.cumsum(steps)])
            begin = np.arange(0.0, min(length[-1], 4.0 * _FAR), dash + gap)

            def along(distance: Floats, run: Floats = run, length: Floats = length) -> Floats:
                return np.stack([np.interp(distance, length, run[:, k]) for k in range(2)], axis=-1)

            center = along(begin + 0.5 * dash) / (self.width, self.height)
            begin = begin[(abs(center - 0.5) < 0.55).all(axis=1)]  # most may be outside
            both = np.stack([begin, np.minimum(begin + dash, length[-1])], axis=1)
            self.segments(along(both), color, width)

    def polygon(self, points: Floats, color: Color, opacity: float = 1.0) -> None:
        """Draw a filled polygon with corners (n, 2) [pixels], unless one of them is NaN."""
        if len(points) < 3 or not np.isfinite(points).all():
            return
        places = (OVERSAMPLING * points).clip(-_FAR, _FAR)
        corners = places.tolist()
        if opacity >= 1.0:
            self._touch(self._pygame.draw.polygon(self._large, color, corners))
            return
        left, top = map(math.floor, places.min(axis=0).tolist())
        right, bottom = map(math.ceil, places.max(axis=0).tolist())
        box = self._large.get_clip().clip((left, top, right - left + 1, bottom - top + 1))
        if box.width and box.height:
            self._layer.set_clip(box)
            self._layer.fill((*color, 0))
            self._pygame.draw.polygon(self._layer, (*color, round(255 * opacity)), corners)
            self._touch(self._large.blit(self._layer, box, box))

    def disc(self, at: Floats, radius: float, color: Color, width: float = 0.0) -> None:
        """Draw a disc, or a ring of a given width [pixels], around a point (2,)."""
        if np.isfinite(at).all():
            n = OVERSAMPLING
            (center,) = _large(at[np.newaxis])
            ring = round(n * width) if width else 0
            radius = max(1.0, n * radius)
            self._touch(self._pygame.draw.circle(self._large, color, center, radius, ring))

    def crosses(self, at: Floats, size: float, color: Color, width: float = 1.5) -> None:
        """Draw diagonal crosses at points (n, 2) [pixels] that are not NaN."""
        shown = at[np.isfinite(at).all(axis=1)]
        self.segments(
            (shown[:, np.newaxis, np.newaxis] + size * _CROSS).reshape(-1, 2, 2), color, width
        )

    def box(
        self, left: float, top: float, width: float, height: float, color: Color, line: float = 0.0
    ) -> None:
        """Draw a filled rectangle, or its border with a line width `line` [pixels]."""
        n = OVERSAMPLING
        rectangle = [round(n * x) for x in (left, top, width, height)]
        self._touch(self._pygame.draw.rect(self._large, color, rectangle, round(n * line)))

    def inside(self, box: tuple[float, float, float, float] | None) -> None:
        """Clip drawing to a rectangle (left, top, width, height) from now on; None: no clipping."""
        n = OVERSAMPLING
        self._large.set_clip(None if box is None else [round(n * x) for x in box])

    def _touch(self, box: Any) -> None:
        """Note that a rectangle of the large surface was drawn on."""
        if box.width and box.height:
            rows = slice(box.top // TILE, -(-box.bottom // TILE))
            self._drawn[rows, 1 + box.left // TILE : 1 - (-box.right // TILE)] = True

    def _boxes(self) -> Iterator[Any]:
        """Rectangles of the large surface that cover all tiles that were drawn on."""
        whole, columns = self._large.get_rect(), self._drawn.shape[1]
        flat = self._drawn.reshape(-1)
        edges = 1 + np.flatnonzero(flat[1:] != flat[:-1])
        for first, end in edges.reshape(-1, 2).tolist():
            row, column = divmod(first, columns)
            yield whole.clip((TILE * (column - 1), TILE * row, TILE * (end - first), TILE))

    # ---- text ---------------------------------------------------------------------------------

    def finish(self) -> None:
        """Halve the picture where it was drawn on; only text can be drawn after this."""
        for box in self._boxes():
            part = [side // OVERSAMPLING for side in box]
            halved = self.surface.subsurface(part)
            self._pygame.transform.smoothscale(self._large.subsurface(box), part[2:], halved)

    def veil(self, left: float, top: float, width: float, height: float) -> None:
        """Brighten a rectangle of the finished picture, for text to stand out."""
        box = (0, 0, round(width), round(height))
        self._layer.set_clip(None)
        self._layer.fill((*WHITE, 190), box)
        self.surface.blit(self._layer, (round(left), round(top)), box)

    def panel(
        self,
        key: tuple[Any, ...],
        at: tuple[float, float],
        size: tuple[float, float],
        write: Callable[[], None],
    ) -> None:
        """Show a brightened rectangle with words, which `write` has written for an equal key."""
        left, top = map(round, at)
        if self._panel[0] != key:
            panel = self._pygame.Surface(tuple(map(round, size)), self._pygame.SRCALPHA, 32, _RGBA)
            panel.fill((*WHITE, 190))
            picture, self.surface = self.surface, panel
            write()
            self._panel, self.surface = (key, panel), picture
        self.surface.blit(self._panel[1], (left, top))

    def text(
        self,
        words: str,
        x: float,
        y: float,
        size: int,
        color: Color = INK,
        anchor: float = 0.0,
    ) -> int:
        """Write a text at x, y, shifted left by `anchor` widths; return its width [pixels]."""
        image = self._word(words, size, color)
        if np.isfinite(x) and np.isfinite(y):
            left = min(max(x - anchor * image.get_width(), -_FAR), _FAR)
            self.surface.blit(image, (round(left), round(min(max(y, -_FAR), _FAR))))
        return int(image.get_width())

    def write_labels(self, labels: Sequence[Label], size: int, bottom: float) -> None:
        """Write labels centered at their places, above a height [pixels]."""
        for words, at, color in labels:
            if np.isfinite(at).all() and at[1] < bottom - self.line_height(size):
                self.text(words, at[0], at[1], size, color, 0.5)

    def mark(self, mark: Mark, x: float, y: float, size: int) -> None:
        """Draw the mark of a part in a legend."""
        (shape, color), step = mark, self.line_height(size) + 2
        if shape == "cross":
            self.text("x", x + 1, y - 1, size, color)
        elif shape == "line":
            self.surface.fill(color, (round(x), round(y + 0.3 * step), 10, 4))
        else:
            left, top = round(x + 1), round(y + 0.5 * step - 5)
            self.surface.fill(INK, (left, top, 8, 8))
            self.surface.fill(color, (left + 1, top + 1, 6, 6))

    def width_of(self, words: str, size: int) -> int:
        """Width of a text [pixels]."""
        return int(self._word(words, size, INK).get_width())

    def fitting(self, wordings: Sequence[str], size: int, width: float) -> str:
        """First of the wordings that is no wider than `width` [pixels], or the last one."""
        fits = (words for words in wordings if self.width_of(words, size) <= width)
        return next(fits, wordings[-1])

    def line_height(self, size: int) -> int:
        """Distance between lines of text [pixels]."""
        return -(-int(self._font(TEXT_OVERSAMPLING * size).get_linesize()) // TEXT_OVERSAMPLING)

    def _font(self, size: int) -> Any:
        if size not in self._fonts:
            self._fonts[size] = self._pygame.font.Font(None, size)
        return self._fonts[size]

    def _word(self, words: str, size: int, color: Color) -> Any:
        key = (words, size, color)
        if key not in self._words:
            if len(self._words) > 500:
                self._words.clear()
            large = self._font(TEXT_OVERSAMPLING * size).render(words, True, color)
            small = [-(-side // TEXT_OVERSAMPLING) for side in large.get_size()]
            word = self._pygame.transform.smoothscale(large.convert(self._layer), small)
            self._words[key] = word
        return self._words[key]

    def pixels(self) -> NDArray[np.uint8]:
        """Finished picture as a new array, (height, width, 3)."""
        self._packed.blit(self.surface, (0, 0))
        raw = np.frombuffer(self._packed.get_buffer(), np.uint8)
        rows = raw.reshape(self.height, self._packed.get_pitch())[:, : 3 * self.width]
        return rows.reshape(self.height, self.width, 3).copy()


def _large(points: Floats) -> Any:
    """Convert points to pixels of the large surface."""
    return (OVERSAMPLING * points).clip(-_FAR, _FAR).tolist()


def _runs(points: Floats) -> list[Floats]:
    """Pieces of a line between points that are NaN."""
    if np.isfinite(points.sum()):  # the usual case
        return [points]
    good = np.isfinite(points).all(axis=-1)
    edges = np.flatnonzero(np.diff(good)) + 1
    return [run for run in np.split(points, edges) if np.isfinite(run[0]).all()]

"""Videos of one episode flown by several policies, side by side."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from quad_gym.flights.record import Flight
from quad_gym.rendering import colors
from quad_gym.rendering.canvas import Canvas
from quad_gym.rendering.renderer import Renderer, errors_of, legend_of
from quad_gym.rendering.video import Progress, checked_video_path, times_of, write_frames

SIDE = (480, 470)  #: width and height of one flight [pixels]
HOLD = 1.5  #: duration of the last picture, to read how the flights ended [s]
BAND, LEGEND = 64, 34  #: heights of the label above a flight, and of the legend below [pixels]
_LARGE, _SMALL = 24, 20  #: sizes of text


@dataclass(frozen=True, eq=False)
class Side:
    """One flight of a video side by side.

    Args:
        flight: Flight, from its start to its ending.
        label: Name of the policy, for readers.
        ending: Ending of the episode, for readers, such as "collision".
        crashed: True if the ending was a crash.
        course: Name and number of the objects passed on a course, such as ("gates", 8).
    """

    flight: Flight
    label: str
    ending: str
    crashed: bool
    course: tuple[str, int] | None = None

    @property
    def end(self) -> float:
        """Time at which the flight ended [s]."""
        return float(self.flight["time"][-1])

    def status(self, time: float) -> str:
        """Errors or progress on the course at a time [s]; after the end, how the flight ended."""
        if time > self.end - 1e-9:
            how = "crashed" if self.crashed else "ended"
            return f"{how} at {self.end:.1f} s: {self.ending.replace('_', ' ')}"
        if self.course is None:
            return errors_of(self.flight.until(time))
        now, (what, total) = self.flight.until(time).rows[-1], self.course
        speed = np.linalg.norm(now["velocity"])
        return f"{int(now['gates_passed'])} of {total} {what}, {speed:.1f} m/s"


class SideBySide:
    """Renderer of flights of one episode, side by side; ended flights stay at their last instant.

    Args:
        sides: Flights, from left to right.

    Raises:
        ValueError: If there is no flight.
        ImportError: If pygame is not installed.
    """

    def __init__(self, sides: Sequence[Side]) -> None:
        if not sides:
            raise ValueError("sides must be at least one, got none")
        self.sides = tuple(sides)
        self.end = max(side.end for side in sides)
        width, height = SIDE
        # a course of obstacles is too long for one picture
        views = ["course" if len(side.flight.scene.obstacles) else "fixed" for side in sides]
        size = (width, height - BAND - LEGEND)
        self._renderers = [Renderer(view, size, legend=False) for view in views]
        self._band = Canvas(width, BAND)
        self._legend = Canvas(width * len(sides), LEGEND)

    def draw(self, time: float) -> NDArray[np.uint8]:
        """Draw a picture (height, width, 3) of red, green, blue at a time [s]."""
        parts = []
        for side, renderer in zip(self.sides, self._renderers, strict=True):
            picture = renderer.draw(side.flight.until(time))
            if side.crashed and time > side.end - 1e-9:  # pale
                picture = (picture // 2 + 127).astype(np.uint8)
            parts.append(np.concatenate([self._label(side, time), picture]))
            parts[-1][:, -2:] = colors.GREY
        return np.concatenate([np.concatenate(parts, axis=1), self._footer(time)])

    def _label(self, side: Side, time: float) -> NDArray[np.uint8]:
        """Draw the band above a flight: its label, and its status below."""
        band, over = self._band, time > side.end - 1e-9
        ending = colors.VERMILLION if side.crashed else colors.GREEN
        band.clear(ending if over else colors.PALE)
        band.finish()
        ink = colors.WHITE if over else colors.INK
        band.text(band.fitting([side.label], _LARGE, band.width), 12.0, 8.0, _LARGE, ink)
        band.text(side.status(time), 12.0, 14.0 + band.line_height(_LARGE), _SMALL, ink)
        return band.pixels()

    def _footer(self, time: float) -> NDArray[np.uint8]:
        """Draw the time and the legend below all flights."""
        canvas, flight = self._legend, self.sides[0].flight
        canvas.clear(colors.WHITE)
        canvas.finish()
        x = 12.0 + canvas.text(f"{time:4.1f} s", 12.0, 9.0, _SMALL) + 20.0
        legend = legend_of(flight.until(min(time, self.sides[0].end)))
        legend += [("marker in view", ("box", colors.INK))] if flight.scene.has_camera else []
        for words, mark in legend:
            canvas.mark(mark, x, 9.0, _SMALL)
            x += 34.0 + canvas.text(words, x + 16.0, 9.0, _SMALL)
        return canvas.pixels()


def save_side_by_side(
    sides: Sequence[Side],
    path: Path | str,
    *,
    fps: float = 12.5,
    speed: float = 1.0,
    progress: Progress | None = None,
) -> Path:
    """Write flights of one episode as a video, from left to right; it ends with the longest flight.

    Other arguments and the result are as in `save_video`.

    Raises:
        ValueError: If an argument is invalid.
        ImportError: If a library for drawing or writing is not installed.
    """
    target = checked_video_path(path)
    film = SideBySide(sides)
    times = times_of(film.end, fps, speed, progress)

    def frames() -> Iterator[NDArray[np.uint8]]:
        for time in times:
            last = film.draw(time)
            yield last
        for _ in range(round(HOLD * fps)):
            yield last

    write_frames(frames(), target, fps=fps, lossless=True)
    return target

"""Videos of one episode flown by several policies, side by side."""

import dataclasses
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from quad_gym.flights.record import Flight
from quad_gym.rendering import colors
from quad_gym.rendering.canvas import Canvas
from quad_gym.rendering.colors import Color
from quad_gym.rendering.geometry import Perspective, course_view, fixed_view
from quad_gym.rendering.history import ErrorHistory
from quad_gym.rendering.inset import Inset, inset_box
from quad_gym.rendering.renderer import active_faults
from quad_gym.rendering.scene import Scene
from quad_gym.rendering.strip import Box
from quad_gym.rendering.video import Progress, checked_video_path, times_of, write_frames
from quad_gym.rotations import quaternion_to_dcm

Floats = NDArray[np.float64]

SIDE = (480, 440)
"""Width and height of one flight [pixels]."""
HOLD = 1.5
"""Duration of the last picture, to read how the flights ended [s]."""

COURSE_GRID = 4.0
"""Distance between grid lines along a course [m]; more lines would double the file size."""

_BAND, _PLOT = 50.0, 118.0
"""Heights above and below the scene [pixels]."""
_TEXT, _SMALL = 19, 17
_TINTS: tuple[Color, ...] = ((228, 230, 234), (214, 236, 229))
"""Background colors of the labels, in turn."""
WEDGE = 2.5
"""Distance to which the camera's field of view is drawn [m]."""
_SHOWN = 9.0
"""Distance from the start along an axis up to which a fixed view must show positions [m]."""
_FAR = 30.0
"""Scale below which a vehicle is marked by a disc, because it is hardly visible [pixels/m]."""


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

    def last_words(self) -> str:
        """Return the text that is shown after the end of the flight."""
        words = self.ending.replace("_", " ")
        if self.crashed:
            return f"crashed at {self.end:.1f} s: {words}"
        return f"ended at {self.end:.1f} s: {words}"


class SideBySide:
    """Renderer of flights of one episode, side by side; ended flights stay at their last instant.

    Args:
        sides: Flights, from left to right.

    Raises:
        ValueError: If there is no flight, or one without a filter.
        ImportError: If pygame is not installed.
    """

    def __init__(self, sides: Sequence[Side]) -> None:
        if not sides:
            raise ValueError("sides must be at least one, got none")
        for side in sides:
            if not side.flight.estimated:
                raise ValueError(f"sides must have an estimate, {side.label!r} has none")
        self.sides = tuple(sides)
        self.end = max(side.end for side in sides)
        paths = [s.flight[c] for s in sides for c in ("position", "estimated_position")]
        points = np.concatenate(paths)
        near = points[np.abs(points - sides[0].flight["position"][0]).max(axis=1) < _SHOWN]
        self._halves = [
            _Half(side, self.end, near, _TINTS[k % len(_TINTS)]) for k, side in enumerate(sides)
        ]

    def draw(self, time: float) -> NDArray[np.uint8]:
        """Draw a picture (height, width, 3) of red, green, blue at a time [s]."""
        parts = [half.draw(time) for half in self._halves]
        for part in parts[1:]:
            part[:, :2] = colors.GREY
        return np.concatenate(parts, axis=1)


class _Half:
    """Drawing of one flight: its label, the scene, and the errors over the whole episode."""

    def __init__(self, side: Side, end: float, points: Floats, tint: Color) -> None:
        self._side, self._points, self._tint = side, points, tint
        width, height = SIDE
        self._canvas = Canvas(width, height)
        self._scene = Box(0.0, _BAND, width, height - _BAND - _PLOT)
        plot = Box(0.0, height - _PLOT, width, _PLOT)
        self._history = ErrorHistory(self._canvas, plot, side.flight, end, _SMALL, side.course)
        self._fixed: Perspective | None = None

    def draw(self, time: float) -> NDArray[np.uint8]:
        """Draw the picture at a time [s]."""
        canvas, box, width = self._canvas, self._scene, SIDE[0]
        flight = self._side.flight.until(time)
        view = self._view(flight)
        canvas.clear(colors.WHITE)
        canvas.inside((box.left, box.top, box.width, box.height))
        scene = Scene(
            *(canvas, flight, view, self._moves),
            magnified=False,
            spacing=COURSE_GRID if self._moves else 1.0,
        )
        scene.draw_background()
        labels = scene.draw()
        self._mark(flight, view)
        inset = None
        if flight.scene.has_camera and self._side.course is None:
            self._wedge(flight, view)
            inset = Inset(canvas, inset_box(flight.scene, width - 8.0, box.top + 8.0, 118.0), 15)
            inset.draw(flight)
        canvas.inside(None)
        canvas.box(0.0, 0.0, width, _BAND, self._tint)
        self._history.draw(flight)
        canvas.finish()
        canvas.write_labels(labels, 15, box.top + box.height, box.top)
        if inset is not None:
            inset.write(flight)
        self._write_label(flight)
        self._write_legend(flight)
        self._history.write(flight)
        if time > self._side.end - 1e-9:
            self._write_end()
        return canvas.pixels()

    @property
    def _moves(self) -> bool:
        """True if the view moves, because a course of obstacles is too long for one picture."""
        return len(self._side.flight.scene.obstacles) > 0

    def _view(self, flight: Flight) -> Perspective:
        box = self._scene
        if self._moves:
            view = course_view(flight, box.width, box.height)
        elif self._fixed is None:
            high = box.height - 34.0  # the ending is written below
            view = self._fixed = fixed_view(flight, box.width, high, self._points)
        else:
            view = self._fixed
        return dataclasses.replace(view, center=view.center + np.array([0.0, box.top]))

    def _mark(self, flight: Flight, view: Perspective) -> None:
        """Mark truth and estimate where they are hardly visible."""
        now = flight.rows[-1]
        if view.scale_at(np.array(now["position"])) < _FAR:
            self._canvas.disc(
                view.project(now["estimated_position"])[0], 6.0, colors.VERMILLION, 2.0
            )
            self._canvas.disc(view.project(now["position"])[0], 4.0, colors.BLUE)

    def _wedge(self, flight: Flight, view: Perspective) -> None:
        """Draw a horizontal slice of the camera's field of view, up to `WEDGE`."""
        now = flight.rows[-1]
        R_BI = quaternion_to_dcm(now["quaternion"])
        apex, a, b, c, d = flight.scene.frustum_corners(now["position"], R_BI, WEDGE)
        outline = view.outline(np.stack([apex, (a + d) / 2, (b + c) / 2]))
        self._canvas.polygon(outline, colors.LIGHT_BLUE, 0.25)
        self._canvas.line(outline, colors.LIGHT_BLUE, 1.0, closed=True)

    def _write_label(self, flight: Flight) -> None:
        canvas, width = self._canvas, SIDE[0]
        clock = f"{flight['time'][-1]:.1f} s"
        room = width - 24.0 - canvas.width_of("00.0 s", _TEXT)
        lines = _wrapped(canvas, self._side.label, _TEXT, room)
        step = canvas.line_height(_TEXT) + 2
        y = 0.5 * (_BAND - step * len(lines)) + 2.0
        for line in lines:
            canvas.text(line, 10.0, y, _TEXT)
            y += step
        canvas.text(clock, width - 10.0, 0.5 * (_BAND - step) + 2.0, _TEXT, colors.INK, 1.0)

    def _write_legend(self, flight: Flight) -> None:
        """Write legend and warnings in the upper left corner of the scene."""
        canvas, scene = self._canvas, flight.scene
        entries: list[tuple[str, Color]] = [
            ("truth", colors.BLUE),
            ("estimate, 3 sigma", colors.VERMILLION),
        ]
        if not self._moves:
            entries.append(("next gate" if len(scene.gates_I) else "reference", colors.GREEN))
        if scene.has_gnss:
            entries.append(("GNSS fix", colors.PURPLE))
        step = canvas.line_height(_SMALL) + 2
        top = _BAND + 6.0
        faults = [f"fault: {name}" for name in active_faults(flight)]
        widths = [canvas.width_of(words, _SMALL) for words in [w for w, _ in entries] + faults]
        canvas.veil(6, top, max(widths) + 28, step * (len(entries) + len(faults)) + 4)
        y = canvas.write_legend(entries, 12.0, top + 3.0, _SMALL)
        for words in faults:
            canvas.text(words, 12.0, y, _SMALL, colors.VERMILLION)
            y += step

    def _write_end(self) -> None:
        """Write the ending of the flight across the lower edge of the scene."""
        canvas, box = self._canvas, self._scene
        words, height = self._side.last_words(), canvas.line_height(_TEXT) + 8
        width = canvas.width_of(words, _TEXT) + 24
        left, top = 0.5 * (box.width - width), box.top + box.height - height - 8.0
        color = colors.VERMILLION if self._side.crashed else colors.GREEN
        canvas.surface.fill(color, (round(left), round(top), width, height))
        canvas.text(words, 0.5 * box.width, top + 4.0, _TEXT, colors.WHITE, 0.5)


def _wrapped(canvas: Canvas, words: str, size: int, width: float) -> list[str]:
    """Wrap a text to lines of at most `width` [pixels], after commas or else between words."""
    if canvas.width_of(words, size) <= width:
        return [words]
    parts = [part + "," for part in words.split(", ")]
    parts[-1] = parts[-1][:-1]
    if max(canvas.width_of(part, size) for part in parts) > width:
        parts = words.split()
    lines = parts[:1]
    for part in parts[1:]:
        longer = f"{lines[-1]} {part}"
        if canvas.width_of(longer, size) > width:
            lines.append(part)
        else:
            lines[-1] = longer
    return lines


def save_side_by_side(
    sides: Sequence[Side],
    path: Path | str,
    *,
    fps: float = 12.5,
    speed: float = 1.0,
    progress: Progress | None = None,
) -> Path:
    """Write flights of one episode as a video, side by side; it ends with the longest flight.

    Args:
        sides: Flights, from left to right.
        path: Path of the file, as in `save_video`.
        fps: Pictures per second.
        speed: Seconds of flight per second of video.
        progress: Wrapper of the times of the pictures, such as `tqdm.tqdm`.

    Returns:
        Path of the file.

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

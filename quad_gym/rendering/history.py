"""Plot below a scene: errors and standard deviation of the position over a whole episode."""

import numpy as np
from numpy.typing import NDArray

from quad_gym.flights.record import Flight
from quad_gym.rendering import colors
from quad_gym.rendering.canvas import Canvas
from quad_gym.rendering.colors import Color
from quad_gym.rendering.strip import (
    Box,
    Plot,
    draw_axes,
    format_length,
    height_on,
    write_axes,
)

Floats = NDArray[np.float64]

ERRORS = Plot(
    (),
    low=3e-3,
    high=20.0,
    ticks={1e-2: "1 cm", 1e-1: "10 cm", 1.0: "1 m", 10.0: "10 m"},
    share=1.0,
)
_FAULT: Color = (232, 232, 232)


def position_sigma(flight: Flight) -> Floats:
    """Largest standard deviation of the position along an axis, (n,) [m]."""
    variances = np.diagonal(flight["covariance"][:, :3, :3], axis1=1, axis2=2)
    return np.asarray(np.sqrt(variances.max(axis=1)))


class ErrorHistory:
    """Plot of errors over a whole episode, up to the last row of a flight.

    Args:
        canvas: Canvas to draw on.
        box: Rectangle of the plot.
        flight: Complete flight.
        end: End of the time axis [s].
        size: Size of the text [pixels].
        course: Name and number of the objects passed on a course. Progress and speed then replace
            the distance from the reference.
    """

    def __init__(
        self,
        canvas: Canvas,
        box: Box,
        flight: Flight,
        end: float,
        size: int,
        course: tuple[str, int] | None = None,
    ) -> None:
        self._canvas, self._box, self._end, self._size = canvas, box, end, size
        self._course = course
        self._time = flight["time"]
        self._faulty = flight["faults"] > 0
        self._curves: list[tuple[str, Floats, Color]] = []
        if course is None:
            self._curves.append(("position error", flight["position_error"], colors.BLUE))
        self._curves += [
            ("filter sigma", position_sigma(flight), colors.INK),
            ("estimation error", flight["estimation_error"], colors.VERMILLION),
        ]
        label = 10.0 + max(canvas.width_of(words, size - 2) for words in ERRORS.ticks.values())
        top = box.top + canvas.line_height(size) + 12.0
        height = box.top + box.height - top - canvas.line_height(size - 2) - 4.0
        self._place = Box(box.left + label, top, box.width - label - 14.0, height)

    def draw(self, flight: Flight) -> None:
        """Draw axes, faults and curves."""
        canvas, box, place, count = self._canvas, self._box, self._place, len(flight)
        canvas.box(box.left, box.top, box.width, box.height, colors.WHITE)
        x = place.left + place.width * self._time[:count] / self._end
        for begin, stop in _runs(self._faulty[:count]):
            canvas.box(x[begin], place.top, x[stop - 1] - x[begin], place.height, _FAULT)
        draw_axes(canvas, ERRORS, place)
        stride = -(-count // 480)
        chosen = np.append(np.arange(0, count - 1, stride), count - 1)
        for _, values, color in self._curves:
            y = height_on(ERRORS, np.nan_to_num(values[chosen], nan=ERRORS.low), place)
            curve = np.stack([x[chosen], y], axis=1)
            canvas.line(curve, color, 1.6)
            canvas.disc(curve[-1], 2.6, color)

    def write(self, flight: Flight) -> None:
        """Write names, present values and ticks, after the canvas is finished."""
        canvas, box = self._canvas, self._box
        last = len(flight) - 1
        words = [(f"{name} {format_length(values[last])}", c) for name, values, c in self._curves]
        if self._course is not None:
            what, total = self._course
            speed = np.linalg.norm(flight["velocity"][last])
            passed = int(flight["gates_passed"][last])
            words.insert(0, (f"{passed} of {total} {what}, {speed:.1f} m/s", colors.BLUE))
        for k, (text, color) in enumerate(words):
            x = box.left + 10.0 + k / len(words) * (box.width - 10.0)
            canvas.text(text, x, box.top + 5.0, self._size, color)
        write_axes(canvas, ERRORS, self._place, (0.0, self._end), self._size - 2)


def _runs(active: NDArray[np.bool_]) -> list[tuple[int, int]]:
    """First index of each active interval, and the index after its last."""
    edges = np.flatnonzero(np.diff(np.concatenate([[0], active.astype(int), [0]])))
    return [(int(a), int(b)) for a, b in edges.reshape(-1, 2)]

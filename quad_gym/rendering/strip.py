"""Strip below the scene: errors, filter consistency and rotor speeds over time."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from quad_gym.analysis.metrics import STATE_DIMENSION, chi_square_band
from quad_gym.flights.record import Flight
from quad_gym.rendering import colors
from quad_gym.rendering.canvas import Canvas
from quad_gym.rendering.colors import Color

Floats = NDArray[np.float64]

WINDOW_SECONDS = 10.0  #: duration of the past that a plot shows [s]


@dataclass(frozen=True)
class Box:
    """Rectangle [pixels]."""

    left: float
    top: float
    width: float
    height: float


@dataclass(frozen=True)
class Plot:
    """Plot of columns over time, on a logarithmic scale."""

    curves: tuple[tuple[str, str, Color], ...]
    """Column, name and color of each"""
    low: float
    high: float
    ticks: dict[float, str]
    share: float
    """Of the strip's width"""


ERRORS = Plot(
    (
        ("position_error", "tracking", colors.BLUE),
        ("estimation_error", "estimation", colors.VERMILLION),
    ),
    low=3e-4,
    high=6.0,
    ticks={1e-3: "1 mm", 1e-2: "1 cm", 1e-1: "10 cm", 1.0: "1 m"},
    share=0.47,
)
CONSISTENCY = Plot(
    (("nees", "NEES", colors.INK),),
    low=1.0,
    high=2000.0,
    ticks={1.0: "1", 10.0: "10", 100.0: "100", 1e3: "1000"},
    share=0.34,
)
PLOTS = (ERRORS, CONSISTENCY)


def format_length(meters: float) -> str:
    """Format a length in millimeters, centimeters or meters."""
    if not np.isfinite(meters):
        return "-"
    if meters < 0.01:
        return f"{1e3 * meters:.1f} mm"
    if meters < 0.995:
        return f"{1e2 * meters:.1f} cm"
    return f"{meters:.2f} m"


def height_on(plot: Plot, value: Floats | float, box: Box) -> Floats:
    """Vertical position of values in a plot's box [pixels]."""
    logs = np.log10(np.clip(value, plot.low, plot.high))
    share = (logs - np.log10(plot.low)) / (np.log10(plot.high) - np.log10(plot.low))
    return np.asarray(box.top + box.height * (1.0 - share))


def shows(flight: Flight, column: str) -> bool:
    """True if a curve has values: without a filter, some have none."""
    if column == "nees":
        return flight.estimated
    return column != "estimation_error" or flight.scene.observation != "truth"


class Strip:
    """Strip in a box for the last row of a flight; plots show the past of a duration [s]."""

    def __init__(self, canvas: Canvas, box: Box, size: int, seconds: float) -> None:
        self._canvas, self._box, self._size, self._seconds = canvas, box, size, seconds
        pad, title = 0.012 * box.width, 1.1 * canvas.line_height(size)
        self._title_y = box.top + 0.06 * box.height
        top = self._title_y + title
        height = box.top + box.height - top - 0.95 * canvas.line_height(size - 2)
        self._boxes, left = [], box.left
        for plot in PLOTS:
            width = plot.share * box.width
            label = pad + max(canvas.width_of(words, size - 2) for words in plot.ticks.values()) + 5
            self._boxes.append(Box(left + label, top, width - label - pad, height))
            left += width
        self._rotors = Box(left + pad, top, box.left + box.width - left - 2 * pad, height)

    def draw_background(self, hover_share: float) -> None:
        """Draw boxes, axes and bands; `hover_share` is the hover speed over the largest speed."""
        box, canvas = self._box, self._canvas
        canvas.box(box.left, box.top, box.width, box.height, colors.WHITE)
        edge = np.array([[box.left, box.top], [box.left + box.width, box.top]])
        canvas.line(edge, colors.GREY)
        for plot, place in zip(PLOTS, self._boxes, strict=True):
            self._draw_axes(plot, place)
        place = self._rotors
        for k in range(4):
            left = place.left + (k + 0.2) * place.width / 4
            canvas.box(left, place.top, 0.15 * place.width, place.height, (238, 241, 245))
        y = place.top + place.height * (1.0 - hover_share)
        hover = np.array([[place.left, y], [place.left + place.width, y]])
        canvas.dashes(hover, colors.INK, 1.0, 4.0, 3.0)

    def draw(self, flight: Flight) -> None:
        """Draw the curves and the rotors."""
        rows = flight.rows[-max(2, round(self._seconds * flight.scene.control_rate)) :]
        for plot, place in zip(PLOTS, self._boxes, strict=True):
            self._draw_curves(plot, place, flight, rows)
        canvas, place = self._canvas, self._rotors
        speeds = flight.rows["rotor_speeds"][-1] / flight.scene.max_rotor_speed
        for k, speed in enumerate(np.clip(np.nan_to_num(speeds), 0.0, 1.0)):
            left, height = place.left + (k + 0.25) * place.width / 4, speed * place.height
            canvas.box(
                left, place.top + place.height - height, 0.125 * place.width, height, colors.BLUE
            )

    def write(self, flight: Flight) -> None:
        """Write titles, numbers and ticks, after the canvas is finished."""
        canvas, small, now = self._canvas, self._size - 2, flight.rows[-1]
        for plot, place in zip(PLOTS, self._boxes, strict=True):
            x, gap = place.left, 0.04 * place.width
            titles = self._titles(flight, plot)
            widths = [canvas.width_of(words, self._size) + gap for words, _ in titles]
            if sum(widths) - gap > place.width:
                titles = self._titles(flight, plot, named=False)
            for words, color in titles:
                x += canvas.text(words, x, self._title_y, self._size, color) + gap
            if plot is CONSISTENCY and flight.estimated:
                words = f"({STATE_DIMENSION} if consistent)"
                if x + canvas.width_of(words, small) < place.left + place.width:
                    canvas.text(words, x, self._title_y + 1, small, colors.GREY)
            for tick, words in plot.ticks.items():
                y = float(height_on(plot, tick, place)) - 0.45 * canvas.line_height(small)
                canvas.text(words, place.left - 4.0, y, small, colors.GREY, 1.0)
            begin, y = max(0.0, now["time"] - self._seconds), place.top + place.height + 1.0
            for share in (0.0, 1.0):
                words = f"{begin + share * self._seconds:.0f} s"
                x = place.left + share * place.width
                canvas.text(words, x, y, small, colors.GREY, share)
        place = self._rotors
        words = canvas.fitting(("rotor speeds", "rotors"), self._size, place.width)
        canvas.text(words, place.left, self._title_y, self._size)
        for k in range(4):
            x = place.left + (k + 0.5) * place.width / 4
            canvas.text(str(k + 1), x, place.top + place.height + 1.0, small, colors.GREY, 0.5)

    def _titles(self, flight: Flight, plot: Plot, *, named: bool = True) -> list[tuple[str, Color]]:
        """Names of a plot's curves with their last values, or the values alone."""
        found: list[tuple[str, Color]] = []
        roomy = self._canvas.width_of("0" * 45, self._size - 2) < self._boxes[0].width
        for column, name, color in plot.curves:
            if not shows(flight, column):
                found.append(("no filter runs" if plot is CONSISTENCY else "", colors.GREY))
                continue
            value = float(flight.rows[-1][column])
            number = f"{value:.0f}" if plot is CONSISTENCY else format_length(value)
            words = f"{name} {'-' if np.isnan(value) else number}"
            if plot is ERRORS and column == "position_error" and len(flight.scene.gates_I):
                words = f"to the gate {number}"
            if plot is ERRORS and column == "estimation_error" and roomy:
                words += " error"
            found.append((words if named or plot is CONSISTENCY else number, color))
        return found

    def _draw_axes(self, plot: Plot, place: Box) -> None:
        canvas = self._canvas
        if plot is CONSISTENCY:
            across = np.array([place.left, place.left + place.width])
            band = chi_square_band(STATE_DIMENSION)
            low, high = (float(height_on(plot, x, place)) for x in band)
            canvas.box(place.left, high, place.width, low - high, (214, 236, 229))
            middle = height_on(plot, float(STATE_DIMENSION), place)
            canvas.dashes(np.stack([across, np.full(2, middle)], axis=1), colors.GREEN, 0.8)
        right, bottom = place.left + place.width, place.top + place.height
        for tick in plot.ticks:
            y = height_on(plot, tick, place)
            canvas.line(np.array([[place.left, y], [right, y]]), colors.PALE, 0.6)
        corners = [[place.left, place.top], [place.left, bottom], [right, bottom]]
        canvas.line(np.array(corners), colors.GREY, 0.8)

    def _draw_curves(self, plot: Plot, place: Box, flight: Flight, rows: NDArray[np.void]) -> None:
        begin = max(0.0, float(rows["time"][-1]) - self._seconds)
        stride = -(-len(rows) // 240)
        shown = rows[(len(rows) - 1) % stride :: stride]
        x = place.left + place.width * (shown["time"] - begin) / self._seconds
        for column, _, color in reversed(plot.curves):
            if shows(flight, column):
                values = shown[column]
                y = height_on(plot, np.nan_to_num(values, nan=plot.low), place)
                curve = np.stack([x, np.where(np.isfinite(values), y, np.nan)], axis=1)
                self._canvas.line(curve[x >= place.left - 1.0], color, 1.4)
                self._canvas.disc(curve[-1], 2.2, color)

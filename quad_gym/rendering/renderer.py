"""`Renderer`: pictures of the last instant of a flight."""

from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from quad_gym.analysis.reports import short_name
from quad_gym.flights.flight_scene import FlightScene
from quad_gym.flights.record import Flight
from quad_gym.params import checks as check
from quad_gym.records import FaultKind, FilterStatus, GateDecision
from quad_gym.rendering import colors
from quad_gym.rendering.canvas import Canvas, Mark
from quad_gym.rendering.geometry import Perspective, chase_view, course_view, fixed_view
from quad_gym.rendering.inset import Inset, inset_box
from quad_gym.rendering.scene import Scene, ellipsoid_scale

VIEWS = ("fixed", "chase")  #: names of the views of a flight
MOVING_VIEWS = {"chase": chase_view, "course": course_view}
MIN_WIDTH, MIN_HEIGHT = 320, 240
STALE_FIX = 0.5  #: time without a fix after which a warning is shown [s]
_SEEN = {
    "truth": "the truth",
    "estimate": "the estimate",
    "noisy": "noisy truth",
    "measurements": "raw measurements",
}


class Renderer:
    """Renderer of recorded flights.

    Args:
        view: "fixed" (the whole reference from outside), "chase" (from behind the vehicle) or
            "course" (from above and behind, along a course of obstacles).
        size: Width and height [pixels].
        legend: True to show task, time, legend and errors, and the image of the camera.

    Raises:
        ValueError: If an argument is invalid.
        ImportError: If pygame is not installed.
    """

    def __init__(
        self, view: str = "fixed", size: tuple[int, int] = (640, 480), *, legend: bool = True
    ) -> None:
        self._legend = legend
        self.view = check.choice("render_view", view, ("fixed", *MOVING_VIEWS))
        self.size = checked_size(size)
        width, height = self.size
        self._canvas = Canvas(width, height)
        self._text = max(14, round(18 * min(width / 640, height / 480)))
        self._scene: FlightScene | None = None
        """Scene of the flight to which the stored view and background belong."""
        self._fixed: Perspective

    def draw(self, flight: Flight) -> NDArray[np.uint8]:
        """Draw the last instant of a flight; `flight.until(t)` ends at a time t.

        Args:
            flight: Flight to draw.

        Returns:
            Picture in red, green, blue, (height, width, 3).
        """
        canvas, (width, height), small = self._canvas, self.size, self._text - 2
        spacing = 4.0 if self.view == "course" else 1.0
        scene = Scene(canvas, flight, self._view_of(flight), self.view != "fixed", spacing)
        self._draw_background(flight, scene)
        labels = scene.draw()
        inset = None
        if self._legend and flight.scene.has_camera and flight.estimated:
            box = inset_box(flight.scene, width - 8.0, 8.0, 0.27 * width)
            inset = Inset(canvas, flight, box, small)
            inset.draw()
        canvas.finish()

        canvas.write_labels(labels, small, height)
        if inset is not None:
            inset.write()
        if self._legend:
            self._write_legend(flight)
        return canvas.pixels()

    def __reduce__(self) -> Any:
        return partial(Renderer, legend=self._legend), (self.view, self.size)

    def _view_of(self, flight: Flight) -> Perspective:
        if self.view != "fixed":
            return MOVING_VIEWS[self.view](flight, *self.size)
        if self._scene is not flight.scene:
            self._fixed = fixed_view(flight, *self.size)
        return self._fixed

    def _draw_background(self, flight: Flight, scene: Scene) -> None:
        """Draw the background, which a fixed view stores."""
        if self._scene is flight.scene and self.view == "fixed":
            self._canvas.show_background()
            return
        scene.draw_background()
        if self.view == "fixed":
            self._scene = flight.scene
            self._canvas.keep_background()

    def _write_legend(self, flight: Flight) -> None:
        """Write task, time, legend and warnings in the upper left corner."""
        canvas, large, small = self._canvas, self._text + 2, self._text - 1
        name = str(flight.about.get("task", flight.scene.task)).replace("_", " ")
        title, clock = f"{name} on {_SEEN[flight.scene.observation]}", f"{flight['time'][-1]:.2f} s"
        policy = flight.about.get("policy")
        lines: list[tuple[str, Mark | None]] = []
        lines += [(f"controller: {short_name(str(policy))}", None)] if policy else []
        lines += [*legend_of(flight), (errors_of(flight), None)]
        lines += [(words, None) for words in _warnings(flight)]
        width = max(26 + canvas.width_of(words, small) for words, _ in lines)
        width = max(width, canvas.width_of(f"{title}   {clock}", large) + 12)
        step, x, y = canvas.line_height(small) + 2, 12.0, 9.0
        canvas.veil(6, 6, width, 8 + canvas.line_height(large) + step * len(lines))
        canvas.text(title, x, y, large)
        canvas.text(clock, 6 + width - 6, y, large, colors.INK, 1.0)
        y += canvas.line_height(large) + 2
        for words, mark in lines:
            if mark is not None:
                canvas.mark(mark, x, y, small)
            canvas.text(words, x if mark is None else x + 15, y, small)
            y += step


def legend_of(flight: Flight) -> list[tuple[str, Mark]]:
    """Names and marks of the parts of a picture."""
    scene = flight.scene
    found: list[tuple[str, Mark]] = []
    found += [("next gate" if len(scene.gates_I) else "reference", ("line", colors.GREEN))]
    if scene.reference_period and not len(scene.gates_I):
        found = [("reference", ("line", colors.GREY)), ("its next second", ("line", colors.GREEN))]
    found += [("truth", ("line", colors.BLUE))]
    if flight.estimated:
        scale = ellipsoid_scale(flight)
        size = "3-sigma ellipsoid, true size"
        size = size if scale == 1.0 else f"3-sigma ellipsoid, error, drawn x {scale:g}"
        found += [(words, ("line", colors.VERMILLION)) for words in ("estimate", size)]
        if scene.has_gnss:
            refused = (flight.rows["gnss_decision"][:, 0] == GateDecision.REJECTED).any()
            words = "GNSS fix (gray: rejected)" if refused else "GNSS fix"
            found.append((words, ("cross", colors.PURPLE)))
        if len(scene.anchors_I):
            found.append(("anchor", ("box", colors.PURPLE)))
    elif scene.observation == "noisy":
        found.append(("observed position", ("line", colors.VERMILLION)))
    return found


def errors_of(flight: Flight) -> str:
    """Errors of tracking, and of the estimated position."""
    row, scene = flight.rows[-1], flight.scene
    what = "distance to the gate" if len(scene.gates_I) else "tracking error"
    found = f"{what} {_length(row['position_error'])}"
    if scene.observation == "truth":
        return found
    return f"{found}, estimation error {_length(row['estimation_error'])}"


def _length(meters: float) -> str:
    """Format a length in millimeters, centimeters or meters."""
    if not np.isfinite(meters):
        return "-"
    if meters < 0.01:
        return f"{1e3 * meters:.1f} mm"
    return f"{1e2 * meters:.1f} cm" if meters < 0.995 else f"{meters:.2f} m"


def _warnings(flight: Flight) -> list[str]:
    """Active faults, missing fixes, and failures of the filter."""
    rows, now = flight.rows, flight.rows[-1]
    active = [kind.name.lower() for kind in FaultKind if int(now["faults"]) >> kind & 1]
    spoken = (name.replace("gnss", "GNSS").replace("imu_", "IMU_") for name in active)
    found = [f"fault: {name}".replace("_", " ") for name in spoken]
    if not flight.estimated:
        return found
    fixes = np.flatnonzero(np.isfinite(rows["gnss_position"][:, 0]))
    age = now["time"] - rows["time"][fixes[-1]] if fixes.size else now["time"]
    if flight.scene.has_gnss and age > STALE_FIX:
        found.append(f"no GNSS fix for {age:.1f} s")
    if now["filter_status"] != 0:
        names = [str(s.name).lower() for s in FilterStatus if s & int(now["filter_status"])]
        found.append("filter: " + ", ".join(names).replace("_", " "))
    return found


def checked_size(size: tuple[int, int]) -> tuple[int, int]:
    """Check width and height of a picture [pixels].

    Raises:
        ValueError: If they are not integers, too small for the text, or odd, which video formats do
            not support.
    """
    if not isinstance(size, (tuple, list)) or len(size) != 2:
        raise ValueError(f"render_size must be a width and a height, got {size!r}")
    width = check.whole("render_size[0]", size[0], least=MIN_WIDTH)
    height = check.whole("render_size[1]", size[1], least=MIN_HEIGHT)
    if width % 2 or height % 2:
        raise ValueError(f"render_size must be even numbers, got {width} x {height}")
    return width, height


def tile(frames: list[NDArray[np.uint8]]) -> NDArray[np.uint8]:
    """Return frames of one size in a grid that is as square as possible, padded with white."""
    columns = int(np.ceil(np.sqrt(len(frames))))
    rows = -(-len(frames) // columns)
    height, width = frames[0].shape[:2]
    sheet = np.full((rows * height, columns * width, 3), 255, np.uint8)
    for k, frame in enumerate(frames):
        i, j = divmod(k, columns)
        sheet[i * height : (i + 1) * height, j * width : (j + 1) * width] = frame
    return sheet

"""`Renderer`: pictures of the last instant of a flight."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from quad_gym.analysis.reports import short_name
from quad_gym.flights.flight_scene import FlightScene
from quad_gym.flights.record import Flight
from quad_gym.params import checks as check
from quad_gym.records import FaultKind, FilterStatus, GateDecision
from quad_gym.rendering import colors
from quad_gym.rendering.canvas import Canvas
from quad_gym.rendering.colors import Color
from quad_gym.rendering.geometry import Perspective, chase_view, fixed_view
from quad_gym.rendering.inset import Inset, inset_box
from quad_gym.rendering.scene import Scene, ellipsoid_scale
from quad_gym.rendering.strip import Box, Strip

VIEWS = ("fixed", "chase")
"""Names of the views of a flight."""
LEAST_WIDTH, LEAST_HEIGHT = 320, 240
STALE_FIX = 0.5
"""Time without a fix after which a warning is shown [s]."""


class Renderer:
    """Renderer of recorded flights.

    Args:
        view: "fixed" (the whole reference from outside) or "chase" (from behind the vehicle).
        size: Width and height [pixels].

    Raises:
        ValueError: If an argument is invalid.
        ImportError: If pygame is not installed.
    """

    def __init__(self, view: str = "fixed", size: tuple[int, int] = (640, 480)) -> None:
        self.view = check.choice("render_view", view, VIEWS)
        self.size = checked_size(size)
        width, height = self.size
        self._canvas = Canvas(width, height)
        scale = min(width / 640, height / 480)
        self._text = max(14, round(18 * scale))
        self._scene_height = round(0.765 * height)
        strip = Box(0.0, self._scene_height, width, height - self._scene_height)
        self._strip = Strip(self._canvas, strip, self._text)
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
        canvas, (width, _), small = self._canvas, self.size, self._text - 2
        scene = Scene(canvas, flight, self._view_of(flight), self.view == "chase")
        self._draw_background(flight, scene)
        canvas.inside((0.0, 0.0, width, self._scene_height))
        labels = scene.draw()
        inset = None
        if flight.scene.has_camera and flight.estimated:
            box = inset_box(flight.scene, width - 8.0, 8.0, 0.27 * width)
            inset = Inset(canvas, box, small)
            inset.draw(flight)
        canvas.inside(None)
        self._strip.draw(flight)
        canvas.finish()

        canvas.write_labels(labels, small, self._scene_height)
        if inset is not None:
            inset.write(flight)
        self._strip.write(flight)
        self._write_legend(flight)
        return canvas.pixels()

    def __reduce__(self) -> Any:
        return Renderer, (self.view, self.size)

    def _view_of(self, flight: Flight) -> Perspective:
        width = self.size[0]
        if self.view == "chase":
            return chase_view(flight, width, self._scene_height)
        if self._scene is not flight.scene:
            self._fixed = fixed_view(flight, width, self._scene_height)
        return self._fixed

    def _draw_background(self, flight: Flight, scene: Scene) -> None:
        """Draw the unchanging parts: of a fixed view the whole background, of a chase the strip."""
        known, moves = self._scene is flight.scene, self.view == "chase"
        if known:
            self._canvas.show_background(self._scene_height if moves else 0.0)
        if moves or not known:
            self._canvas.inside((0.0, 0.0, self.size[0], self._scene_height))
            scene.draw_background()
            self._canvas.inside(None)
        if not known:
            flown = self._scene = flight.scene
            self._strip.draw_background(flown.hover_rotor_speed / flown.max_rotor_speed)
            self._canvas.keep_background()

    def _write_legend(self, flight: Flight) -> None:
        """Write task, time, legend and warnings in the upper left corner."""
        canvas, scene, now = self._canvas, flight.scene, flight.rows[-1]
        large, small = self._text + 2, self._text - 1
        name = str(flight.about.get("task", scene.task)).replace("_", " ")
        title = f"{name} on {_SEEN[scene.observation]}"
        aim = "reference, next second" if scene.reference_period else "reference"
        aim = "next gate" if len(scene.gates_I) else aim
        entries: list[tuple[str, Color]] = [(aim, colors.GREEN), ("truth", colors.BLUE)]
        if flight.estimated:
            scale = ellipsoid_scale(flight)
            size = "3-sigma ellipsoid, true size"
            size = size if scale == 1.0 else f"3-sigma ellipsoid, error, drawn x {scale:g}"
            entries += [("estimate", colors.VERMILLION), (size, colors.VERMILLION)]
            if scene.has_gnss:
                refused = (flight.rows["gnss_decision"][:, 0] == GateDecision.REJECTED).any()
                words = "GNSS fix (gray: rejected)" if refused else "GNSS fix"
                entries.append((words, colors.PURPLE))
        elif scene.observation == "noisy":
            entries.append(("observed position", colors.VERMILLION))
        policy, warnings = flight.about.get("policy"), self._warnings(flight)
        flown_by = [f"flown by {short_name(str(policy))}"] if policy else []
        lines = [title, *flown_by, *[words for words, _ in entries], *warnings]
        width = 26 + max(
            canvas.width_of(words, large if k == 0 else small) for k, words in enumerate(lines)
        )
        step = canvas.line_height(small) + 2
        clock = f"{now['time']:.2f} s"
        width = max(width, canvas.width_of(f"{title}   {clock}", large) + 12)
        canvas.veil(6, 6, width, 8 + canvas.line_height(large) + step * (len(lines) - 1))
        x, y = 12.0, 9.0
        canvas.text(title, x, y, large)
        canvas.text(clock, 6 + width - 6, y, large, colors.INK, 1.0)
        y += canvas.line_height(large) + 2
        for words in flown_by:
            canvas.text(words, x, y, small)
            y += step
        y = canvas.write_legend(entries, x, y, small)
        for words in warnings:
            canvas.text(words, x, y, small)
            y += step

    @staticmethod
    def _warnings(flight: Flight) -> list[str]:
        rows, now = flight.rows, flight.rows[-1]
        found = [f"fault: {name}" for name in active_faults(flight)]
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


def active_faults(flight: Flight) -> list[str]:
    """Readable names of the faults at the last instant of a flight."""
    active = int(flight.rows[-1]["faults"])
    return [_spoken(kind) for kind in FaultKind if active >> kind & 1]


def _spoken(fault: FaultKind) -> str:
    words = fault.name.lower().split("_")
    return " ".join(word.upper() if word in ("gnss", "imu") else word for word in words)


_SEEN = {
    "truth": "the truth",
    "estimate": "the estimate",
    "noisy": "noisy truth",
    "measurements": "raw measurements",
}


def checked_size(size: tuple[int, int]) -> tuple[int, int]:
    """Check width and height of a picture [pixels].

    Raises:
        ValueError: If they are not integers, too small for the text, or odd, which video formats do
            not support.
    """
    if not isinstance(size, (tuple, list)) or len(size) != 2:
        raise ValueError(f"render_size must be a width and a height, got {size!r}")
    width = check.whole("render_size[0]", size[0], least=LEAST_WIDTH)
    height = check.whole("render_size[1]", size[1], least=LEAST_HEIGHT)
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

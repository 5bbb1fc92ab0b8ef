"""`Renderer`: pictures of the last instant of a flight, also of one that flies on."""

import os
import time
from collections.abc import Sequence
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from quad_gym.analysis.reports import short_name
from quad_gym.batch.flight_batch import FlightBatch
from quad_gym.flights import Flight, FlightRecorder, FlightScene
from quad_gym.params import checks as check
from quad_gym.records import FaultKind, FilterStatus, GateDecision
from quad_gym.rendering import canvas as colors
from quad_gym.rendering.canvas import Canvas, Mark, load_pygame
from quad_gym.rendering.geometry import (
    Perspective,
    chase_view,
    course_view,
    fixed_view,
    follow_view,
)
from quad_gym.rendering.scene import Inset, Scene, ellipsoid_scale, inset_box

# --------------------------------------------------------------------------------------------------
# `Renderer`: pictures of the last instant of a flight.
# --------------------------------------------------------------------------------------------------

VIEWS = ("fixed", "chase")  #: names of the views of a flight
MOVING_VIEWS = {"chase": chase_view, "follow": follow_view, "course": course_view}
MIN_WIDTH, MIN_HEIGHT = 320, 240
STALE_FIX = 0.5  #: time without a fix after which a warning is shown [s]
_GRAIN = 16  #: of the legend's width, which else would change with its numbers [pixels]
_SEEN = {
    "truth": "truth",
    "estimate": "estimate",
    "noisy": "noisy truth",
    "measurements": "raw measurements",
}


class Renderer:
    """Renderer of recorded flights.

    Args:
        view: "fixed" (the whole reference from outside), "chase" (from behind the vehicle),
            "follow" (from the east, moving with the vehicle) or "course" (from above and behind,
            along a course of obstacles, without the reference).
        size: Width and height [pixels].
        legend: True to show task, time, legend and errors, and the image of the camera.
        path_I: Positions of a whole flight, (n, 3) in I [m], which a fixed view then contains. A
            vehicle that leaves the reference stays in the picture for 3 m.

    Raises:
        ValueError: If an argument is invalid.
        ImportError: If pygame is not installed.
    """

    def __init__(
        self,
        view: str = "fixed",
        size: tuple[int, int] = (640, 480),
        *,
        legend: bool = True,
        path_I: NDArray[np.float64] | None = None,
    ) -> None:
        self._legend, self._path_I = legend, path_I
        self.view = check.choice("render_view", view, ("fixed", *MOVING_VIEWS))
        self.size = checked_size(size)
        width, height = self.size
        self._canvas = Canvas(width, height)
        self._text = max(14, round(18 * min(width / 640, height / 480)))
        self._scene: FlightScene | None = None
        """Scene of the flight to which the stored view and background belong."""
        self._fixed: Perspective

    def draw(self, flight: Flight, stamp: str = "") -> NDArray[np.uint8]:
        """Draw the last instant of a flight; `flight.until(t)` ends at a time t.

        Args:
            flight: Flight to draw.
            stamp: Words to write in large letters across the picture.

        Returns:
            Picture in red, green, blue, (height, width, 3).
        """
        canvas, (width, height), small = self._canvas, self.size, self._text - 2
        spacing = 4.0 if self.view == "course" else 1.0
        view, moving, on_course = self._view_of(flight), self.view != "fixed", self.view == "course"
        scene = Scene(canvas, flight, view, moving, spacing, shows_reference=not on_course)
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
        if stamp:
            large = 2 * self._text
            top = 0.16 * height
            canvas.text(stamp, 0.5 * width, top, large, colors.VERMILLION, 0.5)
        return canvas.pixels()

    def __reduce__(self) -> Any:
        made = partial(Renderer, legend=self._legend, path_I=self._path_I)
        return made, (self.view, self.size)

    def _view_of(self, flight: Flight) -> Perspective:
        """Perspective in which the last instant of a flight is drawn."""
        if self.view != "fixed":
            return MOVING_VIEWS[self.view](flight, *self.size)
        if self._scene is not flight.scene:
            top = self._legend_bottom(len(_legend_lines(flight)) + 1) if self._legend else 0.0
            self._fixed = fixed_view(flight, *self.size, top, self._path_I)
        return self._fixed

    def _legend_bottom(self, lines: int) -> float:
        """Bottom of a legend with a number of lines below its title [pixels]."""
        return 6.0 + self._line_top(lines) + 3.0

    def _line_top(self, k: int) -> float:
        """Top of the k-th line of the legend, in its panel [pixels]."""
        canvas, large, small = self._canvas, self._text + 2, self._text - 1
        return 5.0 + canvas.line_height(large) + (canvas.line_height(small) + 2) * k

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
        name = str(flight.about.get("task", flight.scene.task)).replace("_", " ").title()
        title = f"{name.replace(' ', '')}, {_SEEN[flight.scene.observation]}"
        clock = f"{flight['time'][-1]:.2f} s"
        errors = errors_of(flight)
        lines = [*_legend_lines(flight), *((words, None) for words in _warnings(flight))]
        width = max(26 + canvas.width_of(words, small) for words, _ in lines)
        head = (canvas.width_of(words, large) for words in (title, "   ", clock))
        width = -(-max(width, sum(head) + 12) // _GRAIN) * _GRAIN
        places = {words: self._line_top(k) for k, (words, _) in enumerate(lines)}

        def write() -> None:  # without what changes in each picture
            canvas.text(title, 6, 3, large)
            for words, mark in lines:
                if mark is not None:
                    canvas.mark(mark, 6, places[words], small)
                if words != errors:
                    canvas.text(words, 6 if mark is None else 21, places[words], small)

        key = (title, width, *((words, mark) for words, mark in lines if words != errors))
        canvas.panel(key, (6, 6), (width, self._legend_bottom(len(lines)) - 6.0), write)
        canvas.text(clock, width, 9, large, colors.INK, 1.0)
        canvas.text(errors, 12, 6 + places[errors], small)


def _legend_lines(flight: Flight) -> list[tuple[str, Mark | None]]:
    """Lines of the legend below its title, without warnings."""
    policy = flight.about.get("policy")
    lines: list[tuple[str, Mark | None]] = [(_controller(str(policy)), None)] if policy else []
    return [*lines, *legend_of(flight), (errors_of(flight), None)]


def _controller(policy: str) -> str:
    """Name of a controller for readers."""
    known = {"pd": "PD control", "pretrained": "included policy"}
    return known.get(policy, f"controller: {short_name(policy)}")


def legend_of(flight: Flight) -> list[tuple[str, Mark]]:
    """Names and marks of the parts of a picture."""
    scene = flight.scene
    found: list[tuple[str, Mark]] = []
    found += [("next gate" if len(scene.gates_I) else "reference", ("line", colors.GREEN))]
    if scene.reference_period and not len(scene.gates_I):
        found = [
            ("reference", ("line", colors.GREY)),
            ("reference, next 1 s", ("line", colors.GREEN)),
        ]
    found += [("truth", ("line", colors.BLUE))]
    if flight.estimated:
        scale = ellipsoid_scale(flight)
        size = "3σ ellipsoid, to scale"
        size = size if scale == 1.0 else f"3σ ellipsoid and error, {scale:g} times as large"
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
    if not frames:
        raise ValueError("frames must be at least one, got none")
    columns = int(np.ceil(np.sqrt(len(frames))))
    rows = -(-len(frames) // columns)
    height, width = frames[0].shape[:2]
    sheet = np.full((rows * height, columns * width, 3), 255, np.uint8)
    for k, frame in enumerate(frames):
        i, j = divmod(k, columns)
        sheet[i * height : (i + 1) * height, j * width : (j + 1) * width] = frame
    return sheet


# --------------------------------------------------------------------------------------------------
# Rendering of environments while they fly: the render modes of Gymnasium, and a window.
# --------------------------------------------------------------------------------------------------

RENDER_MODES = ("human", "rgb_array", "rgb_array_list")
"""Values of Gymnasium's `render_mode`, besides None."""
WINDOW_RATE = 50.0  #: largest number of pictures per second in a window [Hz]

_INVISIBLE = ("offscreen", "dummy")
"""Drivers that SDL uses without a display; their windows are invisible."""


class Window:
    """Window on the screen that shows frames in real time.

    Raises:
        RuntimeError: If there is no display to open a window on. A driver without a display, such
            as "dummy", is used only if the environment variable SDL_VIDEODRIVER names it.
    """

    def __init__(self, size: tuple[int, int], title: str) -> None:
        self._pygame = load_pygame()
        try:
            self._pygame.display.init()
            driver = self._pygame.display.get_driver()
            if driver in _INVISIBLE and "SDL_VIDEODRIVER" not in os.environ:
                raise self._pygame.error("no display was found")
            self._screen = self._pygame.display.set_mode(size)
        except self._pygame.error as error:
            self._pygame.display.quit()
            raise RuntimeError(f"cannot open a window: {error}") from None
        self._pygame.display.set_caption(title)
        self._due = time.monotonic()
        self.closed = False

    def show(self, frame: NDArray[np.uint8], seconds: float) -> None:
        """Show a frame after the previous one has been visible for its duration [s].

        A window that its user has closed shows nothing.
        """
        if not self.closed and self._pygame.event.get(self._pygame.QUIT):
            self.close()
        if self.closed:
            return
        self._pygame.event.clear()
        image = self._pygame.image.frombuffer(frame.tobytes(), frame.shape[1::-1], "RGB")
        self._screen.blit(image, (0, 0))
        time.sleep(max(0.0, self._due - time.monotonic()))
        self._pygame.display.flip()
        self._due = max(self._due, time.monotonic() - 0.1) + seconds  # delays are not caught up

    def close(self) -> None:
        """Close the window, if it is open."""
        if not self.closed:
            self._pygame.display.quit()
            self.closed = True


class Rendering:
    """Rendering of an environment: it records the flights, and draws them on request.

    It reads the batch and never changes it. Pygame is imported with the first picture, so that
    environments can be made without it: Stable-Baselines3 asks for "rgb_array" by default.

    Args:
        batch: Flights of the environment.
        mode: One of `RENDER_MODES`.
        flights: Indices of the flights to show; None: all of them.
        view: "fixed" or "chase".
        size: Width and height of each picture [pixels].

    Raises:
        ValueError: If an argument is invalid.
    """

    def __init__(
        self,
        batch: FlightBatch,
        mode: str,
        *,
        flights: Sequence[int] | None = None,
        view: str = "fixed",
        size: tuple[int, int] = (640, 480),
    ) -> None:
        check.choice("render_mode", mode, RENDER_MODES)
        self.mode = mode
        chosen = range(batch.count) if flights is None else flights
        if not len(chosen):
            raise ValueError("render_flights must choose at least one flight")
        self._recorders = [
            FlightRecorder(batch, check.whole("render_flights", i, least=0)) for i in chosen
        ]
        self._batch = batch
        self._look = check.choice("render_view", view, VIEWS), checked_size(size)
        self._renderers: list[Renderer] = []
        self.frame_rate = batch.clocks.control_rate
        self._frames: list[tuple[NDArray[np.uint8], ...]] = []
        self._window: Window | None = None
        self._closed = False
        self._waiting = 0.0
        self._title = f"quad_gym: {batch.task.kind}"

    def observe(self, *, reset: bool = False) -> None:
        """Record the present instant; to be called after every reset and every step."""
        for recorder in self._recorders:
            recorder.keep()
        if self.mode == "rgb_array_list":
            if reset:
                self._frames.clear()
            self._frames.append(self.frames())
        elif self.mode == "human" and not self._closed:
            self._show(at_once=reset)

    def frames(self) -> tuple[NDArray[np.uint8], ...]:
        """Return pictures of the present instant, one per shown flight."""
        if not self._renderers:
            self._renderers = [Renderer(*self._look) for _ in self._recorders]
        if not self._batch.begun:  # a snapshot may have been restored
            for recorder in self._recorders:
                recorder.keep()
        pairs = zip(self._renderers, self._recorders, strict=True)
        return tuple(renderer.draw(recorder.flight) for renderer, recorder in pairs)

    def taken_frames(self) -> list[tuple[NDArray[np.uint8], ...]]:
        """Return pictures of all instants since the last call or reset, for "rgb_array_list"."""
        frames, self._frames = self._frames, []
        return frames

    @property
    def flights(self) -> list[Flight]:
        """Shown flights, since the start of their episodes."""
        return [recorder.flight for recorder in self._recorders]

    def close(self) -> None:
        """Close the window, if it is open."""
        self._closed = True
        if self._window is not None:
            self._window.close()
            self._window = None

    def _show(self, at_once: bool) -> None:
        # fast controllers are shown at a slower rate, but in real time
        self._waiting += 1.0 / self.frame_rate
        if self._waiting < 0.999 / WINDOW_RATE and not at_once:
            return
        seconds, self._waiting = self._waiting, 0.0
        picture = tile(list(self.frames()))
        if self._window is None:
            self._window = self._open((picture.shape[1], picture.shape[0]))
        self._window.show(picture, seconds)

    def _open(self, size: tuple[int, int]) -> Window:
        try:
            return Window(size, self._title)
        except RuntimeError as error:
            raise RuntimeError(
                f'{error}. Without a display, use render_mode="rgb_array" for pictures, or set '
                "SDL_VIDEODRIVER=dummy to run without a visible window."
            ) from None

    def __getstate__(self) -> dict[str, Any]:
        return self.__dict__ | {"_window": None}  # a copy opens its own

"""Rendering of environments while they fly: the render modes of Gymnasium, and a window."""

import os
import time
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from quad_gym.batch.flight_batch import FlightBatch
from quad_gym.flights.record import Flight, FlightRecorder
from quad_gym.params import checks as check
from quad_gym.rendering.canvas import load_pygame
from quad_gym.rendering.renderer import VIEWS, Renderer, checked_size, tile

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

"""Rendering, the same for all interfaces of an environment; imports nothing until it is used.

Pygame is imported with the first picture: environments with a render mode can be made without it.
"""

import copy
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import gymnasium
from gymnasium.envs.registration import EnvSpec

from quad_gym.envs.flights import Flights
from quad_gym.envs.keywords import RENDERING_KEYWORDS

if TYPE_CHECKING:
    from quad_gym.rendering.live import Rendering

RENDERING_METADATA: dict[str, Any] = {
    "render_modes": ["human", "rgb_array", "rgb_array_list"],
    "render_fps": 50,
}
"""Gymnasium's metadata; an environment's own has its control rate as the frame rate."""


def rendering_options(keywords: dict[str, Any]) -> dict[str, Any]:
    """Remove the rendering keywords from the keywords of an environment, and return them."""
    return {name: keywords.pop(name) for name in RENDERING_KEYWORDS if name in keywords}


class Rendered:
    """Flights with a renderer and Gymnasium's description, as the interfaces have them."""

    flights: Flights
    render_mode: str | None
    rendering: "Rendering | None"
    _spec: EnvSpec | None = None
    _seeded = False

    def _open(self, flights: Flights, mode: str | None, keywords: Mapping[str, Any]) -> None:
        """Set flights, and a renderer if there is a `render_mode`, which other keywords need."""
        self.flights, self.render_mode, self.rendering = flights, mode, None
        given = {name: value for name, value in keywords.items() if value is not None}
        if mode is None and given:
            raise ValueError(f"{next(iter(given))} needs a render_mode, got None")
        if mode is not None:
            from quad_gym.rendering.live import Rendering

            options = {name.removeprefix("render_"): value for name, value in given.items()}
            self.rendering = Rendering(flights.batch, mode, **options)

    @property
    def spec(self) -> EnvSpec | None:
        """Gymnasium's description of the environment, with the time limit in steps."""
        return self._spec

    @spec.setter
    def spec(self, value: EnvSpec | None) -> None:
        """Store a description with the time limit of the environment, not of a wrapper."""
        self._spec = copy.copy(value)
        if self._spec is not None:
            self._spec.max_episode_steps = self.flights.batch.max_steps or None

    def _open_rendering(self, make: str) -> "Rendering | None":
        """Return the renderer of flights that have begun, or warn if it is missing."""
        if self.rendering is None:
            gymnasium.logger.warn(
                f"render() needs a render_mode: {make}(..., render_mode='rgb_array')"
            )
        elif not self._seeded:
            raise gymnasium.error.ResetNeeded("call reset() before render()")
        return self.rendering

    def close(self) -> None:
        """Close the window, if there is one; closing twice is fine."""
        if self.rendering is not None:
            self.rendering.close()

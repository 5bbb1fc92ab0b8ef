"""Rendering, the same for all interfaces of an environment; imports nothing until it is used.

Pygame is imported with the first picture: environments with a render mode can be made without it.
"""

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

from quad_gym.envs.configuration import Flights
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


def rendering_of(
    flights: Flights,
    render_mode: str | None,
    *,
    render_view: str | None = None,
    render_size: tuple[int, int] | None = None,
    render_flights: Sequence[int] | None = None,
) -> "Rendering | None":
    """Return the renderer of an environment; None if it does not render."""
    given: dict[str, Any] = {"view": render_view, "size": render_size, "flights": render_flights}
    given = {name: value for name, value in given.items() if value is not None}
    if render_mode is None:
        if given:
            raise ValueError(f"render_{next(iter(given))} needs a render_mode, got None")
        return None
    from quad_gym.rendering.live import Rendering

    return Rendering(flights.batch, render_mode, **given)

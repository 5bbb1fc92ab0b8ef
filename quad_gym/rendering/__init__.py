"""Pictures of flights: live, from a record, as frames and videos, and in a window; uses pygame.

`gymnasium.make(..., render_mode="rgb_array")` is the usual interface. Its parts: `Renderer` draws a
`quad_gym.Flight`, `tile` puts frames side by side, `record_flight` flies a policy and returns the
flight, `save_video` writes a flight as a video, and `record_video` does both; `save_side_by_side`
writes flights of one episode side by side.
"""

from quad_gym.rendering.live import RENDER_MODES, Rendering
from quad_gym.rendering.renderer import VIEWS, Renderer, tile
from quad_gym.rendering.side_by_side import Side, SideBySide, save_side_by_side
from quad_gym.rendering.video import flight_of, record_flight, record_video, save_video

__all__ = [
    "RENDER_MODES",
    "VIEWS",
    "Renderer",
    "Rendering",
    "Side",
    "SideBySide",
    "flight_of",
    "record_flight",
    "record_video",
    "save_side_by_side",
    "save_video",
    "tile",
]

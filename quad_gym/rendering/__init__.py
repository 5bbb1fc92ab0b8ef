"""Rendering of flights with pygame: frames, videos, and a window.

`gymnasium.make(..., render_mode="rgb_array")` is the usual interface. `Renderer` draws a
`quad_gym.Flight`, `tile` arranges frames in a grid, `record_flight` runs a policy and returns the
flight, `save_video` writes a flight as a video, and `save_side_by_side` several flights of one
episode.
"""

from quad_gym.rendering.renderer import RENDER_MODES, VIEWS, Renderer, Rendering, tile
from quad_gym.rendering.video import Side, SideBySide, record_flight, save_side_by_side, save_video

__all__ = [
    "RENDER_MODES",
    "VIEWS",
    "Renderer",
    "Rendering",
    "Side",
    "SideBySide",
    "record_flight",
    "save_side_by_side",
    "save_video",
    "tile",
]

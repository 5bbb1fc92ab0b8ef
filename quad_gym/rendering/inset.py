"""Inset with the image plane of the vehicle's camera and the features in it."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from quad_gym.flights.flight_scene import FlightScene
from quad_gym.flights.record import Flight
from quad_gym.records import GateDecision
from quad_gym.rendering import colors
from quad_gym.rendering.canvas import Canvas
from quad_gym.rotations import quaternion_to_dcm

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class Box:
    """Rectangle [pixels]."""

    left: float
    top: float
    width: float
    height: float


def place_in_inset(pixels: Floats, scene: FlightScene, box: Box) -> Floats:
    """Convert image coordinates of the camera (..., 2) to pixels of the inset.

    The image is shown upright: it is turned by half a turn if the camera's y axis points up.
    """
    turn = -1.0 if scene.R_CB[1, 2] > 0.0 else 1.0
    center = np.array([box.left + box.width / 2, box.top + box.height / 2])
    return np.asarray(center + turn * pixels * box.width / (2.0 * scene.half_image[0]))


def inset_box(scene: FlightScene, right: float, top: float, width: float) -> Box:
    """Box with the proportions of the image, given its right edge, top and width."""
    height = width * float(scene.half_image[1] / scene.half_image[0])
    return Box(right - width, top, width, height)


def last_image(flight: Flight) -> NDArray[np.void]:
    """Row of the last image, which is shown until the next one is due.

    If the camera rate is lower than the control rate, most rows have no image. If the last image
    had no feature, this is the present row.
    """
    scene = flight.scene
    held = max(1, round(scene.control_rate / scene.camera_rate))
    rows = flight.rows[-held:]
    seen = np.flatnonzero(np.isfinite(rows["pixels"]).any(axis=(1, 2)))
    return rows[seen[-1] if seen.size else -1]


class Inset:
    """Image of the camera for the last row of a flight, in a box, with text of a size [pixels]."""

    def __init__(self, canvas: Canvas, flight: Flight, box: Box, size: int) -> None:
        self._canvas, self._scene, self._box, self._size = canvas, flight.scene, box, size
        self._image = last_image(flight)
        self._refused = self._image["feature_decision"] == GateDecision.REJECTED

    def draw(self) -> None:
        """Draw measured features as crosses, and features predicted from the estimate as rings."""
        canvas, box, scene, image = self._canvas, self._box, self._scene, self._image
        canvas.box(box.left, box.top, box.width, box.height, colors.WHITE)
        x, y = box.left + box.width / 2, box.top + box.height / 2
        canvas.line(np.array([[box.left, y], [box.left + box.width, y]]), colors.PALE)
        canvas.line(np.array([[x, box.top], [x, box.top + box.height]]), colors.PALE)
        canvas.inside((box.left, box.top, box.width, box.height))
        q = image["estimated_quaternion"]
        if np.isfinite(q).all():
            predicted = scene.project_features(image["estimated_position"], quaternion_to_dcm(q))
            for at in place_in_inset(predicted, scene, box):
                canvas.disc(at, 6.0, colors.VERMILLION, 1.5)
        places, refused = place_in_inset(image["pixels"], scene, box), self._refused
        canvas.crosses(places[~refused], 3.2, colors.INK, 1.6)
        canvas.crosses(places[refused], 3.2, colors.GREY, 1.6)
        canvas.inside(None)
        canvas.box(box.left, box.top, box.width, box.height, colors.GREY, 1.0)

    def write(self) -> None:
        """Write a title and the numbers of the features."""
        canvas, box, image = self._canvas, self._box, self._image
        seen = np.isfinite(image["pixels"]).all(axis=1)
        wordings = ["camera"] if seen.any() else ["camera: no feature in view", "no feature"]
        if (count := self._refused.sum()) > 0:
            wordings = [f"camera: {count} rejected (gray)", f"{count} rejected"]
        top, size = box.top + box.height + 2.0, self._size
        words = canvas.fitting(wordings, size, box.width - 4.0)
        width = canvas.width_of(words, size)
        canvas.veil(box.left, top, width + 8, canvas.line_height(size))
        ink = colors.INK if seen.any() else colors.GREY
        canvas.text(words, box.left + 4.0, top + 1.0, size, ink)
        if len(seen) <= 4:
            for k in np.flatnonzero(seen):
                x, y = place_in_inset(image["pixels"][k], self._scene, box)
                canvas.text(str(k + 1), x + 8.0, y - 6.0, self._size - 2)

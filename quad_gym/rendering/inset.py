"""The inset: the image plane of the vehicle's camera, with the features in it."""

import numpy as np
from numpy.typing import NDArray

from quad_gym.flights.flight_scene import FlightScene
from quad_gym.flights.record import Flight
from quad_gym.records import GateDecision
from quad_gym.rendering.canvas import GREY, INK, PALE, VERMILLION, WHITE, Canvas
from quad_gym.rendering.strip import Box
from quad_gym.rotations import quaternion_to_dcm

Floats = NDArray[np.float64]


def place_in_inset(pixels: Floats, scene: FlightScene, box: Box) -> Floats:
    """Where pixels of the camera, from its image's center, are in the inset.

    The image is turned upright: half a turn, where the camera's y axis points up in the body.

    Args:
        pixels: (..., 2).
        scene: Of the flight.
        box: The inset, as wide and high as the image in proportion.
    """
    turn = -1.0 if scene.R_CB[1, 2] > 0.0 else 1.0
    center = np.array([box.left + box.width / 2, box.top + box.height / 2])
    return np.asarray(center + turn * pixels * box.width / (2.0 * scene.half_image[0]))


def inset_box(scene: FlightScene, right: float, top: float, width: float) -> Box:
    """A box in the proportions of the image, by its right edge, top and width."""
    height = width * float(scene.half_image[1] / scene.half_image[0])
    return Box(right - width, top, width, height)


def last_image(flight: Flight) -> NDArray[np.void]:
    """The row of the last image, which is shown until the next one is due.

    Where cameras are slower than control most rows have no image; if the last one held no feature,
    this is the present row.
    """
    scene = flight.scene
    held = max(1, round(scene.control_rate / scene.camera_rate))
    rows = flight.rows[-held:]
    seen = np.flatnonzero(np.isfinite(rows["pixels"]).any(axis=(1, 2)))
    return rows[seen[-1] if seen.size else -1]


def rejected_features(row: NDArray[np.void]) -> NDArray[np.bool_]:
    """Which features of a row the filter's gate has left out, (n,)."""
    return np.asarray(row["feature_decision"] == GateDecision.REJECTED)


class Inset:
    """Draws the camera's image for the last row of a flight.

    Args:
        canvas: To draw on.
        box: Where.
        size: Of the text [pixels].
    """

    def __init__(self, canvas: Canvas, box: Box, size: int) -> None:
        self._canvas, self._box, self._size = canvas, box, size

    def draw(self, flight: Flight) -> None:
        """Measured features as crosses, those that the estimate predicts as rings."""
        canvas, box, scene, image = self._canvas, self._box, flight.scene, last_image(flight)
        canvas.box(box.left, box.top, box.width, box.height, WHITE)
        x, y = box.left + box.width / 2, box.top + box.height / 2
        canvas.line(np.array([[box.left, y], [box.left + box.width, y]]), PALE)
        canvas.line(np.array([[x, box.top], [x, box.top + box.height]]), PALE)
        canvas.inside((box.left, box.top, box.width, box.height))
        q = image["estimated_quaternion"]
        if np.isfinite(q).all():
            predicted = scene.project_features(image["estimated_position"], quaternion_to_dcm(q))
            for at in place_in_inset(predicted, scene, box):
                canvas.disc(at, 6.0, VERMILLION, 1.5)
        places, refused = place_in_inset(image["pixels"], scene, box), rejected_features(image)
        canvas.crosses(places[~refused], 3.2, INK, 1.6)
        canvas.crosses(places[refused], 3.2, GREY, 1.6)
        canvas.inside(None)
        canvas.box(box.left, box.top, box.width, box.height, GREY, 1.0)

    def write(self, flight: Flight) -> None:
        """Name the features and say what the picture is."""
        canvas, box, image = self._canvas, self._box, last_image(flight)
        seen = np.isfinite(image["pixels"]).all(axis=1)
        wordings = ["camera"] if seen.any() else ["camera: no feature in view", "no feature"]
        if (count := rejected_features(image).sum()) > 0:
            wordings = [f"camera: {count} rejected (gray)", f"{count} rejected"]
        top, size = box.top + box.height + 2.0, self._size
        words = canvas.fitting(wordings, size, box.width - 4.0)
        width = canvas.width_of(words, size)
        canvas.veil(box.left, top, width + 8, canvas.line_height(size))
        canvas.text(words, box.left + 4.0, top + 1.0, size, INK if seen.any() else GREY)
        if len(seen) <= 4:
            for k in np.flatnonzero(seen):
                x, y = place_in_inset(image["pixels"][k], flight.scene, box)
                canvas.text(str(k + 1), x + 8.0, y - 6.0, self._size - 2)

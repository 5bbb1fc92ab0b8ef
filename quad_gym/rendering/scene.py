"""Scene in perspective: ground, reference, vehicle, estimate, fixes, and the camera's image."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from quad_gym.flights import Flight, FlightScene
from quad_gym.records import GateDecision
from quad_gym.rendering import canvas as colors
from quad_gym.rendering.canvas import Canvas, Color, Label
from quad_gym.rendering.geometry import (
    Perspective,
    attitude_of,
    ellipsoid_axes,
    ellipsoid_outline,
    faces_of,
)

# --------------------------------------------------------------------------------------------------
# Inset with the image plane of the vehicle's camera and the features in it.
# --------------------------------------------------------------------------------------------------

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
            predicted = scene.project_features(image["estimated_position"], attitude_of(q))
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
        wordings = ["camera"] if seen.any() else ["camera: no marker in view", "no marker"]
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
                canvas.text(str(k), x + 8.0, y - 6.0, self._size - 2)


# --------------------------------------------------------------------------------------------------
# Scene in perspective: ground, reference, vehicle, estimate, fixes and features.
# --------------------------------------------------------------------------------------------------

TRAIL_SECONDS, FIX_SECONDS, AHEAD_SECONDS = 6.0, 1.5, 1.0
"""Durations of trails, of fixes, and of the part of the reference ahead that is drawn bold [s]."""
TRAIL_POINTS = 180
SIGMAS = 3.0
ELLIPSOID_SCALES = (50.0, 20.0, 10.0, 5.0, 2.0, 1.0)  #: by which an ellipsoid may be magnified
ELLIPSOID_LIMIT, SCALE_SECONDS = 0.5, 3.0  #: largest half-axis then [m], over the past [s]
ROTOR_RADIUS, FRUSTUM_DEPTH, GRID_HALF_SIZE = 0.13, 0.55, 9  #: [m]

_LINES = np.arange(-GRID_HALF_SIZE, GRID_HALF_SIZE + 1.0)
_NORTHWARD = [
    np.stack([_LINES, np.full_like(_LINES, s * GRID_HALF_SIZE), 0.0 * _LINES], axis=1)
    for s in (-1, 1)
]
_GRID = np.stack([np.concatenate([ends, ends[:, [1, 0, 2]]]) for ends in _NORTHWARD])
"""Start and end points of the lines on the ground, one meter apart, (2, n, 3)."""
_CIRCLE = np.linspace(0.0, 2.0 * np.pi, 25)
_RING = np.stack([np.cos(_CIRCLE), np.sin(_CIRCLE), np.zeros_like(_CIRCLE)], axis=1)

HARDLY_VISIBLE = 30.0  #: scale below which a vehicle is marked by a disc [pixels/m]
SMALLEST_SPAN = 44.0  #: distance between opposite rotors below which a vehicle is enlarged [pixels]
MAX_ENLARGEMENT = 4.0
SOLID, GLASS = 0.55, 0.12  #: opacity of obstacles behind the vehicle, and in front of it
EDGES = (
    (0, 1),
    (0, 2),
    (0, 4),
    (1, 3),
    (1, 5),
    (2, 3),
    (2, 6),
    (3, 7),
    (4, 5),
    (4, 6),
    (5, 7),
    (6, 7),
)
"""Edges of a box whose corners are numbered in binary: x, y, z."""


def ellipsoid_scale(flight: Flight) -> float:
    """Factor by which the ellipsoid is magnified, so that it is visible but not too large.

    It depends on the largest standard deviation of the last seconds, so it rarely changes.
    """
    recent = flight.rows[-max(1, round(SCALE_SECONDS * flight.scene.control_rate)) :]
    variances = np.diagonal(recent["covariance"][:, :3, :3], axis1=1, axis2=2)
    variances = variances[np.isfinite(variances)]
    largest = SIGMAS * np.sqrt(variances.max()) if variances.size else 0.0
    fitting = [s for s in ELLIPSOID_SCALES if s * largest <= ELLIPSOID_LIMIT]
    return fitting[0] if fitting else 1.0


class Scene:
    """Drawing of the last row of a flight in a view, which may be moving with the vehicle.

    The lines on the ground have a `spacing` [m].
    """

    def __init__(
        self,
        canvas: Canvas,
        flight: Flight,
        view: Perspective,
        moving: bool,
        spacing: float,
        shows_reference: bool = True,
    ) -> None:
        self._canvas, self._flight, self._view, self._moving = canvas, flight, view, moving
        self._shows_reference = shows_reference
        self._spacing = spacing
        self._scene, self._now = flight.scene, flight.rows[-1]
        self._R_BI = self._attitude("quaternion")
        self.labels: list[Label] = []

    def draw_background(self) -> None:
        """Draw the parts that do not change during a flight: ground, axes, and a fixed path."""
        self._ground()
        scene = self._scene
        if scene.reference_period and not len(scene.gates_I):
            self._path(scene.reference(np.linspace(0.0, scene.reference_period, 1 + scene.pieces)))

    def draw(self) -> list[Label]:
        """Draw the rest from back to front; return the labels to write when all is drawn."""
        for tip, name in ((1.15, 0.0, 0.0), "E"), ((0.0, 1.15, 0.0), "N"):
            self.labels.append((name, self._view.project(np.array(tip))[0], colors.GREY))
        if self._shows_reference:
            self._reference()
        self._gates()
        self._fence()
        self._obstacles(before_vehicle=False)
        self._shadow()
        self._trails()
        self._camera()
        self._boxes(self._scene.anchors_I, [colors.PURPLE] * len(self._scene.anchors_I))
        self._fixes()
        self._estimate()
        self._body(np.array(self._now["position"]), self._R_BI, ghost=False)
        self._axes()
        self._obstacles(before_vehicle=True)
        return self.labels

    def _lines(self, starts: Floats, ends: Floats, color: Color, width: float = 1.0) -> None:
        """Draw line segments between points (n, 3) or (3,) in I."""
        self._canvas.segments(self._view.segments(starts, ends), color, width)

    # ---- the world ----------------------------------------------------------------------------

    def _ground(self) -> None:
        view, canvas = self._view, self._canvas
        n = GRID_HALF_SIZE
        shift = np.zeros(3)
        wide = bool((np.abs(self._scene.obstacles[:, 1:3]) > n).any())
        if self._moving or wide:  # an infinite plane, with the grid around the vehicle
            shift[:2] = self._spacing * np.round(self._now["position"][:2] / self._spacing)
            canvas.clear(colors.SKY, bottom=view.horizon)
            canvas.clear(colors.GROUND, top=view.horizon)
        else:
            canvas.clear(colors.SKY)
            corners = n * np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]])
            border = view.segments(corners, np.roll(corners, -1, axis=0))
            canvas.polygon(border.reshape(-1, 2), colors.GROUND)
        starts, ends = self._spacing * _GRID + shift
        self._lines(starts, ends, colors.GRID)
        self._lines(np.zeros(3), np.eye(3)[:2], colors.GREY, 1.6)

    def _reference(self) -> None:
        scene, view, canvas = self._scene, self._view, self._canvas
        now = float(self._now["time"])
        if len(scene.gates_I):
            first = int(self._now["gates_passed"])
            self._path(np.concatenate([self._now["position"][np.newaxis], scene.gates_I[first:]]))
            return
        if scene.reference_period:
            ahead = np.linspace(now, now + AHEAD_SECONDS, 24)
            canvas.line(view.project(scene.reference(ahead))[0], colors.GREEN, 3.0)
        at, _ = view.project(self._now["reference_position"])
        canvas.disc(at, 5.0, colors.WHITE)
        canvas.disc(at, 5.0, colors.GREEN, 2.0)

    def _path(self, points: Floats) -> None:
        self._canvas.dashes(self._view.project(points)[0], colors.GREY, 1.2)

    def _gates(self) -> None:
        view, canvas = self._view, self._canvas
        passed = int(self._now["gates_passed"])
        for k, gate in enumerate(self._scene.gates_I):
            color = colors.PALE if k < passed else colors.GREEN if k == passed else colors.GREY
            sphere = self._scene.gate_radius * np.eye(3)
            outline = ellipsoid_outline(gate, sphere, view)
            bottom = gate - (0.0, 0.0, self._scene.gate_radius)
            self._lines(gate * (1.0, 1.0, 0.0), bottom, color)
            if k == passed:
                canvas.polygon(outline, color, 0.15)
            canvas.line(outline, color, 2.5 if k == passed else 1.5, closed=True)
            ink = colors.GREY if k < passed else colors.INK
            self.labels.append((str(k + 1), view.project(gate)[0] - (0.0, 6.0), ink))

    def _obstacles(self, before_vehicle: bool) -> None:
        """Draw the obstacles behind the vehicle, or those in front, nearly transparent."""
        view, canvas = self._view, self._canvas
        far = np.linalg.norm(self._now["position"] - view.eye)
        chosen = []
        for obstacle in self._scene.obstacles:
            faces = faces_of(obstacle, view.eye)
            # walls are long: use the point that is nearest to the eye
            corners = np.concatenate(faces)
            distance = float(np.linalg.norm(corners - view.eye, axis=1).min())
            if (distance < far) == before_vehicle:
                chosen.append((distance, faces))
        for _, faces in sorted(chosen, key=lambda one: -one[0]):
            is_round = any(len(face) > 4 for face in faces)
            for face in faces:
                outline = view.outline(face)
                canvas.polygon(outline, colors.GREY, GLASS if before_vehicle else SOLID)
                if len(face) > 4 or not is_round:
                    canvas.line(outline, colors.GREY, 1.2, closed=True)

    def _fence(self) -> None:
        """Draw the edges of the geofence."""
        fence = self._scene.geofence_I
        if len(fence):
            corners = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)])
            places = np.where(corners == 0, fence[0], fence[1])
            a, b = np.array(EDGES).T
            self._lines(places[a], places[b], colors.PALE)

    def _shadow(self) -> None:
        r_I = np.array(self._now["position"])
        foot = r_I * (1.0, 1.0, 0.0)
        if r_I[2] > 0.0:
            self._canvas.polygon(self._view.project(foot + 0.22 * _RING)[0], colors.GREY, 0.35)
            self._lines(foot, r_I, colors.GREY, 0.7)

    def _trail(self, column: str) -> Floats:
        """Pixels of a position over the last seconds, evenly subsampled."""
        count, wanted = len(self._flight.rows), round(TRAIL_SECONDS * self._scene.control_rate)
        stride = -(-wanted // TRAIL_POINTS)
        # rows are counted from the start of the flight to prevent flicker of the trail
        first = -(-max(0, count - wanted) // stride) * stride
        rows = np.append(np.arange(first, count - 1, stride), count - 1)
        return self._view.project(self._flight.rows[column][rows])[0]

    def _trails(self) -> None:
        if self._flight.estimated:
            self._canvas.line(self._trail("estimated_position"), colors.VERMILLION, 2.6)
        self._canvas.line(self._trail("position"), colors.BLUE, 1.5)

    # ---- sensors ------------------------------------------------------------------------------

    def _camera(self) -> None:
        scene, view, canvas = self._scene, self._view, self._canvas
        if not scene.has_camera:
            return
        if not self._flight.estimated:  # no camera measures, but the features exist
            self._features(np.zeros(len(scene.features_I), bool))
            return
        r_I = self._now["position"]
        corners = scene.frustum_corners(r_I, self._R_BI, FRUSTUM_DEPTH)
        image = view.segments(corners[1:], np.roll(corners[1:], -1, axis=0))
        if len(image) == 4 and not self._moving:  # from near it would hide too much
            canvas.polygon(image[:, 0], colors.LIGHT_BLUE, 0.14)
        self._lines(corners[0], corners[1:], colors.LIGHT_BLUE)
        canvas.segments(image, colors.LIGHT_BLUE, 1.3)
        seen = np.isfinite(last_image(self._flight)["pixels"]).all(axis=1)
        if seen.any():
            self._lines(corners[0], scene.features_I[seen], colors.LIGHT_BLUE, 1.4)
        self._features(seen)

    def _features(self, seen: NDArray[np.bool_]) -> None:
        self._boxes(self._scene.features_I, [colors.INK if one else colors.WHITE for one in seen])

    def _boxes(self, places_I: Floats, fills: Sequence[Color]) -> None:
        """Draw places as small boxes."""
        for at, fill in zip(self._view.project(places_I)[0], fills, strict=True):
            if np.isfinite(at).all():
                x, y = at
                self._canvas.box(x - 4.0, y - 4.0, 8.0, 8.0, fill)
                self._canvas.box(x - 4.0, y - 4.0, 8.0, 8.0, colors.INK, 1.2)

    def _fixes(self) -> None:
        rows = self._flight.rows[-max(1, round(FIX_SECONDS * self._scene.control_rate)) :]
        fixes = rows["gnss_position"]
        measured = np.isfinite(fixes[:, 0])
        if not measured.any():
            return
        ages = self._now["time"] - rows["time"][measured]
        places = self._view.project(fixes[measured])[0]
        refused = rows["gnss_decision"][measured, 0] == GateDecision.REJECTED
        stride = -(-len(places) // 40)
        old = ages > 0.5 * FIX_SECONDS
        for color, chosen in (
            (colors.PALE_PURPLE, old & ~refused),
            (colors.PURPLE, ~old & ~refused),
            (colors.GREY, refused),
        ):
            self._canvas.crosses(places[chosen][::stride], 2.6, color, 1.3)
        color = colors.GREY if refused[-1] else colors.PURPLE
        self._canvas.crosses(places[-1:], 4.0, color, 2.0)
        if ages[-1] < 0.3 and len(places) < 0.5 * FIX_SECONDS * self._scene.control_rate:
            radius = 6.0 + 40.0 * float(ages[-1])
            self._canvas.disc(places[-1], radius, color, 1.5)  # a ripple if fixes are rare

    # ---- the vehicle and the estimate ---------------------------------------------------------

    def _attitude(self, column: str) -> Floats:
        q = self._now[column]
        return attitude_of(q) if np.isfinite(q).all() else np.eye(3)

    def _estimate(self) -> None:
        believed = self._flight["observed_position"][-1]
        attitude = "observed_quaternion"
        if self._flight.estimated:
            believed, attitude = self._now["estimated_position"], "estimated_quaternion"
        elif self._scene.observation != "noisy":
            return
        if not np.isfinite(believed).all():
            return
        view, canvas = self._view, self._canvas
        covariance, scale = self._now["covariance"][:3, :3], 1.0
        if self._flight.estimated and np.isfinite(covariance).all():  # estimators may have none
            scale = ellipsoid_scale(self._flight)
            axes = scale * ellipsoid_axes(covariance, SIGMAS)
            if np.linalg.norm(axes, axis=1).max() * view.scale_at(believed) < canvas.width:
                outline = ellipsoid_outline(believed, axes, view)
                canvas.polygon(outline, colors.VERMILLION, 0.16)
                canvas.line(outline, colors.VERMILLION, 1.2, closed=True)
                self._lines(believed - axes, believed + axes, colors.VERMILLION, 0.8)
        self._body(np.array(believed), self._attitude(attitude), ghost=True)
        if self._flight.estimated and scale > 1.0:
            # the error has the scale of the ellipsoid, which shows if the truth is inside
            error = believed + scale * (self._now["position"] - believed)
            self._lines(believed, error, colors.INK, 1.4)
            at = view.project(error)[0]
            canvas.disc(at, 4.0, colors.WHITE)
            canvas.disc(at, 2.8, colors.INK)

    def _body(self, r_I: Floats, R_BI: Floats, ghost: bool) -> None:
        """Draw arms and rotors; a ghost is drawn in outline."""
        view, canvas, scene = self._view, self._canvas, self._scene
        span = 2.0 * float(np.linalg.norm(scene.rotor_positions_B, axis=1).max())
        larger = max(1.0, SMALLEST_SPAN / max(span * view.scale_at(r_I), 1.0))
        larger = 1.0 if self._moving else min(larger, MAX_ENLARGEMENT)
        hubs_B = larger * scene.rotor_positions_B
        hubs = r_I + hubs_B @ R_BI
        thickness = float(np.clip(0.035 * view.scale_at(r_I), 1.6, 6.0))
        color = colors.VERMILLION if ghost else colors.BLUE
        if view.scale_at(r_I) < HARDLY_VISIBLE:
            canvas.disc(view.project(r_I)[0], 6.0 if ghost else 4.0, color, 2.0 if ghost else 0.0)
        self._lines(r_I, hubs, color if ghost else colors.INK, 1.2 if ghost else thickness)
        speeds = np.nan_to_num(self._now["rotor_speeds"]) / scene.max_rotor_speed
        discs = view.project(hubs[:, np.newaxis] + (larger * ROTOR_RADIUS * _RING) @ R_BI)[0]
        for disc, hub_B, speed in zip(discs, hubs_B, speeds, strict=True):
            front = hub_B[0] > 1e-9
            if not ghost:
                canvas.polygon(disc, colors.BLUE, float(np.clip(0.1 + 0.9 * speed, 0.1, 0.7)))
            canvas.line(disc, color if ghost or front else colors.INK, 1.2 if ghost else 1.4)

    def _axes(self) -> None:
        r_I, view = self._now["position"], self._view
        near = view.scale_at(np.array(r_I)) > 120.0
        tips = r_I + 0.42 * self._R_BI
        self._lines(r_I, tips, colors.INK, 1.5)
        places = view.project(r_I + 0.5 * self._R_BI)[0] - (0.0, 5.0)
        for name, at in zip("xyz", places, strict=True):
            if near or name == "x":
                self.labels.append((name, at, colors.INK))

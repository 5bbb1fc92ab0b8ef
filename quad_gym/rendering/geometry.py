"""Geometry of pictures in NumPy: a viewing camera, ellipsoids, and visible faces.

A viewing camera's axes are x to the right, y down and z into the picture, in pixels from the
picture's upper left corner.
"""

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from quad_gym.flights import Flight
from quad_gym.records import Shape

# --------------------------------------------------------------------------------------------------
# Geometry of pictures in NumPy: a viewing camera, and outlines of ellipsoids.
# --------------------------------------------------------------------------------------------------

Floats = NDArray[np.float64]

NEAR = 0.05  #: distance from the viewing camera below which objects are not drawn [m]
AROUND = 6.0  #: distance from reference and start within which a fixed view shows obstacles [m]
ASTRAY = 3.0  #: distance from the scene up to which a fixed view shows the path of a vehicle [m]


@dataclass(frozen=True, eq=False)
class Perspective:
    """Perspective view of the inertial frame."""

    eye: Floats
    """Position of the viewer, (3,) in I [m]"""
    R_VI: Floats
    """Rotation from I to viewing axes, (3, 3); rows: right, down, into the picture"""
    focal: float
    """Focal length [pixels]"""
    center: Floats
    """Pixel of the optical axis, (2,)"""

    def in_view(self, points: Floats) -> Floats:
        """Transform points (..., 3) from I to viewing axes [m]."""
        return np.asarray((points - self.eye) @ self.R_VI.T)

    def flatten(self, points_V: Floats) -> Floats:
        """Pixels (..., 2) of points (..., 3) in viewing axes, all in front of the viewer."""
        return self.center + self.focal * points_V[..., :2] / points_V[..., 2:]

    def project(self, points: Floats) -> tuple[Floats, Floats]:
        """Pixels (..., 2) and depths (...,) of points (..., 3) in I; NaN behind the viewer."""
        points_V = self.in_view(np.asarray(points, np.float64))
        depth = points_V[..., 2]
        safe = np.where(depth[..., np.newaxis] > NEAR, points_V, np.nan)
        return self.flatten(safe), depth

    def segments(self, starts: Floats, ends: Floats) -> Floats:
        """Pixels (m, 2, 2) of line segments, (n, 3) or (3,) each, clipped where too near."""
        count = len(starts) if starts.ndim == 2 else len(ends) if ends.ndim == 2 else 1
        both = np.empty((count, 2, 3))
        both[:, 0], both[:, 1] = self.in_view(starts), self.in_view(ends)
        in_front = both[..., 2] > NEAR
        if in_front.all():
            return self.flatten(both)
        visible = in_front.any(axis=1)
        both, in_front = both[visible], in_front[visible, :, np.newaxis]
        a, b = both[:, :1], both[:, 1:]
        gap = b[..., 2:] - a[..., 2:]
        share = (NEAR * 1.001 - a[..., 2:]) / np.where(np.abs(gap) < 1e-12, 1.0, gap)
        cut = a + np.clip(share, 0.0, 1.0) * (b - a)
        return self.flatten(np.where(in_front, both, cut))

    def outline(self, corners: Floats) -> Floats:
        """Pixels (m, 2) of a flat polygon with corners (n, 3), clipped where it is too near."""
        points = self.in_view(corners)
        depth = points[:, 2] - NEAR * 1.001
        if (depth > 0.0).all():
            return self.flatten(points)
        kept: list[Floats] = []
        for k, (a, b) in enumerate(zip(depth, np.roll(depth, -1), strict=True)):
            if a > 0.0:
                kept.append(points[k])
            if (a > 0.0) != (b > 0.0):
                after = points[(k + 1) % len(points)]
                kept.append(points[k] + a / (a - b) * (after - points[k]))
        return self.flatten(np.array(kept)) if kept else np.zeros((0, 2))

    @property
    def horizon(self) -> float:
        """Row of the horizon [pixels], for views without roll."""
        down, level = self.R_VI[2, 2], float(np.hypot(*self.R_VI[2, :2]))
        return float(self.center[1] + self.focal * down / max(level, 1e-9))

    def scale_at(self, point: Floats) -> float:
        """Scale perpendicular to the line of sight at a point in I [pixels/m]."""
        return self.focal / max(float(self.in_view(point)[2]), NEAR)


def attitude_of(quaternion: Floats) -> Floats:
    """R_BI (..., 3, 3) of finite quaternions (..., 4): SciPy would take longer than most lines."""
    q = np.moveaxis(quaternion / np.linalg.norm(quaternion, axis=-1, keepdims=True), -1, 0)
    w, x, y, z = q
    xx, yy, zz = 2.0 * q[1:] * q[1:]
    xy, xz, yz, wx, wy, wz = 2.0 * np.stack([x * y, x * z, y * z, w * x, w * y, w * z])
    R_BI = np.empty((*quaternion.shape[:-1], 3, 3))
    R_BI[..., 0, 0], R_BI[..., 0, 1], R_BI[..., 0, 2] = 1.0 - yy - zz, xy + wz, xz - wy
    R_BI[..., 1, 0], R_BI[..., 1, 1], R_BI[..., 1, 2] = xy - wz, 1.0 - xx - zz, yz + wx
    R_BI[..., 2, 0], R_BI[..., 2, 1], R_BI[..., 2, 2] = xz + wy, yz - wx, 1.0 - xx - yy
    return R_BI


def look_at(eye: Floats, target: Floats, focal: float, center: Floats) -> Perspective:
    """View from `eye` toward `target`, with the vertical upright."""
    into = (target - eye) / np.linalg.norm(target - eye)
    right = np.cross(into, (0.0, 0.0, 1.0))
    length = np.linalg.norm(right)
    right = right / length if length > 1e-9 else np.array([1.0, 0.0, 0.0])
    return Perspective(eye, np.stack([right, np.cross(into, right), into]), focal, center)


def fit_view(
    points: Floats, azimuth: float, elevation: float, focal: float, low: Floats, high: Floats
) -> Perspective:
    """Closest view of all points (n, 3) within a rectangle of pixels, from its corner low to high.

    The direction from the points to the eye is given by azimuth and elevation [rad].
    """
    c = np.cos(elevation)
    backward = np.array([c * np.cos(azimuth), c * np.sin(azimuth), np.sin(elevation)])
    center, half = (low + high) / 2, (high - low) / 2
    axes = look_at(backward, np.zeros(3), focal, center).R_VI
    p = points @ axes.T
    # a point is inside if |x - x0| <= half/focal * depth; all four edges at once per axis
    eye = np.zeros(3)
    edges = []
    for k in range(2):
        slope = half[k] / focal
        right, left = (p[:, k] - slope * p[:, 2]).max(), (p[:, k] + slope * p[:, 2]).min()
        eye[k] = (right + left) / 2  # both edges at equal distances
        edges.append(-(right - left) / 2 / slope)
    eye[2] = min(edges)
    return Perspective(eye @ axes, axes, focal, center)


def fixed_view(
    flight: Flight,
    width: float,
    height: float,
    top: float = 0.0,
    path_I: Floats | None = None,
) -> Perspective:
    """View (width, height) [pixels] of the whole reference, the start, and the markers.

    Args:
        flight: Flight to show.
        width: Width of the picture [pixels].
        height: Height of the picture [pixels].
        top: Height of a legend, below which these are shown [pixels].
        path_I: Positions of vehicles that are shown as well, unless they go astray, (n, 3) [m].
    """
    scene, start = flight.scene, flight["position"][0]
    times = np.linspace(0.0, scene.reference_period or 1.0, max(64, scene.pieces // 4))
    around = [scene.reference(times), start[np.newaxis], scene.gates_I, scene.features_I]
    around.append(scene.anchors_I)
    around += [np.concatenate(around[:3]) * (1.0, 1.0, 0.0)]  # points on the ground below
    points = np.concatenate(around)
    if len(scene.obstacles):  # all within the geofence, or else those nearby
        low, high = points.min(axis=0) - AROUND, points.max(axis=0) + AROUND
        low, high = scene.geofence_I if len(scene.geofence_I) else (low, high)
        places = np.clip(scene.obstacles[:, 1:4], low, high)
        points = np.concatenate([points, places * (1.0, 1.0, 0.0), places])
    if path_I is not None:  # a vehicle that flies away must not make all the rest small
        path_I = path_I[np.isfinite(path_I).all(axis=1)]
        near = np.clip(path_I, points.min(axis=0) - ASTRAY, points.max(axis=0) + ASTRAY)
        points = np.concatenate([points, near])
    pad = 0.45 * np.array([[i, j, k] for i in (-1, 1) for j in (-1, 1) for k in (0, 1)])
    corners = (points[:, np.newaxis] + pad).reshape(-1, 3)
    share = min(max(0.24, top / height), 0.6)  # legend and inset fill the upper corners
    low = np.array([0.03 * width, share * height])
    high = np.array([0.97 * width, 0.97 * height])
    azimuth, elevation = np.radians(-62.0), np.radians(24.0)
    return fit_view(corners, azimuth, elevation, 1.15 * width, low, high)


def chase_view(flight: Flight, width: float, height: float) -> Perspective:
    """View from behind and above the vehicle, a little to its right, that follows it smoothly.

    It depends only on the last half second, so a replay is identical to the live view.
    """
    recent = flight.rows[-max(2, round(0.5 * flight.scene.control_rate)) :]
    here = np.array(recent["position"][-1])
    ahead = attitude_of(recent["quaternion"])[:, 0, :2].mean(axis=0)
    heading = np.arctan2(ahead[1], ahead[0]) - np.radians(28.0)
    behind = np.array([np.cos(heading), np.sin(heading), 0.0])
    eye = here - 2.4 * behind + (0.0, 0.0, 1.15)
    eye[2] = max(eye[2], 0.25)
    target = here + 0.3 * behind + (0.0, 0.0, 0.12)
    return look_at(eye, target, 1.15 * width, np.array([0.5 * width, 0.5 * height]))


def follow_view(flight: Flight, width: float, height: float) -> Perspective:
    """View from the east and above that moves with the vehicle and does not turn.

    It is as far away as the true and the estimated position require, and looks between them.
    """
    here = np.array(flight["position"][-1])
    between = np.zeros(3)
    if flight.estimated:
        between = 0.5 * np.nan_to_num(flight["estimated_position"][-1] - here)
    distance = 5.5 + 2.5 * float(np.linalg.norm(between))
    azimuth, elevation = np.radians(-25.0), np.radians(24.0)
    backward = np.array([np.cos(azimuth), np.sin(azimuth), 0.0]) * np.cos(elevation)
    backward[2] = np.sin(elevation)
    target = here + between
    return look_at(
        target + distance * backward, target, 1.15 * width, np.array([0.5 * width, 0.6 * height])
    )


def course_view(flight: Flight, width: float, height: float) -> Perspective:
    """View along a course of obstacles, from behind and above the vehicle.

    It moves with the true position along the course and does not turn, so that sideways motion of
    the vehicle remains visible.
    """
    start = np.array(flight["position"][0]) * (1.0, 1.0, 0.0)
    ahead = flight.scene.obstacles[:, 1:4].mean(axis=0) * (1.0, 1.0, 0.0) - start
    ahead = ahead / np.linalg.norm(ahead)
    here = start + ((flight["position"][-1] - start) @ ahead) * ahead
    eye, target = here - 15.0 * ahead + (0.0, 0.0, 25.0), here + 4.5 * ahead + (0.0, 0.0, 3.0)
    return look_at(eye, target, 1.15 * width, np.array([0.5 * width, 0.5 * height]))


def ellipsoid_axes(covariance: Floats, sigmas: float) -> Floats:
    """Half-axes in rows of the ellipsoid of a (3, 3) covariance, the shortest first."""
    values, vectors = np.linalg.eigh(covariance)
    return np.asarray((sigmas * np.sqrt(np.maximum(values, 0.0)) * vectors).T)


def ellipsoid_outline(center: Floats, axes: Floats, view: Perspective, count: int = 48) -> Floats:
    """Outline of an ellipsoid with half-axes in rows, (count, 2) pixels; (0, 2) if it is too near.

    In dual form the ellipsoid is [[A - c c^T, -c], [-c^T, -1]], where A is the sum of the outer
    products of its half-axes; the camera matrix maps it to the dual conic of its outline (R.
    Hartley, A. Zisserman, Multiple View Geometry, 2003, section 8.3).
    """
    c = view.in_view(center)
    half = axes @ view.R_VI.T
    if c[2] - np.sqrt((half[:, 2] ** 2).sum()) < NEAR:
        return np.zeros((0, 2))
    dual = half.T @ half - np.outer(c, c)
    dual = dual / -dual[2, 2]
    middle = -dual[:2, 2]
    shape = dual[:2, :2] + np.outer(middle, middle)
    values, vectors = np.linalg.eigh(shape)
    root = vectors * np.sqrt(np.maximum(values, 0.0))
    angle = np.linspace(0.0, 2.0 * np.pi, count, endpoint=False)
    ring = np.stack([np.cos(angle), np.sin(angle)], axis=1) @ root.T
    return np.asarray(view.center + view.focal * (middle + ring))


# --------------------------------------------------------------------------------------------------
# Obstacles as polygons: visible faces of walls and cylinders, in NumPy.
# --------------------------------------------------------------------------------------------------

SIDES = 20  #: of the prism that represents a cylinder


def faces_of(obstacle: Floats, eye: Floats) -> list[Floats]:
    """Polygons (corners, 3) of a row of `FlightScene.obstacles` turned to the eye, in I [m].

    All faces are returned if the eye is inside.
    """
    faces, normals, corners = _prism(obstacle.tobytes())
    turned = ((eye - corners) * normals).sum(axis=1) > 0.0
    return [face for face, seen in zip(faces, turned, strict=True) if seen] or list(faces)


@lru_cache(maxsize=256)  # obstacles stand still, while the eye moves with each picture
def _prism(row: bytes) -> tuple[tuple[Floats, ...], Floats, Floats]:
    """Faces of an obstacle, their outward normals (n, 3), and a corner of each (n, 3), in I [m]."""
    shape, *numbers = np.frombuffer(row)
    center, half, (c, s) = np.array(numbers[:3]), numbers[3:6], numbers[6:]
    if shape == Shape.CYLINDER:
        angle = np.linspace(0.0, 2.0 * np.pi, SIDES, endpoint=False)
        level = half[0] * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    else:
        level = half[:2] * np.array([[1.0, 1.0], [-1.0, 1.0], [-1.0, -1.0], [1.0, -1.0]])
        level = level @ np.array([[c, s], [-s, c]])
    low, high = (
        np.column_stack([center[:2] + level, np.full(len(level), center[2] + sign * half[2])])
        for sign in (-1.0, 1.0)
    )
    sides = np.stack([low, np.roll(low, -1, 0), np.roll(high, -1, 0), high], axis=1)
    faces = (*sides, low, high)
    corners = np.stack([face[:3] for face in faces])
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 1])
    middles = np.stack([face.mean(axis=0) for face in faces])
    outward = np.sign(((middles - center) * normals).sum(axis=1, keepdims=True))
    return faces, outward * normals, corners[:, 0]

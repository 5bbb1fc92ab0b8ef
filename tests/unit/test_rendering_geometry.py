"""Projection in pictures, against hand-computed pixels, sampled surfaces and the camera model."""

import numpy as np
import pytest
from scipy.spatial import ConvexHull

from quad_gym import CameraParams
from quad_gym.envs.config import EnvConfig
from quad_gym.envs.flights import Flights
from quad_gym.flights import FlightRecorder
from quad_gym.records import Autoreset, Shape
from quad_gym.rendering.geometry import (
    chase_view,
    ellipsoid_axes,
    ellipsoid_outline,
    faces_of,
    fit_view,
    fixed_view,
    look_at,
)
from quad_gym.rendering.scene import inset_box, place_in_inset
from quad_gym.rotations import euler_to_dcm
from quad_gym.sensors import Camera

CENTER = np.array([320.0, 180.0])


def a_flight(task="circle", seed=0, steps=5, **keywords):
    flights = Flights(EnvConfig.of(keywords, task), 1, Autoreset.DISABLED, threads=1)
    recorder = FlightRecorder(flights.batch)
    flights.batch.reset(seeds=[seed])
    recorder.keep()
    for _ in range(steps):
        flights.batch.step(np.zeros((1, 4)))
        recorder.keep()
    return recorder.flight


def a_covariance(rng):
    factor = rng.normal(size=(3, 3))
    return factor @ factor.T + 0.1 * np.eye(3)


def test_known_points_land_on_the_expected_pixels():
    # 10 m south of the origin, 2 m up, looking north and level: east is right, up is up
    view = look_at(np.array([0.0, -10.0, 2.0]), np.array([0.0, 0.0, 2.0]), 500.0, CENTER)
    points = [[0.0, 0.0, 2.0], [1.0, 0.0, 2.0], [0.0, 0.0, 3.0], [2.0, 10.0, 0.0]]
    pixels, depth = view.project(np.array(points))
    np.testing.assert_allclose(depth, [10.0, 10.0, 10.0, 20.0], atol=1e-12)
    expected = [[320.0, 180.0], [370.0, 180.0], [320.0, 130.0], [370.0, 230.0]]
    np.testing.assert_allclose(pixels, expected, atol=1e-9)


def test_things_behind_the_eye_are_cut_off():
    view = look_at(np.zeros(3), np.array([1.0, 0.0, 0.0]), 500.0, CENTER)
    pixels, depth = view.project(np.array([[-1.0, 0.0, 0.0], [1.0, 0.0, 0.0]]))
    assert np.isnan(pixels[0]).all()
    assert depth[0] < 0.0
    np.testing.assert_allclose(pixels[1], CENTER)
    assert ellipsoid_outline(np.array([0.5, 0.0, 0.0]), np.eye(3), view).shape == (0, 2)
    start, end = np.array([[4.0, -1.0, 0.0]]), np.array([[-4.0, -1.0, 0.0]])
    ((near, far),) = view.segments(start, end)
    np.testing.assert_allclose(near, view.project(start[0])[0])
    assert far[1] == pytest.approx(near[1])  # the line is level with the eye
    assert far[0] > near[0]  # and comes closer on the right
    assert not len(view.segments(end, end + 0.1))


@pytest.mark.parametrize("seed", range(3))
def test_a_fitted_view_shows_all_points_and_could_not_be_closer(seed):
    rng = np.random.default_rng(seed)
    points = rng.normal(size=(30, 3)) * (4.0, 2.0, 1.0)
    low, high = np.array([20.0, 40.0]), np.array([600.0, 330.0])
    view = fit_view(points, rng.uniform(-3, 3), rng.uniform(0.1, 1.2), 700.0, low, high)
    pixels, depth = view.project(points)
    assert (depth > 0.0).all()
    assert (pixels > low - 1e-6).all()
    assert (pixels < high + 1e-6).all()
    touching = np.concatenate([abs(pixels - low), abs(pixels - high)]).min(axis=0)
    assert touching.min() < 1e-6


@pytest.mark.parametrize("seed", range(3))
def test_outline_agrees_with_samples_of_the_ellipsoid_surface(seed):
    rng = np.random.default_rng(seed)
    P, center = a_covariance(rng), rng.normal(size=3)
    view = look_at(np.array([0.0, -15.0, 5.0]), rng.normal(size=3), 400.0, CENTER)
    outline = ellipsoid_outline(center, ellipsoid_axes(P, 1.0), view, count=720)
    directions = rng.normal(size=(200_000, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    pixels, _ = view.project(center + directions @ np.linalg.cholesky(P).T)
    middle = outline.mean(axis=0)
    for angle in np.linspace(0.0, 2.0 * np.pi, 16):
        along = np.array([np.cos(angle), np.sin(angle)])
        farthest, drawn = ((pixels - middle) @ along).max(), ((outline - middle) @ along).max()
        assert farthest == pytest.approx(drawn, rel=2e-3)


@pytest.mark.parametrize(
    "task", ["hover", "circle", "lemniscate", "random_trajectory", "trajectory", "waypoints"]
)
def test_the_fixed_view_shows_reference_features_and_start(task):
    flight = a_flight(task)
    view = fixed_view(flight, 640, 367)
    times = np.linspace(0.0, flight.scene.reference_period or 1.0, 50)
    things = [flight.scene.reference(times), flight.scene.features_I, flight.scene.gates_I]
    pixels, _ = view.project(np.concatenate([*things, flight["position"][:1]]))
    assert (pixels > (0.0, 0.0)).all()
    assert (pixels < (640.0, 367.0)).all()


def test_the_chase_view_has_the_vehicle_near_its_middle():
    flight = a_flight("lemniscate", steps=60)
    pixels, depth = chase_view(flight, 640, 367).project(flight["position"][-1])
    assert 1.0 < depth < 4.0
    assert (abs(pixels - (320.0, 183.0)) < 90.0).all()


def poses(count, seed):
    rng = np.random.default_rng(seed)
    for _ in range(count):
        place = rng.uniform((-4, -4, 0.5), (4, 4, 2.5))
        yaw = np.arctan2(-place[1], -place[0]) + rng.normal(0.0, 0.3)
        yield place, euler_to_dcm([*rng.normal(0.0, 0.2, 2), yaw])


def test_features_are_drawn_where_the_camera_measures_them():
    flight = a_flight()
    params = CameraParams(pixel_sigma=1e-9)
    camera = Camera(params, np.random.default_rng(0))
    compared = 0
    for place, R_BI in poses(200, 1):
        measured = camera.measure(place, R_BI)
        seen = np.isfinite(measured).all(axis=1)
        predicted = flight.scene.project_features(place, R_BI)
        np.testing.assert_allclose(predicted[seen], measured[seen], atol=1e-4)
        compared += seen.sum()
    assert compared > 100


def test_frustum_contains_exactly_the_features_seen_by_the_camera():
    flight = a_flight()
    camera = Camera(CameraParams(), np.random.default_rng(0))
    for place, R_BI in poses(100, 2):
        seen = np.isfinite(camera.measure(place, R_BI)).all(axis=1)
        apex, *corners = flight.scene.frustum_corners(place, R_BI, 1.0)
        # inside: on the inner side of the four planes through the apex and two corners
        rays = np.array(corners) - apex
        normals = np.cross(rays, np.roll(rays, -1, axis=0))
        axis = rays.mean(axis=0)
        normals *= np.sign(normals @ axis)[:, np.newaxis]
        inside = ((flight.scene.features_I - apex) @ normals.T > 0.0).all(axis=1)
        np.testing.assert_array_equal(inside, seen)


def test_the_inset_shows_the_image_upright_and_to_scale():
    scene = a_flight().scene
    box = inset_box(scene, right=632.0, top=8.0, width=160.0)
    assert (box.left, box.width, box.height) == (472.0, 160.0, 90.0)
    half = scene.half_image
    corners = place_in_inset(np.array([[0.0, 0.0], half, -half]), scene, box)
    np.testing.assert_allclose(corners, [[552.0, 53.0], [472.0, 8.0], [632.0, 98.0]])
    # a feature to the right of the vehicle is on the right, a higher one is higher
    place = np.array([0.0, 0.0, 1.0])  # level, looking east
    ahead, right, higher = ([3.0, 0.0, -1.0], [3.0, -0.5, -1.0], [3.0, 0.0, -0.5])
    for point, expected in ((right, (1, 0)), (higher, (0, -1))):
        both = np.array([ahead, point])
        X_C = (both - place - scene.camera_B) @ scene.R_CB.T
        pixels = scene.focal_length * X_C[:, :2] / X_C[:, 2:]
        first, second = place_in_inset(pixels, scene, box)
        step = np.where(abs(second - first) > 4.0, np.sign(second - first), 0.0)
        np.testing.assert_array_equal(step, expected)


def test_polygon_behind_the_eye_is_cut_off():
    view = look_at(np.array([0.0, 0.0, 1.0]), np.array([0.0, 1.0, 1.0]), 500.0, CENTER)
    floor = np.array([[-1.0, -5.0, 0.0], [1.0, -5.0, 0.0], [1.0, 5.0, 0.0], [-1.0, 5.0, 0.0]])
    outline = view.outline(floor)
    assert outline.shape == (4, 2)
    assert np.isfinite(outline).all()
    assert (outline[:, 1] > view.horizon).all()  # the floor is below the horizon
    ahead = view.project(floor[2:])[0]
    assert all(np.abs(outline - corner).sum(axis=1).min() < 1e-9 for corner in ahead)
    assert view.outline(floor - (0.0, 20.0, 0.0)).shape == (0, 2)
    before = floor - (0.0, -9.0, 0.0)
    np.testing.assert_array_equal(view.outline(before), view.project(before)[0])


def test_faces_of_obstacles_are_those_on_whose_outer_side_the_eye_is():
    """Half-spaces by SciPy's convex hull of the corners are the reference."""
    rng, center, half = np.random.default_rng(5), np.array([1.0, -2.0, 3.0]), (0.8, 0.3, 1.2)
    turned, straight = (np.cos(0.4), np.sin(0.4)), (1.0, 0.0)
    for shape, turn in ((Shape.WALL, turned), (Shape.CYLINDER, straight)):
        obstacle = np.array([shape, *center, *half, *turn])
        every = faces_of(obstacle, center)  # the eye is inside
        hull = ConvexHull(np.unique(np.concatenate(every).round(12), axis=0))
        planes = np.unique(hull.equations.round(6) + 0.0, axis=0)
        assert len(every) == len(planes)
        for eye in center + rng.normal(0.0, 4.0, (50, 3)):
            outside = planes[planes[:, :3] @ eye + planes[:, 3] > 0.0]
            seen = faces_of(obstacle, eye)
            if not len(outside):
                assert len(seen) == len(every)
                continue
            assert len(seen) == len(outside)
            for face in seen:  # each lies in one of these planes
                distance = outside[:, :3] @ face.T + outside[:, 3:]
                assert (abs(distance).max(axis=1) < 1e-5).sum() == 1

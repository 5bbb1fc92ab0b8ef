"""Walls and cylinders: distances, lines of sight and contact, against dense sampling."""

import numpy as np
import pytest
from scipy.spatial import cKDTree

import quad_gym
from quad_gym import Cylinder, Wall, WorldParams
from quad_gym.batch.starts import hidden_points, nearest_obstacle, require_room
from quad_gym.records import FEATURE_SLICE, MAX_OBSTACLES, WIDTH, Ending, Source
from tests.builders import batch as batch_of

WALL = Wall(center_I=(0.5, -0.2, 1.0), size=(3.0, 0.6, 2.0), yaw=0.7)
MAST = Cylinder(center_I=(-0.4, 0.3, 0.8), radius=0.5, height=1.8)
CROSSED = WorldParams(obstacles=(WALL, MAST, Wall(center_I=(3.5, 2.0, 1.0), size=(1.0, 4.0, 3.0))))


def axes(obstacle):
    yaw = getattr(obstacle, "yaw", 0.0)
    return np.array([[np.cos(yaw), np.sin(yaw), 0], [-np.sin(yaw), np.cos(yaw), 0], [0, 0, 1.0]])


def is_inside(obstacle, points):
    p = (points - obstacle.center_I) @ axes(obstacle).T
    if isinstance(obstacle, Wall):
        return (np.abs(p) < 0.5 * np.array(obstacle.size)).all(axis=-1)
    return (np.hypot(p[..., 0], p[..., 1]) < obstacle.radius) & (
        np.abs(p[..., 2]) < 0.5 * obstacle.height
    )


def surface(obstacle, step=0.02):
    """Points on the whole surface, about `step` apart."""

    def grid(a, b):
        u, v = (np.linspace(-x, x, max(3, round(2.0 * x / step))) for x in (a, b))
        return np.stack(np.meshgrid(u, v), axis=-1).reshape(-1, 2)

    parts = []
    if isinstance(obstacle, Wall):
        half = 0.5 * np.array(obstacle.size)
        for i in range(3):
            j, k = [n for n in range(3) if n != i]
            for sign in (-1.0, 1.0):
                face = np.zeros((len(flat := grid(half[j], half[k])), 3))
                face[:, [j, k]], face[:, i] = flat, sign * half[i]
                parts.append(face)
    else:
        R, h = obstacle.radius, 0.5 * obstacle.height
        turn = grid(np.pi, h)
        parts.append(np.stack([R * np.cos(turn[:, 0]), R * np.sin(turn[:, 0]), turn[:, 1]], 1))
        disc = grid(R, R)
        disc = disc[np.hypot(*disc.T) <= R]
        parts += [np.column_stack([disc, np.full(len(disc), z)]) for z in (-h, h)]
    return np.concatenate(parts) @ axes(obstacle) + obstacle.center_I


def centers(obstacles, count):
    return np.tile([o.center_I for o in obstacles], (count, 1, 1))


@pytest.mark.parametrize("obstacle", [WALL, MAST])
def test_distances_agree_with_dense_samples_of_the_surface(obstacle):
    points = np.random.default_rng(0).uniform((-2.5, -2.5, -1.0), (2.5, 2.5, 3.0), (4000, 3))
    distance, vector = nearest_obstacle([obstacle], centers([obstacle], len(points)), points)
    sampled, _ = cKDTree(surface(obstacle)).query(points)
    inside = is_inside(obstacle, points)
    assert 50 < inside.sum() < 3000
    np.testing.assert_array_equal(distance < 0.0, inside)
    # the sampled distance is too large, by half a diagonal of the grid at most
    assert (sampled - np.abs(distance) > -1e-9).all()
    assert (sampled - np.abs(distance) < 0.02).all()
    np.testing.assert_allclose(np.linalg.norm(vector, axis=1), np.abs(distance), atol=1e-12)
    there, _ = nearest_obstacle([obstacle], centers([obstacle], len(points)), points + vector)
    np.testing.assert_allclose(there, 0.0, atol=1e-12)


def test_distances_agree_with_hand_computed_values():
    box, mast = Wall(size=(4.0, 2.0, 6.0)), Cylinder(radius=1.0, height=2.0)
    for obstacle, point, distance, vector in (
        (box, (-4.0, 4.0, 9.0), 7.0, (2.0, -3.0, -6.0)),  # a corner
        (box, (2.0, 0.5, 0.0), 0.0, (0.0, 0.0, 0.0)),  # on the surface
        (mast, (4.0, 0.0, 5.0), 5.0, (-3.0, 0.0, -4.0)),  # the rim
        (mast, (0.0, 0.0, 2.0), 1.0, (0.0, 0.0, -1.0)),  # on the axis, above
    ):
        found = nearest_obstacle([obstacle], np.zeros((1, 1, 3)), np.array([point]))
        np.testing.assert_allclose(found[0], distance, atol=1e-12)
        np.testing.assert_allclose(found[1][0], vector, atol=1e-12)
    length, _ = nearest_obstacle([mast], np.zeros((1, 1, 3)), np.zeros((1, 3)))
    assert length[0] == -1.0  # at the center


@pytest.mark.parametrize("obstacle", [WALL, MAST])
def test_lines_of_sight_agree_with_dense_samples_of_the_line(obstacle):
    rng = np.random.default_rng(1)
    eyes = rng.uniform((-3.0, -3.0, -1.0), (3.0, 3.0, 3.0), (60, 3))
    points = rng.uniform((-3.0, -3.0, -1.0), (3.0, 3.0, 3.0), (50, 3))
    eyes[0], points[0] = (0.5, -3.0, 0.9), (0.5, 3.0, 0.9)  # along an axis of I
    eyes[1], points[1] = (-0.4, 0.3, 3.0), (-0.4, 0.3, -1.0)  # straight down
    hidden = hidden_points([obstacle], centers([obstacle], 60), eyes, points)
    share = np.linspace(0.0, 1.0, 2001)[:, np.newaxis]
    unsure = 0
    for i, eye in enumerate(eyes):
        for j, point in enumerate(points):
            line = eye + share * (point - eye)
            hits = is_inside(obstacle, line).sum()
            if is_inside(obstacle, line[-1]) and hits == 1:
                unsure += 1
            elif not hits and hidden[i, j]:  # it cuts a corner between two samples
                near, _ = nearest_obstacle([obstacle], centers([obstacle], len(line)), line)
                assert near.min() < 5e-3
                unsure += 1
            else:
                assert hidden[i, j] == (hits > 0), (eye, point)
    assert unsure < 30
    assert 200 < hidden.sum() < 2800


def test_marks_on_a_wall_are_hidden_from_behind():
    wall = Wall(center_I=(0.0, 0.0, 1.0), size=(6.0, 0.2, 4.0), yaw=0.3)
    along, across = axes(wall)[0], axes(wall)[1]
    marks = wall.center_I + np.linspace(-2.9, 2.9, 7)[:, np.newaxis] * along + 0.1 * across
    eyes = np.stack([side * 3.0 * across + (0.0, 0.0, 1.5) for side in (1.0, -1.0)])
    hidden = hidden_points([wall], centers([wall], 2), eyes, marks)
    assert not hidden[0].any()
    assert hidden[1].all()


@pytest.mark.parametrize(("depth", "hides"), [(0.5e-3, False), (1.5e-3, True)])
def test_points_up_to_a_millimeter_inside_an_obstacle_are_seen(depth, hides):
    """From any distance, and from nearer than that, through each kind of surface."""
    box, mast = Wall(size=(4.0, 2.0, 6.0)), Cylinder(radius=1.0, height=2.0)
    for obstacle, faces in ((box, np.diag([2.0, 1.0, 3.0])), (mast, np.eye(3))):
        for face in faces:
            outward = face / np.linalg.norm(face)
            for side, far in ((1.0, 8.0), (-1.0, 0.3)):
                eye, point = side * (face + far * outward), side * (face - depth * outward)
                found = hidden_points([obstacle], np.zeros((1, 1, 3)), eye[None], point[None])
                assert found.item() == hides


TRUTH = {"source": Source.TRUTH, "threads": 1}


def circling(world, **options):
    """Flights on the true state around the origin, also through obstacles."""
    task = quad_gym.TaskParams(start="hover", randomize_reference=True, duration=0.0)
    return batch_of(8, world=world, task=task, **{**TRUTH, **options})


def test_the_kernels_find_the_same_distances_inside_and_outside():
    batch, inside = circling(CROSSED, control_rate=50.0), 0
    for step in range(400):
        batch.step()
        if step % 4:
            continue
        distance, vector = nearest_obstacle(
            CROSSED.obstacles, centers(CROSSED.obstacles, 8), batch.record("r")
        )
        np.testing.assert_allclose(batch.record("obstacle_distance"), distance, atol=1e-12)
        np.testing.assert_allclose(batch.record("obstacle_vector"), vector, atol=1e-9)
        inside += (distance < 0.0).sum()
    assert inside > 20


def test_collision_in_a_step_ends_the_episode_after_it():
    barred = (Wall(center_I=(x, 0.0, 1.0), size=(4.0, 0.2, 4.0)) for x in (-3.5, 3.5))
    world = WorldParams(obstacles=tuple(barred))
    ticks, steps = circling(world), circling(world, control_rate=25.0)
    first, ended = np.full(8, np.inf), np.full(8, np.inf)
    for tick in range(1, 801):
        ticks.step()
        places = centers(world.obstacles, 8)
        distance, _ = nearest_obstacle(world.obstacles, places, ticks.record("r"))
        reached = distance <= world.vehicle_radius
        first = np.where(reached & np.isinf(first), tick, first)
        np.testing.assert_array_equal(ticks.record("collided") > 0.0, np.isfinite(first))
        if tick % 8 == 0:
            steps.step()
            hit = steps.result("ending") == Ending.COLLISION
            np.testing.assert_array_equal(hit, steps.result("terminated") > 0.0)
            ended = np.where(hit & np.isinf(ended), tick, ended)
    assert np.isfinite(first).sum() > 3
    np.testing.assert_array_equal(ended, np.ceil(first / 8) * 8)


@pytest.mark.parametrize(("gap", "touches"), [(0.0, True), (2.0**-40, False)])
def test_distance_of_exactly_the_vehicle_radius_is_a_collision(gap, touches):
    # at rest on its pad, at (4, 0, 0); the wall's face is at x = 4.5
    wall = Wall(center_I=(4.75, 0.0, 0.0), size=(0.5, 2.0, 2.0))
    world = WorldParams(obstacles=(wall,), vehicle_radius=0.5 - gap)
    batch = batch_of(1, world=world, **TRUTH)
    assert batch.record("obstacle_distance")[0] == 0.5
    assert bool(batch.record("collided")[0]) is touches


def test_leaving_the_geofence_ends_an_episode():
    low, high = (-9.0, -2.0, -1.0), (9.0, 2.0, 4.0)
    batch = circling(WorldParams(geofence=(low, high)))
    outside = np.zeros(8, bool)
    for _ in range(600):
        batch.step()
        r = batch.record("r")
        outside |= ((r < low) | (r > high)).any(axis=1)
        np.testing.assert_array_equal(batch.result("terminated") > 0.0, outside)
        np.testing.assert_array_equal(batch.result("ending") == Ending.LEFT_GEOFENCE, outside)
    assert outside.any()
    assert np.isinf(batch.record("obstacle_distance")).all()


def test_each_side_of_the_geofence_ends_an_episode():
    low, high = np.array([-9.0, -8.0, -1.0]), np.array([9.0, 7.0, 4.0])
    batch = batch_of(12, world=WorldParams(geofence=(tuple(low), tuple(high))), **TRUTH)
    places = np.tile([1.0, 2.0, 3.0], (12, 1))
    beyond = np.resize([0.01, -0.01], 12)
    for k in range(12):
        axis, side = k // 2 % 3, k // 6
        places[k, axis] = high[axis] + beyond[k] if side else low[axis] - beyond[k]
    batch.step()
    flights = batch.snapshot()
    flights["left_fence"] = 0.0
    for k, place in enumerate(places):
        flights["r"][k // WIDTH, :, k % WIDTH] = place
        flights["v"][k // WIDTH, :, k % WIDTH] = 0.0
    batch.restore(flights)
    batch.step()
    np.testing.assert_array_equal(batch.record("left_fence"), beyond > 0.0)


def test_obstacles_hide_features_and_change_nothing_else():
    tall = Wall(center_I=(1.5, 0.0, 1.0), size=(0.3, 2.0, 3.0), yaw=0.4)
    world = WorldParams(obstacles=(tall, Cylinder(center_I=(-2.0, -0.5, 1.0), radius=0.6)))
    free, hidden = (circling(w, sensors="lab", run_filter=True) for w in (WorldParams(), world))
    features, behind = np.array(free.sensors.camera.features_I), 0
    share = np.linspace(0.0, 1.0, 401)[:, np.newaxis, np.newaxis]
    for step in range(400):
        free.step()
        hidden.step()
        np.testing.assert_array_equal(free.record("r"), hidden.record("r"))
        if step % 8:
            continue
        seen, kept = (
            b.record("block_valid")[:, FEATURE_SLICE][:, : len(features)] > 0.0
            for b in (free, hidden)
        )
        R_BI = quad_gym.rotations.quaternion_to_dcm(free.record("q"))
        eyes = free.record("r") + np.einsum("nij,i->nj", R_BI, free.sensors.camera.position_B)
        for k, point in enumerate(features):
            line = eyes + share * (point - eyes)
            crossed = np.any([is_inside(o, line).any(axis=0) for o in world.obstacles], axis=0)
            np.testing.assert_array_equal(kept[:, k], seen[:, k] & ~crossed)
            behind += (seen[:, k] & crossed).sum()
        pixels, those = (b.record("pixels")[:, : len(features)] for b in (free, hidden))
        np.testing.assert_array_equal(those[kept], pixels[kept])
    assert behind > 50


def test_late_images_lack_features_hidden_at_their_time_stamp():
    suite = quad_gym.sensor_suite("lab")
    late = suite.replace(camera=suite.camera.replace(rate=40.0, latency=0.035))
    prompt = suite.replace(camera=suite.camera.replace(rate=40.0))
    world = WorldParams(obstacles=(Wall(center_I=(1.5, 0.0, 1.0), size=(0.3, 2.0, 3.0)),))
    now, then = (circling(world, sensors=s, run_filter=True) for s in (prompt, late))
    arrived, taken = [], []
    for _ in range(400):
        now.step()
        then.step()
        taken.append(now.record("block_valid")[:, FEATURE_SLICE])
        arrived.append(then.record("block_valid")[:, FEATURE_SLICE])
    np.testing.assert_array_equal(arrived[7:], taken[:-7])
    assert 0.2 < np.mean(np.array(taken)[4::5, :, 0] > 0.0) < 0.9


SHIFTED = WorldParams(
    obstacles=(
        Wall(center_I=(30.0, 3.0, 1.0), shift_I=(0.5, 2.0, 0.0)),
        Wall(center_I=(30.0, -3.0, 1.0), shift_I=(0.0, 0.5, 0.0), follows=0),
        Cylinder(center_I=(-30.0, 0.0, 1.0), shift_I=(0.0, 0.0, 0.3)),
    )
)


def test_shifts_are_uniform_and_shared_by_followers():
    batch = batch_of(2000, world=SHIFTED, **TRUTH)
    nominal = np.array([o.center_I for o in SHIFTED.obstacles])
    shift = batch.record("obstacle_center")[:, :3] - nominal
    own = shift[:, 1] - shift[:, 0]
    for values, reach in (
        (shift[:, 0, 0], 0.5),
        (shift[:, 0, 1], 2.0),
        (own[:, 1], 0.5),
        (shift[:, 2, 2], 0.3),
    ):
        assert np.abs(values).max() <= reach * (1 + 1e-12)
        # eight standard errors of the mean, and of the mean square
        assert abs(values.mean()) < 8.0 * reach / np.sqrt(3.0 * 2000)
        assert abs(np.mean(values**2) * 3.0 / reach**2 - 1.0) < 8.0 * np.sqrt(0.8 / 2000)
    np.testing.assert_allclose(own[:, [0, 2]], 0.0, atol=1e-12)
    assert (shift[:, 2, :2] == 0.0).all()
    again = batch_of(3, world=SHIFTED, **TRUTH)
    np.testing.assert_array_equal(
        again.record("obstacle_center"), batch.record("obstacle_center", np.arange(3))
    )


def test_reset_draws_new_obstacle_positions_and_clears_collisions():
    batch = batch_of(4, world=SHIFTED, **TRUTH)
    before = batch.record("obstacle_center")
    batch._blocks["collided"] = 1.0
    batch.reset(mask=np.array([True, False, True, False]))
    after = batch.record("obstacle_center")
    moved = (before != after).any(axis=(1, 2))
    np.testing.assert_array_equal(moved, [True, False, True, False])
    np.testing.assert_array_equal(batch.record("collided"), [0.0, 1.0, 0.0, 1.0])


@pytest.mark.parametrize(
    ("obstacles", "message"),
    [
        ((Wall(follows=0),), r"obstacles\[0\].follows must be"),
        (("wall",), "must contain Wall and Cylinder, got 'wall'"),
        ((Wall(),) * (MAX_OBSTACLES + 1), f"at most {MAX_OBSTACLES}, got {MAX_OBSTACLES + 1}"),
    ],
)
def test_invalid_obstacles_are_refused(obstacles, message):
    with pytest.raises(ValueError, match=message):
        WorldParams(obstacles=obstacles)


def test_starts_in_the_way_are_refused_before_anything_changes():
    world = WorldParams(obstacles=(WALL, MAST), geofence=((-5.0, -5.0, -1.0), (5.0, 5.0, 4.0)))
    batch = batch_of(2, world=world, **TRUTH)
    before = batch.snapshot()
    with pytest.raises(ValueError, match=r"farther than vehicle_radius=0\.42 m from all obstacles"):
        batch.reset(position=[WALL.center_I, (0.0, 3.0, 1.0)])
    with pytest.raises(ValueError, match="position must be within the geofence"):
        batch.reset(position=(0.0, 5.5, 1.0))
    assert batch.snapshot().tobytes() == before.tobytes()
    batch.reset(position=[(0.0, 3.0, 1.0), WALL.center_I], mask=np.array([True, False]))


def test_starts_where_a_shift_may_put_an_obstacle_are_refused():
    """The reference is the nearest of many shifts."""
    rng = np.random.default_rng(3)
    for obstacle in (
        MAST.replace(shift_I=(1.0, 0.5, 0.0)),
        WALL.replace(yaw=0.0, shift_I=(0.5, 1.0, 0.2)),
        WALL.replace(shift_I=(0.3, 0.3, 0.0)),  # rotated: the check may be too strict
    ):
        world = WorldParams(obstacles=(obstacle,))
        shifts = np.linspace(-1.0, 1.0, 9)
        shifts = np.stack(np.meshgrid(shifts, shifts, shifts), -1).reshape(-1, 3) * obstacle.shift_I
        for point in rng.uniform((-4.0, -4.0, -1.0), (4.0, 4.0, 3.0), (60, 3)):
            places = np.repeat(point[np.newaxis], len(shifts), axis=0)
            there = (shifts + obstacle.center_I)[:, np.newaxis]
            nearest = nearest_obstacle([obstacle], there, places)[0].min()
            try:
                require_room("position", point[np.newaxis], world)
                assert nearest > world.vehicle_radius
            except ValueError:
                slack = 0.5 if getattr(obstacle, "yaw", 0.0) else 0.13  # shifts are 0.25 apart
                assert nearest < world.vehicle_radius + slack

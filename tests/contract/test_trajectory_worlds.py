"""A trajectory of one's own among obstacles: who touches one, and what a task is told."""

import gymnasium
import numpy as np

import quad_gym
from quad_gym import TaskParams, Trajectory, Wall, WorldParams
from quad_gym.batch.surroundings import nearest_obstacle
from quad_gym.records import Source
from tests.builders import batch, part

GAP = (
    Wall(center_I=(0.0, 5.5, 2.0), size=(0.2, 8.0, 4.0), shift_I=(0.0, 0.2, 0.0)),
    Wall(center_I=(0.0, -5.5, 2.0), size=(0.2, 8.0, 4.0), follows=0),
)
THROUGH = Trajectory.through([(-3, 0, 1.5), (0, 0, 1.5), (3, 1, 1.5)], max_speed=1.5)
INTO_A_WALL = Trajectory.through([(-3, 0, 1.5), (0, 3, 1.5), (3, 1, 1.5)], max_speed=1.5)


def fly(trajectory, world, count=4, **options):
    """States of all ticks, and who has collided; under PD control on the estimate."""
    task = TaskParams(kind="trajectory", start="hover", trajectory=trajectory, duration=0.0)
    flights = batch(count, task=task, sensors="indoor", gains="tuned", world=world, **options)
    seconds = max(path.duration for path in task.trajectories)
    found = []
    for _ in range(round(seconds * flights.clocks.imu_rate)):
        flights.step()
        names = ("r", "collided", "obstacle_distance", "obstacle_center")
        found.append([flights.record(name) for name in names])
    return [np.array(part) for part in zip(*found, strict=True)]


def test_trajectory_through_a_gap_does_not_collide():
    world = WorldParams(obstacles=GAP)
    seeing = {"source": Source.TRUTH}  # an estimate is worse behind walls, which hide markers
    r, collided, distance, centers = fly(THROUGH, world, **seeing)
    assert not collided.any()
    for k in range(0, len(r), 50):
        expected, _ = nearest_obstacle(GAP, centers[k][:, :2], r[k])
        np.testing.assert_allclose(distance[k], expected, atol=1e-12)
    assert (fly(THROUGH, WorldParams(), **seeing)[0] == r).all()


def test_trajectory_into_a_wall_collides():
    r, collided, distance, _ = fly(INTO_A_WALL, WorldParams(obstacles=GAP))
    assert collided[-1].all()
    first = collided.argmax(axis=0)
    radius = WorldParams().vehicle_radius
    for flight, k in enumerate(first):
        assert distance[k, flight] <= radius < distance[k - 1, flight]
        assert abs(r[k, flight, 0]) < 0.1 + radius + 1e-9


def test_a_task_sees_the_wall_and_the_way_ahead():
    class Sees(quad_gym.Task):
        def observe(self, view):
            return {
                "wall": view.observed.obstacle_vector,
                "ahead": view.observed.preview.reshape(-1, 6),
            }

    world = WorldParams(obstacles=GAP)
    made = {"trajectory": THROUGH, "world": world, "task": Sees(), "observation": "truth"}
    env = gymnasium.make_vec("QuadGym/Trajectory-v0", num_envs=3, **made)
    observations, _ = env.reset(seed=0)
    flights = env.unwrapped.flights
    lengths = np.linalg.norm(part(env, observations, "wall"), axis=1)
    np.testing.assert_allclose(lengths, flights.batch.record("obstacle_distance"), rtol=1e-5)

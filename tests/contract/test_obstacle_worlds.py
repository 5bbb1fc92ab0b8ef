"""Environments whose world has obstacles: endings, autoreset, views, records, pictures."""

import gymnasium
import numpy as np
import pytest

import quad_gym
from quad_gym import Wall, WorldParams
from quad_gym.envs.single import QuadEnv
from quad_gym.envs.vector import QuadVectorEnv
from quad_gym.flights import Flight
from quad_gym.records import Ending
from quad_gym.tasks.rewards import Crash
from tests.builders import recorded_flight, single_env
from tests.contract.configurations import OBSTACLES
from tests.tasks.tasks import Near

EASTWARD = np.array([0.0, 0.0, -0.03, 0.0], np.float32)  # pitches the vehicle, which looks west


def actions(count, steps, seed=0):
    noise = np.random.default_rng(seed).normal(0.0, 0.1, (steps, count, 4))
    return np.clip(noise, -1.0, 1.0).astype(np.float32)


def hovering(count=6, **keywords):
    return QuadVectorEnv(count, base="hover", world=OBSTACLES, **keywords)


def test_collision_with_wall_terminates_with_ending_in_info():
    env = single_env(seed=0, world=OBSTACLES, observation="truth", task=Near)
    for _ in range(400):
        _, _, terminated, truncated, info = env.step(EASTWARD)
        if terminated or truncated:
            break
    assert terminated
    assert not truncated
    assert info["ending"] == Ending.COLLISION
    view = env.flights.batch.view
    assert 0.3 < view.obstacle_distance[0] <= OBSTACLES.vehicle_radius
    assert Crash()(view)[0] == 1.0


@pytest.mark.parametrize("mode", ["NextStep", "SameStep"])
def test_new_episode_after_collision_has_new_obstacles_and_continues(mode):
    env = gymnasium.make_vec(
        "QuadGym/Hover-v0", num_envs=4, world=OBSTACLES, observation="truth", autoreset_mode=mode
    )
    env.reset(seed=0)
    batch = env.unwrapped.flights.batch
    places, endings, lasted = [batch.record("obstacle_center")], [], []
    for _ in range(300):
        *_, info = env.step(np.tile(EASTWARD, (4, 1)))
        places.append(batch.record("obstacle_center"))
        ended = info.get("final_info", info)
        endings += np.ravel(ended["ending"]).tolist()
        lasted.append(batch.record("step"))
    episodes = (np.diff(np.array(places)[:, 0, 0, 0]) != 0.0).sum()
    assert endings.count(Ending.COLLISION) > 4
    assert episodes >= 1
    # no flight collides at once in the next episode, so its collision is reset
    assert np.array(lasted).max() > 50


def test_view_has_observed_and_true_obstacle_distances():
    env = hovering(6, task=Near, sensors="rtk")
    seen, _ = env.reset(seed=3)
    batch = env.flights.batch
    for action in actions(6, 30):
        seen, *_ = env.step(action)
    view = batch.view
    np.testing.assert_array_equal(view.obstacles, batch.record("obstacle_center")[:, :2])
    vector_I = np.einsum("nji,nj->ni", view.observed.R_BI, view.observed.obstacle_vector)
    truth, believed = view.truth.obstacle_vector, view.observed.position - view.position
    # where the wall is flat, the errors of vector and position are equal
    near_wall = np.abs(truth[:, 0]) > np.abs(truth[:, 1])
    np.testing.assert_allclose((vector_I - truth)[near_wall, 0], -believed[near_wall, 0], atol=1e-9)
    np.testing.assert_allclose(view.truth.obstacle_distance, np.linalg.norm(truth, axis=1))
    np.testing.assert_allclose(seen[:, -4], view.observed.obstacle_distance, atol=1e-6)


class Peeking(quad_gym.Task):
    def observe(self, view):
        return view.obstacle_distance


def test_the_true_distance_is_hidden_from_the_controller():
    with pytest.raises(quad_gym.TaskError, match="observe cannot read the truth"):
        QuadEnv(base="hover", world=OBSTACLES, task=Peeking)


def test_a_flight_keeps_its_obstacles(tmp_path):
    env, flight, _ = recorded_flight("hover", 3, world=OBSTACLES)
    centers = env.flights.batch.record("obstacle_center")[0, :2]
    np.testing.assert_array_equal(flight.scene.obstacles[:, 1:4], centers)
    np.testing.assert_array_equal(flight.scene.obstacles[:, 0], [0.0, 1.0])
    np.testing.assert_array_equal(flight.scene.obstacles[1, 4:7], [0.3, 0.3, 1.5])
    again = Flight.load(flight.save(tmp_path / "flight.npz")).scene
    np.testing.assert_array_equal(again.obstacles, flight.scene.obstacles)
    np.testing.assert_array_equal(again.geofence_I, OBSTACLES.geofence)


@pytest.mark.parametrize("view", ["fixed", "chase"])
def test_rendered_frames_show_obstacles(view):
    pytest.importorskip("pygame")
    frames = []
    # next to the vehicle, and around the camera of the chase view
    for obstacles in ((), (*OBSTACLES.obstacles, Wall(center_I=(3.0, 1.5, 1.0)))):
        env = gymnasium.make(
            "QuadGym/Hover-v0",
            world=WorldParams(obstacles=obstacles),
            render_mode="rgb_array",
            render_view=view,
        )
        env.reset(seed=0)
        frames.append(env.render().astype(int))
    changed = (np.abs(frames[0] - frames[1]).sum(axis=2) > 6).mean()
    assert 0.005 < changed < 0.97  # the legend stays

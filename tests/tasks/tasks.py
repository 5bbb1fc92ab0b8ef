"""Tasks that tests fly: one uses everything, one changes nothing, one observes surroundings."""

import numpy as np

import quad_gym
from quad_gym.tasks import ObservationSpec


class Chase(quad_gym.Task):
    """Follow a target that moves on a straight line, new in each episode."""

    state = {"target": np.zeros(3), "velocity": np.zeros(3), "best": np.inf, "caught": False}
    observes = {"target": ObservationSpec("m", "B", -20.0, 20.0)}

    def reset(self, view, rng):
        view.state.target = view.reference_position + rng.uniform(-0.5, 0.5, (view.count, 3))
        view.state.velocity = rng.normal(0.0, 0.3, (view.count, 3))
        near = view.state.target + (0.0, 0.0, 0.2)
        return {"position": near, "yaw": rng.uniform(-1.0, 1.0)}

    def update(self, view, rng):
        view.state.velocity += rng.normal(0.0, 0.02, (view.count, 3))
        view.state.target += view.period * view.state.velocity
        distance = np.linalg.norm(view.state.target - view.position, axis=1)
        view.state.best = np.minimum(view.state.best, distance)
        view.state.caught = distance < 0.1

    def reward(self, view):
        distance = np.linalg.norm(view.state.target - view.position, axis=1)
        return np.exp(-distance) + view.state.caught

    def terminated(self, view):
        far = np.linalg.norm(view.state.target - view.position, axis=1) > 1.0
        return far | view.builtin.terminated

    def observe(self, view):
        gap = view.state.target - view.observed.position
        return {
            "target": np.einsum("nij,nj->ni", view.observed.R_BI, gap),
            "best": view.state.best.clip(0.0, 5.0),
        }


class Same(quad_gym.Task):
    """Return the reward and endings of the built-in task."""

    def reward(self, view):
        return view.builtin.reward

    def terminated(self, view):
        return super().terminated(view)

    def truncated(self, view):
        return view.builtin.truncated


class Near(quad_gym.Task):
    """Observe the nearest obstacle, where there are any, and the first feature."""

    def observe(self, view):
        seen = {"feature": (view.features - view.observed.position[:, None])[:, 0]}
        if view.obstacles.shape[1]:
            seen["wall_distance"] = view.observed.obstacle_distance
            seen["wall_vector"] = view.observed.obstacle_vector
        return seen

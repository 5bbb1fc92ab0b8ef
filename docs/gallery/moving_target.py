"""Follow a target that wanders, and see it only through a noisy bearing and range.

    python docs/gallery/moving_target.py

PD control of the distance shows that the task can be done; train on it with
`quad-gym train QuadGym/Hover-v0 --env custom=moving_target:MovingTarget` in this folder.
"""

import gymnasium
import numpy as np

import quad_gym


class MovingTarget(quad_gym.Task):
    """The target's velocity is a random walk that is drawn back to where the episode began."""

    state = {"target": np.zeros(3), "velocity": np.zeros(3), "seen": np.zeros(3)}
    observes = {"target": quad_gym.Observed("m", "B", -50.0, 50.0)}

    def reset(self, view, rng):
        view.state.target = view.state.seen = view.reference_position

    def update(self, view, rng):
        state, dt = view.state, view.period
        home = view.reference_position - state.target
        push = 0.3 * home - 0.4 * state.velocity + rng.normal(0.0, 5.0, (view.count, 3))
        state.velocity += dt * push
        state.target += dt * state.velocity
        state.seen = state.target + rng.normal(0.0, 0.05, (view.count, 3))

    def distance(self, view):
        return np.linalg.norm(view.state.target - view.position, axis=1)

    def reward(self, view):
        return np.exp(-2.0 * self.distance(view)) + quad_gym.rewards.FOLLOWING(view) * 0.1

    def terminated(self, view):
        return super().terminated(view) | (self.distance(view) > 5.0)

    def observe(self, view):
        gap = view.state.seen - view.seen.position
        return {"target": np.einsum("nij,nj->ni", view.seen.R_BI, gap)}


def main(steps=500):
    envs = gymnasium.make_vec(
        "QuadGym/Hover-v0", num_envs=100, custom=MovingTarget(), action="velocity"
    )
    observations, _ = envs.reset(seed=0)
    total = np.zeros(envs.num_envs)
    for _ in range(steps):
        ahead = 1.5 * observations[:, -3:] / 5.0  # of the full velocity of 5 m/s
        actions = np.hstack([ahead, np.zeros((envs.num_envs, 1))]).clip(-1.0, 1.0)
        observations, rewards, *_ = envs.step(actions)
        total += rewards
    print(f"mean reward of a step: {total.mean() / steps:.2f}")
    return total.mean() / steps


if __name__ == "__main__":
    main()

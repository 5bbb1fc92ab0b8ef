"""
Follow a moving target
======================

A task of your own: a target wanders, and the vehicle sees it with noise of 5 cm. `quad_gym.Task`
keeps the target of every flight, rewards, ends episodes, and adds where the target is seen.
"""

import gymnasium
import matplotlib.pyplot as plt
import numpy as np

import quad_gym


class MovingTarget(quad_gym.Task):
    state = {"target": np.zeros(3), "velocity": np.zeros(3), "seen": np.zeros(3)}
    observes = {"target": quad_gym.Observed("m", "B", -50.0, 50.0)}

    def reset(self, view, rng):
        view.state.target = view.state.seen = view.reference_position

    def update(self, view, rng):  # noise pushes the target, a spring draws it back
        state, dt = view.state, view.period
        pull = 0.3 * (view.reference_position - state.target) - 0.4 * state.velocity
        state.velocity += dt * (pull + rng.normal(0.0, 5.0, (view.count, 3)))
        state.target += dt * state.velocity
        state.seen = state.target + rng.normal(0.0, 0.05, (view.count, 3))

    def reward(self, view):
        distance = np.linalg.norm(view.state.target - view.position, axis=1)
        return np.exp(-2.0 * distance) - 0.02 * quad_gym.rewards.Effort()(view)

    def terminated(self, view):
        far = np.linalg.norm(view.state.target - view.position, axis=1) > 5.0
        return super().terminated(view) | far

    def observe(self, view):
        gap = view.state.seen - view.seen.position
        return {"target": np.einsum("nij,nj->ni", view.seen.R_BI, gap)}


# %%
# The table of the observation says where the new part is. A controller that flies toward it:

task = {"custom": MovingTarget(), "action": "velocity"}
envs = gymnasium.make_vec("QuadGym/Hover-v0", num_envs=100, **task)
place = next(f.slice for f in envs.unwrapped.flights.table if f.name == "target")
observations, _ = envs.reset(seed=0)
mean_rewards = []
for _ in range(400):
    ahead = 0.3 * observations[:, place]
    actions = np.hstack([ahead, np.zeros((100, 1))]).clip(-1.0, 1.0)
    observations, rewards, *_ = envs.step(actions)
    mean_rewards.append(rewards.mean())
plt.plot(np.arange(400) / 50.0, mean_rewards)
plt.gca().set(xlabel="time [s]", ylabel="mean reward of a step")

"""
Land on a pad
=============

Your own task, with ground on which the vehicle can stand: the vehicle starts hovering, the pad is
up to a meter away, and PPO learns to land on it.
"""

from pathlib import Path

import gymnasium
import matplotlib.pyplot as plt
import numpy as np

import quad_gym
from baselines.compiled_ppo.ppo import CompiledPPO
from baselines.mlp import MlpPolicy
from baselines.recipes import Recipe

# %%
# Steps on the pad are rewarded, and the approach a little. Touching the ground faster than 0.5 m/s
# ends the episode, and with it all further reward.


class Landing(quad_gym.Task):
    state = {"pad": np.zeros(2)}
    observes = {"to_pad": quad_gym.ObservationSpec("m", "B", -5.0, 5.0)}

    def reset(self, view, rng):
        view.state.pad = view.reference_position[:, :2] + rng.uniform(-1.0, 1.0, (view.count, 2))

    def miss(self, view):
        return np.linalg.norm(view.position[:, :2] - view.state.pad, axis=1)

    def reward(self, view):
        near = 0.5 * np.exp(-2.0 * self.miss(view)) + 0.5 * np.exp(-10.0 * self.miss(view))
        low = np.exp(-2.0 * np.maximum(view.position[:, 2], 0.0))
        stands = view.truth.on_ground & (self.miss(view) < 0.2)
        return (
            0.2 * near
            + 0.3 * near * low
            + 0.5 * stands
            - 0.02 * quad_gym.rewards.ActionRate()(view)
        )

    def observe(self, view):
        pad = np.column_stack([view.state.pad, np.zeros(view.count)])
        return {"to_pad": np.einsum("nij,nj->ni", view.observed.R_BI, pad - view.observed.position)}


# %%
# The actions are velocities. A million and a half steps take about a minute on two cores; the
# resulting policy is stored next to this file.

KEYWORDS = {
    "task": Landing(),
    "world": quad_gym.WorldParams(ground=quad_gym.GroundParams(max_touchdown_speed=0.5)),
    "action": "velocity",
    "height": 1.0,
    "out_of_bounds": 3.0,  # a pad may be 1.7 m from the point that Hover holds
    "max_episode_steps": 300,
}
RECIPE = Recipe(
    steps=1_500_000,
    n_envs=128,
    parameters={"n_steps": 32, "batch_size": 1024, "n_epochs": 5, "gamma": 0.98},
    policy={"log_std_init": -1.0},
)
FILE = Path("policies/landing.npz")
if not FILE.exists():
    made = {"num_envs": RECIPE.n_envs, "autoreset_mode": "SameStep"}
    model = CompiledPPO(gymnasium.make_vec("QuadGym/Hover-v0", **made, **KEYWORDS), RECIPE, seed=0)
    model.learn(RECIPE.steps)
    model.policy().save(FILE)

# %%
# The trained policy in 200 episodes with other seeds:

policy = MlpPolicy.load(FILE)
envs = gymnasium.make_vec("QuadGym/Hover-v0", num_envs=200, **KEYWORDS)
observations, _ = envs.reset(seed=1_000)
batch, heights, crashed = envs.unwrapped.flights.batch, [], np.zeros(200, bool)
for _ in range(299):
    observations, _, terminated, *_ = envs.step(policy.predict(observations)[0])
    crashed |= terminated
    heights.append(batch.read("position")[:, 2])
miss = np.linalg.norm(batch.read("position")[:, :2] - batch.view.state.pad, axis=1)
stands = batch.read("on_ground") & ~crashed
landed = (stands & (miss < 0.2)).mean()
print(f"on the pad {100 * landed:.0f} %, median miss {100 * np.median(miss):.1f} cm")
assert landed > 0.95

plt.plot(np.arange(299) / 50.0, np.array(heights)[:, :20])
plt.gca().set(xlabel="time [s]", ylabel="height of the center of mass [m]")

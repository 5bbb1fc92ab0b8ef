"""
Follow a moving target
======================

Your own task: a target wanders, and the vehicle observes it with noise of 5 cm. A `quad_gym.Task`
keeps the target of each flight, computes the reward, ends episodes, and adds the observed target to
the observation.
"""

from pathlib import Path

import gymnasium
import matplotlib.pyplot as plt
import numpy as np

import quad_gym
from baselines.compiled_ppo.ppo import CompiledPPO
from baselines.mlp import MlpPolicy
from baselines.recipes import Recipe


class MovingTarget(quad_gym.Task):
    state = {"target": np.zeros(3), "velocity": np.zeros(3), "seen": np.zeros(3)}
    observes = {"target": quad_gym.ObservationSpec("m", "B", -50.0, 50.0)}

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
        return np.exp(-2.0 * distance) - 0.02 * quad_gym.rewards.ActionRate()(view)

    def terminated(self, view):
        far = np.linalg.norm(view.state.target - view.position, axis=1) > 5.0
        return super().terminated(view) | far

    def observe(self, view):
        gap = view.state.seen - view.observed.position
        return {"target": np.einsum("nij,nj->ni", view.observed.R_BI, gap)}


# %%
# PPO learns to follow. The actions are velocities; a million steps take about a minute on two
# cores, and the resulting policy is stored next to this file. The bounds are wider than in
# ``Hover``, because the target wanders more than 1.6 m away.

KEYWORDS = {
    "task": MovingTarget(),
    "action": "velocity",
    "out_of_bounds": 3.0,
    "max_episode_steps": 400,
}
RECIPE = Recipe(
    steps=1_000_000,
    n_envs=128,
    parameters={"n_steps": 32, "batch_size": 1024, "n_epochs": 5, "gamma": 0.97},
    policy={"log_std_init": -1.0},
)
FILE = Path("policies/moving_target.npz")
if not FILE.exists():
    made = {"num_envs": RECIPE.n_envs, "autoreset_mode": "SameStep"}
    model = CompiledPPO(gymnasium.make_vec("QuadGym/Hover-v0", **made, **KEYWORDS), RECIPE, seed=0)
    model.learn(RECIPE.steps)
    model.policy().save(FILE)

# %%
# With other seeds, compared with a proportional controller on the observed target. The table of the
# observation has the slice of the target.

envs = gymnasium.make_vec("QuadGym/Hover-v0", num_envs=100, **KEYWORDS)
place = next(f.slice for f in envs.unwrapped.flights.table if f.name == "target")
policy = MlpPolicy.load(FILE)


def proportional(observations):
    return np.hstack([0.5 * observations[:, place], np.zeros((100, 1))]).clip(-1.0, 1.0)


def fly(act):
    """(t, n) distances from the target."""
    observations, _ = envs.reset(seed=1_000)
    batch, distances = envs.unwrapped.flights.batch, []
    for _ in range(399):
        observations, *_ = envs.step(act(observations))
        distances.append(np.linalg.norm(batch.view.state.target - batch.read("position"), axis=1))
    return np.array(distances)


learned, plain = fly(lambda observations: policy.predict(observations)[0]), fly(proportional)
late = learned[100:].mean()
print(f"mean distance after 2 s: learned {late:.2f} m, proportional {plain[100:].mean():.2f} m")
assert late < 0.9 * plain[100:].mean()

for distances, name in ((learned, "learned"), (plain, "proportional")):
    plt.plot(np.arange(399) / 50.0, distances.mean(axis=1), label=name)
plt.gca().set(xlabel="time [s]", ylabel="mean distance [m]", ylim=(0.0, None))
plt.legend()

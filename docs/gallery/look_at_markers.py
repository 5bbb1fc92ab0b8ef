"""
Reward looking at markers
=========================

Without GNSS, the position estimate is only as good as the camera's view of the markers. This task
rewards markers in view and a small covariance. Half of the vehicles start turned away from them.
"""

import gymnasium
import matplotlib.pyplot as plt
import numpy as np

import quad_gym
from baselines import PDPolicy
from quad_gym import rewards


class LookAtMarkers(quad_gym.Task):
    observes = {"position_sigma": quad_gym.ObservationSpec("m", "I", 0.0, 10.0)}

    def __init__(self, turned):
        self.turned = turned
        unsure = rewards.Uncertainty("position")
        self.pieces = rewards.Tracking() + 0.2 * rewards.Visibility() - 5.0 * unsure

    def reset(self, view, rng):
        x, y, _ = view.reference_heading.T
        yaw = np.arctan2(y, x) + self.turned + rng.normal(0.0, 0.1)
        return {"yaw": np.remainder(yaw, 2.0 * np.pi)}

    def reward(self, view):
        return self.pieces(view)

    def observe(self, view):
        return {"position_sigma": view.estimate.position_sigma}


# %%
# PD control turns toward the markers by itself. Until then the standard deviation grows, and the
# reward is smaller:

figure, (of_reward, of_sigma) = plt.subplots(1, 2, figsize=(9, 4))
for turned, label in ((0.0, "toward the markers"), (np.pi, "away from them")):
    envs = gymnasium.make_vec(
        "QuadGym/Hover-v0", num_envs=50, sensors="indoor", task=LookAtMarkers(turned)
    )
    policy, earned, sigma = PDPolicy(envs), [], []
    observations, _ = envs.reset(seed=0)
    for _ in range(100):
        observations, reward, *_ = envs.step(policy.predict(observations)[0])
        earned.append(reward.mean())
        sigma.append(1e3 * observations[:, -3:].max(axis=1).mean())
    of_reward.plot(np.arange(100) / 50.0, earned, label=label)
    of_sigma.plot(np.arange(100) / 50.0, sigma, label=label)
of_reward.set(xlabel="time [s]", ylabel="mean reward of a step")
of_sigma.set(xlabel="time [s]", ylabel="standard deviation of the position [mm]")
of_reward.legend()

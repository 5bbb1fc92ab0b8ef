"""Hover where there is no GNSS, and be paid for keeping markers in view and the filter sure.

    python docs/gallery/look_at_markers.py

Compares two headings of PD control by the reward: the filter stays sure where the camera sees.
"""

import gymnasium
import numpy as np

import quad_gym
from baselines import PDPolicy
from quad_gym import rewards


class LookAtMarkers(quad_gym.Task):
    """Tracking counts, and so does knowing where one is; the policy sees how sure its filter is."""

    observes = {"position_sigma": quad_gym.Observed("m", "I", 0.0, 10.0)}

    def __init__(self, turned=0.0):
        self.turned = turned
        unsure = rewards.Uncertainty("position")
        self.pieces = rewards.Tracking() + 0.2 * rewards.Visibility() - 5.0 * unsure

    def reset(self, view, rng):
        away = np.arctan2(view.reference_heading[:, 1], view.reference_heading[:, 0])
        return {"yaw": away + self.turned + rng.normal(0.0, 0.1)}

    def reward(self, view):
        return self.pieces(view)

    def observe(self, view):
        return {"position_sigma": view.estimate.position_sigma}


def main(steps=25):
    means = []
    for turned in (0.0, np.pi):
        envs = gymnasium.make_vec(
            "QuadGym/Hover-v0", num_envs=50, sensors="indoor", custom=LookAtMarkers(turned)
        )
        policy, earned = PDPolicy(envs), []
        observations, _ = envs.reset(seed=0)
        for _ in range(steps):
            observations, reward, *_ = envs.step(policy.predict(observations)[0])
            earned.append(reward[:, np.newaxis])
        means.append(float(np.mean(earned)))
        print(f"turned by {np.degrees(turned):3.0f} deg: mean reward {means[-1]:.2f}")
    return means


if __name__ == "__main__":
    main()

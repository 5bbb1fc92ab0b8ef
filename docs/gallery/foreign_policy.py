"""
A third-party policy
====================

RAPTOR is a policy for quadrotors that it has never seen: a network of 2,084 parameters with memory,
trained by its authors on a thousand vehicles, which adapts to another one within a second
(J. Eschmann et al., arXiv:2509.11481; ``pip install foundation-policy``). Here it flies this
package's vehicle on the estimate, without further training.
"""

import matplotlib.pyplot as plt
import numpy as np
from foundation_policy import QuadrotorPolicy

import quad_gym
from quad_gym.evaluation import evaluate

EPISODES = 100

# %%
# The policy observes position, attitude, velocity, body rates and its last action at 100 Hz, and
# commands the motors. It holds the origin with the nose along x, so the reference is subtracted and
# all vectors are turned into axes along the reference's heading. It numbers the rotors clockwise
# from the right front one; this package numbers them counterclockwise.

ENVIRONMENT = {"action": "motor", "layout": "absolute", "control_rate": 100}
COLUMNS = {field.name: field.slice for field in quad_gym.observation_layout(layout="absolute")}
ROTORS = [0, 3, 2, 1]
LARGEST_ERROR = 0.5  # larger position errors are shortened to this length [m]


class Raptor:
    """RAPTOR as a policy of this package; it has one memory for each environment."""

    def __init__(self):
        self.network = QuadrotorPolicy()

    def predict(self, observation, state=None, episode_start=None, deterministic=True):
        """Actions for a batch of observations; `episode_start`: (n,) flags of new episodes."""
        o = {name: observation[:, columns] for name, columns in COLUMNS.items()}
        north, east = o["reference_heading"][:, 1], o["reference_heading"][:, 0]
        zero, one = np.zeros_like(north), np.ones_like(north)
        turn = np.array([[east, north, zero], [-north, east, zero], [zero, zero, one]])
        turn = np.moveaxis(turn, 2, 0)  # inertial axes to those of the heading, (n, 3, 3)
        error = o["position"] - o["reference_position"]
        distance = np.linalg.norm(error, axis=1, keepdims=True)
        error *= np.minimum(1.0, LARGEST_ERROR / np.maximum(distance, 1e-9))
        velocity = o["velocity"] - o["reference_velocity"]
        attitude = turn @ o["R_BI"].reshape(-1, 3, 3).swapaxes(1, 2)
        sees = [
            np.einsum("nij,nj->ni", turn, error),
            attitude.reshape(-1, 9),
            np.einsum("nij,nj->ni", turn, velocity),
            o["body_rates"],
            o["last_action"][:, ROTORS],
        ]
        memory = self.network.layers[1]
        start = np.ones(len(observation), bool) if episode_start is None else episode_start
        if state is None:
            state = np.tile(memory.initial_hidden_state, (len(observation), 1))
        memory.state = np.where(start[:, None], memory.initial_hidden_state, state)
        action = self.network.evaluate_step(np.concatenate(sees, axis=1))
        return np.clip(action[:, ROTORS], -1.0, 1.0).astype(np.float32), memory.state


# %%
# It tracks without any number of the vehicle. LookAround is different: there, the camera sees its
# markers only if the vehicle turns to them. A policy trained on the true state has no reason to,
# and loses the estimate.

print("task          observation  mean error  estimation  crashed")
for task in ("Hover", "Circle", "Lemniscate", "LookAround"):
    for source in ("truth", "estimate"):
        flown = evaluate(
            Raptor(),
            f"QuadGym/{task}-v0",
            episodes=EPISODES,
            observation=source,
            **ENVIRONMENT,
        )
        mean = flown.summary()
        print(
            f"{task:13} {source:10} {1e3 * mean['mean_error']:8.0f} mm "
            f"{1e3 * mean['estimation_error']:7.0f} mm {100 * mean['crash_rate']:6.0f} %"
        )

# %%
# It adapts. Here the true mass differs from the one that the environment assumes, by which the
# motor commands are scaled: neutral commands lift half the weight, or twice. The error is the mean
# over the second half of an episode.

factors = [0.5, 0.75, 1.0, 1.5, 2.0, 2.6, 3.0]
errors = []
for factor in factors:
    mass = quad_gym.Uniform(factor, factor, relative=True)
    flown = evaluate(
        Raptor(),
        "QuadGym/Hover-v0",
        episodes=EPISODES,
        randomization=quad_gym.Randomization({"mass": mass}),
        **ENVIRONMENT,
    )
    mean = flown.summary()
    errors.append(1e3 * mean["late_error"])
    print(f"mass x {factor:4.2f} {errors[-1]:6.0f} mm, {100 * mean['crash_rate']:.0f} % crashed")

figure, axes = plt.subplots()
axes.plot(factors, errors, "o-")
axes.set(xlabel="true mass over the assumed one", ylabel="error in Hover [mm]", ylim=(0, None))

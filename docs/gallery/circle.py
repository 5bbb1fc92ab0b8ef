"""
Fly the circle on truth and on the estimate
===========================================

The same controller flies the same circle twice: once on the true state, once on the estimate of the
filter. The difference is the cost of the estimate.
"""

import gymnasium
import matplotlib.pyplot as plt
import numpy as np

import quad_gym
from baselines import PDPolicy

# %%
# The controller computes its action from the observation alone. The keyword ``observation`` chooses
# its source; everything else stays the same.

STEPS = 500  # ten seconds at 50 actions per second


def fly(source):
    """One episode: path, reference, distance from the reference, error of the estimate."""
    env = gymnasium.make("QuadGym/Circle-v0", observation=source)
    policy = PDPolicy(env, gains="tuned")
    batch = env.unwrapped.flights.batch
    observation, info = env.reset(seed=1)
    path, tracking, estimation = [], [], []
    for _ in range(STEPS):
        action, _ = policy.predict(observation)
        observation, reward, terminated, truncated, info = env.step(action)
        path.append(batch.read("position")[0])
        tracking.append(info["position_error"])
        estimation.append(info["estimation_error"])
    return np.array(path), 1e3 * np.array(tracking), 1e3 * np.array(estimation)


truth, estimate = fly("truth"), fly("estimate")

# %%
# ``FlightBatch.read`` returns any quantity of the flights behind an environment, such as the true
# position. From above, both flights look the same: the vehicle leaves its launch pad late, cuts
# the corner, and joins the circle.

figure, (above, error) = plt.subplots(1, 2, figsize=(9, 4))
angle = np.linspace(0, 2 * np.pi, 200)
above.plot(4 * np.cos(angle), 4 * np.sin(angle), color="0.6", linestyle="--", label="reference")
time = np.arange(1, STEPS + 1) / 50
for (path, tracking, _), name in ((truth, "on truth"), (estimate, "on the estimate")):
    above.plot(path[:, 0], path[:, 1], label=name)
    error.semilogy(time, tracking, label=name)
above.set(aspect="equal", xlabel="east [m]", ylabel="north [m]")
error.set(xlabel="time [s]", ylabel="distance from the reference [mm]")
above.legend()
error.legend()

# %%
# Tracking errors use the true position in both cases. The estimate adds a few millimeters, about
# as much as the error of the filter:

for (_, tracking, estimation), name in ((truth, "truth"), (estimate, "estimate")):
    print(
        f"on {name:8}: tracking {tracking[250:].mean():5.1f} mm in the second half, "
        f"estimation {estimation[250:].mean():4.1f} mm"
    )

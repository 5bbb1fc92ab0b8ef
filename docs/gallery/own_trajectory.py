"""
Fly your own trajectory
=======================

A minimum-snap trajectory through five points, and how closely the vehicle follows it on the
estimate.
"""

import gymnasium
import matplotlib.pyplot as plt
import numpy as np

import quad_gym
from baselines import PDPolicy

# %%
# The times at the points are chosen such that either the speed or the acceleration just reaches its
# limit. ``check`` lists the demands on the vehicle.

points = np.array([(0, 0, 1.5), (3, 1.5, 2), (3, -1.5, 1), (-3, 1.5, 2), (-3, -1.5, 1)])
path = quad_gym.Trajectory.through(points, closed=True, max_speed=2.5, yaw="along")
print(path, path.times.round(2))
for name, value in path.check(quad_gym.vehicle_params("lab"))._asdict().items():
    print(name, np.round(value, 2))

# %%
# Twenty flights, each from the start of the trajectory. ``randomize_reference=True`` would start
# each flight at a random point, and turn the trajectory by a random angle.

envs = gymnasium.make_vec("QuadGym/Trajectory-v0", num_envs=20, trajectory=path)
policy, flown = PDPolicy(envs), []
observations, _ = envs.reset(seed=0)
for _ in range(envs.unwrapped.flights.batch.max_steps - 1):
    observations, _, _, _, info = envs.step(policy.predict(observations)[0])
    flown.append(envs.unwrapped.flights.batch.read("position"))
print(f"mean error in the last step: {1e3 * info['position_error'].mean():.0f} mm")

# %%
# From above, with the heading every half second (arrows); speed and acceleration, with their limits
# (dotted).

t = np.linspace(0.0, path.duration, 600)
figure, (above, over_time) = plt.subplots(1, 2, figsize=(10, 4))
flown = np.array(flown)  # (steps, flights, 3)
above.plot(flown[..., 0], flown[..., 1], color="C0", linewidth=0.7, alpha=0.5)
above.plot(*path(t)[:, :2].T, "k--", linewidth=1.0, label="trajectory")
above.plot(*points[:, :2].T, "o", color="C3", label="points")
at = np.arange(0.0, path.duration, 0.5)
ahead = np.cos(path.yaw(at)), np.sin(path.yaw(at))
above.quiver(*path(at)[:, :2].T, *ahead, scale=18.0, width=0.007, color="0.3", zorder=3)
above.set(xlabel="east [m]", ylabel="north [m]", aspect="equal")
above.legend(loc="lower left", bbox_to_anchor=(0.0, 1.0), ncols=2, frameon=False)
for k, (name, bound) in enumerate((("speed [m/s]", 2.5), ("acceleration [m/s$^2$]", 3.0)), 1):
    over_time.plot(t, np.linalg.norm(path(t, k), axis=1), color=f"C{k}", label=name)
    over_time.axhline(bound, color=f"C{k}", linestyle=":", linewidth=1.0)
over_time.plot(path.times, 0.0 * path.times, "o", color="C3", clip_on=False)
over_time.set(xlabel="time [s]", xlim=(0.0, path.duration), ylim=(0.0, 3.8))
over_time.legend(ncols=2, loc="upper right")

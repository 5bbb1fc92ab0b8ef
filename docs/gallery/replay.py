"""
Replay a log with irregular times
=================================

``replay`` runs a filter on the log of a flight: samples at irregular times, measurements that are
late or missing. Here a hobby vehicle has one GNSS antenna and no magnetometer, so its heading is
unknown until it moves.
"""

import matplotlib.pyplot as plt
import numpy as np

import quad_gym
from quad_gym.estimation import replay

# %%
# A simulated flight replaces a real one. One row in a hundred is dropped, and fixes reach the
# recorder 0.1 s to 0.15 s after their time stamps.

suite = quad_gym.sensor_suite("rtk").replace(camera=None)
batch = quad_gym.FlightBatch(1, sensors=suite, gains="tuned")
batch.reset(seeds=[4])
rng, rows, truth = np.random.default_rng(0), [], []
nothing = np.full(3, np.nan)
fields = ("gyro", "accel", "gnss_position", "gnss_velocity")
for k in range(2001):
    if k > 0:
        batch.step()
    time, (gyro, accel, place, speed) = 0.005 * k, (batch.read(name)[0] for name in fields)
    rows.append([time, time, *(gyro if k else nothing), *accel, *nothing, *nothing])
    if np.isfinite(place).all():
        stamps = (time - 0.1, time + rng.uniform(0.0, 0.05)) if k else (0.0, 0.0)
        rows.append([*stamps, *nothing, *nothing, *place, *speed])
    truth.append(batch.read("position")[0])
rows = np.array(rows)[rng.random(len(rows)) > 0.01]

# %%
# The columns of a table have names; see :doc:`/logs`.

parts = np.split(rows, [1, 2, 5, 8, 11], axis=1)
names = ("time", "received", "gyro", "accel", "gnss_enu", "gnss_velocity_enu")
log = {name: np.squeeze(part) for name, part in zip(names, parts, strict=True)}
result = replay(log, sensors=suite)
print(f"heading known after {result.time[np.argmax(result.heading_known)]:.2f} s")

# %%
# The position error stays within three standard deviations. The standard deviation of the heading,
# uniform at first, falls as soon as the vehicle accelerates.

position = np.array(truth)[np.rint(result.time / 0.005).astype(int)]
figure, axes = plt.subplots(2, 1, sharex=True, figsize=(7, 5))
sigma = 100 * result.sigma[:, 0]
axes[0].fill_between(result.time, -3 * sigma, 3 * sigma, color="C1", alpha=0.25, linewidth=0)
axes[0].plot(result.time, 100 * (position - result.position)[:, 0])
axes[0].set(ylabel="error to the east [cm]", ylim=(-10, 10))
axes[1].semilogy(result.time, np.degrees(result.sigma[:, 8]))
axes[1].set(xlabel="time [s]", ylabel="deviation of the heading [deg]")

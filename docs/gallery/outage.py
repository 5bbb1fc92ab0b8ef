"""
Watch the filter through a GNSS outage
======================================

GNSS fails for some seconds. The covariance of a consistent filter grows with its error. A filter
that becomes inconsistent during the outage detects it only when GNSS returns, and has to recover.
"""

import gymnasium
import matplotlib.pyplot as plt
import numpy as np

import quad_gym
from baselines import PDPolicy
from quad_gym.faults import AccelBiasStep, GnssOutage

FLIGHTS, SECONDS = 200, 20


def fly(*faults):
    """Errors and standard deviations (steps, flights), and the share of diverged filters."""
    envs = gymnasium.make_vec(
        "QuadGym/Hover-v0",
        num_envs=FLIGHTS,
        sensors="rtk",
        camera=False,
        duration=float(SECONDS),
        out_of_bounds=1e3,
        faults=faults,
    )
    policy = PDPolicy(envs, gains="tuned")
    batch = envs.unwrapped.flights.batch
    observation, _ = envs.reset(seed=0)
    errors, claimed, lost = [], [], []
    for _ in range(50 * SECONDS - 1):
        action, _ = policy.predict(observation)
        observation, _, _, _, info = envs.step(action)
        error = batch.read("position") - batch.read("estimated_position")
        errors.append(error[:, 0])
        claimed.append(np.sqrt(batch.covariance()[:, 0, 0]))
        lost.append(info["filter_diverged"].mean())
    return np.array(errors), np.array(claimed), np.array(lost)


# %%
# Without GNSS, the covariance grows
# ----------------------------------
#
# From 4 s to 8 s there are no fixes, and this vehicle has no camera. The filter continues with the
# IMU alone. Its error grows, and so does its standard deviation: nearly all of the 200 flights stay
# within three standard deviations.

outage = GnssOutage(start=4.0, duration=4.0)
errors, claimed, lost = fly(outage)
time = np.arange(1, len(errors) + 1) / 50

figure, axes = plt.subplots()
axes.axvspan(4, 8, color="0.9", label="no GNSS")
axes.plot(time, errors, color="C0", alpha=0.08, linewidth=0.8)
for sign in (-3, 3):
    axes.plot(time, sign * claimed.mean(axis=1), color="C1", label="3 sigma" if sign > 0 else None)
axes.set(xlabel="time [s]", ylabel="error of the position, east [m]", title="An outage")
axes.legend(loc="upper left")

inside = (np.abs(errors) < 3 * claimed).mean()
print(f"within 3 sigma: {100 * inside:.1f} % of all errors")
print(f"diverged filters: {100 * lost.max():.0f} %")

# %%
# A bias step during the outage
# -----------------------------
#
# Now the accelerometer's bias steps by 0.2 m/s² while there is no GNSS, ten times the standard
# deviation that the filter assumes for it. The error grows far beyond the covariance. When
# fixes return, they contradict the estimate so much that the gate rejects them. After a
# second the filter resets the states that only GNSS measures, and accepts the next fix.
# ``info["filter_diverged"]`` is true while the filter's covariance does not explain its
# measurements.

step = AccelBiasStep(start=5.0, duration=float("inf"), size=(0.2, 0.2))
errors, claimed, lost = fly(outage, step)
sizes = np.abs(errors)

figure, (above, below) = plt.subplots(2, 1, sharex=True, height_ratios=(2, 1), figsize=(7, 5))
for axes in (above, below):
    axes.axvspan(4, 8, color="0.9")
above.semilogy(time, np.median(sizes, axis=1), color="C0", label="error, median")
above.semilogy(time, np.percentile(sizes, 95, axis=1), "C0:", label="error, 95th percentile")
above.semilogy(time, np.median(claimed, axis=1), color="C1", label="reported standard deviation")
above.set(ylabel="east [m]", ylim=(2e-3, 30), title="A bias step during the outage")
above.legend(ncols=3, loc="upper right")
below.fill_between(time, 100 * lost, color="C3", alpha=0.5)
below.set(xlabel="time [s]", ylabel="diverged filters [%]", ylim=(0, 105))

far = (sizes[-1] > 0.1).mean()
print(f"diverged filters: at most {100 * lost.max():.0f} %, at the end {100 * lost[-1]:.0f} %")
print(f"farther than 10 cm at the end: {100 * far:.1f} % of the flights")

# %%
# One recovery is not always enough. While the new bias is still uncertain, the estimate drifts off
# again, as the 95th percentile shows, until the filter resets its biases once more.
#
# ``truncate_when_diverged=True`` truncates an episode when its filter is flagged as diverged. See
# :doc:`/sensors-and-filter` for tests, thresholds and actions.

"""
Effect of faults on the NIS
===========================

The normalized innovation squared (NIS) measures how well a measurement fits the prediction. Faults
change its distribution, and a gate acts on it.
"""

import gymnasium
import matplotlib.pyplot as plt
import numpy as np
from scipy.stats import chi2

import quad_gym
from baselines import PDPolicy
from quad_gym.faults import GnssJump, GnssOutliers, GnssRamp
from quad_gym.records import POSITION_BLOCK, GateDecision

FLIGHTS, SECONDS = 200, 10


def fly(sensors, *faults):
    """NIS of GNSS positions (step, flight), gate decisions, errors of the estimate [m]."""
    envs = gymnasium.make_vec(
        "QuadGym/Hover-v0",
        num_envs=FLIGHTS,
        sensors=sensors,
        innovations=True,
        faults=faults,
        out_of_bounds=1e3,
    )
    policy = PDPolicy(envs, gains="tuned")
    observation, _ = envs.reset(seed=0)
    nis, gate, error = [], [], []
    for _ in range(50 * SECONDS - 1):
        action, _ = policy.predict(observation)
        observation, _, _, _, info = envs.step(action)
        found = info["innovations"]
        fresh = found["measured"][:, POSITION_BLOCK]
        nis.append(np.where(fresh, found["nis"][:, POSITION_BLOCK], np.nan))
        gate.append(np.where(fresh, found["gate"][:, POSITION_BLOCK], GateDecision.NONE))
        error.append(info["estimation_error"])
    return np.array(nis), np.array(gate), np.array(error)


# %%
# Five percent of outliers
# ------------------------
#
# Without faults, NIS of a position is chi-square with three degrees of freedom. With five percent
# of outliers, of 10 to 100 standard deviations, a second mode appears far to the right. The gate
# of ``"rtk"`` is the quantile that one valid measurement in 10,000 exceeds.

clean, _, _ = fly("rtk")
dirty, gate, gated_error = fly("rtk", GnssOutliers(share=0.05))

figure, axes = plt.subplots()
bins = np.geomspace(0.02, 2e4, 80)
centers = np.sqrt(bins[1:] * bins[:-1])
for values, name in ((clean, "no fault"), (dirty, "5 % outliers")):
    values = values[~np.isnan(values)]
    share, _ = np.histogram(values, bins)
    axes.step(centers, share / len(values), where="mid", label=name)
axes.plot(centers, np.diff(chi2.cdf(bins, 3)), color="0.3", linestyle="--", label="chi-square, 3")
limit = chi2.isf(quad_gym.sensor_suite("rtk").estimator.false_alarm_probability, 3)
axes.axvline(limit, color="C3", label="gate")
axes.set(xscale="log", yscale="log", ylim=(1e-5, 0.2), xlabel="NIS of GNSS positions")
axes.set(ylabel="share of fixes per bin")
axes.legend()

rejected = (gate == GateDecision.REJECTED).sum() / (gate != GateDecision.NONE).sum()
print(f"rejected: {100 * rejected:.2f} % of the fixes")

# %%
# With the gate, the filter tolerates them:

rtk = quad_gym.sensor_suite("rtk")
open_gate = rtk.replace(estimator=rtk.estimator.replace(false_alarm_probability=0.0))
_, _, open_error = fly(open_gate, GnssOutliers(share=0.05))
print(f"mean error of the estimate: with the gate {1e3 * gated_error.mean():.1f} mm, ", end="")
print(f"without it {1e3 * open_error.mean():.1f} mm")

# %%
# Jumps and ramps
# ---------------
#
# A jump of the positions is detected at once; a slow ramp passes any gate on single innovations at
# first. ``"rtk"`` has a camera, whose features contradict GNSS: the estimate does not follow.

no_camera = rtk.replace(camera=None)
figure, axes = plt.subplots(2, 1, sharex=True, figsize=(7, 5.5))
time = np.arange(1, 50 * SECONDS) / 50
for fault, name, color in (
    (GnssJump(start=4.0, duration=100.0, size=(0.5, 0.5)), "jump of 0.5 m", "C0"),
    (GnssRamp(start=4.0, duration=100.0, speed=(0.05, 0.05)), "ramp of 5 cm/s", "C1"),
):
    for suite, style, what in ((rtk, "-", "with camera"), (no_camera, ":", "without")):
        nis, _, error = fly(suite, fault)
        there = ~np.isnan(nis).all(axis=1)
        axes[0].semilogy(time[there], np.nanmedian(nis[there], axis=1), style, color=color)
        axes[1].semilogy(
            time, np.median(error, axis=1), style, color=color, label=f"{name}, {what}"
        )
axes[0].axhline(limit, color="C3", linewidth=1)
axes[0].set(ylabel="NIS, median")
axes[1].set(xlabel="time [s]", ylabel="error of the estimate [m]")
axes[1].legend(fontsize=8)

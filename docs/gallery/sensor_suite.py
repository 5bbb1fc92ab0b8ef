"""
Your own sensor suite
=====================

A sensor suite is a frozen dataclass. Take the closest one, replace the fields that differ, and
check that the filter is still consistent.
"""

import gymnasium
import matplotlib.pyplot as plt
import numpy as np

import quad_gym
from baselines import PDPolicy
from quad_gym.analysis.consistency import draw_mean_square, endless, measure_consistency
from quad_gym.evaluation import roll_out

# %%
# A survey vehicle with cheaper parts
# -----------------------------------
#
# We begin with ``"rtk"``: a receiver with half of its rate, a longer baseline, a camera that
# looks at four markers only, and an IMU with three times the noise. The filter assumes these
# numbers, too.

rtk = quad_gym.sensor_suite("rtk")
mine = rtk.replace(
    gnss=rtk.gnss.replace(
        rate=5.0,
        primary_antenna_B=(0.25, 0.0, 0.05),
        secondary_antenna_B=(-0.25, 0.0, 0.05),
        baseline_sigma=np.radians(0.4) / 0.5,  # 0.4 degrees for a baseline of 1 m
    ),
    camera=rtk.camera.replace(features_I=((2, 2, 0), (2, -2, 0), (-2, 2, 0), (-2, -2, 0))),
    imu=rtk.imu.replace(
        gyro_noise_density=3 * rtk.imu.gyro_noise_density,
        accel_noise_density=3 * rtk.imu.accel_noise_density,
    ),
)

# %%
# Invalid values are refused by name:

try:
    rtk.gnss.replace(rate=-5.0)
except ValueError as error:
    print(error)

# %%
# Cost
# ----

for name, suite in (("rtk", "rtk"), ("mine", mine)):
    envs = gymnasium.make_vec("QuadGym/Circle-v0", num_envs=200, sensors=suite)
    s = roll_out(PDPolicy(envs, gains="tuned"), envs, seed=0).summary()
    print(
        f"{name:5}: tracking error {1e3 * s['late_error']:5.1f} mm in the second half, "
        f"estimation error {1e3 * s['estimation_error']:5.1f} mm"
    )

# %%
# Consistency
# -----------
#
# ``measure_consistency`` flies many vehicles without early endings, and compares errors with the
# covariances of the filters. The normalized estimation error squared (NEES) of 15 states is 15 on
# average in a consistent filter; the band contains the mean over all flights 95 times in 100.

batch = quad_gym.FlightBatch(
    200,
    sensors=mine,
    task=endless(
        quad_gym.TaskParams(kind="random_trajectory", start="hover", randomize_reference=True)
    ),
    gains="tuned",
    innovations=True,
)
findings = measure_consistency(batch, seeds=range(200), duration=8.0, every=0.1)
for sentence in findings.sentences().values():
    print(sentence)

# %%
# Some values leave the band by chance. Biases hardly change in eight seconds, so their NEES then
# stays outside for a long time; more vehicles give a better answer. The innovations of the baseline
# are smaller than predicted, and not white: headings of ``"rtk"`` have a constant error, which no
# average removes. The filter models it as larger white noise, so that the attitude is consistent.

figure, axes = plt.subplots()
draw_mean_square(axes, findings.nees["state"])
axes.set(xlabel="time [s]", title="NEES of the state, mean over 200 flights")

# %%
# ``quad-gym consistency`` does the same for the suites by name, with all figures.

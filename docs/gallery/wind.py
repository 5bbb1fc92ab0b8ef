"""
Wind and randomization
======================

The default world is calm, and every episode flies the same vehicle. Here the wind blows, and each
episode draws its own wind and mass.
"""

import math

import gymnasium
import matplotlib.pyplot as plt

import quad_gym
from baselines.policies import load_policy
from quad_gym import Uniform
from quad_gym.evaluation import roll_out

FLIGHTS = 400

# %%
# ``world="breeze"`` has gusts, linear drag, ground effect and a battery. ``randomization`` draws
# parameters for every episode from each flight's own random stream. Controller and filter assume
# the nominal values.

envs = gymnasium.make_vec(
    "QuadGym/Hover-v0",
    num_envs=FLIGHTS,
    sensors="rtk",
    world="breeze",
    randomization={
        "mass": Uniform(0.85, 1.15, relative=True),
        "wind_speed": Uniform(0.0, 8.0),
        "wind_direction": Uniform(-math.pi, math.pi),
    },
)
envs.reset(seed=0)
drawn = envs.unwrapped.flights.batch.drawn()
for name, values in drawn.items():
    print(name, values[:3].round(2))

# %%
# PD control and the trained policy; neither observes the wind:

figure, (of_wind, of_mass) = plt.subplots(1, 2, figsize=(9, 4), sharey=True)
for name in ("pd", "pretrained"):
    episodes = roll_out(load_policy(name, envs), envs, seed=0)
    s = episodes.summary()
    print(
        f"{name:10}: mean error {1e3 * s['mean_error']:.0f} mm, "
        f"crashed {100 * s['crash_rate']:.1f} %, "
        f"error of the estimate {1e3 * s['estimation_error']:.1f} mm"
    )
    late = 1e3 * episodes.late_error
    of_wind.plot(drawn["wind_speed"], late, ".", markersize=4, label=name)
    of_mass.plot(drawn["mass"], late, ".", markersize=4, label=name)
of_wind.set(xlabel="wind [m/s]", ylabel="tracking error, second half [mm]")
of_mass.set(xlabel="mass [kg]")
of_wind.legend()

# %%
# Neither controller has an integral term, so a position error remains: it grows with the wind, and
# with the difference of the mass from 0.78 kg. The error of the estimate hardly grows: the IMU
# drives the filter, which uses no model of vehicle or air.
#
# With ``privileged=True``, observations include the wind and the drawn parameters for a critic.
# With ``Randomization(..., known=True)``, filter and controller use the drawn parameters of vehicle
# and sensors.

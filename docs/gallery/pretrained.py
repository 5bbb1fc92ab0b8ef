"""
Evaluate a trained policy
=========================

The package includes trained policies for most tasks. Here one of them is compared with tuned PD
control, on the truth and on the estimate.
"""

import gymnasium
import matplotlib.pyplot as plt

import quad_gym
from baselines.policies import load_policy
from quad_gym.evaluation import roll_out

EPISODES = 300

# %%
# ``load_policy`` checks that a policy fits the environment, and ``roll_out`` flies one episode in
# each environment. Episode ``i`` has the seed ``seed + i``, so that all four cases share the same
# noise realization.

results = {}
for source in ("truth", "estimate"):
    envs = gymnasium.make_vec("QuadGym/Lemniscate-v0", num_envs=EPISODES, observation=source)
    for name in ("pd", "pretrained"):
        results[name, source] = roll_out(load_policy(name, envs), envs, seed=0)

# %%
# Every result has one number per episode; errors refer to the true position.

print("policy     on        mean error  second half  estimation  crashed  return")
for (name, source), episodes in results.items():
    s = episodes.summary()
    print(
        f"{name:10} {source:8} {1e3 * s['mean_error']:8.1f} mm {1e3 * s['late_error']:9.1f} mm"
        f" {1e3 * s['estimation_error']:8.1f} mm {100 * s['crash_rate']:6.1f} % {s['return']:7.1f}"
    )

# %%
# The second half of each episode measures the figure of eight itself; the first half contains the
# approach.

figure, axes = plt.subplots()
labels = [f"{name}\non {source}" for name, source in results]
axes.boxplot([1e3 * e.late_error for e in results.values()], tick_labels=labels, showfliers=False)
axes.set(ylabel="tracking error, second half [mm]", ylim=(0, None))

# %%
# On the command line, with confidence intervals and figures:
#
# .. code-block:: sh
#
#    quad-gym evaluate QuadGym/Lemniscate-v0 --policy pd pretrained

"""
A short training with Stable-Baselines3
=======================================

``quad_gym.make_sb3_vec_env`` makes an ordinary vector environment of Stable-Baselines3. PPO
learns to hover on the estimate in about ten seconds; the recipes of ``quad-gym train`` train
longer.
"""

import gymnasium
import matplotlib.pyplot as plt
import torch
from stable_baselines3 import PPO
from stable_baselines3.common.callbacks import BaseCallback

import quad_gym
from baselines.policies import load_policy
from quad_gym.evaluation import roll_out

torch.set_num_threads(1)  # the networks are small
STEPS, FLIGHTS = 240_000, 128

# %%
# Flight ``i`` is seeded with ``seed + i``. Seeds from one billion on are for training; the
# evaluation below uses others. The environment records episodes without a ``Monitor``.

env = quad_gym.make_sb3_vec_env("QuadGym/Hover-v0", n_envs=FLIGHTS, seed=10**9)
model = PPO(
    "MlpPolicy",
    env,
    n_steps=32,
    batch_size=1024,
    n_epochs=5,
    gamma=0.97,
    learning_rate=1e-3,
    seed=0,
    device="cpu",
)


class Errors(BaseCallback):
    """Keeps the mean true position error of all flights, rollout by rollout."""

    def _on_training_start(self):
        self.steps, self.errors, self._sum, self._count = [], [], 0.0, 0

    def _on_step(self):
        self._sum += sum(info["position_error"] for info in self.locals["infos"])
        self._count += FLIGHTS
        return True

    def _on_rollout_end(self):
        self.steps.append(self.num_timesteps)
        self.errors.append(self._sum / self._count)
        self._sum, self._count = 0.0, 0


history = Errors()
model.learn(STEPS, callback=history)

# %%
# The policy explores during training, so its returns are lower than without exploration.

figure, axes = plt.subplots()
axes.plot(history.steps, history.errors)
axes.set(xlabel="steps", ylabel="mean position error while learning [m]", ylim=(0, None))

# %%
# Without exploration, on new seeds, compared with PD control and with the included policy, which
# was trained for longer:

test = gymnasium.make_vec("QuadGym/Hover-v0", num_envs=100)
policies = {"this training": model, "tuned PD": load_policy("pd", test)}
policies["pretrained"] = load_policy("pretrained", test)
for name, policy in policies.items():
    s = roll_out(policy, test, seed=0).summary()
    print(
        f"{name:13}: mean error {1e3 * s['mean_error']:6.1f} mm, second half "
        f"{1e3 * s['late_error']:6.1f} mm, crashed {100 * s['crash_rate']:.0f} %"
    )

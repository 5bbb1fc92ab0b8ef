"""
Export a policy to C
====================

A trained policy is exported as a single C99 file, compiled with the system's compiler, and flown in
place of the policy: the flights are the same. :doc:`Deployment </deployment>` explains how to call
it on an autopilot.
"""

import ctypes
import shutil
import subprocess
import tempfile
from pathlib import Path

import gymnasium
import matplotlib.pyplot as plt
import numpy as np

import quad_gym
from baselines.exporting import c_source, controller_of

# %%
# The included policy for the figure of eight. ``controller_of`` also accepts the files of
# ``quad-gym train``.

controller = controller_of("pretrained", "QuadGym/Lemniscate-v0")
source = c_source(controller, "lemniscate")
print(source[: source.index("static const")])
print(f"... {len(source.splitlines())} lines, {len(source) / 1000:.0f} kB")

# %%
# Compiled as a library for Python.

compiler = shutil.which("cc") or shutil.which("gcc") or shutil.which("clang")
folder = Path(tempfile.mkdtemp())
(folder / "lemniscate.c").write_text(source)
line = [
    compiler,
    "-std=c99",
    "-O2",
    "-shared",
    "-fPIC",
    "lemniscate.c",
    "-o",
    "lemniscate.so",
    "-lm",
]
subprocess.run(line, cwd=folder, check=True)
function = ctypes.CDLL(str(folder / "lemniscate.so")).lemniscate


def fly_in_c(observations):
    """Actions of the C function, observation by observation."""
    observations = np.ascontiguousarray(observations, np.float32)
    actions = np.empty((len(observations), 4), np.float32)
    for row, action in zip(observations, actions, strict=True):
        status = function(*(a.ctypes.data_as(ctypes.c_void_p) for a in (row, action)))
        assert status == 0
    return actions


# %%
# Twenty flights by the policy and twenty by the C function, with the same seeds.

paths, differences = {}, []
for name, act in {"policy": lambda o: controller.policy.predict(o)[0], "C": fly_in_c}.items():
    envs = gymnasium.make_vec("QuadGym/Lemniscate-v0", num_envs=20)
    observations, _ = envs.reset(seed=0)
    path = []
    for _ in range(499):
        if name == "C":
            differences.append(np.abs(act(observations) - controller.act(observations)).max())
        observations, *_ = envs.step(act(observations))
        path.append(envs.unwrapped.flights.batch.read("position").copy())
    paths[name] = np.array(path)

print(f"largest difference of an action   {max(differences):.1e}")
print(f"largest distance between flights  {np.abs(paths['C'] - paths['policy']).max():.1e} m")

# %%
# The only difference is the rounding of single precision.

figure, axes = plt.subplots()
axes.plot(*paths["policy"][:, 0, :2].T, color="0.7", linewidth=5, label="policy")
axes.plot(*paths["C"][:, 0, :2].T, color="C0", linewidth=1.2, label="C")
axes.set(xlabel="east [m]", ylabel="north [m]", aspect="equal")
figure.legend(loc="outside right upper")

# %%
# On the command line:
#
# .. code-block:: sh
#
#    quad-gym export policy pretrained QuadGym/Lemniscate-v0 --to c

"""The script for a GPU: it flies golden flights and measures once, here by PTX in C."""

import functools
import json
import pickle
import subprocess
import sys
import zlib

import pytest

from quad_gym.kernels.compiling.building import PROCESSORS
from quad_gym.kernels.library import machine
from tests.golden.ptx import PtxLauncher

pytest.importorskip("torch")
from quad_gym.device import plan_of
from scripts.benchmarks import gpu
from tests.builders import vec_env

BARE = """
import sys, types, zlib, pickle
class Refused:
    def find_spec(self, name, path=None, target=None):
        if name.partition(".")[0] in ("gymnasium", "numba", "llvmlite", "scipy"):
            raise ImportError(f"{name} is not here")
sys.meta_path.insert(0, Refused())
sys.path.insert(0, "scripts/benchmarks")
import gpu
gpu._without_gymnasium()
class Launcher:
    warps = 1
    def __call__(self, *words):
        pass
content = pickle.loads(zlib.decompress(sys.stdin.buffer.read()))
batch = gpu._flights(content, 40, lambda ptx: Launcher(), "cpu")
import torch
size = gpu._Flights(batch).reset(0)[0].shape[1]
batch.write("episode", torch.ones(40, dtype=torch.float64))
print(size, gpu._Flights(batch).step(torch.zeros(40, 4))[0].shape)
"""
"""Flies with a task, by a launcher that does nothing, where packages are missing."""


def test_flights_with_a_task_need_numpy_and_torch_alone():
    batch = vec_env("look_around", 2).flights.batch
    size = batch.final_observations.shape[1]
    content = {"plan": plan_of(batch), "ptx": b"", "task": batch.made}
    done = subprocess.run(
        [sys.executable, "-c", BARE],
        input=zlib.compress(pickle.dumps(content)),
        capture_output=True,
        cwd=gpu.ROOT,
        check=False,
    )
    assert done.stdout.decode() == f"{size} torch.Size([40, {size}])\n", done.stderr.decode()


@pytest.mark.slow  # compiles PTX in C
@pytest.mark.skipif(machine() not in PROCESSORS, reason="no code for this processor")
def test_script_for_a_gpu_flies_golden_flights_and_measures_once(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(gpu, "DURATION", 0.0)
    sizes = {"num_envs": 40, "num_minibatches": 2, "total_timesteps": 40 * 32}
    training = gpu.Training("QuadGym/Circle-v0", sizes, {"observation": "truth"})
    monkeypatch.setattr(gpu, "STEPS", 60)
    monkeypatch.setattr(gpu, "WARM_UP", 2)
    monkeypatch.setattr(gpu, "LONGEST", 1e6)
    monkeypatch.setattr(gpu, "TRAININGS", {"training": training})
    for name in ("observation truth", "training", "LookAround, truth"):
        assert "PTX of" in gpu._prepare(tmp_path, name)
    launchers, compiled = [], functools.cache(lambda text: PtxLauncher(text.decode()))

    def make(text):
        launchers.append(text)
        return compiled(text)

    found = gpu.run(tmp_path, make, "cpu", (40,), only="golden")
    assert len(launchers) == 2
    for name in ("observation truth", "LookAround, truth"):
        golden = found[f"golden: {name}"]
        assert golden["differing"] == {}
        assert golden["numbers"] > 800
    found = gpu.run(tmp_path, make, "cpu", (40,))
    assert found["observation truth, 40 flights"]["steps/s"] > 0
    assert found["training"]["steps"] == 40 * 32
    assert len(launchers) == 4
    capsys.readouterr()
    assert gpu.run(tmp_path, make, "cpu", (40,)) == found
    assert (len(launchers), capsys.readouterr().out) == (4, "")
    assert json.loads((tmp_path / "results.json").read_text()) == found
    monkeypatch.setattr(gpu, "EPISODES", 4)
    gpu.evaluate(tmp_path)
    summary = json.loads((tmp_path / "results.json").read_text())["evaluation: training"]
    assert summary["episodes"] == 4

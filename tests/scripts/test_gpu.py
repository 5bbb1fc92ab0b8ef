"""The script for a GPU: it flies golden flights and measures once, here by PTX in C."""

import functools
import json

import pytest

from quad_gym.kernels.compiling.building import PROCESSORS
from quad_gym.kernels.library import machine
from tests.golden.ptx import PtxLauncher

pytest.importorskip("torch")
from scripts.benchmarks import gpu


@pytest.mark.slow  # compiles PTX in C
@pytest.mark.skipif(machine() not in PROCESSORS, reason="no code for this processor")
def test_script_for_a_gpu_flies_golden_flights_and_measures_once(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(gpu, "DURATION", 0.0)
    sizes = {"num_envs": 40, "num_minibatches": 2, "total_timesteps": 40 * 32}
    monkeypatch.setattr(gpu, "TRAINING", sizes)
    monkeypatch.setattr(gpu, "TRAINED", {**gpu.TRAINED, "observation": "truth"})
    monkeypatch.setattr(gpu, "STEPS", 60)
    monkeypatch.setattr(gpu, "WARM_UP", 2)
    monkeypatch.setattr(gpu, "TRAININGS", {"training": {}})
    said = [
        gpu._prepare(tmp_path, name) for name in ("observation truth", "training", "LookAround")
    ]
    assert (
        said[2]
        == "LookAround: flights on a GPU need compiled steps, and a task in Python runs in Python"
    )
    launchers, compiled = [], functools.cache(lambda text: PtxLauncher(text.decode()))

    def make(text):
        launchers.append(text)
        return compiled(text)

    found = gpu.run(tmp_path, make, "cpu", (40,))
    golden, speed = found["golden: observation truth"], found["observation truth, 40 flights"]
    assert golden["differing"] == {}
    assert golden["numbers"] > 800
    assert speed["steps/s"] > 0
    assert 0.0 < found["training"]["error"] < 10.0
    assert len(launchers) == 3
    capsys.readouterr()
    assert gpu.run(tmp_path, make, "cpu", (40,)) == found
    assert (len(launchers), capsys.readouterr().out) == (3, "")
    assert json.loads((tmp_path / "results.json").read_text()) == found

"""Bundle the page: `python -m docs.browser.build FILE.html`, with the package `ziglang`."""

import base64
import gzip
import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

_HERE = Path(__file__).parent
_BASE = 1 << 20
"""Address of the first record, above code's constants and the stack."""
_ONE_LANE = {"QUAD_GYM_LANES": "1", "NUMBA_CPU_NAME": "generic", "NUMBA_CPU_FEATURES": ""}


def contents() -> dict[str, Any]:
    """Return module, memory and scenes; in a process with one lane per record."""
    from docs.browser.emission import module_of
    from docs.browser.image import Image, put_batch
    from docs.browser.scenes import SCENES, batch_of, described

    batches = {name: batch_of(name) for name in SCENES}
    module, stages = module_of({s for batch in batches.values() for s in batch._stages.values()})
    image, scenes = Image(_BASE), {}
    for name, batch in batches.items():
        scenes[name] = {**put_batch(image, batch, stages), **described(name, batch)}
    policies, weights = _policies({scene.trained for scene in SCENES.values()})
    return {
        "module": _packed(module),
        "memory": _packed(image.content),
        "base": _BASE,
        "size": image.size,
        "scenes": scenes,
        "policies": policies,
        "weights": _packed(weights),
    }


def _policies(names: set[str]) -> tuple[dict[str, Any], bytes]:
    """Return the layers of the policies of tasks, and all weights, float32 one after another."""
    from baselines.mlp import MlpPolicy
    from baselines.policies import PRETRAINED

    layers: dict[str, Any] = {}
    weights = b""
    for name in sorted(names):
        files = {"truth": PRETRAINED / f"{name}_truth.npz", "estimate": PRETRAINED / f"{name}.npz"}
        layers[name] = {}
        for source, file in files.items():
            policy = MlpPolicy.load(file)
            if policy.normalization is not None:
                raise ValueError(f"{file} normalizes observations, which the page does not")
            each = zip(policy.weights, policy.biases, policy.activations, strict=True)
            layers[name][source] = []
            for W, b, activation in each:
                layers[name][source].append([*W.shape, activation])
                weights += W.astype("<f4").tobytes() + b.astype("<f4").tobytes()
    return layers, weights


def _packed(content: bytes) -> str:
    """Return compressed bytes as text."""
    return base64.b64encode(gzip.compress(content, 9, mtime=0)).decode()


def page() -> str:
    """Return the page as one text."""
    env = {**os.environ, **_ONE_LANE, "PYTHONPATH": os.pathsep.join(sys.path)}
    command = [sys.executable, "-m", "docs.browser.build", "--contents"]
    data = subprocess.run(command, env=env, check=True, stdout=subprocess.PIPE, text=True).stdout
    text = (_HERE / "fly.html").read_text(encoding="utf-8")
    style = (_HERE / "fly.css").read_text(encoding="utf-8")
    return text.replace("/*STYLE*/", style).replace("/*SCRIPT*/", script(data))


def script(data: str) -> str:
    """Return all modules of JavaScript as one script."""
    modules = ("memory", "controllers", "simulation", "scene", "plots", "main")
    parts = [(_HERE / f"{name}.js").read_text(encoding="utf-8") for name in modules]
    return f'"use strict";\nconst DATA = {data};\n' + "\n".join(parts)


if __name__ == "__main__":
    if sys.argv[1:] == ["--contents"]:
        json.dump(contents(), sys.stdout)
    else:
        Path(sys.argv[1]).write_text(page(), encoding="utf-8")

"""`MlpPolicy`: a trained network as plain arrays, evaluated in NumPy.

Included policies need neither torch nor unpickling: they are files of weights with the record of
the training.
"""

import json
import zipfile
from collections.abc import Mapping, Sequence
from itertools import pairwise
from pathlib import Path
from typing import IO, Any

import numpy as np
from numpy.typing import NDArray

FORMAT = "quad_gym policy 1"  #: identifier of the file format

_ACTIVATIONS: dict[str, Any] = {
    "relu": lambda x: np.maximum(x, 0.0),
    "tanh": np.tanh,
    "elu": lambda x: np.where(x > 0.0, x, np.expm1(np.minimum(x, 0.0))),
    "none": lambda x: x,
}


class MlpPolicy:
    """Network with layers x <- activation(W x + b), whose output is clipped to [-1, 1].

    Args:
        weights: Weights of each layer, (outputs, inputs).
        biases: Biases of each layer, (outputs,).
        activations: Activation of each layer: "relu", "tanh", "elu" or "none".
        record: Training record: the plan and its results.

    Raises:
        ValueError: If the shapes of the layers are inconsistent.
    """

    def __init__(
        self,
        weights: Sequence[NDArray[np.float32]],
        biases: Sequence[NDArray[np.float32]],
        activations: Sequence[str],
        record: Mapping[str, Any],
    ) -> None:
        shapes = [w.shape for w in weights]
        chained = all(a[0] == b[1] for a, b in pairwise(shapes))
        fitting = all(b.shape == (w.shape[0],) for w, b in zip(weights, biases, strict=True))
        if not (chained and fitting and len(activations) == len(weights)):
            raise ValueError(f"weights, biases and activations must fit each other, got {shapes}")
        unknown = sorted(set(activations) - set(_ACTIVATIONS))
        if unknown:
            raise ValueError(f"activations must be among {', '.join(_ACTIVATIONS)}, got {unknown}")
        self.weights, self.biases = tuple(weights), tuple(biases)
        self.activations, self.record = tuple(activations), dict(record)

    @property
    def inputs(self) -> int:
        """Length of an observation."""
        return int(self.weights[0].shape[1])

    def predict(
        self,
        observation: Any,
        state: Any = None,
        episode_start: Any = None,
        deterministic: bool = True,
    ) -> tuple[NDArray[np.float32], None]:
        """Return actions for observations (..., n), and None; always deterministic."""
        x = np.asarray(observation, np.float32)
        if x.shape[-1:] != (self.inputs,):
            raise ValueError(f"observation must be (..., {self.inputs}), got shape {x.shape}")
        for W, b, activation in zip(self.weights, self.biases, self.activations, strict=True):
            x = _ACTIVATIONS[activation](x @ W.T + b)
        return np.clip(x, -1.0, 1.0).astype(np.float32), None

    def save(self, file: str | Path | IO[bytes]) -> None:
        """Write the policy and its record to one file."""
        layers: dict[str, Any] = {f"W{i}": W for i, W in enumerate(self.weights)}
        layers |= {f"b{i}": b for i, b in enumerate(self.biases)}
        about = {"format": FORMAT, "activations": self.activations, "record": self.record}
        np.savez_compressed(file, about=np.array(json.dumps(about)), **layers)

    @classmethod
    def load(cls, file: str | Path) -> "MlpPolicy":
        """Read a policy; a ValueError if the file does not exist or is no policy in this format."""
        file = Path(file)
        if not file.exists():
            raise ValueError(f"there is no policy {file}")
        try:
            with np.load(file, allow_pickle=False) as stored:
                about: dict[str, Any] = json.loads(str(stored["about"]))
                count = range(len(about["activations"]))
                weights, biases = ([stored[f"{name}{i}"] for i in count] for name in "Wb")
        except (zipfile.BadZipFile, OSError, EOFError, KeyError, ValueError, TypeError):
            raise ValueError(f"{file} is not a policy, or is damaged") from None
        if about.get("format") != FORMAT:
            raise ValueError(f"{file} must be a {FORMAT!r}, got {about.get('format')!r}")
        return cls(weights, biases, about["activations"], about["record"])


def mlp_of(model: Any, record: Mapping[str, Any]) -> MlpPolicy:
    """Convert the deterministic actor of a Stable-Baselines3 model with an "MlpPolicy".

    Raises a ValueError if the actor is not a multilayer perceptron.
    """
    from torch import nn

    policy = model.policy
    if hasattr(policy, "lstm_actor"):
        raise ValueError(
            "model must be a multilayer perceptron: recurrent policies cannot be converted"
        )
    if hasattr(policy, "action_net"):
        modules = [*policy.mlp_extractor.policy_net, policy.action_net]
    elif hasattr(policy.actor, "latent_pi"):
        modules = [*policy.actor.latent_pi, policy.actor.mu, nn.Tanh()]
    else:
        modules = [*policy.actor.mu]
    names = {nn.ReLU: "relu", nn.Tanh: "tanh", nn.ELU: "elu"}
    weights, biases, activations = [], [], []
    for module in modules:
        if isinstance(module, nn.Linear):
            weights.append(module.weight.detach().numpy().copy())
            biases.append(module.bias.detach().numpy().copy())
            activations.append("none")
        elif type(module) in names:
            activations[-1] = names[type(module)]
        else:
            raise ValueError(f"model must consist of plain layers, got {type(module).__name__}")
    return MlpPolicy(weights, biases, activations, record)

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

from baselines.normalization import Normalization
from quad_gym.analysis.reports import without_numpy

FORMAT = "quad_gym policy 1"  #: identifier of the file format
LARGEST = 2**28  #: largest size of a file, unpacked [bytes]; the included policies have 0.1 MB
NORMALIZED_FORMAT = "quad_gym policy 2"  #: identifier of a file that has a normalization

FUNCTIONS: dict[str, Any] = {
    "relu": lambda x: np.maximum(x, 0.0),
    "tanh": np.tanh,
    "elu": lambda x: np.where(x > 0.0, x, np.expm1(np.minimum(x, 0.0))),
    "none": lambda x: x,
}
"""Activations by name."""


class MlpPolicy:
    """Network with layers x <- activation(W x + b), whose output is clipped to [-1, 1].

    Args:
        weights: Weights of each layer, (outputs, inputs).
        biases: Biases of each layer, (outputs,).
        activations: Activation of each layer: "relu", "tanh", "elu" or "none".
        record: Training record: the plan and its results.
        normalization: Normalization of observations before the first layer; None: none.

    Raises:
        ValueError: If the shapes of the layers are inconsistent, or a weight is not finite.
    """

    def __init__(
        self,
        weights: Sequence[NDArray[np.float32]],
        biases: Sequence[NDArray[np.float32]],
        activations: Sequence[str],
        record: Mapping[str, Any],
        normalization: Normalization | None = None,
    ) -> None:
        shapes = [w.shape for w in weights]
        if not shapes or any(len(shape) != 2 for shape in shapes):
            raise ValueError(f"weights must be matrices, one per layer, got shapes {shapes}")
        if not all(np.isfinite(values).all() for values in (*weights, *biases)):
            raise ValueError("weights and biases must be finite: they contain NaN or infinity")
        chained = all(a[0] == b[1] for a, b in pairwise(shapes))
        fitting = all(b.shape == (w.shape[0],) for w, b in zip(weights, biases, strict=True))
        if not (chained and fitting and len(activations) == len(weights)):
            raise ValueError(f"weights, biases and activations must fit each other, got {shapes}")
        unknown = sorted(set(activations) - set(FUNCTIONS))
        if unknown:
            raise ValueError(f"activations must be among {', '.join(FUNCTIONS)}, got {unknown}")
        self.weights, self.biases = tuple(weights), tuple(biases)
        self.activations, self.record = tuple(activations), dict(record)
        if normalization is not None and len(normalization.mean) != self.inputs:
            raise ValueError(
                f"normalization must have {self.inputs} numbers, as the observations of the "
                f"policy, got {len(normalization.mean)}"
            )
        self.normalization = normalization

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
        if self.normalization is not None:
            x = self.normalization(x)
        for W, b, activation in zip(self.weights, self.biases, self.activations, strict=True):
            x = FUNCTIONS[activation](x @ W.T + b)
        return np.clip(x, -1.0, 1.0).astype(np.float32), None

    def save(self, file: str | Path | IO[bytes]) -> None:
        """Write the policy and its record to one file."""
        layers: dict[str, Any] = {f"W{i}": W for i, W in enumerate(self.weights)}
        layers |= {f"b{i}": b for i, b in enumerate(self.biases)}
        about: dict[str, Any] = {"format": FORMAT, "activations": self.activations}
        about["record"] = self.record
        if self.normalization is not None:
            about |= {"format": NORMALIZED_FORMAT, "clip": self.normalization.clip}
            layers |= {"mean": self.normalization.mean, "deviation": self.normalization.deviation}
        np.savez_compressed(
            file, about=np.array(json.dumps(about, default=without_numpy)), **layers
        )

    @classmethod
    def load(cls, file: str | Path) -> "MlpPolicy":
        """Read a policy; a ValueError if the file does not exist or is no policy in this format."""
        file = Path(file)
        if not file.exists():
            raise ValueError(f"policy file not found: {file}")
        try:
            arrays, about = _contents(file)
            count = range(len(about["activations"]))
            weights, biases = ([arrays[f"{name}{i}"] for i in count] for name in "Wb")
        except (
            zipfile.BadZipFile,
            OSError,
            EOFError,
            KeyError,
            ValueError,
            TypeError,
            MemoryError,
        ):
            raise ValueError(f"{file} is not a policy, or is damaged") from None
        if about.get("format") not in (FORMAT, NORMALIZED_FORMAT):
            raise ValueError(f"{file} must be a {FORMAT!r}, got {about.get('format')!r}")
        try:
            normalization = None
            if about["format"] == NORMALIZED_FORMAT:
                statistics = arrays["mean"], arrays["deviation"]
                normalization = Normalization(*statistics, float(about["clip"]))
            record = checked_record(about["record"])
            return cls(weights, biases, about["activations"], record, normalization)
        except (KeyError, TypeError, ValueError) as error:
            raise ValueError(f"{file} is not a valid policy: {error}") from None


def _contents(file: Path) -> tuple[dict[str, NDArray[Any]], dict[str, Any]]:
    """Arrays of a file and its description; refuses a file that is larger than policies are."""
    with zipfile.ZipFile(file) as archive:
        size = sum(entry.file_size for entry in archive.infolist())
    if size > LARGEST:
        raise ValueError(f"it has {size:,} bytes")
    with np.load(file, allow_pickle=False) as stored:
        arrays = {name: stored[name] for name in stored.files}
    about = json.loads(str(arrays.pop("about")))
    if not isinstance(about, dict):
        raise TypeError("its description is not a table")
    return arrays, about


def checked_record(record: Any) -> dict[str, Any]:
    """A training record, of which the tables that policies are loaded by are tables."""
    if not isinstance(record, dict):
        raise ValueError(f"its training record must be a table, got {record!r}")
    plan = record.get("plan", {})
    tables = {"plan": plan, "interface": record.get("interface", {})}
    if isinstance(plan, dict):
        tables["environment"] = plan.get("environment", {})
    for name, table in tables.items():
        if not isinstance(table, dict):
            raise ValueError(f"{name} of its training record must be a table, got {table!r}")
    seen = tables["interface"].get("observation", [])
    if not (isinstance(seen, list | tuple) and all(isinstance(name, str) for name in seen)):
        raise ValueError(f"observation of its training record must be names, got {seen!r}")
    return record


def mlp_of(
    model: Any, record: Mapping[str, Any], normalization: Normalization | None = None
) -> MlpPolicy:
    """Convert the deterministic actor of a Stable-Baselines3 model with an "MlpPolicy".

    `normalization` has the statistics with which its observations were normalized, if they were.
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
    return MlpPolicy(weights, biases, activations, record, normalization)

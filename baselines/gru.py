"""`GruPolicy`: a trained network with memory as plain arrays, evaluated in NumPy."""

from collections.abc import Mapping
from pathlib import Path
from typing import IO, Any

import numpy as np
from numpy.typing import NDArray

from baselines.mlp import MlpPolicy, contents, require_format

FORMAT = "quad_gym recurrent policy 1"  #: identifier of the file format

Floats = NDArray[np.float32]


class GruPolicy:
    """Gated recurrent unit, and layers that receive the observation and the memory, (x, h').

        r, u = s(W_r x + b_r + U_r h + c_r), s(W_u x + b_u + U_u h + c_u)
        n = tanh(W_n x + b_n + r (U_n h + c_n))
        h' = (1 - u) n + u h,  s: logistic function

    Args:
        W, b: Weights (3 units, inputs) and biases (3 units,) of the input: reset gate r, update
            gate u, candidate n, as in PyTorch.
        U, c: Weights (3 units, units) and biases (3 units,) of the memory.
        layers: Layers, whose output is the action, with the training record.

    Raises:
        ValueError: If the shapes are inconsistent.
    """

    def __init__(self, W: Floats, b: Floats, U: Floats, c: Floats, layers: MlpPolicy) -> None:
        units = U.shape[-1]
        fitting = W.ndim == U.ndim == 2 and len(W) == len(U) == len(b) == len(c) == 3 * units
        if not fitting or layers.inputs != W.shape[1] + units:
            shapes = [each.shape for each in (W, b, U, c)]
            raise ValueError(
                f"W, b, U, c and layers must fit each other, got {shapes}, and layers with "
                f"{layers.inputs} inputs"
            )
        self.W, self.b, self.U, self.c, self.layers, self.units = W, b, U, c, layers, units

    @property
    def inputs(self) -> int:
        """Length of an observation."""
        return int(self.W.shape[1])

    @property
    def record(self) -> dict[str, Any]:
        """Training record: the plan and its results."""
        return self.layers.record

    @record.setter
    def record(self, record: Mapping[str, Any]) -> None:
        self.layers.record = dict(record)

    def predict(
        self,
        observation: Any,
        state: Any = None,
        episode_start: Any = None,
        deterministic: bool = True,
    ) -> tuple[Floats, Floats]:
        """Return actions for observations (..., n), and memories (..., units).

        Pass the memories as `state` in the next step; None: zeros, as at the start of an episode.
        Memories where `episode_start` (...) is True are set to zero. Actions are deterministic.
        """
        x = np.asarray(observation, np.float32)
        if x.shape[-1:] != (self.inputs,):
            raise ValueError(f"observation must be (..., {self.inputs}), got shape {x.shape}")
        shape = (*x.shape[:-1], self.units)
        h = np.zeros(shape, np.float32) if state is None else np.asarray(state, np.float32)
        if h.shape != shape:
            raise ValueError(f"state must have shape {shape}, got {h.shape}")
        if episode_start is not None:
            starts = np.asarray(episode_start, bool).reshape(shape[:-1])
            h = np.where(starts[..., np.newaxis], np.float32(0.0), h)
        h = self.remember(x, h)
        return self.layers.predict(np.concatenate([x, h], axis=-1))[0], h

    def remember(self, x: Floats, h: Floats) -> Floats:
        """Compute the memories (..., units) after observations (..., n)."""
        k = self.units
        a, p = x @ self.W.T + self.b, h @ self.U.T + self.c
        r, u = (_logistic(a[..., s] + p[..., s]) for s in (slice(k), slice(k, 2 * k)))
        n = np.tanh(a[..., 2 * k :] + r * p[..., 2 * k :])
        return n + u * (h - n)

    def save(self, file: str | Path | IO[bytes]) -> None:
        """Write the policy and its record to one file."""
        gru = {name: getattr(self, name) for name in "WbUc"}
        self.layers.save_with(file, FORMAT, gru)

    @classmethod
    def load(cls, file: str | Path) -> "GruPolicy":
        """Read a policy; a ValueError if the file does not exist or is no policy in this format."""
        about, arrays = contents(file)
        require_format(file, about, FORMAT)
        W, b, U, c = (arrays[name] for name in "WbUc")
        return cls(W, b, U, c, MlpPolicy.of(about, arrays))


def load_network(file: str | Path) -> MlpPolicy | GruPolicy:
    """Read a policy with or without memory; a ValueError if the file does not exist or is none."""
    recurrent = contents(file)[0].get("format") == FORMAT
    return GruPolicy.load(file) if recurrent else MlpPolicy.load(file)


def _logistic(x: Floats) -> Floats:
    return np.float32(0.5) * (np.float32(1.0) + np.tanh(np.float32(0.5) * x))

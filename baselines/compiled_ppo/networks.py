"""Actor and critic in one vector of parameters: offsets of the layers and initial values."""

from collections.abc import Mapping, Sequence
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from baselines.compiled_ppo.kernels import INPUTS, OUTPUTS, STORED, TILE
from baselines.mlp import MlpPolicy
from baselines.recipes import ACTIVATIONS, Recipe


class Networks:
    """Gaussian policy and value function of a recipe, for observations and actions of some lengths.

    The vector of parameters contains the actor's layers, the logarithms of the policy's standard
    deviations, and the critic's layers. Initial values are drawn as in Stable-Baselines3.
    `critic_only` inputs, at the end, are for the critic only.
    """

    def __init__(
        self,
        inputs: int,
        outputs: int,
        recipe: Recipe,
        rng: np.random.Generator,
        critic_only: int = 0,
    ) -> None:
        self.actor, first = _table((inputs - critic_only, *recipe.layers, outputs), 0)
        self.critic, count = _table((inputs, *recipe.critic_layers, 1), first + outputs)
        self.params = np.zeros(count, np.float32)
        self.log_std = self.params[first : first + outputs]
        self.log_std[:] = recipe.policy.get("log_std_init", 0.0)
        for table, last_gain in ((self.actor, 0.01), (self.critic, 1.0)):
            for W, _ in self.layers(table)[:-1]:
                W[:] = np.sqrt(2.0) * _orthogonal(W.shape, rng)
            W, _ = self.layers(table)[-1]
            W[:] = last_gain * _orthogonal(W.shape, rng)
        self._activation = recipe.activation
        number = ACTIVATIONS.index(recipe.activation)
        self.model = (self.params, np.zeros_like(self.params), self.actor, self.critic, number)

    def layers(self, table: NDArray[np.int64]) -> list[tuple[Any, Any]]:
        """Weights (outputs, inputs) and biases (outputs,) of each layer, as views."""
        return [
            (self.params[w : w + i * o].reshape(o, i), self.params[b : b + o])
            for i, o, w, b, _ in table.tolist()
        ]

    def rooms(self, parts: int) -> tuple[NDArray[np.float32], ...]:
        """Work memory for `kernels.differentiate`."""
        tables = (self.actor, self.critic)
        sizes = (
            (2, TILE, self.critic[0, INPUTS]),
            (TILE * max(t[-1, STORED] + t[-1, OUTPUTS] for t in tables),),
            (2, TILE * max(t[:, OUTPUTS].max() for t in tables)),
            (max((t[:, INPUTS] * t[:, OUTPUTS]).max() for t in tables),),
        )
        return tuple(np.zeros((parts, *size), np.float32) for size in sizes)

    def policy(self, record: Mapping[str, Any]) -> MlpPolicy:
        """Copy the actor to a policy that requires only NumPy."""
        layers = self.layers(self.actor)
        activations = [self._activation] * (len(layers) - 1) + ["none"]
        return MlpPolicy(
            [W.copy() for W, _ in layers], [b.copy() for _, b in layers], activations, record
        )


def _table(sizes: Sequence[int], first: int) -> tuple[NDArray[np.int64], int]:
    """Table of a network whose parameters begin at `first`, and the end of its parameters."""
    rows, stored = [], 0
    for inputs, outputs in pairwise(sizes):
        rows.append((inputs, outputs, first, first + inputs * outputs, stored))
        first += (inputs + 1) * outputs
        stored += outputs
    return np.array(rows, np.int64), first


def _orthogonal(shape: tuple[int, ...], rng: np.random.Generator) -> NDArray[Any]:
    """Draw a matrix with orthonormal rows or columns, whichever are fewer (Saxe et al. 2014)."""
    Q, R = np.linalg.qr(rng.standard_normal((max(shape), min(shape))))
    Q *= np.sign(np.diag(R))
    return Q if shape[0] >= shape[1] else Q.T

"""`Networks`: actor and critic as multilayer perceptrons in one vector of parameters."""

from collections.abc import Mapping, Sequence
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from baselines.compiled_ppo import kernels
from baselines.compiled_ppo.kernels import INPUTS, OUTPUTS, STORED, TILE
from baselines.mlp import MlpPolicy
from baselines.recipes import ACTIVATIONS, Recipe

Floats = NDArray[np.float32]
Table = NDArray[np.int64]


class Networks:
    """Gaussian policy and value function of a recipe, for observations and actions of some lengths.

    `critic_only` inputs, at the end of an observation, are for the critic only. The vector of
    parameters contains the logarithms of the policy's standard deviations directly after the
    actor's layers. Initial values of layers are drawn as in Stable-Baselines3.
    """

    def __init__(
        self,
        inputs: int,
        outputs: int,
        recipe: Recipe,
        rng: np.random.Generator,
        critic_only: int = 0,
    ) -> None:
        self.actor, first = _table_of((inputs - critic_only, *recipe.layers, outputs), 0)
        self.critic, count = _table_of((inputs, *recipe.critic_layers, 1), first + outputs)
        self._activation, self.params = recipe.activation, np.zeros(count, np.float32)
        self.net = (self.params, np.zeros_like(self.params), ACTIVATIONS.index(recipe.activation))
        self.model = (self.net, self.actor, self.critic)
        self.log_std = self.params[first : first + outputs]
        self.log_std[:] = recipe.policy.get("log_std_init", 0.0)
        for table, last_gain in ((self.actor, 0.01), (self.critic, 1.0)):
            for W, _ in self.layers(table)[:-1]:
                W[:] = np.sqrt(2.0) * orthogonal(W.shape, rng)
            W, _ = self.layers(table)[-1]
            W[:] = last_gain * orthogonal(W.shape, rng)
        self._room = tuple(room[0] for room in self.rooms(1)[:2])

    def layers(self, table: Table, vector: Floats | None = None) -> list[tuple[Any, Any]]:
        """Weights (outputs, inputs) and biases (outputs,) of each layer, as views.

        They are views of the parameters, or of a vector like these, such as a gradient.
        """
        vector = self.params if vector is None else vector
        return [
            (vector[w : w + i * o].reshape(o, i), vector[b : b + o])
            for i, o, w, b, _ in table.tolist()
        ]

    def flip(self) -> None:
        """Update the flipped weights from the parameters."""
        for table in (self.actor, self.critic):
            kernels.flip(self.net, table)

    def rooms(self, parts: int) -> tuple[Floats, ...]:
        """Work memory of `kernels.differentiate`: inputs, outputs, deltas, and a matrix product."""
        tables = (self.actor, self.critic)
        sizes = (
            (2, TILE, int(self.critic[0, INPUTS])),
            (TILE * max(int(t[-1, STORED] + t[-1, OUTPUTS]) for t in tables),),
            (2, TILE * max(int(t[:, OUTPUTS].max()) for t in tables)),
            (max(int((t[:, INPUTS] * t[:, OUTPUTS]).max()) for t in tables),),
        )
        return tuple(np.zeros((parts, *size), np.float32) for size in sizes)

    def evaluate(self, x: Floats) -> tuple[Floats, Floats]:
        """Means of actions (n, a) and values (n,) for observations x (n, o)."""
        means = np.empty((len(x), len(self.log_std)), np.float32)
        values = np.empty(len(x), np.float32)
        kernels.evaluate(x, self.model, *self._room, means, values)
        return means, values

    def policy(self, record: Mapping[str, Any]) -> MlpPolicy:
        """Copy the actor to a policy that requires only NumPy."""
        layers = self.layers(self.actor)
        activations = [self._activation] * (len(layers) - 1) + ["none"]
        return MlpPolicy(
            [W.copy() for W, _ in layers], [b.copy() for _, b in layers], activations, record
        )


def _table_of(sizes: Sequence[int], first: int) -> tuple[Table, int]:
    """Table of a network whose parameters begin at `first`, and the end of its parameters."""
    rows, stored = [], 0
    for inputs, outputs in pairwise(sizes):
        rows.append((inputs, outputs, first, first + inputs * outputs, stored))
        first += (inputs + 1) * outputs
        stored += outputs
    return np.array(rows, np.int64), first


def orthogonal(shape: tuple[int, ...], rng: np.random.Generator) -> NDArray[Any]:
    """Draw a matrix with orthonormal rows or columns, whichever are fewer (Saxe et al. 2014)."""
    Q, R = np.linalg.qr(rng.standard_normal((max(shape), min(shape))))
    Q *= np.sign(np.diag(R))
    return Q if shape[0] >= shape[1] else Q.T

"""Common part of both kinds of networks: actor and critic in one vector of parameters."""

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from baselines.compiled_ppo.kernels.common import INPUTS, OUTPUTS, STORED, TILE, flip
from baselines.gru import GruPolicy
from baselines.mlp import MlpPolicy
from baselines.recipes import ACTIVATIONS, Recipe

Floats = NDArray[np.float32]
Table = NDArray[np.int64]


class Networks(ABC):
    """Gaussian policy and value function of a recipe, for observations and actions of some lengths.

    The vector of parameters contains the logarithms of the policy's standard deviations directly
    after the actor's layers. Initial values of layers are drawn as in Stable-Baselines3.
    """

    differentiate: Any
    """Entry made by `kernels.differentiating`"""
    memory_units = 0
    """Number of units that remember, of the actor, and of the critic"""
    sequence_length = 1
    """Number of successive samples of a flight that are learned together"""
    model: tuple[Any, ...]
    """`net`, and the tables of actor and critic"""

    def __init__(self, recipe: Recipe, count: int, tables: Sequence[Table], actor: Table) -> None:
        """Allocate `count` parameters of networks with some tables, one of which is the actor's."""
        self.actor, self._tables, self._activation = actor, tables, recipe.activation
        self.params = np.zeros(count, np.float32)
        number = ACTIVATIONS.index(recipe.activation)
        self.net = (self.params, np.zeros_like(self.params), number)
        first = int(actor[-1, STORED - 1] + actor[-1, OUTPUTS])
        self.log_std = self.params[first : first + int(actor[-1, OUTPUTS])]
        self.log_std[:] = recipe.policy.get("log_std_init", 0.0)

    def layers(self, table: Table) -> list[tuple[Any, Any]]:
        """Weights (outputs, inputs) and biases (outputs,) of each layer, as views."""
        return [
            (self.params[w : w + i * o].reshape(o, i), self.params[b : b + o])
            for i, o, w, b, _ in table.tolist()
        ]

    def flip(self) -> None:
        """Update the flipped weights from the parameters."""
        for table in self._tables:
            flip(self.net, table)

    @abstractmethod
    def rooms(self, parts: int) -> tuple[Floats, ...]:
        """Work memory for `differentiate`."""

    @abstractmethod
    def evaluate(self, x: Floats, memory: Floats) -> tuple[Floats, Floats, Floats]:
        """Evaluate both networks on observations x (n, o) and their memories (2, n, units).

        Returns means of actions (n, a), values (n,), and the next memories.
        """

    @abstractmethod
    def policy(self, record: Mapping[str, Any]) -> MlpPolicy | GruPolicy:
        """Copy the actor to a policy that requires only NumPy."""

    def _perceptron(self, record: Mapping[str, Any]) -> MlpPolicy:
        """Copy the actor's layers."""
        layers = self.layers(self.actor)
        activations = [self._activation] * (len(layers) - 1) + ["none"]
        return MlpPolicy(
            [W.copy() for W, _ in layers], [b.copy() for _, b in layers], activations, record
        )

    def _draw_layers(self, table: Table, last_gain: float, rng: np.random.Generator) -> None:
        """Draw initial weights of layers."""
        for W, _ in self.layers(table)[:-1]:
            W[:] = np.sqrt(2.0) * orthogonal(W.shape, rng)
        W, _ = self.layers(table)[-1]
        W[:] = last_gain * orthogonal(W.shape, rng)


def table_of(sizes: Sequence[int], first: int) -> tuple[Table, int]:
    """Table of a network whose parameters begin at `first`, and the end of its parameters."""
    return table_of_maps(list(pairwise(sizes)), first)


def table_of_maps(maps: Sequence[tuple[int, int]], first: int) -> tuple[Table, int]:
    """Table of linear maps (inputs, outputs), and the end of their parameters."""
    rows, stored = [], 0
    for inputs, outputs in maps:
        rows.append((inputs, outputs, first, first + inputs * outputs, stored))
        first += (inputs + 1) * outputs
        stored += outputs
    return np.array(rows, np.int64), first


def layer_rooms(tables: Sequence[Table], product: int = 0) -> tuple[tuple[int, ...], ...]:
    """Sizes of the work memory of layers: outputs, deltas, and a product of `product` or more."""
    return (
        (TILE * max(int(t[-1, STORED] + t[-1, OUTPUTS]) for t in tables),),
        (2, TILE * max(int(t[:, OUTPUTS].max()) for t in tables)),
        (max(product, *(int((t[:, INPUTS] * t[:, OUTPUTS]).max()) for t in tables)),),
    )


def orthogonal(shape: tuple[int, ...], rng: np.random.Generator) -> NDArray[Any]:
    """Draw a matrix with orthonormal rows or columns, whichever are fewer (Saxe et al. 2014)."""
    Q, R = np.linalg.qr(rng.standard_normal((max(shape), min(shape))))
    Q *= np.sign(np.diag(R))
    return Q if shape[0] >= shape[1] else Q.T

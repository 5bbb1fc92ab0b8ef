"""Networks with memory: a GRU before the layers of the actor, and one before the critic's.

Each is a `baselines.gru.GruPolicy`: its layers receive the observation and the memory.
"""

from collections.abc import Mapping
from typing import Any

import numpy as np

from baselines.compiled_ppo.kernels import recurrent
from baselines.compiled_ppo.kernels.common import INPUTS, TILE
from baselines.compiled_ppo.kernels.recurrent import SEQUENCES, UPDATE
from baselines.compiled_ppo.networks import (
    Floats,
    Networks,
    Table,
    layer_rooms,
    orthogonal,
    table_of,
    table_of_maps,
)
from baselines.gru import GruPolicy
from baselines.recipes import Recipe


class Recurrent(Networks):
    """A GRU and layers each; `critic_only` inputs, at the end, are for the critic only."""

    differentiate = staticmethod(recurrent.differentiate)

    def __init__(
        self,
        inputs: int,
        outputs: int,
        recipe: Recipe,
        rng: np.random.Generator,
        critic_only: int = 0,
        sequence_length: int = 32,
    ) -> None:
        self.memory_units, self.sequence_length = recipe.memory_units, sequence_length
        size = recipe.memory_units
        seen = inputs - critic_only
        self.gru, first = _gru_table(seen, size, 0)
        actor, first = table_of((seen + size, *recipe.layers, outputs), first)
        self.critic_gru, first = _gru_table(inputs, size, first + outputs)
        self.critic, count = table_of((inputs + size, *recipe.critic_layers, 1), first)
        grus = (self.gru, self.critic_gru)
        super().__init__(recipe, count, (actor, self.critic, *grus), actor)
        for gru, table, gain in ((self.gru, actor, 0.01), (self.critic_gru, self.critic, 1.0)):
            maps = self.layers(gru)
            for W, _ in maps:
                W[:] = orthogonal(W.shape, rng)
            # time constants from one step to the length of a sequence (Tallec and Ollivier 2018)
            maps[UPDATE][1][:] = np.log(rng.uniform(1.0, max(2.0, sequence_length), size))
            self._draw_layers(table, gain, rng)
        self.model = (self.net, (self.gru, actor), (self.critic_gru, self.critic))
        self._room = self.rooms(1)

    def rooms(self, parts: int) -> tuple[Floats, ...]:
        """Work memory of `differentiate`, and of `evaluate`.

        Inputs; memories before and after each step and gradients; gates; products; joined inputs;
        and those of the layers.
        """
        rows = max(TILE, SEQUENCES * self.sequence_length)
        inputs, size = int(self.critic_gru[0, INPUTS]), self.memory_units
        product = size * max(inputs, size)
        sizes = (
            (rows * inputs,),
            (3, rows, size),
            (4, rows, size),
            (4, TILE, size),
            (2, TILE * (inputs + size)),
            *layer_rooms((self.actor, self.critic), product),
        )
        return tuple(np.zeros((parts, *each), np.float32) for each in sizes)

    def evaluate(self, x: Floats, memory: Floats) -> tuple[Floats, Floats, Floats]:
        """Evaluate both networks."""
        means = np.empty((len(x), len(self.log_std)), np.float32)
        values, after = np.empty(len(x), np.float32), np.empty(memory.shape, np.float32)
        before = np.ascontiguousarray(memory)
        recurrent.evaluate(x, self.model, self._room, before, means, values, after)
        return means, values, after

    def policy(self, record: Mapping[str, Any]) -> GruPolicy:
        """Copy the actor to a policy that requires only NumPy."""
        maps = self.layers(self.gru)
        W, b, U, c = (
            np.concatenate([part[k] for part in maps[first : first + 3]])
            for first in (0, 3)
            for k in (0, 1)
        )
        return GruPolicy(W, b, U, c, self._perceptron(record))


def _gru_table(inputs: int, units: int, first: int) -> tuple[Table, int]:
    """Table of a GRU, see `RESET`, and the end of its parameters."""
    return table_of_maps([(inputs, units)] * 3 + [(units, units)] * 3, first)

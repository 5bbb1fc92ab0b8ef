"""Networks without memory: multilayer perceptrons as actor and critic."""

from collections.abc import Mapping
from typing import Any

import numpy as np

from baselines.compiled_ppo.kernels import feed_forward
from baselines.compiled_ppo.kernels.common import INPUTS, TILE
from baselines.compiled_ppo.networks import Floats, Networks, layer_rooms, table_of
from baselines.mlp import MlpPolicy
from baselines.recipes import Recipe


class FeedForward(Networks):
    """Multilayer perceptrons; `critic_only` inputs, at the end, are for the critic only."""

    differentiate = staticmethod(feed_forward.differentiate)

    def __init__(
        self,
        inputs: int,
        outputs: int,
        recipe: Recipe,
        rng: np.random.Generator,
        critic_only: int = 0,
    ) -> None:
        actor, first = table_of((inputs - critic_only, *recipe.layers, outputs), 0)
        self.critic, count = table_of((inputs, *recipe.critic_layers, 1), first + outputs)
        super().__init__(recipe, count, (actor, self.critic), actor)
        for table, last_gain in ((self.actor, 0.01), (self.critic, 1.0)):
            self._draw_layers(table, last_gain, rng)
        self.model = (self.net, self.actor, self.critic)
        self._room = tuple(room[0] for room in self.rooms(1)[:2])

    def rooms(self, parts: int) -> tuple[Floats, ...]:
        """Inputs, outputs, deltas, and a matrix product."""
        tables = (self.actor, self.critic)
        sizes = ((2, TILE, int(self.critic[0, INPUTS])), *layer_rooms(tables))
        return tuple(np.zeros((parts, *size), np.float32) for size in sizes)

    def evaluate(self, x: Floats, memory: Floats) -> tuple[Floats, Floats, Floats]:
        """Evaluate both networks; the memory is empty."""
        means = np.empty((len(x), len(self.log_std)), np.float32)
        values = np.empty(len(x), np.float32)
        feed_forward.evaluate(x, self.model, *self._room, means, values)
        return means, values, memory

    def policy(self, record: Mapping[str, Any]) -> MlpPolicy:
        """Copy the actor to a policy that requires only NumPy."""
        return self._perceptron(record)

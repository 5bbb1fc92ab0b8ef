"""Networks without memory: multilayer perceptrons as actor and critic."""

from collections.abc import Mapping
from typing import Any

import numpy as np

from baselines.compiled_ppo.kernels import (
    INPUTS,
    TILE,
    backward,
    differentiating,
    forward,
    log_std_of,
    policy_loss,
    value_loss,
)
from baselines.compiled_ppo.networks import Floats, Networks, layer_rooms, table_of
from baselines.mlp import MlpPolicy
from baselines.recipes import Recipe
from quad_gym.kernels.compiling import entry, routine


@routine
def _seen_by(table, x, spare):
    """Inputs of a network in samples x: the first columns, as a contiguous array."""
    size = table[0, INPUTS]
    if size == x.shape[1]:
        return x
    seen = spare.reshape(-1)[: len(x) * size].reshape((len(x), size))
    for i in range(len(x)):
        for j in range(size):
            seen[i, j] = x[i, j]
    return seen


@routine
def _differentiate_tile(units, model, samples, recipe, rooms, part, gradient, sums):
    """Add the gradient of the loss of a tile; each sample has the weight `share`."""
    chosen, advantages, share = units
    net, actor, critic = model
    observations, returns = samples[0], samples[3]
    inputs, outputs, deltas, product = rooms
    room = (outputs[part], deltas[part], product[part])
    x = inputs[part, 0, : len(chosen)]
    for i in range(len(chosen)):
        sample = chosen[i]
        for j in range(x.shape[1]):
            x[i, j] = observations[sample, j]
    seen = _seen_by(actor, x, inputs[part, 1])
    mean = forward(seen, actor, net, room[0])
    log_std, slope = log_std_of(net[0], actor), log_std_of(gradient, actor)
    d, A = room[1][0, : mean.size].reshape(mean.shape), advantages.reshape(-1)
    policy_loss(mean, log_std, chosen, samples, A, recipe, share, d, slope, sums)
    backward(seen, actor, net, room, gradient)
    value = forward(x, critic, net, room[0])
    value_loss(value, chosen, returns, recipe, share, room[1][0], sums)
    backward(x, critic, net, room, gradient)


@entry
def _evaluate(x, model, inputs, outputs, means, values):
    """Evaluate both networks on observations x (n, o); writes means (n, a) and values (n,)."""
    net, actor, critic = model
    for a in range(0, len(x), TILE):
        b = min(a + TILE, len(x))
        means[a:b] = forward(_seen_by(actor, x[a:b], inputs[1]), actor, net, outputs)
        values[a:b] = forward(x[a:b], critic, net, outputs)[:, 0]


class FeedForward(Networks):
    """Multilayer perceptrons; `critic_only` inputs, at the end, are for the critic only."""

    differentiate = staticmethod(differentiating(_differentiate_tile, TILE))

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
        _evaluate(x, self.model, *self._room, means, values)
        return means, values, memory

    def policy(self, record: Mapping[str, Any]) -> MlpPolicy:
        """Copy the actor to a policy that requires only NumPy."""
        return self._perceptron(record)

"""Compiled parts of networks without memory."""

from baselines.compiled_ppo.kernels.common import (
    INPUTS,
    TILE,
    backward,
    differentiating,
    forward,
    log_std_of,
    policy_loss,
    value_loss,
)
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
def evaluate(x, model, inputs, outputs, means, values):
    """Evaluate both networks on observations x (n, o); writes means (n, a) and values (n,)."""
    net, actor, critic = model
    for a in range(0, len(x), TILE):
        b = min(a + TILE, len(x))
        means[a:b] = forward(_seen_by(actor, x[a:b], inputs[1]), actor, net, outputs)
        values[a:b] = forward(x[a:b], critic, net, outputs)[:, 0]


differentiate = differentiating(_differentiate_tile, TILE)

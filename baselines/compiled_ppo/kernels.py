"""Compiled parts of PPO: layers, the loss and its gradient in threads, and Adam.

A network is a table with one row per layer, and a part of one vector of float32 parameters: weights
(outputs, inputs) of each layer, followed by its biases. `flipped` contains the transposed weights,
so that BLAS computes all matrix products fast. Samples are processed in tiles of `TILE`: the data
of a tile fit into the first-level caches, and BLAS does not distribute such small products over
threads. `net` is the tuple of parameters, flipped weights and activation.
"""

import math

import numpy as np

from quad_gym.kernels.board import add_shared, comes, finished, post, read_shared, take
from quad_gym.kernels.compiling import entry, kernel, routine
from quad_gym.records.call import FINISHED, TICKET

TILE = 64  #: number of samples in a tile

INPUTS, OUTPUTS, WEIGHTS, BIASES, STORED = range(5)
"""Columns of a table of layers: sizes, offsets of weights and biases in the vector of parameters,
and sum of the outputs of the layers below."""

ACTIVATIONS = RELU, TANH, ELU = range(3)

BETAS, EPSILON = (0.9, 0.999), 1e-5
"""Parameters of Adam: the betas of torch, and the epsilon of Stable-Baselines3 for PPO."""

SUMS = ("policy_loss", "value_loss", "approx_kl", "clip_fraction")
"""Sums over the samples of a minibatch that `differentiate` computes."""

_ZERO, _ONE, _HALF = np.float32(0.0), np.float32(1.0), np.float32(0.5)
_FRESH, _EPSILON = tuple(np.float32(1.0 - beta) for beta in BETAS), np.float32(EPSILON)
_LOG_TAU = np.float32(math.log(2.0 * math.pi))


@kernel
def weights(vector, row, first, second):
    """Part of a layer in a vector of weights, as a matrix of row[first] by row[second]."""
    begin, size = row[WEIGHTS], row[INPUTS] * row[OUTPUTS]
    return vector[begin : begin + size].reshape((row[first], row[second]))


@kernel
def _stored(outputs, row, rows):
    """Outputs of a layer for `rows` samples, (rows, outputs)."""
    first = TILE * row[STORED]
    return outputs[first : first + rows * row[OUTPUTS]].reshape((rows, row[OUTPUTS]))


@routine
def _activate(y, activation):
    """Replace y by its activation."""
    v = y.reshape(-1)
    if activation == RELU:
        for i in range(v.size):
            v[i] = max(v[i], _ZERO)
    elif activation == TANH:
        for i in range(v.size):
            v[i] = math.tanh(v[i])
    else:
        for i in range(v.size):
            v[i] = v[i] if v[i] > _ZERO else math.expm1(v[i])


@routine
def _through_activation(delta, y, activation):
    """Multiply delta by the derivative of the activation, given its value y."""
    d, v = delta.reshape(-1), y.reshape(-1)
    if activation == RELU:
        for i in range(v.size):
            d[i] = d[i] if v[i] > _ZERO else _ZERO
    elif activation == TANH:
        for i in range(v.size):
            d[i] *= _ONE - v[i] * v[i]
    else:
        for i in range(v.size):
            d[i] *= _ONE if v[i] > _ZERO else v[i] + _ONE


@kernel
def add_biases(y, params, row):
    """Add the biases of a layer to its products y (rows, outputs)."""
    b = params[row[BIASES] : row[BIASES] + row[OUTPUTS]]
    for i in range(len(y)):
        for j in range(b.size):
            y[i, j] += b[j]


@kernel
def add_gradient(d, below, row, product, gradient):
    """Add the gradient of a layer with inputs `below`, given the one of its outputs, d."""
    change = product[: row[INPUTS] * row[OUTPUTS]]
    np.dot(d.T, below, change.reshape((row[OUTPUTS], row[INPUTS])))
    W = gradient[row[WEIGHTS] : row[WEIGHTS] + change.size]
    for i in range(change.size):
        W[i] += change[i]
    b = gradient[row[BIASES] : row[BIASES] + row[OUTPUTS]]
    for i in range(len(d)):
        for j in range(b.size):
            b[j] += d[i, j]


@routine
def forward(x, table, net, outputs):
    """Forward pass of samples x (rows, inputs); `outputs` stores the outputs of every layer."""
    params, flipped, activation = net
    h = x
    for layer in range(len(table)):
        row = table[layer]
        y = _stored(outputs, row, len(x))
        np.dot(h, weights(flipped, row, INPUTS, OUTPUTS), y)
        add_biases(y, params, row)
        if layer < len(table) - 1:
            _activate(y, activation)
        h = y
    return h


@routine
def backward(x, table, net, room, gradient):
    """Add the gradient of a tile; deltas[0] begins with the gradient with respect to the output.

    Returns the gradient with respect to the outputs of the first layer, without activation.
    """
    params, _, activation = net
    outputs, deltas, product = room
    rows = len(x)
    d = deltas[0, : rows * table[-1, OUTPUTS]].reshape((rows, table[-1, OUTPUTS]))
    for layer in range(len(table) - 1, 0, -1):
        row, side = table[layer], (len(table) - 1 - layer) % 2
        below = _stored(outputs, table[layer - 1], rows)
        add_gradient(d, below, row, product, gradient)
        before = deltas[1 - side, : rows * row[INPUTS]].reshape((rows, row[INPUTS]))
        np.dot(d, weights(params, row, OUTPUTS, INPUTS), before)
        _through_activation(before, below, activation)
        d = before
    add_gradient(d, x, table[0], product, gradient)
    return d


@routine
def policy_loss(mean, log_std, chosen, samples, advantages, recipe, share, d, d_log_std, sums):
    """Policy loss of a tile, and its gradient with respect to means and log_std.

    L = -min(r A, clip(r, 1 - c, 1 + c) A) - k H, where r is the ratio of the action's present to
    its former probability, A its advantage and H the entropy (Schulman et al. 2017, eqs. 7, 9).
    """
    actions, log_probs = samples[1], samples[2]
    clip, entropy_weight = np.float32(recipe[0]), np.float32(recipe[1])
    precision = np.exp(-log_std)
    for i in range(len(chosen)):
        log_prob, action = _ZERO, actions[chosen[i]]
        for j in range(log_std.size):
            z = (action[j] - mean[i, j]) * precision[j]
            log_prob -= _HALF * (z * z + _LOG_TAU) + log_std[j]
        change = log_prob - log_probs[chosen[i]]
        ratio, advantage = math.exp(change), advantages[i]
        gain = ratio * advantage
        held = min(max(ratio, _ONE - clip), _ONE + clip) * advantage
        slope = -gain * share if gain <= held else _ZERO
        for j in range(log_std.size):
            z = (action[j] - mean[i, j]) * precision[j]
            d[i, j] = slope * z * precision[j]
            d_log_std[j] += slope * (z * z - _ONE) - entropy_weight * share
        sums[0] -= min(gain, held)
        sums[2] += ratio - _ONE - change
        sums[3] += abs(ratio - _ONE) > clip


@routine
def value_loss(value, chosen, returns, recipe, share, d, sums):
    """Value loss of a tile, and its gradient with respect to the values (rows, 1)."""
    for i in range(len(chosen)):
        error = value[i, 0] - returns[chosen[i]]
        d[i] = np.float32(2.0 * recipe[2]) * share * error
        sums[1] += error * error


@kernel
def log_std_of(vector, actor):
    """Part of a vector of parameters with the log standard deviations of the policy."""
    first = actor[-1, BIASES] + actor[-1, OUTPUTS]
    return vector[first : first + actor[-1, OUTPUTS]]


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
def _differentiate_tile(
    chosen, advantages, share, model, samples, recipe, rooms, part, gradient, sums
):
    """Add the gradient of the loss of a tile; each sample has the weight `share`."""
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
    d = room[1][0, : mean.size].reshape(mean.shape)
    policy_loss(mean, log_std, chosen, samples, advantages, recipe, share, d, slope, sums)
    backward(seen, actor, net, room, gradient)
    value = forward(x, critic, net, room[0])
    value_loss(value, chosen, returns, recipe, share, room[1][0], sums)
    backward(x, critic, net, room, gradient)


@routine
def _differentiate_part(part, minibatch, model, samples, recipe, rooms, written):
    """Compute the gradient of one part of a minibatch, and its `SUMS`."""
    span, order, advantages = minibatch
    gradient, sums = written[0][part], written[1][part]
    count, parts = span[1] - span[0], len(written[0])
    share = _ONE / np.float32(count)
    gradient[:] = _ZERO
    sums[:] = 0.0
    end = span[0] + count * (part + 1) // parts
    for a in range(span[0] + count * part // parts, end, TILE):
        b = min(a + TILE, end)
        tile = (order[a:b], advantages[a:b], share)
        _differentiate_tile(*tile, model, samples, recipe, rooms, part, gradient, sums)


@entry
def differentiate(
    board, number, command, serving, minibatch, model, samples, recipe, rooms, written
):
    """Compute the gradient of the loss of a minibatch, in parts that threads share on a board.

    Args:
        board: Board whose blocks are the parts, see `quad_gym.kernels.board`.
        number: Number of this thread; 0 posts the minibatches.
        command: 0 to post a minibatch; negative to wait for the last one that was posted.
        serving: True to work on minibatches posted by others, until none is posted for a while.
        minibatch: Begin and end in the order of this epoch, (2,); this order of the samples,
            (n,); advantages in this order, normalized, (n,).
        model: `net`, and the tables of actor and critic.
        samples: Observations (n, o), of which the actor uses the first columns; actions (n, a),
            log probabilities (n,), returns (n,).
        recipe: Clip range, weight of the entropy, and weight of the value loss, (3,).
        rooms: Work memory of each part.
        written: Results of each part: gradient (p,) and `SUMS` (4,).

    Returns:
        True if all parts are finished; False if another thread is still working.
    """
    if not serving and command >= 0:
        post(board, command)
    while True:  # once, unless serving
        seen = read_shared(board, TICKET)
        while True:
            first, last = take(board, number)
            if first == last:
                break
            for part in range(first, last):
                _differentiate_part(part, minibatch, model, samples, recipe, rooms, written)
            add_shared(board, FINISHED, last - first)
        if not serving:
            return finished(board)
        if not comes(board, number, seen):
            return True


@entry
def evaluate(x, model, inputs, outputs, means, values):
    """Evaluate both networks on observations x (n, o); writes means (n, a) and values (n,)."""
    net, actor, critic = model
    for a in range(0, len(x), TILE):
        b = min(a + TILE, len(x))
        means[a:b] = forward(_seen_by(actor, x[a:b], inputs[1]), actor, net, outputs)
        values[a:b] = forward(x[a:b], critic, net, outputs)[:, 0]


@entry
def descend(gradients, params, moments, rate, max_norm, corrections):
    """Take a step of Adam (Kingma and Ba 2015) along the sum of the parts' gradients (parts, p).

    The norm of the sum is clipped to max_norm. `corrections` are 1 - beta^t of both moments.
    Changes params (p,) and moments (2, p); returns the norm of the sum before clipping.
    """
    g, m, v = gradients[0], moments[0], moments[1]
    for part in range(1, len(gradients)):
        more = gradients[part]
        for i in range(g.size):
            g[i] += more[i]
    norm = math.sqrt(np.dot(g, g))
    shortened = np.float32(min(1.0, max_norm / (norm + 1e-6)))
    length, root = np.float32(rate / corrections[0]), np.float32(math.sqrt(corrections[1]))
    for i in range(g.size):
        q = g[i] * shortened
        m[i] += _FRESH[0] * (q - m[i])
        v[i] += _FRESH[1] * (q * q - v[i])
        params[i] -= length * m[i] / (math.sqrt(v[i]) / root + _EPSILON)
    return norm


@entry
def flip(net, table):
    """Update the flipped weights of a table from the parameters."""
    params, flipped, _ = net
    for layer in range(len(table)):
        W = weights(params, table[layer], OUTPUTS, INPUTS)
        weights(flipped, table[layer], INPUTS, OUTPUTS)[:] = W.T

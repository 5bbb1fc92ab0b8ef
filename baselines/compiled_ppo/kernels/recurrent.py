"""Compiled parts of networks with memory, whose equations are in `baselines.gru`.

The gradient goes back through a sequence of samples of a flight, and ends at its beginning and at
the beginning of an episode (truncated backpropagation through time). Rows of a tile are ordered by
time, then by flight.
"""

import math

import numpy as np

from baselines.compiled_ppo.kernels.common import (
    INPUTS,
    OUTPUTS,
    TILE,
    add_biases,
    add_gradient,
    backward,
    differentiating,
    forward,
    log_std_of,
    policy_loss,
    value_loss,
    weights,
)
from quad_gym.kernels.compiling import entry, kernel, routine

SEQUENCES = 16  #: number of sequences in a tile

RESET, UPDATE, CANDIDATE, HIDDEN = range(4)
"""Gates of a GRU, and U_n h + c_n. Its table has six rows: W and b, then U and c, of each gate."""

_ZERO, _HALF, _ONE = np.float32(0.0), np.float32(0.5), np.float32(1.0)
_ODD = tuple(
    np.float32(c)
    for c in (
        *(-2.76076847742355e-16, 2.00018790482477e-13, -8.60467152213735e-11),
        *(5.12229709037114e-08, 1.48572235717979e-05, 6.37261928875436e-04, 4.89352455891786e-03),
    )
)
_EVEN = tuple(
    np.float32(c)
    for c in (
        *(1.19825839466702e-06, 1.18534705686654e-04),
        *(2.26843463243900e-03, 4.89352518554385e-03),
    )
)
"""Coefficients of a rational tanh for single precision, from Eigen (`generic_fast_tanh_float`)."""
_LARGEST = np.float32(7.90531110763549805)


@kernel
def _tanh(x):
    """Hyperbolic tangent in single precision, which the compiler can vectorize."""
    x = min(max(x, -_LARGEST), _LARGEST)
    s = x * x
    odd = ((((((_ODD[0] * s + _ODD[1]) * s + _ODD[2]) * s + _ODD[3]) * s + _ODD[4]) * s
            + _ODD[5]) * s + _ODD[6]) * x  # fmt: skip
    return odd / (((_EVEN[0] * s + _EVEN[1]) * s + _EVEN[2]) * s + _EVEN[3])


@routine
def _bend(y):
    """Replace y by its hyperbolic tangent."""
    v = y.reshape(-1)
    if v.itemsize == 4:
        for i in range(v.size):
            v[i] = _tanh(v[i])
    else:  # double precision, for tests of the gradient
        for i in range(v.size):
            v[i] = math.tanh(v[i])


@routine
def _take_in(x, gru, net, gates):
    """Parts of the gates that depend on inputs x (rows, inputs): W x + b."""
    for a in range(0, len(x), TILE):
        b = min(a + TILE, len(x))
        for k in range(3):
            np.dot(x[a:b], weights(net[1], gru[k], INPUTS, OUTPUTS), gates[k, a:b])
            add_biases(gates[k, a:b], net[0], gru[k])


@routine
def _remember(h, gru, net, r, u, n, q, products, after):
    """Complete the gates, and compute the new memory from h, (m, units) each."""
    for k in range(3):
        np.dot(h, weights(net[1], gru[3 + k], INPUTS, OUTPUTS), products[k, : len(h)])
        add_biases(products[k, : len(h)], net[0], gru[3 + k])
    for i in range(len(h)):
        for j in range(h.shape[1]):
            r[i, j] = _HALF * (r[i, j] + products[0, i, j])
            u[i, j] = _HALF * (u[i, j] + products[1, i, j])
    _bend(r)  # s(2 y) = (1 + tanh y) / 2
    _bend(u)
    for i in range(len(h)):
        for j in range(h.shape[1]):
            r[i, j] = _HALF * (_ONE + r[i, j])
            u[i, j] = _HALF * (_ONE + u[i, j])
            q[i, j] = products[2, i, j]
            n[i, j] += r[i, j] * q[i, j]
    _bend(n)
    for i in range(len(h)):
        for j in range(h.shape[1]):
            after[i, j] = n[i, j] + u[i, j] * (h[i, j] - n[i, j])


@routine
def _recall(h, gru, net, r, u, n, q, products, d, late):
    """Gradient with respect to h; the gates become gradients with respect to their arguments.

    d is the gradient with respect to the new memory through the layers, `late` the one through all
    later steps, which becomes the result.
    """
    for i in range(len(h)):
        for j in range(h.shape[1]):
            R, U, N, D = r[i, j], u[i, j], n[i, j], d[i, j] + late[i, j]
            dn = D * (_ONE - U) * (_ONE - N * N)
            u[i, j] = D * (h[i, j] - N) * U * (_ONE - U)
            r[i, j] = dn * q[i, j] * R * (_ONE - R)
            n[i, j] = dn
            q[i, j] = dn * R
            late[i, j] = D * U
    np.dot(r, weights(net[0], gru[3], OUTPUTS, INPUTS), products[0, : len(h)])
    np.dot(u, weights(net[0], gru[4], OUTPUTS, INPUTS), products[1, : len(h)])
    np.dot(q, weights(net[0], gru[5], OUTPUTS, INPUTS), products[2, : len(h)])
    for i in range(len(h)):
        for j in range(h.shape[1]):
            late[i, j] += products[0, i, j] + products[1, i, j] + products[2, i, j]


@kernel
def _joined(x, h, spare):
    """Inputs (x, h) of the layers, (rows, inputs + units), in spare memory."""
    size = x.shape[1] + h.shape[1]
    both = spare[: len(x) * size].reshape((len(x), size))
    for i in range(len(x)):
        for j in range(x.shape[1]):
            both[i, j] = x[i, j]
        for j in range(h.shape[1]):
            both[i, x.shape[1] + j] = h[i, j]
    return both


@kernel
def _matrix(spare, rows, columns):
    return spare[: rows * columns].reshape((rows, columns))


@routine
def _differentiate_tile(units, model, samples, recipe, rooms, part, gradient, sums):
    """Add the gradient of the loss of some sequences; each sample has the weight `share`."""
    firsts, advantages, share = units
    net, actor, critic = model
    observations, ended, begun = samples[0], samples[4], samples[5]
    inputs, memories, gates, products, joined, outputs, deltas, product = rooms
    m, length, flights = len(firsts), advantages.shape[1], begun.shape[2]
    rows = m * length
    chosen, A = np.empty(rows, np.int64), np.empty(rows, net[0].dtype)
    kept = np.empty(rows, net[0].dtype)
    for t in range(length):
        for i in range(m):
            row, sample = t * m + i, firsts[i] + t * flights
            chosen[row], A[row] = sample, advantages[i, t]
            kept[row] = _ZERO if t > 0 and ended[sample - flights] else _ONE
    tile = (chosen, A, samples, recipe, share)
    layers = (joined[part], (outputs[part], deltas[part], product[part]))
    before, after, d = memories[part, 0, :rows], memories[part, 1, :rows], memories[part, 2, :rows]
    for which in range(2):
        gru, table = (actor, critic)[which]
        x = _matrix(inputs[part], rows, gru[0, INPUTS])
        for i in range(rows):
            for j in range(x.shape[1]):
                x[i, j] = observations[chosen[i], j]
        for i in range(m):
            for j in range(before.shape[1]):
                sequence, flight = firsts[i] // (length * flights), firsts[i] % flights
                before[i, j] = begun[sequence, which, flight, j]
        run = (x, before, after, kept, m)
        _run(run, gru, net, gates[part], products[part])
        _through_layers(which, x, after, table, net, tile, layers, d, gradient, sums)
        _run_back(run, gru, net, gates[part], products[part], d, product[part], gradient)


@routine
def _run(run, gru, net, gates, products):
    """Run sequences of m flights.

    `run`: inputs x (rows, inputs), memories before and after each step (rows, units), of which the
    first m before are given; 0 for a row that begins an episode, otherwise 1 (rows,); m.
    """
    x, before, after, kept, m = run
    _take_in(x, gru, net, gates)
    for a in range(0, len(x), m):
        b = a + m
        if a > 0:
            for i in range(a, b):
                for j in range(before.shape[1]):
                    before[i, j] = kept[i] * after[i - m, j]
        r, u, n, q = gates[0, a:b], gates[1, a:b], gates[2, a:b], gates[3, a:b]
        _remember(before[a:b], gru, net, r, u, n, q, products, after[a:b])


@routine
def _through_layers(which, x, after, table, net, tile, layers, d, gradient, sums):
    """Loss of one network, and its gradient d with respect to the memories after each step."""
    chosen, advantages, samples, recipe, share = tile
    joined, room = layers
    inputs, size = x.shape[1], after.shape[1]
    for a in range(0, len(x), TILE):
        b = min(a + TILE, len(x))
        both = _joined(x[a:b], after[a:b], joined[0])
        y = forward(both, table, net, room[0])
        if which == 0:
            log_std, slope = log_std_of(net[0], table), log_std_of(gradient, table)
            delta, A = _matrix(room[1][0], b - a, y.shape[1]), advantages[a:b]
            policy_loss(y, log_std, chosen[a:b], samples, A, recipe, share, delta, slope, sums)
        else:
            value_loss(y, chosen[a:b], samples[3], recipe, share, room[1][0], sums)
        delta = backward(both, table, net, room, gradient)
        through = _matrix(joined[1], b - a, inputs + size)
        np.dot(delta, weights(net[0], table[0], OUTPUTS, INPUTS), through)
        for i in range(a, b):
            for j in range(size):
                d[i, j] = through[i - a, inputs + j]


@routine
def _run_back(run, gru, net, gates, products, d, product, gradient):
    """Add the gradient of a GRU, given the one with respect to its memories, d (rows, units)."""
    x, before, _, kept, m = run
    late = products[3, :m]
    late[:] = _ZERO
    for a in range(len(x) - m, -1, -m):
        b = a + m
        r, u, n, q = gates[0, a:b], gates[1, a:b], gates[2, a:b], gates[3, a:b]
        _recall(before[a:b], gru, net, r, u, n, q, products, d[a:b], late)
        for i in range(m):
            for j in range(late.shape[1]):
                late[i, j] *= kept[a + i]
    for a in range(0, len(x), TILE):
        b = min(a + TILE, len(x))
        for k in range(3):
            add_gradient(gates[k, a:b], x[a:b], gru[k], product, gradient)
            slope = gates[HIDDEN if k == CANDIDATE else k, a:b]
            add_gradient(slope, before[a:b], gru[3 + k], product, gradient)


@entry
def evaluate(x, model, rooms, memory, means, values, after):
    """Evaluate both networks on observations x (n, o) and memories (2, n, units).

    Writes means (n, a), values (n,), and the memories `after`.
    """
    net, actor, critic = model
    inputs, _, gates, products, joined, outputs, _, _ = rooms
    kept = np.empty(0, np.float32)  # of later steps, of which there are none
    for a in range(0, len(x), TILE):
        b = min(a + TILE, len(x))
        for which in range(2):
            gru, table = (actor, critic)[which]
            seen = _matrix(inputs[0], b - a, gru[0, INPUTS])
            for i in range(b - a):
                for j in range(seen.shape[1]):
                    seen[i, j] = x[a + i, j]
            now = after[which, a:b]
            run = (seen, memory[which, a:b], now, kept, b - a)
            _run(run, gru, net, gates[0], products[0])
            y = forward(_joined(seen, now, joined[0, 0]), table, net, outputs[0])
            if which == 0:
                means[a:b] = y
            else:
                values[a:b] = y[:, 0]


differentiate = differentiating(_differentiate_tile, SEQUENCES)

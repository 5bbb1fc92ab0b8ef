"""Keys of random streams from seeds, for all flights at once.

A key is the first two words of `numpy.random.Generator(PCG64(seed))`, as Gymnasium makes it. The
constants and steps are those of NumPy's `SeedSequence` and `PCG64`, on arrays.
"""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from quad_gym.params import checks as check

Words = NDArray[np.uint64]
Halves = NDArray[np.uint32]

_POOL = 4  #: words of 32 bits that hold a seed's entropy
_CHUNK = 1 << 13  #: seeds whose words stay in the cache
_WORD, _HALF = np.uint64(2**32 - 1), np.uint64(32)
_MULTIPLIER = 2549297995355413924 << 64 | 4865540595714422341  #: of PCG64
_BY_HAND = 1 << 32 * _POOL  #: seeds from here on have more words


def stream_key(rng: np.random.Generator) -> Words:
    """Draw the key of a flight's random stream, (2,) words."""
    return rng.integers(0, 2**64, size=2, dtype=np.uint64, endpoint=False)


def stream_keys(seeds: Sequence[int | None]) -> Words:
    """Return keys (n, 2) for flights seeded one by one; None uses fresh entropy."""
    checked = [check.seed("seeds", seed) for seed in seeds]
    small = [0 if seed is None or seed >= _BY_HAND else seed for seed in checked]
    if max(small, default=0) < 1 << 63:
        keys = keys_of(np.array(small, np.uint64))
    else:
        keys = keys_of(*(np.array([s >> k & 2**64 - 1 for s in small], np.uint64) for k in (0, 64)))
    for flight, seed in enumerate(checked):
        if seed is None or seed >= _BY_HAND:
            keys[flight] = stream_key(np.random.Generator(np.random.PCG64(seed)))
    return keys


def keys_of(low: Words, high: Words | int = 0) -> Words:
    """Return keys (n, 2) of the seeds `low + 2**64 high`, (n,) each."""
    high = np.broadcast_to(np.asarray(high, np.uint64), low.shape)
    keys, one = np.empty((len(low), 2), np.uint64), np.uint64(1)
    for first in range(0, len(low), _CHUNK):
        chunk = slice(first, first + _CHUNK)
        state_high, state_low, sequence_high, sequence_low = _state_words(low[chunk], high[chunk])
        increment = sequence_high << one | sequence_low >> np.uint64(63), sequence_low << one | one
        state = _stepped(_added(increment, (state_high, state_low)), increment)
        for k in range(2):
            state = _stepped(state, increment)
            mixed, turn = state[0] ^ state[1], state[0] >> np.uint64(58)
            keys[chunk, k] = mixed >> turn | mixed << (-turn & np.uint64(63))
    return keys


def _state_words(low: Words, high: Words) -> list[Words]:
    """Return the four words (n,) that `SeedSequence` generates for a seed of four half words."""
    constant = 0x43B0D7E5

    def hashed(value: Halves, factor: int) -> Halves:
        nonlocal constant
        value = value ^ np.uint32(constant)
        constant = constant * factor & 2**32 - 1
        value *= np.uint32(constant)
        value ^= value >> np.uint32(16)
        return value

    entropy = [half.astype(np.uint32) for word in (low, high) for half in (word, word >> _HALF)]
    pool = [hashed(half, 0x931E8875) for half in entropy]
    for source in range(_POOL):
        for target in range(_POOL):
            if source != target:
                right = hashed(pool[source], 0x931E8875) * np.uint32(0x4973F715)
                mixed = pool[target] * np.uint32(0xCA01F9DD) - right
                pool[target] = mixed ^ mixed >> np.uint32(16)
    constant = 0x8B51F9DD
    halves = [hashed(pool[k % _POOL], 0x58F38DED).astype(np.uint64) for k in range(8)]
    return [halves[k] | halves[k + 1] << _HALF for k in range(0, 8, 2)]


def _stepped(state: tuple[Words, Words], increment: tuple[Words, Words]) -> tuple[Words, Words]:
    """Return the next state of PCG64, as its high and low words."""
    a, b = np.uint64(_MULTIPLIER >> 64), np.uint64(_MULTIPLIER & 2**64 - 1)
    high, low = state
    b0, b1, l0, l1 = b & _WORD, b >> _HALF, low & _WORD, low >> _HALF
    middle = l0 * b1 + (l0 * b0 >> _HALF)
    carry = l1 * b0 + (middle & _WORD)
    product = high * b + low * a + l1 * b1 + (middle >> _HALF) + (carry >> _HALF)
    return _added((product, low * b), increment)


def _added(x: tuple[Words, Words], y: tuple[Words, Words]) -> tuple[Words, Words]:
    """Return the sum of numbers of 128 bits, as its high and low words."""
    low = x[1] + y[1]
    return x[0] + y[0] + (low < y[1]), low

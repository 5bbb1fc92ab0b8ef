"""Random numbers for tasks: one stream per flight, independent of the other flights.

Threefry-2x64 with 13 rounds, as in `quad_gym.kernels.maths.random`, on NumPy arrays of keys. The
key is the key of the flight, modified so that tasks and kernels never share a draw; the counter
consists of the instant and the number of the draw.
"""

import math
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

Words = NDArray[np.uint64]

_PARITY = np.uint64(0x1BD11BDAA9FC1A22)
_ROTATIONS = ((16, 42, 12, 31), (16, 32, 24, 21), (16, 42, 12, 31), (16,))
_OURS = np.uint64(0x9E3779B97F4A7C15)
"""Constant that makes the keys of tasks differ from the keys of the kernels."""


def threefry(key0: Words, key1: Words, counter0: Words, counter1: Words) -> tuple[Words, Words]:
    """Generate two random words from a two-word key and counter (J. Salmon et al., SC 2011)."""
    keys = (key0, key1, key0 ^ key1 ^ _PARITY)
    a, b = counter0 + key0, counter1 + key1
    for group, rotations in enumerate(_ROTATIONS):
        if group:
            a = a + keys[group % 3]
            b = b + keys[(group + 1) % 3] + np.uint64(group)
        for places in rotations:
            a = a + b
            b = ((b << np.uint64(places)) | (b >> np.uint64(64 - places))) ^ a
    return a, b


class FlightRandom:
    """Random number generator with a separate stream for each flight.

    Its methods correspond to NumPy's generator. Row i of every result is drawn from the stream of
    flight i at its present instant, so the numbers of a flight do not depend on the batch size.
    Each method of a task, by its number, draws other numbers.
    """

    def __init__(self, keys: Words, instants: Words, method: int) -> None:
        self._key0, self._key1 = keys[:, 0] ^ _OURS, keys[:, 1]
        self._instants = instants
        self._next = method << 32

    def random(self, size: int | tuple[int, ...] | None = None) -> NDArray[np.float64]:
        """Draw uniform numbers in [0, 1).

        Args:
            size: Shape, whose first axis must have the length n; None: (n,).

        Raises:
            ValueError: If the first axis has another length.
        """
        count = len(self._instants)
        shape = (count,) if size is None else (size,) if isinstance(size, int) else tuple(size)
        if not shape or shape[0] != count:
            raise ValueError(f"size must begin with the number of flights, {count}, got {size}")
        columns = math.prod(shape[1:])
        draws = np.arange(self._next, self._next + columns, dtype=np.uint64)
        self._next += columns
        a, _ = threefry(
            self._key0[:, np.newaxis],
            self._key1[:, np.newaxis],
            self._instants[:, np.newaxis],
            draws[np.newaxis],
        )
        return np.ascontiguousarray((a >> np.uint64(11)) * 2.0**-53).reshape(shape)

    def uniform(
        self, low: ArrayLike = 0.0, high: ArrayLike = 1.0, size: int | tuple[int, ...] | None = None
    ) -> NDArray[np.float64]:
        """Draw uniform numbers in [low, high); see `random` for `size`."""
        floor = np.asarray(low, np.float64)
        return np.asarray(floor + (np.asarray(high, np.float64) - floor) * self.random(size))

    def normal(
        self,
        loc: ArrayLike = 0.0,
        scale: ArrayLike = 1.0,
        size: int | tuple[int, ...] | None = None,
    ) -> NDArray[np.float64]:
        """Draw normal numbers with mean `loc` and standard deviation `scale`, as `random` does."""
        radius = np.sqrt(-2.0 * np.log(1.0 - self.random(size)))
        mean, sigma = np.asarray(loc, np.float64), np.asarray(scale, np.float64)
        return np.asarray(mean + sigma * (radius * np.cos(2.0 * np.pi * self.random(size))))

    def integers(
        self, low: int, high: int | None = None, size: int | tuple[int, ...] | None = None
    ) -> NDArray[np.int64]:
        """Draw integers in [low, high), or in [0, low) without `high`; see `random` for `size`."""
        first, end = (0, low) if high is None else (low, high)
        if end <= first:
            raise ValueError(f"high must be greater than low, got {low} and {high}")
        return np.floor(first + (end - first) * self.random(size)).astype(np.int64)

    def __getattr__(self, name: str) -> Any:
        raise AttributeError(
            f"the generator of a task has random, uniform, normal and integers, not {name}"
        )

"""Statistics over few training seeds: interquartile means, bootstrap intervals, worst cases.

The methods that R. Agarwal and others, "Deep reinforcement learning at the edge of the statistical
precipice", NeurIPS 2021, recommend for a handful of trainings. Numbers have the shape (s, e): a
row for each training seed, a column for each episode; column i is the same episode in every row and
in every arm.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

Floats = NDArray[np.float64]
Score = Callable[[Floats], Floats]
"""From numbers (..., e) of episodes to one number (...)."""

RESAMPLES = 2000
_AT_A_TIME = 4_000_000


class Estimated(NamedTuple):
    """A number and its interval."""

    value: float
    low: float
    high: float

    def apart(self, other: "Estimated") -> bool:
        """Whether the intervals have nothing in common."""
        return self.low > other.high or self.high < other.low


def mean(values: Floats) -> Floats:
    """Mean over the last axis."""
    return np.asarray(np.mean(values, axis=-1))


def worst_tenth(values: Floats) -> Floats:
    """Mean of the lowest tenth along the last axis, of at least one number (CVaR at 10 %)."""
    count = max(1, round(0.1 * values.shape[-1]))
    return np.asarray(np.partition(values, count - 1, axis=-1)[..., :count].mean(axis=-1))


def interquartile_mean(scores: ArrayLike, axis: int = -1) -> Floats:
    """Mean of the middle half; a quarter of the numbers, rounded down, is cut at either end."""
    from scipy.stats import trim_mean

    return np.asarray(trim_mean(np.asarray(scores, np.float64), 0.25, axis=axis))


def estimated(
    values: ArrayLike,
    score: Score = mean,
    *,
    probability: float = 0.95,
    resamples: int = RESAMPLES,
    seed: int = 0,
) -> Estimated:
    """Interquartile mean over training seeds of a score over episodes, with a bootstrap interval.

    Seeds and episodes are drawn anew with replacement in every resample, the same episodes for all
    seeds of it, so that the interval covers both. With a single seed, as of a fixed rule, it covers
    the episodes.

    Args:
        values: (s, e) one number for each seed and episode.
        score: Of the episodes.
        probability: Of the interval, by percentiles.
        resamples: How many.
        seed: Of the resampling.

    Raises:
        ValueError: If there are no values, or not all are finite.
    """
    x = _checked(values)
    rng = np.random.default_rng(seed)
    found = np.empty(resamples)
    step = max(1, _AT_A_TIME // x.size)
    for first in range(0, resamples, step):
        count = min(step, resamples - first)
        episodes = rng.integers(x.shape[1], size=(count, x.shape[1]))
        scores = score(x[:, episodes])  # (s, count)
        seeds = rng.integers(len(x), size=(len(x), count))
        drawn = np.take_along_axis(scores, seeds, axis=0)
        found[first : first + count] = interquartile_mean(drawn, axis=0)
    tail = 50.0 * (1.0 - probability)
    low, high = np.percentile(found, [tail, 100.0 - tail])
    return Estimated(float(interquartile_mean(score(x))), float(low), float(high))


def probability_of_improvement(
    first: ArrayLike, second: ArrayLike, *, resamples: int = RESAMPLES, seed: int = 0
) -> Estimated:
    """How probable it is that a training of the first arm scores above one of the second.

    P = mean over pairs of 1 (above), 1/2 (equal) or 0: the Mann-Whitney statistic over the number
    of pairs. Its 95 % interval is a bootstrap over the trainings of each arm.

    Args:
        first: (s,) one score per training.
        second: (t,) likewise.
        resamples: How many.
        seed: Of the resampling.

    Raises:
        ValueError: If there are no scores, or not all are finite.
    """
    a, b = _checked(first)[0], _checked(second)[0]
    above = (a[:, np.newaxis] > b) + 0.5 * (a[:, np.newaxis] == b)
    rng = np.random.default_rng(seed)
    rows = rng.integers(a.size, size=(resamples, a.size, 1))
    columns = rng.integers(b.size, size=(resamples, 1, b.size))
    low, high = np.percentile(above[rows, columns].mean(axis=(1, 2)), [2.5, 97.5])
    return Estimated(float(above.mean()), float(low), float(high))


def _checked(values: ArrayLike) -> NDArray[Any]:
    x = np.atleast_2d(np.asarray(values, np.float64))
    if x.ndim != 2 or x.size == 0 or not np.isfinite(x).all():
        raise ValueError(f"values must be finite numbers (seeds, episodes), got {x.shape}")
    return x

"""Confidence intervals of 95 % for all tables, without resampling.

| quantity | interval |
|---|---|
| a mean of independent values, or of paired differences | Student's t |
| a mean over trainings that fly the same episodes | Student's t of each, added in squares |
| a rate over episodes | Clopper and Pearson's |
| a rate over trainings that fly the same episodes | the Bayesian bootstrap's, with a floor |
| a difference of two estimates | MOVER, from the limits of both |
| the probability of improvement | Newcombe's |

Student's t interval covers the mean of normal values with a probability of 95 %, of any number of
them. Of strongly skewed values (lognormal, sigma 1) it covers 89 % with 2, 82 % with 5, 84 % with
10, 92 % with 100 and 95 % with 1,000; a bootstrap is no better (89 % with 20). Trainings are
averaged with equal weights: an interquartile mean of five discards two of them, and its interval
(Yuen's) is half as wide again for normal values.

Where numbers have the shape (s, e), rows are trainings, one for each seed, and columns are
episodes; column i is the same episode in every row and in every arm. Intervals of means over both
cover 95 % of scores that vary smoothly, and up to 99 % of equal ones; those of rates also hold
where a share of the trainings fails, 93 % or more (`tests.statistical.interval_coverage`).
"""

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from quad_gym.analysis.metrics import Interval, Spread, spread
from quad_gym.params import checks as check

Floats = NDArray[np.float64]
Score = Callable[[Floats], Floats]  #: from numbers (..., e) of episodes to one number (...)

TAIL = 0.025  #: probability beyond either end of an interval
FLOOR = 0.5  #: weight of a training with rate 0, and of one with rate 1, in `rate_over_trainings`


class Estimated(NamedTuple):
    """A number with its 95 % interval."""

    value: float
    low: float
    high: float

    def holds(self, value: float) -> bool:
        """Return True if a value lies in the interval, its ends included."""
        return self.low <= value <= self.high


def in_brackets(
    value: float, interval: tuple[float, float] | None, form: str, scale: float = 1.0
) -> str:
    """Format a number and, in brackets, its interval; None: the number alone."""
    text = f"{scale * value:{form}}"
    if interval is None:
        return text
    low, high = (scale * limit for limit in interval)
    return f"{text} [{low:{form}}, {high:{form}}]"


def mean(values: Floats) -> Floats:
    """Mean over the last axis."""
    return np.asarray(np.mean(values, axis=-1))


def worst_tenth(values: Floats) -> Floats:
    """Mean of the lowest tenth along the last axis, of at least one number (CVaR at 10 %).

    Of n normal values it is too high by 0.22 sigma (n = 10), 0.12 (20) or 0.02 (100).
    """
    count = max(1, round(0.1 * values.shape[-1]))
    return np.asarray(np.partition(values, count - 1, axis=-1)[..., :count].mean(axis=-1))


def mean_interval(values: ArrayLike) -> Interval:
    """Student's t interval of the mean of (n,) independent finite numbers, at least two."""
    x = np.asarray(values, np.float64).reshape(-1)
    if x.size < 2 or not np.isfinite(x).all():
        raise ValueError(f"values must be at least two finite numbers, got {x.size}")
    center, half = _center(x), _half_width(_variance(x) / x.size, x.size - 1)
    return Interval(center - half, center + half)


def rate_interval(count: float, trials: float) -> Interval:
    """Clopper and Pearson's interval of a rate; it covers at least 95 %.

    Args:
        count: Events, such as crashes; not necessarily whole.
        trials: Independent episodes.
    """
    from scipy.special import betaincinv

    n = check.positive("trials", trials)
    k = check.number("count", count, least=0.0, most=n)
    low = float(betaincinv(k, n - k + 1.0, TAIL)) if k > 0.0 else 0.0
    high = float(betaincinv(k + 1.0, n - k, 1.0 - TAIL)) if k < n else 1.0
    return Interval(low, high)


def mean_over_trainings(values: ArrayLike, score: Score = mean) -> Estimated:
    """Mean over trainings of a score over episodes, with an interval that covers both.

    Its half width is the root of the sum of squares of two: Student's t of the trainings' scores,
    and Student's t of the episodes, by the jackknife over them. With one training, as of a fixed
    rule, the interval covers the episodes alone. Of `worst_tenth`, the degrees of freedom are the
    episodes in the tenth: the interval then covers 91 % (10 normal episodes), 88 % (20), 92 % (50),
    93 % (100) and 94 % (200).

    Args:
        values: (s, e) one finite number for each training and episode, at least two.
        score: Of the episodes.
    """
    x = np.atleast_2d(np.asarray(values, np.float64))
    if x.ndim != 2 or x.size < 2 or not np.isfinite(x).all():
        raise ValueError(f"values must be finite numbers (trainings, episodes), got {x.shape}")
    scores, (s, e) = score(x), x.shape
    between = _half_width(_variance(scores) / s, s - 1) if s > 1 else 0.0
    freedom = max(1, round(0.1 * e)) if score is worst_tenth else e - 1
    within = _half_width(_variance_over_episodes(x, score), freedom) if e > 1 else 0.0
    value, half = _center(scores), math.hypot(between, within)
    return Estimated(value, value - half, value + half)


def rate_over_trainings(rates: ArrayLike, episodes: int) -> Estimated:
    """Mean over trainings of a rate, with an interval that covers trainings and episodes.

    It is the interval of the Bayesian bootstrap (D. B. Rubin, The Annals of Statistics 9, 1981)
    over trainings, with two further trainings of half a weight each, whose rates are 0 and 1: the
    floor, Jeffreys' prior of a proportion, as trainings of equal rates do not exclude that others
    fail. No crash in any of five trainings has the interval from 0 to 37 %. A beta distribution
    with the same mean and variance stands for the bootstrap's; the variance over episodes, which
    all trainings share, is added. One rate has Clopper and Pearson's interval over episodes.

    Args:
        rates: (s,) the rate of each training, from 0 to 1; one for a fixed rule.
        episodes: Flown with each.
    """
    x = np.asarray(rates, np.float64).reshape(-1)
    if x.size == 0 or not ((x >= 0.0) & (x <= 1.0)).all():
        raise ValueError(f"rates must be at least one number between 0 and 1, got {rates!r}")
    check.whole("episodes", episodes)
    from scipy.special import betaincinv

    value = _center(x)
    if x.size == 1:
        return Estimated(value, *rate_interval(value * episodes, episodes))
    weight = x.size + 2.0 * FLOOR
    center = (x.sum() + FLOOR) / weight
    of_one = center * (1.0 - center)
    trainings = ((x @ x + FLOOR) / weight - center**2) / (weight + 1.0)
    total = of_one / (trainings + of_one / episodes) - 1.0
    low, high = (
        float(betaincinv(center * total, (1.0 - center) * total, p)) for p in (TAIL, 1.0 - TAIL)
    )
    return Estimated(value, min(low, value) if value else 0.0, max(high, value) if value < 1 else 1)


def difference(first: Estimated, second: Estimated) -> Estimated:
    """First less second, of two independent estimates, by the limits of both.

    The interval is the MOVER of G. Y. Zou and A. Donner, Statistics in Medicine 27, 2008; of two
    rates, it is Newcombe's. Two arms that are equal differ by it with a probability of at most 5 %:
    1 % with three trainings each, 2 % with five (simulated with normal scores).
    """
    value = first.value - second.value
    below = math.hypot(first.value - first.low, second.high - second.value)
    above = math.hypot(first.high - first.value, second.value - second.low)
    return Estimated(value, value - below, value + above)


@dataclass(frozen=True)
class PairedDifference:
    """Difference of a number between two cases with the same seeds."""

    spread: Spread
    """of first less second, seed by seed"""
    interval: Interval | None
    """95 % interval of the mean difference, by Student's t; None for fewer than two seeds"""

    @property
    def significant(self) -> bool:
        """True if the interval excludes zero; with equal cases the probability is 5 %."""
        return self.interval is not None and not self.interval.holds(0.0)


def paired_difference(first: ArrayLike, second: ArrayLike) -> PairedDifference:
    """Compare two cases seed by seed, so that the effect of a seed on both cancels.

    Both have one number for each of these seeds, (n,); a seed with a NaN is left out.
    """
    a, b = np.asarray(first, np.float64), np.asarray(second, np.float64)
    if a.shape != b.shape or a.ndim != 1:
        raise ValueError(f"first and second must have shape (n,), got {a.shape} and {b.shape}")
    differences = (a - b)[np.isfinite(a - b)]
    interval = mean_interval(differences) if differences.size > 1 else None
    return PairedDifference(spread=spread(differences), interval=interval)


def probability_of_improvement(first: ArrayLike, second: ArrayLike) -> Estimated:
    """Probability that a training of the first arm scores above one of the second.

    P = mean over pairs of 1 (above), 1/2 (equal) or 0: the Mann-Whitney statistic over the number
    of pairs. The interval is by R. G. Newcombe, Statistics in Medicine 25, 2006 (method 5). There
    is one score per training, (s,) and (t,).
    """
    from scipy.optimize import brentq

    a, b = (np.asarray(scores, np.float64).reshape(-1) for scores in (first, second))
    if not (a.size and b.size and np.isfinite(a).all() and np.isfinite(b).all()):
        raise ValueError(f"scores must be finite numbers, got {a.size} and {b.size} of them")
    P = float(((a[:, np.newaxis] > b) + 0.5 * (a[:, np.newaxis] == b)).mean())
    z, half = _t(math.inf), 0.5 * (a.size + b.size) - 1.0

    def excess(p: float) -> float:
        """Squared distance of p from P minus z^2 variances."""
        terms = 1.0 + half * ((1.0 - p) / (2.0 - p) + p / (1.0 + p))
        return (p - P) ** 2 - z**2 * p * (1.0 - p) * terms / (a.size * b.size)

    end = 1e-9  # where P is 0 or 1, that is a root, too, and not the one
    low = brentq(excess, 0.0, min(P, 1.0 - end)) if P > 0.0 else 0.0
    high = brentq(excess, max(P, end), 1.0) if P < 1.0 else 1.0
    return Estimated(P, float(low), float(high))


def _center(x: Floats) -> float:
    """Mean, exact for equal numbers."""
    return float(x[0] + (x - x[0]).mean())


def _variance(x: Floats) -> float:
    """Variance with n - 1, exactly zero for equal numbers."""
    return float((x - x[0]).var(ddof=1))


def _variance_over_episodes(x: Floats, score: Score) -> float:
    """Variance of the mean score due to the choice of episodes, by the jackknife."""
    e = x.shape[1]
    if score is mean:  # in closed form
        return _variance(x.mean(axis=0)) / e
    left = np.array([float(score(np.delete(x, j, axis=1)).mean()) for j in range(e)])
    return (e - 1) ** 2 / e * _variance(left)


def _half_width(variance: float, freedom: float) -> float:
    """Half width of Student's t interval of a number with this variance."""
    return _t(freedom) * math.sqrt(variance)


def _t(freedom: float) -> float:
    """Upper quantile of Student's t; of the normal distribution with infinite freedom."""
    from scipy.special import ndtri, stdtrit

    return float(ndtri(1.0 - TAIL) if math.isinf(freedom) else stdtrit(freedom, 1.0 - TAIL))

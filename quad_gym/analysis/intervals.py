"""Confidence intervals of 95 % for all tables, without resampling.

| quantity | interval |
|---|---|
| a mean of independent values, or of paired differences | Student's t |
| a rate over episodes | Clopper and Pearson's |
| a rate over trainings that fly the same episodes | the Bayesian bootstrap's, with a worst case |

Student's t interval covers the mean of normal values with a probability of 95 %, of any number of
them. Of strongly skewed values (lognormal, sigma 1) it covers 89 % with 2, 82 % with 5, 84 % with
10, 92 % with 100 and 95 % with 1,000; a bootstrap is no better (89 % with 20). Trainings are
averaged with equal weights: an interquartile mean of five discards two of them, and its interval
(Yuen's) is half as wide again for normal values.

Intervals of rates over trainings cover 95 % or more, also where a share of the trainings fails
(`tests.statistical.interval_coverage`).
"""

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from quad_gym.analysis.metrics import Interval, Spread, spread
from quad_gym.params import checks as check

Floats = NDArray[np.float64]

TAIL = 0.025  #: probability beyond either end of an interval


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


def mean_interval(values: ArrayLike) -> Interval:
    """Student's t interval of the mean of (n,) independent finite numbers, at least two."""
    x = np.asarray(values, np.float64).reshape(-1)
    if x.size < 2 or not np.isfinite(x).all():
        raise ValueError(f"values must be at least two finite numbers, got {x.size}")
    center, half = center_of(x), half_width(variance_of(x) / x.size, x.size - 1)
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


def rate_over_trainings(rates: ArrayLike, episodes: int) -> Estimated:
    """Mean over trainings of a rate, with an interval that covers trainings and episodes.

    Each end is that of the Bayesian bootstrap (D. B. Rubin, The Annals of Statistics 9, 1981) over
    trainings with one more, the worst case: for the lower end a training with rate 0, for the upper
    end one with rate 1 (N. Gaffke, 2005; E. Learned-Miller and P. S. Thomas, 2019). If all
    trainings have rates of 0 or 1, it is Clopper and Pearson's interval over trainings. No crash
    in any of five trainings has the interval from 0 to 52 %. A beta distribution with the same mean
    and variance stands for the bootstrap's; the variance over episodes, which all trainings share,
    is added. One rate has Clopper and Pearson's interval over episodes.

    Args:
        rates: (s,) the rate of each training, from 0 to 1; one for a fixed rule.
        episodes: Flown with each.
    """
    x = np.asarray(rates, np.float64).reshape(-1)
    if x.size == 0 or not ((x >= 0.0) & (x <= 1.0)).all():
        raise ValueError(f"rates must be at least one number between 0 and 1, got {rates!r}")
    check.whole("episodes", episodes)
    value = center_of(x)
    if x.size == 1:
        return Estimated(value, *rate_interval(value * episodes, episodes))
    low = _bootstrap_quantile(np.append(x, 0.0), episodes, TAIL) if x.any() else 0.0
    high = _bootstrap_quantile(np.append(x, 1.0), episodes, 1.0 - TAIL) if (x < 1.0).any() else 1.0
    return Estimated(value, min(low, value), max(high, value))


def _bootstrap_quantile(rates: Floats, episodes: int, probability: float) -> float:
    """Quantile of the mean rate under the Bayesian bootstrap, with the variance over episodes."""
    from scipy.special import betaincinv

    center = float(rates.mean())
    of_one = center * (1.0 - center)
    variance = float(((rates - center) ** 2).mean()) / (rates.size + 1.0)
    total = of_one / (variance + of_one / episodes) - 1.0
    return float(betaincinv(center * total, (1.0 - center) * total, probability))


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


def center_of(x: Floats) -> float:
    """Mean, exact for equal numbers."""
    return float(x[0] + (x - x[0]).mean())


def variance_of(x: Floats) -> float:
    """Variance with n - 1, exactly zero for equal numbers."""
    return float((x - x[0]).var(ddof=1))


def half_width(variance: float, freedom: float) -> float:
    """Half width of Student's t interval of a number with this variance."""
    from scipy.special import stdtrit

    return float(stdtrit(freedom, 1.0 - TAIL)) * math.sqrt(variance)

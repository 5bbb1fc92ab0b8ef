"""Metrics of tracking and of filter consistency, and confidence intervals.

Errors of flights are arrays whose last axis is time; numbers over seeds are arrays with one entry
per flight. The filter's error has 15 coordinates in the order of its covariance: position,
velocity, attitude (the 3-1-2 Euler angles e with R_BI = R(e) R_hat; with optical flow alone, the
rotation vector e with R_BI = exp(-[e x]) R_hat), accelerometer bias, gyro bias; each is truth minus
estimate.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from quad_gym.params import checks as check
from quad_gym.records import Ending
from quad_gym.rotations import dcm_to_euler, dcm_to_vector

# --------------------------------------------------------------------------------------------------
# Metrics of tracking and of filter consistency.
# --------------------------------------------------------------------------------------------------

STATE_DIMENSION = 15  #: number of coordinates of the filter's error

NO_CRASHES = (Ending.LAST_GATE, Ending.TASK)
"""Endings before the time limit that do not count as crashes: the last gate, and endings of a
user-defined task."""

Floats = NDArray[np.float64]


class Interval(NamedTuple):
    """Range with an associated confidence or probability."""

    low: float  #: lower end
    high: float  #: upper end

    def holds(self, value: float) -> bool:
        """Return True if a value is in the range, its ends included."""
        return self.low <= value <= self.high


@dataclass(frozen=True)
class TrackingSummary:
    """Mean errors of flights."""

    mean: Floats
    """Means over whole flights, (...,) [unit of the error]"""
    last_half: Floats
    """Means over the last half of flights, without the initial transient, (...,) [unit of the
    error]"""

    def spreads(self, chosen: ArrayLike = True) -> "dict[str, Spread]":
        """Distributions of both means over the flights for which `chosen` is True, by name."""
        parts = {"mean": self.mean, "last_half": self.last_half}
        return {name: spread(values[np.asarray(chosen)]) for name, values in parts.items()}


class RunningSummary:
    """Recorder for a `TrackingSummary` of flights with some instants, which stores only sums."""

    def __init__(self, flights: int, instants: int) -> None:
        self._half = instants // 2
        self._instant = 0
        self._sums, self._counts = np.zeros((2, flights)), np.zeros((2, flights))

    def add(self, error: ArrayLike, counts: ArrayLike = True) -> None:
        """Add the errors of the next instant, (flights,), where `counts` is True."""
        counted = np.broadcast_to(np.asarray(counts, bool), self._sums[0].shape)
        value = np.where(counted, np.asarray(error, np.float64), 0.0)
        parts = slice(0, 2 if self._instant >= self._half else 1)
        self._sums[parts] += value
        self._counts[parts] += counted
        self._instant += 1

    def result(self) -> TrackingSummary:
        """Means so far, (flights,) each; NaN for flights without instants."""
        means = np.full(self._sums.shape, np.nan)
        np.divide(self._sums, self._counts, out=means, where=self._counts > 0)
        return TrackingSummary(mean=means[0], last_half=means[1])


@dataclass(frozen=True)
class Spread:
    """Distribution of a number over seeds; all values are NaN without seeds."""

    count: int
    """seeds"""
    mean: float
    sd: float
    """Sample standard deviation, with n - 1; NaN for a single seed"""
    median: float
    low: float
    """5th percentile"""
    high: float
    """95th percentile"""
    largest: float


def spread(values: ArrayLike) -> Spread:
    """Mean, standard deviation and percentiles of one number per seed, (n,); n may be 0."""
    x = np.asarray(values, np.float64).reshape(-1)
    if x.size == 0:
        return Spread(0, *[float("nan")] * 6)
    # subtracting one value first makes the spread of equal numbers exactly zero
    sd = float((x - x[0]).std(ddof=1)) if x.size > 1 else float("nan")
    low, median, high = (float(p) for p in np.percentile(x, (5.0, 50.0, 95.0)))
    mean = float(x[0] + (x - x[0]).mean())
    return Spread(x.size, mean, sd, median, low, high, float(x.max()))


def state_error(
    truth: Mapping[str, Any], estimate: Mapping[str, Any], *, rotation_vector: bool = False
) -> Floats:
    """Error of the filter in the coordinates of its covariance.

    Truth and estimate have "position", "velocity", "accel_bias", "gyro_bias" (..., 3) and "R_BI"
    (..., 3, 3); position and velocity in I [m], [m/s], biases in B [m/s^2], [rad/s].

    Returns:
        Truth minus estimate, (..., 15); attitude as Euler angles e [rad] with R_BI = R(e) R_hat, or
        as the rotation vector e with R_BI = exp(-[e x]) R_hat (see `SensorSuite.flow_alone`).
    """
    names = ("position", "velocity", "accel_bias", "gyro_bias")
    r, v, b_a, b_g = (np.subtract(truth[name], estimate[name]) for name in names)
    R_hat = np.asarray(estimate["R_BI"], np.float64)
    R = np.asarray(truth["R_BI"], np.float64) @ np.swapaxes(R_hat, -1, -2)
    e = dcm_to_vector(R) if rotation_vector else dcm_to_euler(R)
    return np.concatenate([r, v, e, b_a, b_g], axis=-1, dtype=np.float64)


def nees(errors: ArrayLike, covariances: ArrayLike) -> Floats:
    """Normalized estimation error squared, e^T P^-1 e; n on average for a consistent filter.

    Args:
        errors: Errors of the estimate, (..., n).
        covariances: Covariances of the filter in the same coordinates, (..., n, n).

    Returns:
        NEES, (...,) [-]; of a consistent filter, chi-square distributed with n degrees of freedom.

    Raises:
        ValueError: If the shapes do not fit or a covariance is singular.
    """
    e, P = np.asarray(errors, np.float64), np.asarray(covariances, np.float64)
    if e.ndim < 1 or P.shape[-2:] != (e.shape[-1], e.shape[-1]):
        raise ValueError(
            "covariances must have shape (..., n, n) for errors of shape (..., n), "
            f"got {P.shape} and {e.shape}"
        )
    try:
        weighted = np.linalg.solve(P, e[..., np.newaxis])[..., 0]
    except np.linalg.LinAlgError:
        raise ValueError("covariances must not be singular") from None
    return np.asarray((e * weighted).sum(axis=-1))


def mean_band(
    dimension: int, counts: ArrayLike, probability: float = 0.95
) -> tuple[Floats, Floats]:
    """Probability bands of means of independent NEES or NIS values of a consistent filter.

    Args:
        dimension: Degrees of freedom of one value, 15 for the whole state.
        counts: Number of independent values in each mean, at least 1, (...,).
        probability: Probability that a mean is inside its band; the tails are equal.

    Returns:
        Lower and upper ends, (...,) each.
    """
    n = np.asarray(counts, np.float64)
    _require_probability(probability)
    if dimension < 1 or n.size == 0 or n.min() < 1:
        raise ValueError(f"dimension and counts must be at least 1, got {dimension} and {n}")
    from scipy.stats import chi2

    tail = (1.0 - probability) / 2
    return chi2.ppf(tail, dimension * n) / n, chi2.ppf(1.0 - tail, dimension * n) / n


def chi_square_band(dimension: int, count: int = 1, probability: float = 0.95) -> Interval:
    """Probability band of the mean of `count` values; see `mean_band`."""
    low, high = mean_band(dimension, count, probability)
    return Interval(float(low), float(high))


def chi_square_quantile(dimension: int, probability: float) -> float:
    """Quantile of the NEES of a consistent filter.

    Args:
        dimension: Degrees of freedom, 15 for the whole state.
        probability: Probability that the NEES is below the quantile, between 0 and 1.
    """
    _require_probability(probability)
    if dimension < 1:
        raise ValueError(f"dimension must be at least 1, got {dimension}")
    from scipy.stats import chi2

    return float(chi2.ppf(probability, dimension))


def _require_probability(probability: float) -> None:
    if not 0.0 < probability < 1.0:
        raise ValueError(f"probability must be between 0 and 1, got {probability}")


# --------------------------------------------------------------------------------------------------
# Confidence intervals of 95 % for all tables, without resampling.
#
# | quantity | interval |
# |---|---|
# | a mean of independent values, or of paired differences | Student's t |
# | a rate over episodes | Clopper and Pearson's |
# | a rate over trainings that fly the same episodes | the Bayesian bootstrap's, with a worst case |
#
# Student's t interval covers the mean of normal values with a probability of 95 %, of any number of
# them. Of strongly skewed values (lognormal, sigma 1) it covers 89 % with 2, 82 % with 5, 84 % with
# 10, 92 % with 100 and 95 % with 1,000; a bootstrap is no better (89 % with 20). Trainings are
# averaged with equal weights: an interquartile mean of five discards two of them, and its interval
# (Yuen's) is half as wide again for normal values.
#
# Intervals of rates over trainings cover 95 % or more, also where a share of the trainings fails
# (`tests.statistical.interval_coverage`).
# --------------------------------------------------------------------------------------------------

TAIL = 0.025  #: probability beyond either end of an interval


class Estimated(NamedTuple):
    """A number with its 95 % interval."""

    value: float  #: the number
    low: float  #: lower end of the interval
    high: float  #: upper end of the interval

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

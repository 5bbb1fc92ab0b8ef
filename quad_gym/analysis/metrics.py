"""How well flights followed their reference, and how consistent their filters were.

Errors of flights are arrays whose last axis is time; numbers over seeds are arrays with one entry
a flight. The filter's error has 15 coordinates in the order of its covariance: position, velocity,
attitude (the 3-1-2 Euler angles e with R_BI = R(e) R_hat), accelerometer bias, gyro bias; each is
truth minus estimate.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from quad_gym.rotations import dcm_to_euler

STATE_DIMENSION = 15
"""Coordinates of the filter's error."""

Floats = NDArray[np.float64]


class Interval(NamedTuple):
    """A range with a confidence or probability attached to it."""

    low: float
    high: float

    def holds(self, value: float) -> bool:
        """Return True if a value lies in the range, its ends included."""
        return self.low <= value <= self.high


@dataclass(frozen=True)
class TrackingSummary:
    """Mean errors of flights."""

    mean: Floats
    """(...,) mean over the flight [unit of the error]"""
    last_half: Floats
    """(...,) mean over its last half, where the start is forgotten [unit of the error]"""

    def spreads(self, chosen: ArrayLike = True) -> "dict[str, Spread]":
        """How both means are distributed over flights.

        Args:
            chosen: (...,) bool, which flights count; True: all.
        """
        parts = {"mean": self.mean, "last_half": self.last_half}
        return {name: spread(values[np.asarray(chosen)]) for name, values in parts.items()}


def tracking_summary(errors: ArrayLike) -> TrackingSummary:
    """Mean error of each flight, over all of it and over its last half.

    Args:
        errors: (..., n) error at n instants that are equally far apart, such as meters.

    Returns:
        Means, (...,) each. The last half of an odd number of instants has the middle one.

    Raises:
        ValueError: If there are no instants.
    """
    values = np.asarray(errors, np.float64)
    if values.ndim == 0 or values.shape[-1] == 0:
        raise ValueError(f"errors must have shape (..., n) with n >= 1, got {values.shape}")
    half = values[..., values.shape[-1] // 2 :]
    return TrackingSummary(mean=values.mean(axis=-1), last_half=half.mean(axis=-1))


class RunningSummary:
    """A `TrackingSummary` that is built up instant by instant and keeps nothing but sums.

    Args:
        flights: Number of flights.
        instants: Number of instants that a whole flight has.
    """

    def __init__(self, flights: int, instants: int) -> None:
        self._half = instants // 2
        self._instant = 0
        self._sums, self._counts = np.zeros((2, flights)), np.zeros((2, flights))

    def add(self, error: ArrayLike, counts: ArrayLike = True) -> None:
        """Take in the next instant.

        Args:
            error: (flights,) errors.
            counts: (flights,) whether each of them counts; those of flights that have ended do not.
        """
        counted = np.broadcast_to(np.asarray(counts, bool), self._sums[0].shape)
        value = np.where(counted, np.asarray(error, np.float64), 0.0)
        parts = slice(0, 2 if self._instant >= self._half else 1)
        self._sums[parts] += value
        self._counts[parts] += counted
        self._instant += 1

    def result(self) -> TrackingSummary:
        """Means so far, (flights,) each; NaN where nothing counted."""
        means = np.full(self._sums.shape, np.nan)
        np.divide(self._sums, self._counts, out=means, where=self._counts > 0)
        return TrackingSummary(mean=means[0], last_half=means[1])


@dataclass(frozen=True)
class Spread:
    """Distribution of a number over seeds; all NaN where there are no seeds."""

    count: int
    """seeds"""
    mean: float
    sd: float
    """standard deviation with n - 1; NaN for a single seed"""
    median: float
    low: float
    """5th percentile"""
    high: float
    """95th percentile"""
    largest: float


def spread(values: ArrayLike) -> Spread:
    """Mean, standard deviation and percentiles of one number per seed.

    Args:
        values: (n,) one number a seed; n may be 0.
    """
    x = np.asarray(values, np.float64).reshape(-1)
    if x.size == 0:
        return Spread(0, *[float("nan")] * 6)
    # subtracting one of them first makes the spread of equal numbers exactly zero
    sd = float((x - x[0]).std(ddof=1)) if x.size > 1 else float("nan")
    low, median, high = (float(p) for p in np.percentile(x, (5.0, 50.0, 95.0)))
    mean = float(x[0] + (x - x[0]).mean())
    return Spread(x.size, mean, sd, median, low, high, float(x.max()))


def state_error(truth: Mapping[str, Any], estimate: Mapping[str, Any]) -> Floats:
    """The filter's error in the coordinates of its covariance.

    Args:
        truth: "position", "velocity", "accel_bias", "gyro_bias" (..., 3) and "R_BI" (..., 3, 3);
            position and velocity in I [m], [m/s], biases in B [m/s^2], [rad/s].
        estimate: Likewise, by the filter.

    Returns:
        (..., 15) truth minus estimate, the attitude as Euler angles e [rad] with R_BI = R(e) R_hat.

    Raises:
        KeyError: If a quantity is missing.
    """

    def difference(name: str) -> Floats:
        return np.asarray(truth[name], np.float64) - np.asarray(estimate[name], np.float64)

    R_hat = np.asarray(estimate["R_BI"], np.float64)
    e = dcm_to_euler(np.asarray(truth["R_BI"], np.float64) @ np.swapaxes(R_hat, -1, -2))
    parts = (difference("position"), difference("velocity"), e)
    return np.concatenate([*parts, difference("accel_bias"), difference("gyro_bias")], axis=-1)


def nees(errors: ArrayLike, covariances: ArrayLike) -> Floats:
    """Normalized estimation error squared, e^T P^-1 e; about n on average for a consistent filter.

    Args:
        errors: (..., n) errors of the estimate.
        covariances: (..., n, n) covariances that the filter claims, in the same coordinates.

    Returns:
        (...,) without unit; chi-square distributed with n degrees of freedom if the filter is
        consistent.

    Raises:
        ValueError: If the shapes do not fit or a covariance is singular.

    Source: Y. Bar-Shalom, X.-R. Li, T. Kirubarajan, Estimation with Applications to Tracking and
    Navigation, 2001, section 5.4.
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


def chi_square_band(dimension: int, count: int = 1, probability: float = 0.95) -> Interval:
    """Where the mean of `count` independent NEES values lies if the filter is consistent.

    Args:
        dimension: Degrees of freedom of one value, 15 for the whole state.
        count: How many independent values the mean is of.
        probability: Of the mean to lie in the band; what is left is split evenly.

    Raises:
        ValueError: If a number is out of its range.
    """
    _require_probability(probability)
    if dimension < 1 or count < 1:
        raise ValueError(f"dimension and count must be at least 1, got {dimension} and {count}")
    from scipy.stats import chi2

    tail = (1.0 - probability) / 2
    low, high = chi2.ppf((tail, 1.0 - tail), dimension * count) / count
    return Interval(float(low), float(high))


def chi_square_quantile(dimension: int, probability: float) -> float:
    """The NEES that a consistent filter stays below with a given probability.

    Args:
        dimension: Degrees of freedom, 15 for the whole state.
        probability: Between 0 and 1.

    Raises:
        ValueError: If a number is out of its range.
    """
    _require_probability(probability)
    if dimension < 1:
        raise ValueError(f"dimension must be at least 1, got {dimension}")
    from scipy.stats import chi2

    return float(chi2.ppf(probability, dimension))


def _require_probability(probability: float) -> None:
    if not 0.0 < probability < 1.0:
        raise ValueError(f"probability must be between 0 and 1, got {probability}")

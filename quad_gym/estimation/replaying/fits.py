"""Statistics of the innovations of a sensor.

NIS is the normalized innovation squared, over its degrees of freedom: 1 on average for a consistent
filter. Means include the measurements that the gate has rejected; otherwise a filter that rejects
all that contradicts it would look consistent.
"""

import math
from typing import Any, NamedTuple

import numpy as np

from quad_gym.estimation.logs import Floats
from quad_gym.estimation.replaying.results import Measured

AT_LIMIT = 0.05
"""Probability with which a test rejects what is at the limit of the test; a consistent filter is
far from the limits."""
MIN_COUNT = 50  #: number of innovations that shows their correlation


class Fit(NamedTuple):
    """Innovations of a sensor compared with the filter's predictions."""

    measurements: int
    freedoms: int
    mean_nis: float  #: mean NIS per degree of freedom; 1 for a consistent filter
    median_nis: float
    """median NIS over the median of chi-square; 1 for a consistent filter, and hardly changed by
    outliers"""
    rejected: float  #: share of the measurements that the gate rejects
    correlation: float
    """correlation of successive innovations, the largest of all axes; 0 for a consistent filter"""


def fit_of(measured: Measured, rows: Any = slice(None)) -> Fit | None:
    """Return the statistics of some innovations; None: fewer than three are known."""
    from scipy.stats import chi2

    known = np.isfinite(measured.nis)[rows]
    nis, d = measured.nis[rows][known], measured.innovation.shape[1]
    if len(nis) < 3:
        return None
    rho = correlations((measured.innovation / measured.sigma)[rows][known])
    return Fit(
        len(nis),
        d,
        float(nis.mean() / d),
        float(np.median(nis) / chi2.median(d)),
        float(measured.rejected[rows][known].mean()),
        float(rho[np.argmax(np.abs(rho))]),
    )


def correlations(scaled: Floats) -> Floats:
    """Return the correlation of successive innovations (n, axes) by axis."""
    products = (scaled[:-1] * scaled[1:]).mean(axis=0)
    return np.asarray(products / (scaled**2).mean(axis=0))


def correlation_time(values: Floats) -> float:
    """Return the integrated autocorrelation time of numbers, in samples; 1 if they are white.

    The sum ends with the first correlation that white noise would also have, to three standard
    deviations.
    """
    centered, least = values - values.mean(), max(0.05, 3.0 / math.sqrt(len(values)))
    variance, tau = float((centered**2).mean()), 1.0
    if variance == 0.0:
        return tau
    for lag in range(1, len(values) // 4):
        rho = float((centered[:-lag] * centered[lag:]).mean()) / variance
        if rho < least:
            break
        tau += 2.0 * rho
    return tau


def exceeds(hits: Any, share: float) -> bool:
    """Return True if more than a share of the cases (n,) is certainly True.

    The test is binomial (Clopper and Pearson), with as many independent cases as the
    autocorrelation leaves, and rejects a share at the limit with the probability `AT_LIMIT`.
    """
    from scipy.stats import beta

    hits = np.asarray(hits, np.float64)
    count = len(hits) / correlation_time(hits) if len(hits) else 0.0
    true = float(hits.mean()) * count if count else 0.0
    return true > 0.0 and bool(beta.ppf(AT_LIMIT, true, count - true + 1.0) > share)


def larger(nis: Floats, freedoms: int, ratio: float) -> bool:
    """Return True if the innovations' variance certainly exceeds its prediction by a ratio.

    The median decides, so that outliers do not.
    """
    from scipy.stats import chi2

    return exceeds(nis > ratio * chi2.median(freedoms), 0.5)


def runs_beyond_chance(rejected: Any, probability: float) -> list[tuple[int, int]]:
    """Return first and last rows of the runs of rejections (n,) that chance does not explain.

    Chance has independent outliers that are as frequent as the rejections outside of the run, and
    at least 1 %, and explains a run unless its probability is smaller than the given one.
    """
    edges = np.flatnonzero(np.diff(np.concatenate([[0], np.asarray(rejected, int), [0]])))
    count, total = len(rejected), int(np.sum(rejected))
    found = []
    for begin, end in zip(edges[::2].tolist(), edges[1::2].tolist(), strict=True):
        length = end - begin
        share = max((total - length) / max(count - length, 1), 0.01)
        if count * share**length < probability:
            found.append((begin, end - 1))
    return found

"""Alarm level of the statistical tests, and scores that are standard normal for valid samples."""

import numpy as np
from scipy import stats

ALARM = 1e-6
"""Probability that a valid sample fails one statistical test."""


def alarm_score(scores):
    """Return the bound that any of `scores` standard normals exceeds with probability ALARM."""
    return stats.norm.isf(ALARM / 2 / scores)


def mean_scores(samples, mean, covariance):
    """Return errors of the whitened mean of samples (n, d), in standard deviations."""
    factor = np.linalg.cholesky(covariance)
    return np.linalg.solve(factor, np.mean(samples, axis=0) - mean) * np.sqrt(len(samples))


def covariance_scores(samples, mean, covariance):
    """Return errors of the whitened covariance about a known mean, in standard deviations."""
    white = np.linalg.solve(np.linalg.cholesky(covariance), (samples - mean).T)
    excess = white @ white.T / len(samples) - np.eye(len(white))
    deviation = np.sqrt((1.0 + np.eye(len(white))) / len(samples))
    return (excess / deviation)[np.tril_indices(len(white))]


def assert_normal(samples, mean, covariance):
    """Check mean and covariance of samples (n, d), and that each component is normal."""
    scores = np.concatenate(
        [mean_scores(samples, mean, covariance), covariance_scores(samples, mean, covariance)]
    )
    assert np.abs(scores).max() < alarm_score(scores.size), scores
    white = np.linalg.solve(np.linalg.cholesky(covariance), (samples - mean).T)
    for component in white:
        assert stats.kstest(component, "norm").pvalue > ALARM

"""Alarm levels of the statistical tests, and scores that are standard normal when all is well."""

import numpy as np
from scipy import stats

ALARM = 1e-6
"""The probability that a sound sample fails one statistical test."""


def alarm_score(scores):
    """The size that the largest of `scores` standard normals exceeds with probability ALARM."""
    return stats.norm.isf(ALARM / 2 / scores)


def mean_scores(samples, mean, covariance):
    """How many standard deviations each whitened component of the sample mean (n, d) is off."""
    factor = np.linalg.cholesky(covariance)
    return np.linalg.solve(factor, np.mean(samples, axis=0) - mean) * np.sqrt(len(samples))


def covariance_scores(samples, mean, covariance):
    """The same for each entry of the whitened sample covariance about a known mean."""
    white = np.linalg.solve(np.linalg.cholesky(covariance), (samples - mean).T)
    excess = white @ white.T / len(samples) - np.eye(len(white))
    deviation = np.sqrt((1.0 + np.eye(len(white))) / len(samples))
    return (excess / deviation)[np.tril_indices(len(white))]


def assert_normal(samples, mean, covariance):
    """Samples (n, d) have the mean, the covariance and, one by one, the shape of a normal."""
    scores = np.concatenate(
        [mean_scores(samples, mean, covariance), covariance_scores(samples, mean, covariance)]
    )
    assert np.abs(scores).max() < alarm_score(scores.size), scores
    white = np.linalg.solve(np.linalg.cholesky(covariance), (samples - mean).T)
    for component in white:
        assert stats.kstest(component, "norm").pvalue > ALARM

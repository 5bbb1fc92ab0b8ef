"""Filters with unknown heading: a Gaussian sum, with one Gaussian for each of many headings.

A filter that linearizes about one heading fails if the true heading is far from it. Therefore each
lane of several blocks starts from another heading, with half the spacing as its standard deviation:
their sum is nearly uniform. Each measurement weights the lanes by its likelihood,

    log w += -(nu^T S^-1 nu + log det S) / 2,   det S = det R (det L- / det L+)^2,

where R is the same for all. Acceleration reveals the heading; without it the heading stays unknown.
When the standard deviation of the heading is below `RESOLVED`, a single Gaussian with the mean and
the covariance of the sum takes over.

Source: D. L. Alspach and H. W. Sorenson, IEEE Trans. Automatic Control 17(4), 1972.
"""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from quad_gym.estimation.filtering.engine import Engine
from quad_gym.estimation.filtering.samples import Measurement
from quad_gym.estimation.filtering.starts import FirstEstimate, lower_factor
from quad_gym.rotations import dcm_to_euler, euler_to_dcm

Floats = NDArray[np.float64]

COUNT = 48  #: number of headings; a multiple of the lanes of any machine
SPACING = 2.0 * math.pi / COUNT  #: angle between two headings [rad]
RESOLVED = 0.07  #: standard deviation of the heading below which a single Gaussian takes over [rad]

_VECTORS = ("r_hat", "v_hat", "b_a_hat", "b_g_hat")


class Moments(NamedTuple):
    """Mean and covariance of a sum of Gaussians."""

    vectors: dict[str, Floats]  #: r_hat, v_hat, b_a_hat and b_g_hat (3,), slow_hat (n,)
    R_hat: Floats
    covariance: Floats  #: (15 + n, 15 + n)

    @property
    def heading_sigma(self) -> float:
        """Standard deviation of the heading [rad]."""
        return math.sqrt(self.covariance[8, 8])


def write_starts(engine: Engine, starts: list[FirstEstimate]) -> None:
    """Write first estimates into the lanes of an engine that has just been started."""
    fill = [starts[k % len(starts)] for k in range(engine.lanes)]
    engine.write("r_hat", np.array([s.position for s in fill]))
    engine.write("v_hat", np.array([s.velocity for s in fill]))
    engine.write("R_hat", np.array([s.R_BI for s in fill]))
    engine.write_factors(np.array([s.factor for s in fill]))


def _log_determinant(factors: Floats) -> Floats:
    """Return the log determinant of each lane's covariance, without exactly known errors."""
    diagonal = np.diagonal(factors, axis1=1, axis2=2)
    return 2.0 * np.log(np.where(diagonal > 0.0, diagonal, 1.0)).sum(axis=1)


def update_and_weigh(engine: Engine, measurement: Measurement, log_weights: Floats) -> Floats:
    """Update all lanes with a measurement; return their new weights, normalized."""
    before, failures = _log_determinant(engine.factors()), engine.read("update_failures")
    engine.update(measurement)
    after = _log_determinant(engine.factors())
    nis, dimension = engine.read("nis"), engine.read("nis_dimension")
    if not dimension.any() or not measurement.blocks:
        return log_weights
    in_steps = np.isnan(nis)
    if in_steps.any():  # an image processed in steps: block by block
        blocks = engine.read("block_nis")[:, measurement.blocks]
        nis = np.where(in_steps, np.nansum(blocks, axis=1), nis)
    weights = log_weights - 0.5 * (nis + before - after)
    weights[engine.read("update_failures") > failures] = -np.inf
    if not np.isfinite(weights).any():
        return log_weights
    weights -= weights.max()
    return weights - math.log(np.exp(weights).sum())


def moments(engine: Engine, log_weights: Floats) -> Moments:
    """Return mean and covariance of all lanes; for the attitude, about a mean on the circle."""
    w, n = np.exp(log_weights), engine.slow_states
    R = engine.read("R_hat")
    R_mean, turns = R[int(np.argmax(w))], np.zeros((len(w), 3))
    for _ in range(10):
        turns = dcm_to_euler(R @ R_mean.T)
        R_mean = euler_to_dcm(w @ turns) @ R_mean
    turns = dcm_to_euler(R @ R_mean.T)  # yaw first, so that tilts add up as they are
    means = {name: w @ engine.read(name) for name in _VECTORS}
    slow = engine.read("slow_hat")[:, :n]
    means["slow_hat"] = w @ slow
    apart = [engine.read(name) - means[name] for name in _VECTORS]
    d = np.hstack([*apart[:2], turns, *apart[2:], slow - means["slow_hat"]])
    factors = engine.factors()
    covariance = np.einsum("k,kij,klj->il", w, factors, factors)
    covariance += np.einsum("k,ki,kj->ij", w, d, d)
    return Moments(means, R_mean, covariance)


def collapse(engine: Engine, log_weights: Floats, m: Moments) -> None:
    """Continue with one Gaussian with these moments; other memory comes from the likeliest lane."""
    words = engine.copy()
    best = int(np.argmax(log_weights))
    width = words.shape[2]
    engine.restore(words[best // width, :, best % width][np.newaxis, :, np.newaxis])
    n = engine.slow_states
    for name in _VECTORS:
        engine.fill(name, m.vectors[name])
    engine.fill("R_hat", m.R_hat)
    if n:
        slow = engine.read("slow_hat")
        slow[:, :n] = m.vectors["slow_hat"]
        engine.write("slow_hat", slow)
    values, vectors = np.linalg.eigh(m.covariance)
    factor = lower_factor(vectors * np.sqrt(np.maximum(values, 0.0)))
    engine.write_factors(np.repeat(factor[np.newaxis], engine.lanes, axis=0))

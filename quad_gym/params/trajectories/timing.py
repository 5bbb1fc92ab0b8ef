"""The times of segments, so that a path just stays below bounds of speed and acceleration."""

from collections.abc import Callable

import numpy as np

from quad_gym.params.trajectories.pieces import Floats, derivative

EXPONENTS = (0.5, 0.75, 1.0)
"""Exponents of the first guesses for the durations of segments: powers of their lengths."""

IMPROVED, STEPS = 12, 10
"""Segments up to which their times are improved, and steps of the search: with more, it would take
long and gain a few percent."""

NORM = 20.0
"""Power of the mean that stands for the largest use in the search, which needs derivatives."""

SAMPLES = 24  #: samples of a segment, among which its peaks are looked for first
MARGIN = 1e-9  #: share of the bounds that is left to rounding


def choose_times(
    path: Callable[[Floats], Floats],
    rough: Callable[[Floats], Floats],
    places: Floats,
    max_speed: float,
    max_acceleration: float,
) -> Floats:
    """Return the times (m + 1,) at which points (m + 1, 3) are passed, from 0 on [s].

    The shares of the segments are powers of their lengths, then improved by a search for the
    shortest flight. Velocities scale with 1/s and accelerations with 1/s^2 when all times do with
    s: the whole is scaled so that the largest speed, or the largest acceleration, is its bound.
    `path` makes polynomials (8, m, 3) for times; `rough` approximates it faster, for the search.
    """
    from scipy.optimize import minimize

    def log_duration(logs: Floats, power: float | None = NORM) -> float:
        """Log of the whole time in which the bounds are met, if segments take these shares."""
        times = _times_of(logs)
        terms = rough(times)
        speed, acceleration = (_sampled(times, terms, k).ravel() for k in (1, 2))
        use = np.concatenate([speed / max_speed, np.sqrt(acceleration / max_acceleration)])
        worst = float(use.max())
        soft = 0.0 if power is None else float(np.log(np.mean((use / worst) ** power))) / power
        return float(np.log(worst)) + soft

    lengths = np.log(np.linalg.norm(np.diff(places, axis=0), axis=1))
    first = [power * lengths for power in EXPONENTS]
    logs = min(first, key=lambda x: log_duration(x, None))
    if 1 < len(lengths) <= IMPROVED:
        found = minimize(log_duration, logs, method="L-BFGS-B", options={"maxiter": STEPS}).x
        logs = min((logs, found), key=lambda x: log_duration(x, None))
    times = _times_of(logs)
    terms = path(times)
    speed, acceleration = (peak(times, terms, k) for k in (1, 2))
    stretch = max(speed / max_speed, (acceleration / max_acceleration) ** 0.5)
    return times * (stretch * (1.0 + MARGIN))


def _times_of(logs: Floats) -> Floats:
    """(m + 1,) from 0 to 1, of segments whose times have these logarithms but for a factor."""
    shares = np.exp(np.clip(logs - logs.max(), -12.0, 0.0))
    return np.concatenate([[0.0], np.cumsum(shares / shares.sum())])


def _sampled(times: Floats, terms: Floats, order: int) -> Floats:
    """(samples, m) sizes of a derivative."""
    t = np.linspace(0.0, 1.0, SAMPLES)[:, np.newaxis] * np.diff(times)
    values = np.zeros((*t.shape, terms.shape[2]))
    for row in derivative(terms, order):
        values = values * t[..., np.newaxis] + row
    return np.linalg.norm(values, axis=2)


def peak(times: Floats, terms: Floats, order: int) -> float:
    """The largest size that a derivative has at any time: exactly, by roots of polynomials."""
    sampled, lengths = _sampled(times, terms, order).max(axis=0), np.diff(times)
    rows, largest = derivative(terms, order), float(sampled.max())
    for j in np.flatnonzero(sampled > 0.8 * largest):
        # in shares of the segment, whose coefficients are of like size
        scale = lengths[j] ** np.arange(len(rows) - 1, -1, -1)
        scaled = rows[:, j] * scale[:, np.newaxis]
        square = sum(np.convolve(column, column) for column in scaled.T)
        roots = np.roots(np.polyder(square))
        shares = roots.real[np.abs(roots.imag) < 1e-3].clip(0.0, 1.0)
        if shares.size:
            largest = max(largest, float(np.sqrt(np.polyval(square, shares).max())))
    return largest

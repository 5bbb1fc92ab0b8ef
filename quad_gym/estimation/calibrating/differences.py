"""Derivatives of losses by differences, and what follows from them."""

from collections.abc import Sequence

import numpy as np

from quad_gym.estimation.filtering.engine import Floats

_RIDGE = 0.1  #: relative increase of the diagonal of squared scores, which are estimates


def derivatives(losses: Floats, steps: Floats) -> tuple[Floats, Floats]:
    """Return scores (parts, n), and second derivatives (n,) of the sum over all parts.

    The losses (parts, 1 + 2 n) are at a point, and a step (n,) ahead and back along each axis.
    """
    count = 2 * len(steps) + 1
    ahead, back = losses[:, 1:count:2], losses[:, 2:count:2]
    bends = (ahead + back).sum(axis=0) - 2.0 * losses[:, 0].sum()
    return (ahead - back) / (2.0 * steps), bends / steps**2


def spread_between(losses: Floats, h: Floats, sizes: Sequence[int], length: int) -> Floats:
    """Return the variances (n,) of numbers between logs, from losses as in `derivatives`.

    Each log has its best number one Newton step from the common one; the variance of these beyond
    the uncertainty within each log is the method of moments of DerSimonian and Laird, Controlled
    Clinical Trials 7(3), 1986, with equal weights.
    """
    steps, errors = [], []
    for rows in np.split(losses, np.cumsum(sizes)[:-1]):
        scores, bends = derivatives(rows, h)
        H = np.maximum(bends, 0.0) + 1.0
        sums = np.add.reduceat(scores, np.arange(0, len(scores), length))
        steps.append(-scores.sum(axis=0) / H)
        errors.append((sums**2).sum(axis=0) / H**2)
    if len(steps) < 2:
        return np.zeros(len(h))
    return np.maximum(np.var(steps, axis=0, ddof=1) - np.mean(errors, axis=0), 0.0)


def curvature(scores: Floats, bends: Floats) -> Floats:
    """Return second derivatives with the correlations of the scores."""
    squares = scores.T @ scores
    squares += np.diag(_RIDGE * np.diag(squares) + 1e-9)
    sizes = np.sqrt(np.maximum(bends, 0.0) / np.diag(squares))
    return squares * sizes * sizes[:, np.newaxis]


def lowest(places: Floats, losses: Floats) -> float:
    """Return the minimum of a parabola through the lowest loss on a grid and its neighbors."""
    k = int(np.clip(np.argmin(losses), 1, len(losses) - 2))
    bend, slope, _ = np.polyfit(places[k - 1 : k + 2] - places[k], losses[k - 1 : k + 2], 2)
    reach = float(places[1] - places[0])
    move = -0.5 * slope / bend if bend > 0.0 else 0.0
    return float(places[k] + np.clip(move, -reach, reach))

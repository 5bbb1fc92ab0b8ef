"""Piecewise polynomials that approximate any smooth function of time."""

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from quad_gym.params import checks as check
from quad_gym.params.trajectories.pieces import Floats, Pieces
from quad_gym.params.trajectories.splines import heading_choice, polynomials

Function = Callable[[float], Any]

MIN_SEGMENTS, MAX_SEGMENTS = 16, 8192  #: segments that are tried, each time twice as many


def fit(
    function: Callable[[float], ArrayLike],
    duration: float,
    *,
    closed: bool = False,
    tolerance: float = 1e-6,
    yaw: Callable[[float], float] | float | str | None = None,
    look_at: ArrayLike | None = None,
) -> Pieces:
    """Return a trajectory that approximates any smooth function of time.

    The function is replaced by splines of degree 7, with as many segments as the tolerance
    requires.

    Args:
        function: Position (3,) in I [m] as a function of time [s], from 0 to the duration.
        duration: Duration of the trajectory [s].
        closed: True: the trajectory repeats.
        tolerance: Largest distance from the function [m].
        yaw: Heading of body x: None (east), an angle [rad], "along" the horizontal velocity, or
            a function of time.
        look_at: (2,) or (3,) a point in I that body x faces instead [m].

    Returns:
        The trajectory.

    Raises:
        ValueError: If a function does not return finite numbers, a closed trajectory does not
            return to its start, or the function is not smooth enough.
    """
    span = check.positive("duration", duration, least=1e-3)
    check.flag("closed", closed)
    limit = check.positive("tolerance", tolerance, least=1e-9)
    if not callable(function):
        raise ValueError(f"function must be a function of time, got {function!r}")
    rule, point, angles = heading_choice(yaw, look_at)
    if np.ndim(angles) > 0:
        raise ValueError("yaw must be a number, 'along' or a function of time, got an array")
    if closed:
        begin, end = _called("function", function, [0.0, span], 3)
        if np.abs(end - begin).max() > limit:
            raise ValueError(
                f"function must return to its start where closed=True, got {begin} at 0 s and "
                f"{end} at {span:g} s"
            )
    turns = 0.0
    if callable(angles) and closed:
        whole = _called("yaw", angles, [0.0, span], 1)[:, 0]
        turns = float(np.round((whole[1] - whole[0]) / (2.0 * np.pi)) * 2.0 * np.pi / span)

    def joint(t: float) -> Any:
        if not callable(angles):
            return function(t)
        return np.append(np.asarray(function(t), np.float64), angles(t) - turns * t)

    size = 4 if callable(angles) else 3
    times, found = _fitted(joint, span, size, limit, closed)
    terms = np.zeros((8, len(times) - 1, 4))
    terms[..., :size] = found
    if callable(angles):
        terms[7, :, 3] += turns * times[:-1]
        terms[6, :, 3] += turns
    else:
        terms[7, :, 3] = angles
    return Pieces(times, terms, closed, rule, point)


def _fitted(
    joint: Function, span: float, size: int, limit: float, closed: bool
) -> tuple[Floats, Floats]:
    """Return times (m + 1,) and coefficients (8, m, size) of the coarsest spline within a limit."""
    count, known = MIN_SEGMENTS, dict[float, Floats]()
    while True:
        times = np.linspace(0.0, span, count + 1)
        spline = _spline(times, _values(joint, times, size, known), closed)
        between = 0.5 * (times[:-1] + times[1:])
        miss = float(np.abs(spline(between) - _values(joint, between, size, known)).max())
        if miss <= limit:
            return times, polynomials(spline, times, 7)
        count *= 2
        if count > MAX_SEGMENTS:
            raise ValueError(
                f"function must be smooth: splines of {MAX_SEGMENTS} segments still miss it by "
                f"{miss:.3g} m, tolerance={limit:g} m"
            )


def _called(name: str, function: Function, times: Any, size: int) -> Floats:
    """Return the values (n, size) of a function at times."""
    rows = []
    for t in times:
        label = f"{name}({float(t):g})"
        rows.append(check.array(label, np.atleast_1d(function(float(t))), (size,)))
    return np.array(rows)


def _values(joint: Function, times: Floats, size: int, known: dict[float, Floats]) -> Floats:
    """Return the values of a function at times; times known from before are not evaluated again."""
    new = [t for t in times.tolist() if t not in known]
    if new:
        known.update(zip(new, _called("function", joint, new, size), strict=True))
    return np.array([known[t] for t in times.tolist()])


def _spline(times: Floats, values: Floats, closed: bool) -> Any:
    from scipy.interpolate import make_interp_spline

    if closed:
        values = np.concatenate([values[:-1], values[:1]])
    return make_interp_spline(times, values, k=7, bc_type="periodic" if closed else None)

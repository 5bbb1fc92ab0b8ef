"""Minimum snap and minimum jerk through points.

The motion through given points at given times that has the least integral of its squared k-th
derivative is a spline of degree 2k - 1 with knots at the times, whose derivatives up to the
(2k - 2)-th are continuous. With those up to the (k - 1)-th zero at the ends (at rest), or those
from the k-th on (natural), or repeating, SciPy's interpolating splines are that minimum.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from quad_gym.params import checks as check
from quad_gym.params.trajectories.pieces import Floats, HeadingRule, Pieces
from quad_gym.params.trajectories.timing import choose_times

ORDERS = {"snap": 4, "jerk": 3}  #: order of the derivative that is minimized, by name

MAX_SPEED, MAX_ACCELERATION = 2.5, 3.0
"""Bounds where none are given [m/s], [m/s^2], as in the task of random trajectories."""

PADDING = 6  #: points before and after one round of a closed path, where it is approximated
SHORTEST = 1e-6  #: time between two points, and distance where times are chosen, at least [s], [m]


def through(
    points: ArrayLike,
    times: ArrayLike | None = None,
    *,
    max_speed: float | None = None,
    max_acceleration: float | None = None,
    closed: bool = False,
    minimize: str = "snap",
    at_rest: bool = True,
    yaw: ArrayLike | str | None = None,
    look_at: ArrayLike | None = None,
) -> Pieces:
    """Return the smoothest trajectory through points: least integral of squared snap or jerk.

    It is a spline of degree 7 (5) whose derivatives up to the sixth (fourth) are continuous.

    Args:
        points: (n, 3) in I [m].
        times: (n,) times at which the points are passed, counted from the first [s]; closed: (n
            + 1,), with the return to the first point. None: chosen so that speed and
            acceleration reach their bounds and stay below them.
        max_speed: Bound of the speed for the choice of times [m/s]; default: 2.5.
        max_acceleration: Bound of the acceleration for the choice of times [m/s^2]; default: 3.
        closed: True: the trajectory returns to the first point, and repeats.
        minimize: "snap" (fourth derivative) or "jerk" (third).
        at_rest: True: the trajectory starts and ends at rest; False: the minimum sets the
            velocities at its ends. A closed trajectory ignores this.
        yaw: Heading of body x: None (east), an angle [rad], "along" the horizontal velocity, or
            (n,) an angle at each point.
        look_at: (2,) or (3,) a point in I that body x faces instead [m].

    Returns:
        The trajectory.

    Raises:
        ValueError: If an argument is invalid, such as a single point, two equal points in a row
            where times are to be chosen, or times that do not increase.

    Source: Mellinger and Kumar, Minimum snap trajectory generation and control for quadrotors,
    ICRA 2011.
    """
    order = ORDERS[check.choice("minimize", minimize, tuple(ORDERS))]
    check.flag("closed", closed)
    check.flag("at_rest", at_rest)
    places = _places(points, 2 if at_rest or closed else order)
    rule, point, angles = heading_choice(yaw, look_at)
    if callable(angles):
        raise ValueError("yaw must be angles at the points, not a function; see Trajectory.of")
    if np.ndim(angles) > 0:
        angles = check.array("yaw", angles, (len(places),))
    if closed:
        places = np.concatenate([places, places[:1]])

    def path(when: Floats) -> Floats:
        return coefficients(when, places, order, closed=closed, at_rest=at_rest)

    def rough(when: Floats) -> Floats:
        return _unrolled(when, places, order) if closed else path(when)

    bounds = {"max_speed": max_speed, "max_acceleration": max_acceleration}
    if times is None:
        _refuse_equal_neighbors(places, closed)
        usual = zip(bounds.items(), (MAX_SPEED, MAX_ACCELERATION), strict=True)
        limits = [check.positive(name, other if x is None else x) for (name, x), other in usual]
        when = choose_times(path, rough, places, *limits)
    else:
        for name, bound in bounds.items():
            if bound is not None:
                raise ValueError(f"{name} must not be given with times, which it would choose")
        when = _given_times(times, len(places), closed)
    terms = np.zeros((8, len(when) - 1, 4))
    terms[..., :3] = path(when)
    if np.ndim(angles) > 0:
        terms[..., 3] = _yaw_coefficients(when, angles, closed, at_rest)
    else:
        terms[-1, :, 3] = angles
    return Pieces(when, terms, closed, rule, point)


def heading_choice(yaw: Any, look_at: Any) -> tuple[HeadingRule, tuple[float, float], Any]:
    """Return the rule that a heading follows, `Trajectory.heading`, and its point (2,).

    The third value is the source of the angles: a number, or `yaw` itself if it is a function or an
    array.
    """
    if look_at is not None:
        if yaw is not None:
            raise ValueError("yaw must not be given with look_at, which sets the heading")
        size = np.size(look_at)
        point = check.vector("look_at", look_at, length=3 if size == 3 else 2)
        return "toward", (point[0], point[1]), 0.0
    if isinstance(yaw, str):
        check.choice("yaw", yaw, ("along",))
        return "along", (0.0, 0.0), 0.0
    if yaw is None:
        return "given", (0.0, 0.0), 0.0
    if callable(yaw) or np.ndim(yaw) > 0:
        return "given", (0.0, 0.0), yaw
    return "given", (0.0, 0.0), check.angle("yaw", yaw)


def _places(points: ArrayLike, fewest: int) -> Floats:
    """Return the points (n, 3), at least two, and as many as open ends require."""
    places = check.array("points", points, (None, 3))
    if len(places) < 2:
        raise ValueError(f"points must be at least two, got {len(places)}")
    if len(places) < fewest:
        raise ValueError(
            f"at_rest must be True with fewer than {fewest} points, which leave the ends open, got "
            f"{len(places)}"
        )
    return places


def _given_times(times: Any, count: int, closed: bool) -> Floats:
    when = check.array("times", times, (None,))
    if len(when) != count:
        more = ", the last for the return to the first" if closed else ""
        raise ValueError(f"times must be {count}, one for each point{more}, got {len(when)}")
    steps = np.diff(when)
    if (steps < SHORTEST).any():
        k = int(np.argmax(steps < SHORTEST))
        raise ValueError(
            f"times must increase, got {when[k]:g} s and then {when[k + 1]:g} s for points {k} and "
            f"{k + 1}"
        )
    return when - when[0]


def _refuse_equal_neighbors(places: Floats, closed: bool) -> None:
    near = np.linalg.norm(np.diff(places, axis=0), axis=1) < SHORTEST
    if near.any():
        k = int(np.argmax(near))
        if closed and k == len(places) - 2:
            raise ValueError(
                "points must not end where they begin: a closed trajectory returns by itself"
            )
        raise ValueError(
            f"points must differ from one to the next where no times are given, got {places[k]} "
            f"as points {k} and {k + 1}"
        )


def coefficients(
    times: Floats, values: Floats, order: int, *, closed: bool = False, at_rest: bool = True
) -> Floats:
    """Polynomials (8, m, n) of the least integral of a squared derivative of an order, 4 or 3.

    They pass through values (m + 1, n) at times (m + 1,); the highest power of the time since the
    beginning of a segment is first. At rest, derivatives below the order are zero at both ends.
    """
    from scipy.interpolate import make_interp_spline

    degree = 2 * order - 1
    known = range(1, order) if at_rest else range(order, degree)
    if closed:
        spline = make_interp_spline(times, values, k=degree, bc_type="periodic")
    else:
        ends = [(k, np.zeros(values.shape[1])) for k in known]
        spline = make_interp_spline(times, values, k=degree, bc_type=(ends, ends))
    terms = polynomials(spline, times, degree)
    terms[7] = values[:-1]  # what they are, without the rounding of the solution
    if not closed:
        for k in known:
            terms[7 - k, 0] = 0.0
    return terms


def polynomials(spline: Any, times: Floats, degree: int) -> Floats:
    """Return the coefficients (8, m, n) of a spline in the segments between times (m + 1,)."""
    values = np.array([spline(times[:-1], k) for k in range(degree + 1)])
    terms = np.zeros((8, *values.shape[1:]))
    factorial = 1.0
    for k, value in enumerate(values):
        factorial *= max(k, 1)
        terms[7 - k] = value / factorial
    return terms


def _unrolled(times: Floats, values: Floats, order: int) -> Floats:
    """Return the coefficients of a closed path, nearly: from several rounds, with distant ends.

    SciPy's periodic splines take long where several threads share the processor's cores.
    """
    count, span = len(times) - 1, times[-1]
    before = -(-PADDING // count)
    starts = np.arange(-before, before + 1) * span
    when = np.append((starts[:, np.newaxis] + times[:-1]).ravel(), (before + 1) * span)
    given = np.concatenate([np.tile(values[:-1], (2 * before + 1, 1)), values[:1]])
    terms = coefficients(when, given, order, at_rest=False)
    return terms[:, before * count : (before + 1) * count]


def _yaw_coefficients(times: Floats, angles: Sequence[float], closed: bool, rest: bool) -> Floats:
    """(8, m) of least jerk through angles, by the shorter way from each to the next."""
    if not closed:
        turned = np.unwrap(angles)[:, np.newaxis]
        return coefficients(times, turned, 3, at_rest=rest)[..., 0]
    turned = np.unwrap(np.append(angles, angles[0]))
    rate = (turned[-1] - turned[0]) / times[-1]  # of the whole turns of a round
    swing = (turned - rate * times)[:, np.newaxis]
    swing[-1] = swing[0]
    terms = coefficients(times, swing, 3, closed=True)[..., 0]
    terms[7] += rate * times[:-1]
    terms[6] += rate
    return terms

"""Piecewise polynomials in time: minimum snap through points, times of segments, and fits."""

from collections.abc import Callable, Hashable, Sequence
from typing import Any, Literal, NamedTuple, Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from quad_gym.params import checks as check

# --------------------------------------------------------------------------------------------------
# Piecewise polynomials as numbers, which become a `Trajectory`.
# --------------------------------------------------------------------------------------------------

Floats = NDArray[np.float64]
HeadingRule = Literal["given", "along", "toward"]


class Pieces(NamedTuple):
    """Fields of a `Trajectory`, which explains them."""

    times: Floats
    coefficients: Floats
    closed: bool
    heading: HeadingRule
    point: tuple[float, float]


class Reference(Hashable, Protocol):
    """Desired position and heading over time, as functions; `Trajectory` explains them."""

    @property
    def times(self) -> Floats:
        """(m + 1,) times between segments [s]."""

    @property
    def coefficients(self) -> Floats:
        """(8, m, 4) coefficients, the highest power first."""

    @property
    def closed(self) -> bool:
        """True if the reference repeats."""

    def __call__(self, t: ArrayLike, derivative: int = 0) -> Floats:
        """Return the position in I, or one of its derivatives."""

    def yaw(self, t: ArrayLike, derivative: int = 0) -> Floats:
        """Return the heading, or one of its derivatives."""

    def instants(self, count: int) -> Floats:
        """Return `count` times per segment, and the end [s]."""


def derivative(terms: Floats, order: int) -> Floats:
    """Coefficients (8 - order, ...) of a derivative of polynomials, the highest power first."""
    for _ in range(order):
        powers = np.arange(len(terms) - 1, 0, -1, dtype=np.float64)
        terms = terms[:-1] * powers.reshape(-1, *[1] * (terms.ndim - 1))
    return terms


# --------------------------------------------------------------------------------------------------
# The times of segments, so that a path just stays below bounds of speed and acceleration.
# --------------------------------------------------------------------------------------------------

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


# --------------------------------------------------------------------------------------------------
# Minimum snap and minimum jerk through points.
#
# The motion through given points at given times that has the least integral of its squared k-th
# derivative is a spline of degree 2k - 1 with knots at the times, whose derivatives up to the
# (2k - 2)-th are continuous. With those up to the (k - 1)-th zero at the ends (at rest), or those
# from the k-th on (natural), or repeating, SciPy's interpolating splines are that minimum.
# --------------------------------------------------------------------------------------------------

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
        angles = _headings(angles, len(places))
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


def _headings(yaw: ArrayLike, count: int) -> Floats:
    """Return the headings (count,) at the points, of which no two neighbors are a turn apart."""
    found = check.array("yaw", yaw, (count,))
    if count:
        check.angle("yaw", found[0])
    far = np.flatnonzero(np.abs(np.diff(found)) > 2.0 * np.pi)
    if far.size:
        first, second = found[far[0] : far[0] + 2]
        raise ValueError(
            "yaw must be in rad, with steps within ±2 pi from point to point, got "
            f"{first:g} and then {second:g}: in degrees?"
        )
    return found


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


# --------------------------------------------------------------------------------------------------
# Piecewise polynomials that approximate any smooth function of time.
# --------------------------------------------------------------------------------------------------

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

"""Trajectories: references as piecewise polynomials in time."""

import dataclasses
import inspect
from collections.abc import Callable
from functools import cached_property, partial, wraps
from typing import TYPE_CHECKING, Annotated, Any, ParamSpec

import numpy as np
from numpy.typing import ArrayLike, NDArray

from quad_gym.params import checks, portable
from quad_gym.params.checked import Checked
from quad_gym.params.checks import Vector
from quad_gym.params.shown import show
from quad_gym.params.trajectories.feasibility import check_trajectory
from quad_gym.params.trajectories.fitting import fit
from quad_gym.params.trajectories.pieces import Floats, HeadingRule, Pieces
from quad_gym.params.trajectories.reading import from_csv
from quad_gym.params.trajectories.splines import through

if TYPE_CHECKING:
    from scipy.interpolate import PPoly

Arguments = ParamSpec("Arguments")

TERMS = 8  #: coefficients of a polynomial of degree 7, as minimum snap requires
MIN_SPEED = 1e-3  #: horizontal speed below which a heading along the path is held [m/s]
EARLY = 1e-3  #: fraction of a trajectory after which a start from rest has a direction


def _making(
    function: Callable[Arguments, Pieces],
) -> "classmethod[Trajectory, Arguments, Trajectory]":
    """Make a class method that returns an instance from a function that returns its fields."""

    @wraps(function)
    def make(
        cls: "type[Trajectory]", /, *values: Arguments.args, **named: Arguments.kwargs
    ) -> "Trajectory":
        return cls(**function(*values, **named)._asdict())

    make.__annotations__ = {**function.__annotations__, "return": "Trajectory"}
    return classmethod(show(make, inspect.signature(function).parameters.values()))


class Trajectory(Checked, eq=False):
    """Desired position and heading over time: piecewise polynomials, exact in the kernels, too.

    In the segment that begins at t_j, `r*(t) = sum_k c_k (t - t_j)^(7 - k)`, and the yaw has the
    same form. Make trajectories with `through`, `from_csv` or `of` rather than from coefficients. A
    closed trajectory repeats; an open one stands still at its first point before time 0, and at its
    last point after its end.

    Trajectories compare by their numbers, and can be pickled.
    """

    times: Annotated[Floats, partial(checks.array, shape=(None,))]
    """(m + 1,) times at which segments begin, the first at 0, and the end of the last segment
    [s]"""
    coefficients: Annotated[Floats, partial(checks.array, shape=(TERMS, None, 4))]
    """(8, m, 4) coefficients of x, y, z in I [m] and yaw [rad], the highest power first, as in
    SciPy's `PPoly`"""
    closed: bool = False
    """True: the trajectory repeats, its end joining its start"""
    heading: HeadingRule = "given"
    """direction of body x: "given": by the yaw polynomial; "along": along the horizontal velocity;
    "toward": toward a point"""
    point: Annotated[Vector, partial(checks.vector, length=2)] = (0.0, 0.0)
    """(2,) point in I that body x faces with `heading="toward"` [m]"""

    def __post_init__(self) -> None:
        super().__post_init__()
        if len(self.times) < 2 or self.times[0] != 0.0 or not (np.diff(self.times) > 0.0).all():
            self._refuse("times", "begin with 0 and increase, with at least two of them")
        if self.coefficients.shape[1] != len(self.times) - 1:
            must = f"have {len(self.times) - 1} segments, one less than there are times"
            self._refuse("coefficients", must, self.coefficients.shape[1])
        for array in (self.times, self.coefficients):
            array.flags.writeable = False

    through = _making(through)
    from_csv = _making(from_csv)
    of = _making(fit)
    check = check_trajectory

    @property
    def duration(self) -> float:
        """Duration of the trajectory; if closed, of one round [s]."""
        return float(self.times[-1])

    def __call__(self, t: ArrayLike, derivative: int = 0) -> Floats:
        """Return the position, or one of its derivatives.

        Args:
            t: (...) times [s]; a closed trajectory repeats, an open one stands still beyond its
                ends.
            derivative: Order of the derivative: 0: position, 1: velocity, 2: acceleration, 3: jerk,
                4: snap and so on.

        Returns:
            (..., 3) in I [m/s^derivative].
        """
        order = checks.whole("derivative", derivative, least=0)
        time = np.asarray(t, np.float64)
        inside, beyond = self._within(time)
        values = np.asarray(self._polynomials(0, 3)(inside, order))
        return np.where(beyond[..., np.newaxis] & (order > 0), 0.0, values)

    def yaw(self, t: ArrayLike, derivative: int = 0) -> Floats:
        """Return the angle of the heading, from east toward north, or one of its derivatives.

        Args:
            t: (...) times [s].
            derivative: Order of the derivative: 0, 1 or 2.

        Returns:
            (...) [rad/s^derivative].
        """
        order = checks.whole("derivative", derivative, least=0, most=2)
        return self._yaw_angles(np.asarray(t, np.float64))[order]

    def _yaw_angles(self, times: Floats) -> tuple[Floats, Floats, Floats]:
        """The angle of the heading [rad] and its first two derivatives, of the shape of `times`."""
        inside, beyond = self._within(times)
        if self.heading == "given":
            yaw = self._polynomials(3, 4)
            found = [np.asarray(yaw(inside, k))[..., 0] for k in range(3)]
            if self.closed:  # each round adds the turns of one
                turns = yaw(self.duration)[0] - yaw(0.0)[0]
                found[0] = found[0] + np.round(turns / (2 * np.pi)) * 2 * np.pi * np.floor(
                    times / self.duration
                )
            return found[0], np.where(beyond, 0.0, found[1]), np.where(beyond, 0.0, found[2])
        if self.heading == "along":
            d, d1, d2 = (self(times, k)[..., :2] for k in (1, 2, 3))
            begin, end = self.end_headings
            held = np.stack([times <= 0.0, times >= self.duration])
            held &= not self.closed
            d = np.where(held[0][..., np.newaxis], begin, d)
            d = np.where(held[1][..., np.newaxis], end, d)
            still = held.any(axis=0) | (np.hypot(d[..., 0], d[..., 1]) < MIN_SPEED)
        else:
            d = np.array(self.point) - self(times)[..., :2]
            d1, d2 = (-self(times, k)[..., :2] for k in (1, 2))
            still = np.hypot(d[..., 0], d[..., 1]) < 1e-9
        return _angles(d, d1, d2, still)

    def turned(self, angle: float) -> "Trajectory":
        """Return the trajectory rotated about the vertical through the origin.

        Args:
            angle: Angle of the rotation, from east toward north [rad].
        """
        turn = checks.number("angle", angle)
        if turn == 0.0:
            return self
        c, s = portable.cos(turn), portable.sin(turn)
        terms = self.coefficients.copy()
        terms[..., 0] = c * self.coefficients[..., 0] - s * self.coefficients[..., 1]
        terms[..., 1] = s * self.coefficients[..., 0] + c * self.coefficients[..., 1]
        terms[-1, :, 3] += turn
        x, y = self.point
        return self.replace(coefficients=terms, point=(c * x - s * y, s * x + c * y))

    @cached_property
    def reach(self) -> float:
        """Largest distance from the origin, among a hundred instants of each segment [m]."""
        return float(np.linalg.norm(self(self.instants(100)), axis=1).max())

    def instants(self, count: int) -> Floats:
        """Return `count` evenly spaced times per segment, from its beginning, and the end [s]."""
        steps = np.arange(count) / count
        inner = self.times[:-1, np.newaxis] + np.diff(self.times)[:, np.newaxis] * steps
        return np.append(inner.ravel(), self.times[-1])

    @cached_property
    def end_headings(self) -> Floats:
        """Horizontal directions (2, 2) of the velocity at the start and the end, even at rest.

        A heading along the path holds these directions beyond the ends of an open trajectory.
        """
        near = EARLY * self.duration
        found = np.array([[1.0, 0.0], [1.0, 0.0]])
        for row, (end, inner) in enumerate(((0.0, near), (self.duration, self.duration - near))):
            # the end's own, unless it is at rest there but for rounding
            for time, least in ((inner, 1e-10), (end, 1e-4)):
                velocity = self._level_velocity(time)
                speed = portable.norm(velocity)  # BLAS would round it by the processor
                if speed > least:
                    found[row] = velocity / speed
        return found

    def _level_velocity(self, time: float) -> Floats:
        """Return the velocity east and north; unlike SciPy's, with the same bits everywhere."""
        piece = min(int(np.searchsorted(self.times, time, "right")), len(self.times) - 1) - 1
        velocity, power = np.zeros(2), 1.0
        for n, terms in enumerate(self.coefficients[-2::-1, piece, :2], 1):
            velocity += terms * power * n
            power *= float(time - self.times[piece])
        return velocity

    def _polynomials(self, first: int, last: int) -> "PPoly":
        """Return the polynomials of some of x, y, z and yaw, as SciPy's."""
        from scipy.interpolate import PPoly

        return PPoly(self.coefficients[..., first:last], self.times)

    def _within(self, time: Floats) -> tuple[Floats, NDArray[np.bool_]]:
        """Return times within the first round, and a mask of given times beyond the ends."""
        if not np.isfinite(time).all():
            raise ValueError(f"t must be finite, got {time}")
        beyond = np.zeros(time.shape, bool)
        if self.closed:
            time = time - np.floor(time / self.duration) * self.duration
        else:
            beyond = (time < 0.0) | (time > self.duration)
        return np.clip(time, 0.0, self.duration), beyond

    # ---- as values ---------------------------------------------------------------------------

    def _numbers(self) -> tuple[Any, ...]:
        arrays = (self.times.tobytes(), self.coefficients.tobytes())
        return (*arrays, self.closed, self.heading, self.point)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Trajectory) and self._numbers() == other._numbers()

    def __hash__(self) -> int:
        return hash(self._numbers())

    def __repr__(self) -> str:
        kind = "closed" if self.closed else "open"
        return f"<Trajectory: {len(self.times) - 1} segments, {self.duration:g} s, {kind}>"

    def __reduce__(self) -> Any:
        """Copy with new arrays, which are as immutable."""
        values = {field.name: getattr(self, field.name) for field in dataclasses.fields(self)}
        return partial(type(self), **values), ()


def _angles(
    d: Floats, d1: Floats, d2: Floats, still: NDArray[np.bool_]
) -> tuple[Floats, Floats, Floats]:
    """The angle of horizontal vectors and its derivatives, which are 0 where it stands still."""
    square = np.where(still, 1.0, (d * d).sum(axis=-1))
    cross = d[..., 0] * d1[..., 1] - d[..., 1] * d1[..., 0]
    bend = d[..., 0] * d2[..., 1] - d[..., 1] * d2[..., 0]
    rate = cross / square
    change = (bend - 2.0 * rate * (d * d1).sum(axis=-1)) / square
    angle = np.arctan2(d[..., 1], d[..., 0])
    return angle, np.where(still, 0.0, rate), np.where(still, 0.0, change)

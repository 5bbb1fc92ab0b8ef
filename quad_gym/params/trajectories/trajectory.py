"""Trajectories: references as piecewise polynomials in time."""

import dataclasses
import functools
import math
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from quad_gym.params import checks as check
from quad_gym.params import portable
from quad_gym.params.checks import Checked, Vector
from quad_gym.params.vehicle import VehicleParams

if TYPE_CHECKING:
    from scipy.interpolate import PPoly

    from quad_gym.params.trajectories.feasibility import Demand

Floats = NDArray[np.float64]

TERMS = 8
"""Coefficients of a polynomial of degree 7, as minimum snap requires."""

HEADINGS = ("given", "along", "toward")
"""Rules of the heading: given by a polynomial, along the horizontal velocity, toward a point."""

EARLY = 1e-3
"""Fraction of a trajectory after which a start from rest has a direction."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Trajectory(Checked):
    """Desired position and heading over time: piecewise polynomials, exact in the kernels, too.

    In the segment that begins at t_j, `r*(t) = sum_k c_k (t - t_j)^(7 - k)`, and the yaw has the
    same form. Make trajectories with `through`, `from_csv` or `of` rather than from coefficients. A
    closed trajectory repeats; an open one stands still at its first point before time 0, and at its
    last point after its end.

    Trajectories compare by their numbers, and can be pickled.
    """

    times: Floats
    """(m + 1,) times at which segments begin, the first at 0, and the end of the last segment
    [s]"""
    coefficients: Floats
    """(8, m, 4) coefficients of x, y, z in I [m] and yaw [rad], the highest power first, as in
    SciPy's `PPoly`"""
    closed: bool = False
    """True: the trajectory repeats, its end joining its start"""
    heading: str = "given"
    """direction of body x: "given": by the yaw polynomial; "along": along the horizontal velocity;
    "toward": toward a point"""
    point: Vector = (0.0, 0.0)
    """(2,) point in I that body x faces with `heading="toward"` [m]"""

    def __post_init__(self) -> None:
        self._check(check.array, "times", shape=(None,))
        self._check(check.array, "coefficients", shape=(TERMS, None, 4))
        self._check(check.flag, "closed")
        self._check(check.choice, "heading", choices=HEADINGS)
        self._check(check.vector, "point", length=2)
        if len(self.times) < 2 or self.times[0] != 0.0 or not (np.diff(self.times) > 0.0).all():
            raise ValueError(
                "Trajectory.times must begin with 0 and increase, with at least two of them, got "
                f"{self.times}"
            )
        if self.coefficients.shape[1] != len(self.times) - 1:
            raise ValueError(
                f"Trajectory.coefficients must have {len(self.times) - 1} segments, one less than "
                f"there are times, got {self.coefficients.shape[1]}"
            )
        for array in (self.times, self.coefficients):
            array.flags.writeable = False

    # ---- how they are made -------------------------------------------------------------------

    @classmethod
    def through(
        cls,
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
    ) -> "Trajectory":
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
        from quad_gym.params.trajectories.splines import through

        return through(
            cls,
            points,
            times,
            max_speed=max_speed,
            max_acceleration=max_acceleration,
            closed=closed,
            minimize=minimize,
            at_rest=at_rest,
            yaw=yaw,
            look_at=look_at,
        )

    @classmethod
    def from_csv(cls, path: Path | str, **options: Any) -> "Trajectory":
        """Return a trajectory through the rows of a table, at their times.

        The first line names the columns: `time` [s], `x`, `y`, `z` in I [m], and optionally `yaw`
        [rad]; others are ignored. Times must increase, and are counted from the first.

        Args:
            path: A text file of comma-separated values.
            options: Keywords of `through` other than times and bounds, such as `minimize="jerk"`,
                or `at_rest=False` for a table that begins and ends in flight. With `closed=True`,
                the last row is the return to the first.

        Returns:
            The trajectory.

        Raises:
            FileNotFoundError: If there is no such file.
            ValueError: If a column is missing or a value is not a number; the message names the
                line.
        """
        from quad_gym.params.trajectories.reading import from_csv

        return from_csv(cls, Path(path), options)

    @classmethod
    def of(
        cls,
        function: Callable[[float], ArrayLike],
        duration: float,
        *,
        velocity: Callable[[float], ArrayLike] | None = None,
        acceleration: Callable[[float], ArrayLike] | None = None,
        closed: bool = False,
        tolerance: float = 1e-6,
        yaw: Callable[[float], float] | float | str | None = None,
        look_at: ArrayLike | None = None,
    ) -> "Trajectory":
        """Return a trajectory that approximates any smooth function of time.

        The function is replaced by splines of degree 7, with as many segments as the tolerance
        requires.

        Args:
            function: Position (3,) in I [m] as a function of time [s], from 0 to the duration.
            duration: Duration of the trajectory [s].
            velocity: First derivative of the position [m/s], if known: checked against differences,
                and met to 1000 times the tolerance.
            acceleration: Second derivative of the position [m/s^2], if known: checked and met in
                the same way.
            closed: True: the trajectory repeats.
            tolerance: Largest distance from the function [m].
            yaw: Heading of body x: None (east), an angle [rad], "along" the horizontal velocity, or
                a function of time.
            look_at: (2,) or (3,) a point in I that body x faces instead [m].

        Returns:
            The trajectory.

        Raises:
            ValueError: If a function does not return finite numbers, a derivative contradicts the
                function, a closed trajectory does not return to its start, or the function is not
                smooth enough.
        """
        from quad_gym.params.trajectories.fitting import fit

        return fit(
            cls,
            function,
            duration,
            velocity=velocity,
            acceleration=acceleration,
            closed=closed,
            tolerance=tolerance,
            yaw=yaw,
            look_at=look_at,
        )

    # ---- what they are -----------------------------------------------------------------------

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
        order = check.whole("derivative", derivative, least=0)
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
        from quad_gym.params.trajectories.headings import yaw_angles

        order = check.whole("derivative", derivative, least=0, most=2)
        return yaw_angles(self, np.asarray(t, np.float64))[order]

    def check(
        self,
        vehicle: VehicleParams,
        *,
        max_thrust: float | None = None,
        max_tilt: float = math.pi,
        max_body_rates: ArrayLike | None = None,
        max_speed: float | None = None,
        name: str = "trajectory",
    ) -> "Demand":
        """Check that a vehicle can fly the trajectory, and return the largest demands.

        Thrust, attitude and body rates follow from acceleration, jerk and yaw (differential
        flatness), torques from snap, and the forces of the four rotors from thrust and torques.
        Drag and the lag of the rotors are neglected.

        Args:
            vehicle: The vehicle; its rotor forces must be between 0 and their values at full
                voltage.
            max_thrust: Bound of the total thrust, if below the rotors' own [N].
            max_tilt: Bound of the angle between body z and the vertical [rad].
            max_body_rates: (3,) bounds of the body rates about the body axes [rad/s]; None: no
                bound.
            max_speed: Bound of the speed [m/s]; None: no bound.
            name: Name of the trajectory in messages.

        Returns:
            The largest demands.

        Raises:
            ValueError: If a demand exceeds its limit, or the trajectory jumps. The message names
                the demand, the time, the segment and the excess.
        """
        from quad_gym.params.trajectories.feasibility import check_trajectory

        return check_trajectory(
            self,
            vehicle,
            max_thrust=max_thrust,
            max_tilt=max_tilt,
            max_body_rates=max_body_rates,
            max_speed=max_speed,
            name=name,
        )

    def turned(self, angle: float) -> "Trajectory":
        """Return the trajectory rotated about the vertical through the origin.

        Args:
            angle: Angle of the rotation, from east toward north [rad].
        """
        turn = check.number("angle", angle)
        if turn == 0.0:
            return self
        c, s = math.cos(turn), math.sin(turn)
        terms = self.coefficients.copy()
        terms[..., 0] = c * self.coefficients[..., 0] - s * self.coefficients[..., 1]
        terms[..., 1] = s * self.coefficients[..., 0] + c * self.coefficients[..., 1]
        terms[-1, :, 3] += turn
        x, y = self.point
        return self.replace(coefficients=terms, point=(c * x - s * y, s * x + c * y))

    @functools.cached_property
    def reach(self) -> float:
        """Largest distance from the origin, among a hundred instants of each segment [m]."""
        return float(np.linalg.norm(self(self.instants(100)), axis=1).max())

    def instants(self, count: int) -> Floats:
        """Return `count` evenly spaced times per segment, from its beginning, and the end [s]."""
        steps = np.arange(count) / count
        inner = self.times[:-1, np.newaxis] + np.diff(self.times)[:, np.newaxis] * steps
        return np.append(inner.ravel(), self.times[-1])

    @functools.cached_property
    def end_headings(self) -> Floats:
        """Horizontal directions (2, 2) of the velocity at the start and the end, even at rest.

        A heading along the path holds these directions beyond the ends of an open trajectory.
        """
        near = EARLY * self.duration
        found = np.array([[1.0, 0.0], [1.0, 0.0]])
        for row, (end, inner) in enumerate(((0.0, near), (self.duration, self.duration - near))):
            # the end's own, unless it is at rest there but for rounding
            for time, least in ((inner, 1e-10), (end, 1e-4)):
                velocity = self._polynomials(0, 2)(time, 1)
                speed = portable.norm(velocity)  # BLAS would round it by the processor
                if speed > least:
                    found[row] = velocity / speed
        return found

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
        return functools.partial(type(self), **values), ()

"""`Trajectory`: a reference as piecewise polynomials in time."""

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
"""Coefficients of a polynomial: of degree 7, which minimum snap takes."""

HEADINGS = ("given", "along", "toward")
"""What the heading follows: a polynomial, the horizontal velocity, a point."""

EARLY = 1e-3
"""Share of a trajectory after which a start from rest has a direction."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Trajectory(Checked):
    """Where a vehicle is to be at every time: piecewise polynomials, exact in the kernels, too.

    `r*(t) = sum_k c_k (t - t_j)^(7 - k)` in the segment that begins at t_j; likewise the yaw. Made
    by `through`, `from_csv` or `of` rather than from coefficients. A closed one repeats; another
    one stands still at its first point before time 0 and at its last one past its end.

    Trajectories compare by their numbers, and pickle.
    """

    times: Floats
    """(m + 1,) where segments begin, from 0 on, and where the last one ends [s]"""
    coefficients: Floats
    """(8, m, 4) of x, y, z in I [m] and yaw [rad], the highest power first, as SciPy's `PPoly`"""
    closed: bool = False
    """whether it repeats, from its end at its start"""
    heading: str = "given"
    """what body x follows: "given": the yaw; "along": the horizontal velocity; "toward": a point"""
    point: Vector = (0.0, 0.0)
    """(2,) that point in I [m]"""

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
        """The smoothest flight through points: that of the least integral of squared snap or jerk.

        It is a spline of degree 7 (5) whose derivatives up to the sixth (fourth) are continuous.

        Args:
            points: (n, 3) in I [m].
            times: (n,) when each is passed, counted from the first [s]; closed: (n + 1,), with the
                return to the first point. None: chosen so that speed and acceleration reach their
                bounds and stay below them.
            max_speed: Bound for the choice of times [m/s]; 2.5 if neither is given.
            max_acceleration: Likewise [m/s^2]; 3 if not given.
            closed: Whether it returns to the first point, and repeats.
            minimize: "snap" (fourth derivative) or "jerk" (third).
            at_rest: Whether it starts and ends at rest; otherwise, as the minimum has it. A closed
                one does neither.
            yaw: Heading of body x: None (looks east), an angle [rad], "along" the horizontal
                velocity, or (n,) an angle at each point.
            look_at: (2,) or (3,) a point in I to look toward instead [m].

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
        """A trajectory through the rows of a table, at their times.

        The first line names the columns: `time` [s], `x`, `y`, `z` in I [m], and optionally `yaw`
        [rad]; others are ignored. Times increase and are counted from the first.

        Args:
            path: A text file of values separated by commas.
            options: Those of `through` but times and bounds, such as `minimize="jerk"`, or
                `at_rest=False` for a table that begins and ends in flight. With `closed=True`, the
                last row is the return to the first.

        Returns:
            The trajectory.

        Raises:
            FileNotFoundError: If there is no such file.
            ValueError: If a column is missing or a value is not a number; names the line.
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
        """A trajectory along any smooth function of time.

        Splines of degree 7 take the place of the function, with as many segments as it takes.

        Args:
            function: Position (3,) in I [m] at a time [s] within 0 and the duration.
            duration: How long it lasts [s].
            velocity: Its first derivative, if known: checked against differences, and met to 1000
                times the tolerance.
            acceleration: Its second derivative, likewise.
            closed: Whether it repeats.
            tolerance: Largest distance from the function [m].
            yaw: None (looks east), an angle [rad], "along" the horizontal velocity, or a function
                of time.
            look_at: (2,) or (3,) a point in I to look toward instead [m].

        Returns:
            The trajectory.

        Raises:
            ValueError: If a function returns something else than finite numbers, a derivative is
                not that of the function, a closed one does not return to its start, or the function
                is not smooth enough.
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
        """How long it lasts, or one round of it [s]."""
        return float(self.times[-1])

    def __call__(self, t: ArrayLike, derivative: int = 0) -> Floats:
        """Position, or a derivative of it.

        Args:
            t: (...) times [s]; a closed trajectory repeats, others stand still beyond their ends.
            derivative: 0: position, 1: velocity, 2: acceleration, 3: jerk, 4: snap and so on.

        Returns:
            (..., 3) in I [m/s^derivative].
        """
        order = check.whole("derivative", derivative, least=0)
        time = np.asarray(t, np.float64)
        inside, beyond = self._within(time)
        values = np.asarray(self._polynomials(0, 3)(inside, order))
        return np.where(beyond[..., np.newaxis] & (order > 0), 0.0, values)

    def yaw(self, t: ArrayLike, derivative: int = 0) -> Floats:
        """The angle of the heading from east toward north, or its first or second derivative.

        Args:
            t: (...) times [s].
            derivative: 0, 1 or 2.

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
        """What the trajectory demands of a vehicle, which must be able to fly it.

        Thrust, attitude and body rates follow from acceleration, jerk and yaw (differential
        flatness), torques from snap, and the forces of the four rotors from thrust and torques;
        without drag, and with rotors that follow at once.

        Args:
            vehicle: Must have the rotor forces, between 0 and those at full voltage.
            max_thrust: Of all rotors together, if less than they have [N].
            max_tilt: Between body z and the vertical [rad].
            max_body_rates: (3,) about the body axes [rad/s]; None: any.
            max_speed: [m/s]; None: any.
            name: What messages call it.

        Returns:
            The largest demands.

        Raises:
            ValueError: If it demands too much, or jumps. Says what, when, in which segment, and by
                how much.
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
        """The same flight turned about the vertical through the origin.

        Args:
            angle: From east toward north [rad].
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
        """The largest distance from the origin, at a hundred instants of each segment [m]."""
        return float(np.linalg.norm(self(self.instants(100)), axis=1).max())

    def instants(self, count: int) -> Floats:
        """So many times in each segment, from its beginning on, and the end [s]."""
        steps = np.arange(count) / count
        inner = self.times[:-1, np.newaxis] + np.diff(self.times)[:, np.newaxis] * steps
        return np.append(inner.ravel(), self.times[-1])

    @functools.cached_property
    def end_headings(self) -> Floats:
        """(2, 2) horizontal directions of the velocity at the start and the end, even at rest.

        What a heading along the path holds beyond the ends of a trajectory that is not closed.
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
        """The polynomials of some of x, y, z and yaw, as SciPy's."""
        from scipy.interpolate import PPoly

        return PPoly(self.coefficients[..., first:last], self.times)

    def _within(self, time: Floats) -> tuple[Floats, NDArray[np.bool_]]:
        """Times within the first round, and whether those given are beyond the ends."""
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
        """A copy has arrays of its own, which are as immutable."""
        values = {field.name: getattr(self, field.name) for field in dataclasses.fields(self)}
        return functools.partial(type(self), **values), ()

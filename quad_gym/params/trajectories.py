"""User-defined references: trajectories, their construction, and checks of their feasibility."""

import csv
import dataclasses
import functools
import inspect
import math
from collections.abc import Callable
from functools import cached_property, partial, wraps
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, NamedTuple, ParamSpec

import numpy as np
from numpy.typing import ArrayLike, NDArray

from quad_gym.params import checks, portable
from quad_gym.params import checks as check
from quad_gym.params.checks import Checked, Vector, show
from quad_gym.params.splines import Floats, HeadingRule, Pieces, Reference, derivative, fit, through
from quad_gym.params.vehicle import VehicleParams

if TYPE_CHECKING:
    from scipy.interpolate import PPoly

__all__ = [
    "Trajectory",
]


# --------------------------------------------------------------------------------------------------
# Thrust, attitude, body rates and torques that a motion requires, by differential flatness.
#
# Without drag, `f z = m (a + g e3)`, and body y is `unit(z x x*)` with the desired heading x*. Both
# are differentiated twice: body rates come from jerk and yaw rate, their change from snap.
#
# Source: Mellinger and Kumar, Minimum snap trajectory generation and control for quadrotors, ICRA
# 2011; axes as in the report's controller.
# --------------------------------------------------------------------------------------------------

Jet = tuple[Floats, Floats, Floats]  #: a vector (n, 3) over time with its first two derivatives


class Motion(NamedTuple):
    """Demands of a motion at n instants."""

    thrust: Floats  #: (n,) total thrust of the rotors [N]
    R_BI: Floats  #: (n, 3, 3) attitude; its rows are the body axes in I
    body_rates: Floats  #: (n, 3) body rates in B [rad/s]
    torque: Floats  #: (n, 3) torque in B [N m]
    rotor_forces: Floats  #: (n, 4) thrust of each rotor [N]

    @property
    def tilt(self) -> Floats:
        """(n,) angle between body z and the vertical [rad]."""
        return np.arccos(np.clip(self.R_BI[:, 2, 2], -1.0, 1.0))


def motion_of(trajectory: Reference, vehicle: VehicleParams, times: Floats) -> Motion:
    """Return the demands of a trajectory on a vehicle at times (n,) [s]."""
    force = (
        trajectory(times, 2) + np.array([0.0, 0.0, vehicle.gravity]),
        trajectory(times, 3),
        trajectory(times, 4),
    )
    z = _unit(force)
    y = _unit(_cross(z, _heading(trajectory, times)))
    x = _cross(y, z)
    rates = np.stack([-_dot(z[1], y[0]), _dot(z[1], x[0]), -_dot(y[1], x[0])], axis=1)
    changes = np.stack(
        [
            -_dot(z[2], y[0]) - _dot(z[1], y[1]),
            _dot(z[2], x[0]) + _dot(z[1], x[1]),
            -_dot(y[2], x[0]) - _dot(y[1], x[1]),
        ],
        axis=1,
    )
    inertia = np.array(vehicle.inertia)
    torque = changes @ inertia.T + np.cross(rates, rates @ inertia.T)
    thrust = vehicle.mass * np.linalg.norm(force[0], axis=1)
    wrench = np.column_stack([thrust, torque])
    forces = np.linalg.solve(vehicle.effectiveness, wrench.T).T
    return Motion(thrust, np.stack([x[0], y[0], z[0]], axis=1), rates, torque, forces)


def _heading(trajectory: Reference, times: Floats) -> Jet:
    """Return the desired horizontal direction of body x."""
    angle, rate, change = (trajectory.yaw(times, k)[:, np.newaxis] for k in range(3))
    zero = np.zeros_like(angle)
    ahead = np.hstack([np.cos(angle), np.sin(angle), zero])
    left = np.hstack([-np.sin(angle), np.cos(angle), zero])
    return ahead, rate * left, change * left - rate**2 * ahead


def _dot(a: Floats, b: Floats) -> Floats:
    return np.einsum("ni,ni->n", a, b)


def _cross(a: Jet, b: Jet) -> Jet:
    """The cross product and its derivatives."""
    return (
        np.cross(a[0], b[0]),
        np.cross(a[1], b[0]) + np.cross(a[0], b[1]),
        np.cross(a[2], b[0]) + 2.0 * np.cross(a[1], b[1]) + np.cross(a[0], b[2]),
    )


def _unit(a: Jet) -> Jet:
    """The direction and its derivatives; where there is none, numbers too large for any vehicle."""
    length = np.maximum(np.linalg.norm(a[0], axis=1), 1e-9)[:, np.newaxis]
    u = a[0] / length
    growth = _dot(u, a[1])[:, np.newaxis]
    u1 = (a[1] - growth * u) / length
    change = (_dot(u1, a[1]) + _dot(u, a[2]))[:, np.newaxis]
    return u, u1, (a[2] - 2.0 * growth * u1 - change * u) / length


# --------------------------------------------------------------------------------------------------
# Feasibility of a trajectory: the demand that exceeds a limit, its time, and the excess.
# --------------------------------------------------------------------------------------------------

INTERVAL, SAMPLES, MAX_SAMPLES = 0.01, 16, 400
"""Interval of the checks [s], and their least and largest number per segment."""

MIN_THRUST = 0.01
"""Thrust as a fraction of the weight below which, in free fall, the direction of body z is
undefined."""

JUMP = 1e-5
"""Largest jump between segments of position [m], velocity [m/s] and acceleration [m/s^2]."""

TURNABOUT = 1.0  #: change of the heading between two checks that no vehicle can follow [rad]

ROUNDING = 1e-6
"""Fraction of a limit by which a demand may exceed it, so that a limit that is just met is
accepted."""


class Demand(NamedTuple):
    """The largest demands of a trajectory on a vehicle."""

    thrust: tuple[float, float]  #: smallest and largest total thrust [N]
    rotor_force: tuple[float, float]  #: smallest and largest thrust of any single rotor [N]
    tilt: float  #: largest angle between body z and the vertical [rad]
    body_rates: tuple[float, float, float]
    """largest magnitude of the body rate about each body axis [rad/s]"""
    speed: float  #: largest speed [m/s]
    acceleration: float  #: largest acceleration [m/s^2]


def check_trajectory(
    trajectory: Reference,
    vehicle: VehicleParams,
    *,
    max_thrust: float | None = None,
    max_tilt: float = math.pi,
    max_body_rates: ArrayLike | None = None,
    max_speed: float | None = None,
    name: str = "trajectory",
) -> Demand:
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
    check.instance("vehicle", vehicle, VehicleParams)
    rates = None
    if max_body_rates is not None:
        rates = check.vector("max_body_rates", max_body_rates, length=3)
    thrust = None if max_thrust is None else check.positive("max_thrust", max_thrust)
    speed = None if max_speed is None else check.positive("max_speed", max_speed)
    tilt = check.positive("max_tilt", max_tilt, most=math.pi)
    return _checked(trajectory, vehicle, thrust, tilt, rates, speed, name)


@functools.lru_cache(maxsize=256)
def _checked(
    trajectory: Reference,
    vehicle: VehicleParams,
    max_thrust: float | None,
    max_tilt: float,
    max_rates: tuple[float, ...] | None,
    max_speed: float | None,
    name: str,
) -> Demand:
    _refuse_jumps(trajectory, name)
    times = sampling_times(trajectory)
    _refuse_turnabouts(trajectory, times, name)
    motion = motion_of(trajectory, vehicle, times)
    speeds, accelerations = (np.linalg.norm(trajectory(times, k), axis=1) for k in (1, 2))
    force, rates = motion.rotor_forces, np.abs(motion.body_rates)
    largest = vehicle.max_rotor_force
    min_thrust = MIN_THRUST * vehicle.mass * vehicle.gravity
    # name, values over time, unit, lower and upper limit
    demands: list[tuple[str, Floats, str, float, float]] = [
        ("a speed", speeds, "m/s", 0.0, max_speed or math.inf),
        ("a thrust", motion.thrust, "N", min_thrust, max_thrust or 4.0 * largest),
        ("a tilt", np.degrees(motion.tilt), "degrees", 0.0, math.degrees(max_tilt)),
    ]
    if max_rates is not None:
        demands += [
            (f"a body rate about {axis}", rates[:, k], "rad/s", 0.0, max_rates[k])
            for k, axis in enumerate("xyz")
        ]
    demands += [(f"a force of rotor {k}", force[:, k], "N", 0.0, largest) for k in range(4)]
    _refuse_excess(trajectory, demands, times, name)
    return Demand(
        thrust=(float(motion.thrust.min()), float(motion.thrust.max())),
        rotor_force=(float(force.min()), float(force.max())),
        tilt=float(motion.tilt.max()),
        body_rates=tuple(rates.max(axis=0).tolist()),
        speed=float(speeds.max()),
        acceleration=float(accelerations.max()),
    )


def _refuse_excess(
    trajectory: Reference,
    demands: list[tuple[str, Floats, str, float, float]],
    times: Floats,
    name: str,
) -> None:
    """Refuse demands beyond limits; name the one that exceeds its limit by the largest fraction."""
    worst, words = 0.0, ""
    for what, values, unit, least, most in demands:
        high, low = int(np.argmax(values)), int(np.argmin(values))
        if values[high] > most * (1.0 + ROUNDING) and values[high] / most - 1.0 > worst:
            worst = values[high] / most - 1.0
            share = f"{100.0 * worst:.0f} %" if worst > 0.01 else f"{100.0 * worst:.2g} %"
            words = (
                f"{what} of {values[high]:.4g} {unit} {_where(trajectory, times[high])}, "
                f"{share} above the limit of {most:.4g} {unit}"
            )
        scale = most if math.isfinite(most) else 1.0
        short = (least - values[low]) / scale
        if short > ROUNDING and short > worst:
            worst = short
            words = (
                f"{what} of {values[low]:.4g} {unit} {_where(trajectory, times[low])}, "
                f"{least - values[low]:.3g} {unit} below the limit of {least:.3g} {unit}"
            )
    if words:
        raise ValueError(
            f"{name} is infeasible for this vehicle: it needs {words}. Give it more time, or "
            "smaller bounds of speed and acceleration"
        )


def _where(trajectory: Reference, time: float) -> str:
    segments = len(trajectory.times) - 1
    segment = min(int(np.searchsorted(trajectory.times, time, side="right")), segments)
    return f"at {time:.3f} s (segment {segment} of {segments})"


def _refuse_turnabouts(trajectory: Reference, times: Floats, name: str) -> None:
    """Refuse headings that turn about at once, as along a path that stops and comes back."""
    turns = np.diff(trajectory.yaw(times))
    turns = np.abs((turns + np.pi) % (2.0 * np.pi) - np.pi)
    k = int(turns.argmax())
    if turns[k] > TURNABOUT:
        raise ValueError(
            f"{name} must not jump: its heading does by {np.degrees(turns[k]):.0f} degrees "
            f"{_where(trajectory, times[k + 1])}"
        )


def sampling_times(trajectory: Reference) -> Floats:
    """Return the times at which demands are checked [s]."""
    lengths = np.diff(trajectory.times)
    count = int(np.clip(np.ceil(lengths.max() / INTERVAL), SAMPLES, MAX_SAMPLES))
    return trajectory.instants(count)


def _refuse_jumps(trajectory: Reference, name: str) -> None:
    """Refuse segments that do not continue each other."""
    lengths = np.diff(trajectory.times)
    for order, (what, unit) in enumerate(
        (("position", "m"), ("velocity", "m/s"), ("acceleration", "m/s^2"))
    ):
        terms = derivative(trajectory.coefficients[..., :3], order)
        ends = np.zeros(terms.shape[1:])
        for row in terms:
            ends = ends * lengths[:, np.newaxis] + row
        begins = terms[-1]
        if trajectory.closed:
            gaps = np.abs(np.roll(begins, -1, axis=0) - ends).max(axis=1)
        else:
            gaps = np.abs(begins[1:] - ends[:-1]).max(axis=1)
        scale = 1.0 + float(np.abs(ends).max())
        if gaps.size and gaps.max() > JUMP * scale:
            k = int(gaps.argmax())
            raise ValueError(
                f"{name} must not jump: its {what} does by {gaps[k]:.3g} {unit} at "
                f"{trajectory.times[k + 1]:.3f} s, after segment {k + 1}"
            )


# --------------------------------------------------------------------------------------------------
# Trajectories from tables.
# --------------------------------------------------------------------------------------------------

COLUMNS = ("time", "x", "y", "z")  #: columns that a table must have; "yaw" is optional

OPTIONS = ("closed", "minimize", "at_rest", "yaw", "look_at")
"""Keywords of `Trajectory.through` that do not contradict a table."""


def from_csv(path: Path | str, **options: Any) -> Pieces:
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
    check.keywords(options, OPTIONS, "Trajectory.from_csv")
    path = Path(path)
    with path.open(newline="", encoding="utf-8-sig") as stream:
        lines = csv.reader(stream)
        names = [name.strip().lower() for name in next(lines, [])]
        missing = [name for name in COLUMNS if name not in names]
        if missing:
            raise ValueError(
                f"{path} must name the columns {', '.join(COLUMNS)} in its first line, got "
                f"{', '.join(names) or 'nothing'}"
            )
        wanted = [*COLUMNS, *(["yaw"] if "yaw" in names else [])]
        places = [names.index(name) for name in wanted]
        rows = [
            _numbers(f"{path}, line {lines.line_num}", cells, places, wanted)
            for cells in lines
            if any(cell.strip() for cell in cells)
        ]
    if len(rows) < 2:
        raise ValueError(f"{path} must have at least two rows, got {len(rows)}")
    table = np.array(rows)
    behind = np.flatnonzero(np.diff(table[:, 0]) <= 0.0)
    if behind.size:
        k = int(behind[0])
        raise ValueError(
            f"{path} must have increasing times, got {table[k, 0]:g} s and then "
            f"{table[k + 1, 0]:g} s in rows {k + 1} and {k + 2}"
        )
    if "yaw" in wanted and not {"yaw", "look_at"} & {
        k for k, v in options.items() if v is not None
    }:
        options = options | {"yaw": table[:, 4]}
    if not options.get("closed", False):
        return through(table[:, 1:4], table[:, 0], **options)
    if np.abs(table[-1, 1:4] - table[0, 1:4]).max() > 1e-3:
        raise ValueError(
            f"{path} must end where it begins with closed=True, got {table[0, 1:4]} and "
            f"{table[-1, 1:4]}"
        )
    if isinstance(options.get("yaw"), np.ndarray):
        options = options | {"yaw": options["yaw"][:-1]}
    return through(table[:-1, 1:4], table[:, 0], **options)


def _numbers(where: str, cells: list[str], places: list[int], names: list[str]) -> list[float]:
    found = []
    for place, name in zip(places, names, strict=True):
        cell = cells[place].strip() if place < len(cells) else ""
        try:
            found.append(check.number(name, float(cell)))
        except ValueError:
            raise ValueError(f"{where}: {name} must be a finite number, got {cell!r}") from None
    return found


# --------------------------------------------------------------------------------------------------
# Trajectories: references as piecewise polynomials in time.
# --------------------------------------------------------------------------------------------------

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
        turn = checks.angle("angle", angle)
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

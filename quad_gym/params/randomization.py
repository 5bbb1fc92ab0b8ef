"""Domain randomization: parameters drawn in every episode, their distributions and limits.

Draws happen inside the kernel from each flight's own random stream, so the parameters of an episode
depend only on the seed of its flight.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from statistics import NormalDist
from typing import Annotated, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from quad_gym.params import checks as check
from quad_gym.params import portable
from quad_gym.params.checks import Checked
from quad_gym.params.gnss import check_baseline
from quad_gym.params.sensor_table import SENSOR_PARAMS, in_words
from quad_gym.params.suites import SensorSuite
from quad_gym.params.vehicle import (
    RK4_LIMIT,
    Clocks,
    VehicleParams,
    check_gyration,
    check_lag,
    check_moments,
)
from quad_gym.params.world import WorldParams
from quad_gym.records import COLUMNS, DRAWABLES, DRAWN_SIZE, LOG_UNIFORM, NORMAL, UNIFORM, Drawable

# --------------------------------------------------------------------------------------------------
# Distributions of randomized parameters, and the form in which the kernel reads them.
# --------------------------------------------------------------------------------------------------

FARTHEST = 8.3
"""Standard deviations beyond which no draw lies: its probability is a multiple of 2^-53."""


class Affine(NamedTuple):
    """A distribution in the form that the kernel reads; u is uniform on (0, 1)."""

    kind: int  #: UNIFORM: a + b u; LOG_UNIFORM: a e^(b u); NORMAL: a + b Phi^-1(c + d u)
    a: float
    b: float
    c: float = 0.0
    d: float = 1.0


class Distribution(Checked, kw_only=False):
    """Distribution of a parameter, absolute or relative to its nominal value."""

    relative: bool = field(default=False, kw_only=True)
    """True: the draw is multiplied by the nominal value"""
    offset: bool = field(default=False, kw_only=True)
    """True: the draw is added to the nominal value"""

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.relative and self.offset:
            raise ValueError(f"{type(self).__name__} must be relative or an offset, not both")

    @property
    def support(self) -> tuple[float, float]:
        """Smallest and largest possible draw."""
        raise NotImplementedError

    def placed(self, factor: float, shift: float) -> Affine:
        """Return the distribution of `factor` times the draw plus `shift`."""
        raise NotImplementedError

    @property
    def center_and_spread(self) -> tuple[float, float]:
        """Center of the distribution, and half of its range."""
        low, high = self.support
        return 0.5 * (low + high), 0.5 * (high - low)


class _Between(Distribution, kw_only=False):
    """Distribution on [low, high]."""

    low: float
    high: float

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.low > self.high:
            self._refuse("low", "be at most its high", f"{self.low:g} and {self.high:g}")

    @property
    def support(self) -> tuple[float, float]:
        """Bounds of the distribution."""
        return self.low, self.high


class Uniform(_Between, kw_only=False):
    """Uniform distribution on [low, high]."""

    def placed(self, factor: float, shift: float) -> Affine:
        """Return the uniform distribution between the transformed bounds."""
        return Affine(UNIFORM, factor * self.low + shift, factor * (self.high - self.low))


class LogUniform(_Between, kw_only=False):
    """Log-uniform distribution on [low, high], above 0: for scales that are known to a factor."""

    low: check.Positive
    high: check.Positive

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.offset:
            raise ValueError("LogUniform.offset must be False: log-uniform draws are factors")

    def placed(self, factor: float, shift: float) -> Affine:
        """Return the log-uniform distribution between the multiplied bounds."""
        return Affine(LOG_UNIFORM, factor * self.low, portable.log(self.high / self.low))


def _bound(name: str, value: Any) -> float:
    """`value` as a float, which may be infinite."""
    if not (isinstance(value, (int, float, np.number)) and not math.isnan(value)):
        raise ValueError(f"{name} must be a number, got {value!r}")
    return float(value)


class Normal(Distribution, kw_only=False):
    """Normal distribution with mean and standard deviation `sigma`, truncated to [low, high]."""

    mean: float
    sigma: check.Positive
    low: Annotated[float, _bound] = -math.inf
    high: Annotated[float, _bound] = math.inf

    def __post_init__(self) -> None:
        super().__post_init__()
        if self._probabilities[1] < 1e-6:
            raise ValueError(
                "Normal.low and Normal.high must enclose a probability of at least 1e-6, got "
                f"[{self.low:g}, {self.high:g}] for mean {self.mean:g} and sigma {self.sigma:g}"
            )

    @property
    def _probabilities(self) -> tuple[float, float]:
        """Probability of a draw below `low`, and of one between the bounds."""
        below, under = (
            0.5 * portable.erfc((self.mean - bound) / (self.sigma * math.sqrt(2.0)))
            for bound in (self.low, self.high)
        )
        return below, under - below

    @property
    def support(self) -> tuple[float, float]:
        """Bounds of the truncated distribution, or the least and the largest draw without any."""
        reach = FARTHEST * self.sigma
        return max(self.low, self.mean - reach), min(self.high, self.mean + reach)

    @property
    def center_and_spread(self) -> tuple[float, float]:
        """Mean and standard deviation before truncation."""
        return self.mean, self.sigma

    def placed(self, factor: float, shift: float) -> Affine:
        """Return the transformed normal distribution with the same truncated tails."""
        below, between = self._probabilities
        return Affine(NORMAL, factor * self.mean + shift, factor * self.sigma, below, between)


# --------------------------------------------------------------------------------------------------
# Limits of draws: within the bounds of the parameters, able to hover, and stable.
# --------------------------------------------------------------------------------------------------

FAST = 100.0  #: speed that no vehicle reaches [m/s]


class Ranges:
    """Parameters that are drawn, and the least and largest draw of every column of `drawn`."""

    drawables: Sequence[Drawable]
    names: tuple[str, ...]
    low: NDArray[np.float64]
    high: NDArray[np.float64]

    def least(self, name: str) -> float:
        """Return the least draw of any component of a parameter."""
        return float(self.low[COLUMNS[name]].min())

    def most(self, name: str) -> float:
        """Return the largest draw of any component of a parameter."""
        return float(self.high[COLUMNS[name]].max())


def check_bounds(table: Ranges, parts: Mapping[str, Any]) -> None:
    """Refuse draws whose smallest or largest values the parameters themselves refuse."""
    for drawable in table.drawables:
        for ends in (table.low[drawable.columns], table.high[drawable.columns]):
            try:
                _check_values(drawable, ends, parts)
            except ValueError as error:
                reached = ", ".join(f"{end:g}" for end in ends)
                raise ValueError(
                    f"randomization of {drawable.name!r} must stay within the bounds of the "
                    f"parameter, got {reached}: {error}"
                ) from None
    if "inertia" in table.names:
        _check_inertia(table)
    antennas = {"primary_antenna_B", "secondary_antenna_B"} & set(table.names)
    if antennas and parts["antennas"] is not None:  # whose draws may coincide
        one, other = COLUMNS["primary_antenna_B"], COLUMNS["secondary_antenna_B"]
        gap = np.maximum(table.low[one] - table.high[other], table.low[other] - table.high[one])
        name = "randomization of 'primary_antenna_B' and 'secondary_antenna_B'"
        check_baseline(name, np.maximum(gap, 0.0))


def _check_values(
    drawable: Drawable, values: NDArray[np.float64], parts: Mapping[str, Any]
) -> None:
    """Refuse values that the parameter itself refuses."""
    part: Any = parts.get(drawable.of)
    vehicle, world = parts["vehicle"], parts["world"]
    value: Any = float(values[0]) if values.size == 1 else tuple(values.tolist())
    east, north, up = world.wind_I
    winds = {
        "wind_east": (value, north, up),
        "wind_north": (east, value, up),
        "wind_up": (east, north, value),
        "wind_speed": (value, 0.0, up),
    }
    if drawable.name == "inertia":
        check_gyration("inertia", values, vehicle.mass, vehicle.rotor_positions_B)
    elif drawable.name == "center_of_mass_B":
        _check_center(values, vehicle)
    elif drawable.name in winds:
        world.replace(wind_I=winds[drawable.name])
    elif hasattr(part, drawable.field):
        drawn = part.replace(**{drawable.field: value})
        if drawable.name == "position_sigma_I":
            drawn.require_filter()


def _check_center(place: NDArray[np.float64], vehicle: VehicleParams) -> None:
    """Refuse a center of mass beyond the rotors, which could not balance the vehicle."""
    reach = np.abs(vehicle.rotor_positions_B).max(axis=0)
    reach[2] = np.linalg.norm(vehicle.rotor_positions_B, axis=1).max()
    if (np.abs(place) >= reach).any():
        raise ValueError(
            "the center of mass must lie between the rotors, within "
            f"{', '.join(f'{r:g}' for r in reach)} m"
        )


def check_hovering(table: Ranges, vehicle: VehicleParams, world: WorldParams) -> None:
    """Refuse draws whose worst case lacks the thrust or the power to hover."""
    least, most = table.least, table.most
    mass, full = most("mass"), least("max_voltage")
    if world.battery is not None:
        empty = world.battery.empty_voltage
        full *= empty + (1.0 - empty) * least("battery_charge")
    speed = least("motor_speed_per_volt") * full
    lift = 4.0 * least("thrust_coefficient") * least("rotor_efficiency")
    thrust = lift * speed**2
    if mass * vehicle.gravity >= thrust:
        raise ValueError(
            f"randomization must leave the vehicle able to hover: at worst it weighs "
            f"{mass * vehicle.gravity:.1f} N and its rotors lift {thrust:.1f} N; limit mass, "
            "max_voltage, motor_speed_per_volt, thrust_coefficient or rotor_efficiency"
        )
    if world.battery is None:
        return
    speed = math.sqrt(mass * vehicle.gravity / lift)
    torque = 4.0 * least("rotor_efficiency") * most("torque_coefficient") * speed**2
    power = torque * speed / world.battery.motor_efficiency
    # it delivers U (U0 - U) / R at U: the most at half of U0, unless hovering takes more U
    voltage = max(speed / least("motor_speed_per_volt"), 0.5 * full)
    largest = voltage * (full - voltage) / power
    if most("battery_resistance") > largest:
        raise ValueError(
            f"BatteryParams.resistance must be at most {largest:.3g} ohm, drawn or not, to deliver "
            f"the {power:.3g} W that hovering takes at worst, got {most('battery_resistance'):g} "
            "ohm (by mass, thrust_coefficient, torque_coefficient, motor_efficiency, max_voltage, "
            "battery_charge and battery_resistance)"
        )


def check_draws(table: Ranges, vehicle: VehicleParams, clocks: Clocks) -> None:
    """Refuse rotors that are too fast, or drag that is too large, for the integration."""
    _check_drag(table, vehicle, clocks)
    name = label = "motor_time_constant"
    if name in table.names:
        label = f"randomization of {name!r} at its smallest draw"
    check_lag(label, table.least(name), clocks)


def _check_drag(table: Ranges, vehicle: VehicleParams, clocks: Clocks) -> None:
    """Refuse drag that slows the vehicle down within a Runge-Kutta step, which would diverge."""

    def most(name: str) -> float:
        return max(-table.least(name), table.most(name))

    drawn = "wind_speed" in table.names
    level = most("wind_speed") if drawn else math.hypot(most("wind_east"), most("wind_north"))
    speed = FAST + math.hypot(level, most("wind_up")) + most("gust_wind_speed")
    disc = most("drag_coefficient") * vehicle.disc_area * vehicle.air_density * speed
    rotor_speeds = 4.0 * most("motor_speed_per_volt") * most("max_voltage")
    drag = disc + most("linear_drag_B") + most("rotor_drag_B") * rotor_speeds
    mass, step = table.least("mass"), clocks.step
    if step * drag > RK4_LIMIT * mass:
        raise ValueError(
            f"drag must slow the vehicle down by less than {RK4_LIMIT * mass / step:.3g} N s/m, "
            f"where the integration is stable, got {drag:.3g} N s/m at {speed:.3g} m/s (by mass, "
            "drag_coefficient, disc_area, air_density, linear_drag_B, rotor_drag_B, wind_I and "
            "gust_wind_speed)"
        )


def _check_inertia(table: Ranges) -> None:
    """Refuse a range of moments of inertia all of which no body has.

    A range in which some draws break the rule that each moment is at most the sum of the other two
    is accepted: components are drawn independently, so ±20 % of a flat vehicle includes
    such draws, and they fly as well as any. See `params.check_moments`.
    """
    columns = COLUMNS["inertia"]
    low, high = table.low[columns], table.high[columns]
    for k in range(3):
        most = np.where(np.arange(3) == k, low, high)  # the others as large as they can be
        if 2.0 * low[k] > most.sum() * (1.0 + 1e-9):
            check_moments("randomization of 'inertia' at its most favorable draw", most)


# --------------------------------------------------------------------------------------------------
# Domain randomization: parameters drawn in every episode, and their distributions.
# --------------------------------------------------------------------------------------------------

FEATURE_DRAWS = ("features_yaw", "features_shift_I", "feature_offsets_I")
"""Draws that move the camera's features, to positions that the filter uses, too."""

Given = Distribution | Sequence[Distribution | None]


@dataclass(frozen=True)
class Randomization:
    """Domain randomization: the distributions of the parameters that are drawn in every episode.

    `quad_gym.params.randomization.DRAWABLES` lists the names. The components of a parameter are
    drawn independently, all from one distribution or each from its own in a sequence, where None
    keeps the nominal value of a component. `feature_offsets_I` has three components for each of the
    camera's features; a sequence of three holds the distributions along x, y and z.

    Args:
        parameters: Distributions by name of the parameter.
        known: True: filter and controller use the true parameters of vehicle and sensors, draws
            included. False: they assume the nominal ones. Wind and ground are never known to them;
            the positions of the camera's features always are known to the filter.

    Raises:
        ValueError: If a name is unknown, or a value is not a distribution.

    Example:
        `Randomization({"mass": Uniform(0.8, 1.2, relative=True), "wind_speed": Uniform(0.0, 5.0),
        "wind_direction": Uniform(-math.pi, math.pi)})`
    """

    parameters: Mapping[str, Given]
    known: bool = False

    def __post_init__(self) -> None:
        check.flag("Randomization.known", self.known)
        if not isinstance(self.parameters, Mapping):
            raise ValueError(
                f"Randomization.parameters must be distributions by name, got {self.parameters!r}"
            )
        unknown = sorted(set(self.parameters) - set(COLUMNS), key=str)
        if unknown:
            raise ValueError(
                f"randomization of {unknown[0]!r} is unknown; parameters that can be drawn are "
                f"{', '.join(COLUMNS)}{check.did_you_mean(unknown[0], COLUMNS)}"
            )
        if {"wind_speed", "wind_direction"} & set(self.parameters) and {
            "wind_east",
            "wind_north",
        } & set(self.parameters):
            raise ValueError(
                "randomization must draw the wind by wind_speed and wind_direction or by wind_east "
                "and wind_north, not by both"
            )
        for drawable in DRAWABLES:
            if drawable.name in self.parameters:
                self.distributions(drawable.name)

    @classmethod
    def of(cls, given: "Randomization | Mapping[str, Given] | None") -> "Randomization":
        """Return a randomization from one, from distributions by name, or from None."""
        return given if isinstance(given, Randomization) else cls({} if given is None else given)

    @cached_property
    def names(self) -> tuple[str, ...]:
        """Names of the parameters that are drawn, in the order of `DRAWABLES`."""
        return tuple(name for name in COLUMNS if name in self.parameters)

    def distributions(self, name: str) -> tuple[Distribution | None, ...]:
        """Return the distribution of each component of a parameter; None: not drawn."""
        size = COLUMNS[name].stop - COLUMNS[name].start
        if name == "feature_offsets_I":
            size = 3
        given = self.parameters.get(name)
        if given is None or isinstance(given, Distribution):
            if name in self.parameters and given is None:
                raise ValueError(f"randomization of {name!r} must be a distribution, got None")
            return (given,) * size
        if not isinstance(given, (tuple, list)) or len(given) != size:
            wanted = "a distribution" if size == 1 else f"a distribution or {size} of them"
            raise ValueError(f"randomization of {name!r} must be {wanted}, got {given!r}")
        for part in given:
            if not (part is None or isinstance(part, Distribution)):
                raise ValueError(f"randomization of {name!r} must be distributions, got {part!r}")
        return tuple(given)


class DrawingTable(Ranges):
    """A randomization in numbers: the distribution of each column of a flight's field `drawn`.

    Vehicle, sensors, world and delay of actions [control steps] are those without draws. Ranges
    with invalid values are refused, such as a vehicle too heavy to hover.
    """

    def __init__(
        self,
        randomization: Randomization,
        vehicle: VehicleParams,
        sensors: SensorSuite,
        world: WorldParams,
        action_delay: float = 0.0,
    ) -> None:
        self.names = randomization.names
        self.drawables = [drawable for drawable in DRAWABLES if drawable.name in self.names]
        self.kind = np.zeros(DRAWN_SIZE, np.int64)
        self.a, self.b, self.c, self.d = np.zeros((4, DRAWN_SIZE))
        nominal = nominal_values(vehicle, sensors, world)
        nominal[COLUMNS["action_delay"]] = action_delay
        self.low, self.high = nominal.copy(), nominal.copy()
        self.center, self.spread = np.zeros(DRAWN_SIZE), np.ones(DRAWN_SIZE)
        for drawable in self.drawables:
            parts = randomization.distributions(drawable.name)
            if drawable.name == "feature_offsets_I":
                parts = parts * max(sensors.blocks_of("pixels"), 1)
            for column, part in enumerate(parts, drawable.columns.start):
                self._fill(drawable, column, part, nominal[column])
        check_bounds(self, parts_of(vehicle, sensors, world))
        check_hovering(self, vehicle, world)

    def mean_square(self, name: str) -> NDArray[np.float64]:
        """Return the mean squares (size,) of a parameter's components over their distributions."""
        u, quantile = (np.arange(4096) + 0.5) / 4096, NormalDist().inv_cdf
        found = []
        for k in range(COLUMNS[name].start, COLUMNS[name].stop):
            kind, a, b = int(self.kind[k]), self.a[k], self.b[k]
            if kind == UNIFORM:
                values = a + b * u
            elif kind == LOG_UNIFORM:
                values = a * np.exp(b * u)
            elif kind == NORMAL:
                values = a + b * np.array([quantile(p) for p in self.c[k] + self.d[k] * u])
            else:
                values = np.zeros(1)
            found.append(math.fsum(values * values) / values.size)
        return np.array(found)

    def _fill(
        self, drawable: Drawable, column: int, part: Distribution | None, nominal: float
    ) -> None:
        name = drawable.name
        if np.isnan(nominal):
            raise ValueError(f"randomization of {name!r} needs {_MISSING[drawable.of]}, got none")
        if part is None:  # a component that stays among others that are drawn
            part = Uniform(nominal, nominal)
        if part.relative and nominal == 0.0:
            raise ValueError(
                f"randomization of {name!r} must not be relative: its nominal value is 0"
            )
        factor, shift = (nominal, 0.0) if part.relative else (1.0, nominal * part.offset)
        low, high = sorted(factor * bound + shift for bound in part.support)
        too_low = low < drawable.least or (low <= drawable.above > -math.inf)
        if too_low or high > drawable.most:
            raise ValueError(
                f"randomization of {name!r} must stay {_range_in_words(drawable)}, got "
                f"{part!r}, which reaches from {low:g} to {high:g}"
            )
        if drawable.unit == "rad":
            for end in (low, high):
                check.angle(f"randomization of {name!r}", end)
        self.kind[column], self.a[column], self.b[column], self.c[column], self.d[column] = (
            part.placed(factor, shift)
        )
        self.low[column], self.high[column] = low, high
        center, spread = part.center_and_spread
        self.center[column] = factor * center + shift
        self.spread[column] = abs(factor * spread) or 1.0


def _range_in_words(drawable: Drawable) -> str:
    words = []
    if drawable.above > -math.inf:
        words.append(f"above {drawable.above:g}")
    if drawable.least > -math.inf:
        words.append(f"at least {drawable.least:g}")
    if drawable.most < math.inf:
        words.append(f"at most {drawable.most:g}")
    return f"{' and '.join(words)} {'' if drawable.unit == '-' else drawable.unit}".strip()


_MISSING = {
    **{name: in_words(name) for name in SENSOR_PARAMS},
    "antennas": "GNSS with two antennas",
    "battery": "a battery (WorldParams.battery)",
}
"""Parts that a configuration may lack, in messages."""


def parts_of(vehicle: VehicleParams, sensors: SensorSuite, world: WorldParams) -> dict[str, Any]:
    """Return the parts with nominal values of drawn parameters, by `Drawable.of`; None: missing."""
    parts = {"vehicle": vehicle, "world": world, "battery": world.battery, "imu": sensors.imu}
    paired = sensors.blocks_of("gnss_baseline") > 0
    every = {name: getattr(sensors, name) for name in SENSOR_PARAMS}
    return parts | every | {"antennas": every["gnss"] if paired else None}


def nominal_values(
    vehicle: VehicleParams, sensors: SensorSuite, world: WorldParams
) -> NDArray[np.float64]:
    """Return the columns (DRAWN_SIZE,) of `drawn` without draws; NaN: of a missing part."""
    east, north, up = world.wind_I
    derived: dict[str, Any] = {
        "inertia": np.diag(vehicle.inertia),
        "rotor_efficiency": 1.0,
        "wind_east": east,
        "wind_north": north,
        "wind_up": up,
        "wind_speed": portable.hypot(east, north),
        "wind_direction": portable.atan2(north, east),
    }
    values, parts = np.zeros(DRAWN_SIZE), parts_of(vehicle, sensors, world)
    for drawable in DRAWABLES:
        part = parts.get(drawable.of)
        value = derived.get(drawable.name, getattr(part, drawable.field, 0.0))
        values[drawable.columns] = math.nan if drawable.of and part is None else value
    return values

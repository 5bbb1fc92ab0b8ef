"""Domain randomization: parameters drawn in every episode, and their distributions.

Draws happen inside the kernel from each flight's own random stream, so the parameters of an episode
depend only on the seed of its flight.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from statistics import NormalDist
from typing import Any

import numpy as np
from numpy.typing import NDArray

from quad_gym.params import checks as check
from quad_gym.params import portable
from quad_gym.params.distributions import Distribution, Uniform
from quad_gym.params.draw_limits import Ranges, check_bounds, check_hovering
from quad_gym.params.sensors import SensorSuite
from quad_gym.params.vehicle import VehicleParams
from quad_gym.params.world import WorldParams
from quad_gym.records import COLUMNS, DRAWABLES, DRAWN_SIZE, LOG_UNIFORM, NORMAL, UNIFORM, Drawable

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
            if drawable.name == "feature_offsets_I" and sensors.camera is not None:
                parts = parts * len(sensors.camera.features_I)
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
    "camera": "a camera",
    "gnss": "GNSS",
    "antennas": "GNSS with two antennas",
    "battery": "a battery (WorldParams.battery)",
}
"""Parts that a configuration may lack, in messages."""


def parts_of(vehicle: VehicleParams, sensors: SensorSuite, world: WorldParams) -> dict[str, Any]:
    """Return the parts with nominal values of drawn parameters, by `Drawable.of`; None: missing."""
    gnss = sensors.gnss
    paired = gnss if gnss is not None and gnss.has_baseline else None
    parts = {"vehicle": vehicle, "world": world, "battery": world.battery, "imu": sensors.imu}
    return parts | {"gnss": gnss, "antennas": paired, "camera": sensors.camera}


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

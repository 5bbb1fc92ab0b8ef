"""Limits of draws: within the bounds of the parameters, able to hover, and stable."""

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from quad_gym.params.clocks import Clocks
from quad_gym.params.gnss import check_baseline
from quad_gym.params.vehicle import (
    RK4_LIMIT,
    VehicleParams,
    check_gyration,
    check_lag,
    check_moments,
)
from quad_gym.params.world import WorldParams
from quad_gym.records import COLUMNS, Drawable

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


def check_draws(table: Ranges, vehicle: VehicleParams, world: WorldParams, clocks: Clocks) -> None:
    """Refuse rotors that are too fast, or drag that is too large, for the integration."""
    _check_drag(table, vehicle, world, clocks)
    name = label = "motor_time_constant"
    if name in table.names:
        label = f"randomization of {name!r} at its smallest draw"
    check_lag(label, table.least(name), clocks)


def _check_drag(table: Ranges, vehicle: VehicleParams, world: WorldParams, clocks: Clocks) -> None:
    """Refuse drag that slows the vehicle down within a Runge-Kutta step, which would diverge."""

    def most(name: str) -> float:
        return max(-table.least(name), table.most(name))

    wind = sum(most(f"wind_{part}") for part in ("east", "north", "up", "speed"))
    speed = FAST + wind + float(np.linalg.norm(world.wind_I)) + most("gust_wind_speed")
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

"""Quantities of a log: values that no sensor measures are left out, and sensors are compared.

Each check yields one sentence that names the cause. Implausible streams are left out; they are
never fused.
"""

import math
from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np

from quad_gym.frames import ecef_to_enu
from quad_gym.logs.formats.log import Floats, Log, LogSource, RawLog, positive
from quad_gym.params.sensor_table import READINGS, SENSOR_PARAMS
from quad_gym.params.suites import SensorSuite

ENOUGH, LONG = 20, 2.0  #: number of rows, and their duration [s], from which a constant is dead
MIN_FORCE = 5.0  #: specific force that contains gravity, at least [m/s^2]
EARTH = (6.3e6, 7.0e6)  #: distances of receivers from the center of the Earth [m]
NULL_ISLAND = 2e4  #: distance from 0 degrees north and east without land [m]
SEA_LEVEL, SCALE, EXPONENT = 101325.0, 44330.77, 0.190263
"""Pressure [Pa], height [m] and exponent of the standard atmosphere (ISO 2533)."""
PRESSURES = (26_000.0, 110_000.0)  #: pressures from 10 km above to 700 m below sea level [Pa]
UNITS_OF_PRESSURE = {1.0: "Pa", 1e2: "hPa", 1e3: "kPa", 1e5: "bar"}  #: how many Pa one of them has
APART = 30.0  #: median difference of heights by barometer and GNSS on one level, at most [m]
MOVED = 5.0  #: extent of a motion that shows the scale of measurements [m]
HIGHEST = 20_000.0  #: mean height of a flight [m]
ALIKE = 0.9  #: correlation of heights that belong together [-]
CERTAIN = 4.0  #: standard deviations of a motion beyond which it is no noise
OFF = 0.5
"""Difference from 1 of the median ratio of velocities and motion, as complex numbers: of their turn
and scale [-]. Noise and outliers of positions leave it at 1."""
UNKNOWN = "wrong direction, unit or axes"  #: cause of velocities that contradict the positions
CORRELATED = 0.7  #: correlation of velocities and motion that belong together [-]
SILENT = 0.25  #: ratio of velocities and motion below which a log has no velocities [-]
SPAN = 1.0  #: time over which velocities are compared with positions [s]
DISPUTE = 5.0  #: time for which they contradict each other before it is worth a judgment [s]
FARTHEST = 1e6  #: distance from the origin of I [m]
FAST = 100.0  #: speed of a jump away from a fix at zero [m/s]
_LENGTHS = {
    -1.0: "m downward",
    0.001: "km",
    3.28084: "ft",
    100.0: "cm",
    1000.0: "mm",
    -12.0: "Pa",
    -0.12: "hPa",
}
"""Units of a height or pressure, by the change of the number per meter of height."""
MAX_FIELD = 5.0  #: ratio of the median magnetic field and the suite's, either way [-]
_FIELDS = {1e4: "gauss", 1e6: "microtesla", 1e7: "milligauss", 1e9: "nanotesla"}
"""Units of a magnetic field, by how many of them one tesla has."""
_SPEEDS = {100.0: "cm/s", 3.6: "km/h", 1.94384: "knots", 3.28084: "ft/s", 1000.0: "mm/s"}
"""Units of a speed, by how many of them 1 m/s has."""


# ---- one source ----------------------------------------------------------------------------------


def measured(recording: RawLog, source: LogSource) -> LogSource:
    """Return a source without rows in which nothing was measured; empty: without any that was."""
    if source.sensor == "gnss":
        source = _with_valid_numbers(source)
    source = source.keep(_finite(source), "nothing measured")
    if source.sensor == "gnss":
        source = _with_fix(source)
    elif source.sensor == "magnetometer":
        source = source.keep(source.values["magnetometer"].any(axis=1), "zero field")
    elif source.sensor == "barometer" and "pressure" in source.values:
        source = _height(recording, source)
    if len(source) < ENOUGH or np.ptp(source.time) < LONG:
        return source
    for name, values in source.values.items():
        dead = source.sensor in ("magnetometer", "barometer")
        if dead and not np.ptp(values, axis=0).any():
            word = "zero" if not values.any() else "constant"
            return source.keep(np.zeros(len(source), bool), f"{word} {name}")
    if (force := source.values.get("accel")) is not None:
        size = float(np.median(np.linalg.norm(force, axis=1)))
        if size < MIN_FORCE and np.linalg.norm(force.mean(axis=0)) < 0.5 * size:
            return source.keep(np.zeros(len(source), bool), "specific force without gravity")
    return source


def _with_valid_numbers(source: LogSource) -> LogSource:
    """Return GNSS measurements with NaN for zero baselines and accuracies: both mean unknown."""
    values = dict(source.values)
    for name, value in values.items():
        if "sigma" in name:
            values[name] = positive(value)
        elif "baseline" in name:
            values[name] = np.where(np.any(value, axis=1, keepdims=True), value, np.nan)
    return replace(source, values=values)


def _finite(source: LogSource) -> Any:
    """Return True for the rows in which all of a vector, or of one of several, was measured."""
    if not len(source):
        return np.ones(0, bool)
    values, kind = source.values, SENSOR_PARAMS.get(source.sensor)
    known = [
        reading.known(values[key])
        for reading in (() if kind is None else kind.readings(source.sensor))
        for key in reading.in_logs
        if key in values
    ]
    if known:
        return np.any(known, axis=0)
    whole = [np.isfinite(value.reshape(len(source), -1)).all(axis=1) for value in values.values()]
    return np.all(whole, axis=0)


def _with_fix(source: LogSource) -> LogSource:
    """Return GNSS measurements without positions that no receiver has."""
    if (places := source.values.get("gnss_position_G")) is not None:
        away = np.linalg.norm(places, axis=1)
        null = np.linalg.norm(places - [6378137.0, 0.0, 0.0], axis=1) < NULL_ISLAND
        ok = ~np.isfinite(away) | ((away > EARTH[0]) & (away < EARTH[1]) & ~null)
        return source.keep(ok, "no place on the Earth, or 0, 0")
    if (places := source.values.get("gnss_position_I")) is None:
        return source
    far = np.linalg.norm(places, axis=1) > FARTHEST
    source = source.keep(~far, "farther than 1000 km")
    places = source.values["gnss_position_I"]
    away, time = np.linalg.norm(places, axis=1), source.time
    real = np.flatnonzero(away > 0.0)
    if not 0 < len(real) < len(away):
        return source
    slow = np.ones(len(away), bool)
    for k in np.flatnonzero(away == 0.0):  # near a real fix, a zero may be one too
        place = int(np.searchsorted(real, k))
        near = real[max(0, place - 1) : place + 1]
        steps = np.maximum(np.abs(time[near] - time[k]), 1e-3)
        slow[k] = (away[near] / steps).min() < FAST
    return source.keep(slow, "fix at 0, 0, 0")


def _height(recording: RawLog, source: LogSource) -> LogSource:
    """Return heights from static pressures, in the unit that makes them such."""
    pressure = source.values["pressure"]
    middle = float(np.median(pressure)) if len(pressure) else 0.0
    for factor, unit in UNITS_OF_PRESSURE.items():
        if PRESSURES[0] < factor * middle < PRESSURES[1]:
            if factor != 1.0:
                recording.notes.append(f"{source.name}: pressure is {middle:.4g}, taken as {unit}")
            ratio = np.maximum(factor * pressure, 1.0) / SEA_LEVEL
            heights = SCALE * (1.0 - ratio**EXPONENT)
            right = (factor * pressure > PRESSURES[0]) & (factor * pressure < PRESSURES[1])
            return replace(source, values={"barometer": heights}).keep(right, "no static pressure")
    reason = f"{middle:.4g} in the median is no pressure of the atmosphere: differential?"
    return source.keep(np.zeros(len(source), bool), reason)


# ---- several sensors -----------------------------------------------------------------------------

_Found = Iterator[tuple[dict[str, Any], str]]


def compared(log: Log, suite: SensorSuite) -> Log:
    """Return a log without streams that others contradict, with sentences about them.

    Streams that the suite does not use are not compared.

    Args:
        log: The log.
        suite: The suite, whose reference antenna is the origin of I.
    """
    gnss = suite.gnss
    checks: list[Callable[[Log, Floats, Floats], _Found]] = []
    if gnss is not None:
        checks.append(_heights_of_gnss)
        checks += [_velocities] if gnss.velocity_sigma is not None else []
    if suite.barometer is not None:
        checks += [_unit_of_barometer]
    problems = list(log.problems)
    for changes, sentence in _unit_of_heading(log):
        log = replace(log, **changes)
        problems.append(sentence)
    origin_G = None if gnss is None else np.array(gnss.reference_antenna_G)
    for check in checks:
        for changes, sentence in check(log, *_places(log, origin_G)):
            log = replace(log, **changes)
            problems.append(sentence)
    if suite.barometer is not None:
        for changes, sentence in _level_of_barometer(log, *_places(log, origin_G)):
            log = replace(log, **changes, notes=(*log.notes, sentence))
    if suite.magnetometer is not None:
        for changes, sentence in _unit_of_field(log, suite.magnetometer.strength):
            log = replace(log, **changes)
            problems.append(sentence)
    return replace(log, problems=tuple(problems))


def _places(log: Log, origin_G: Floats | None) -> tuple[Floats, Floats]:
    """Return times (n,) and places (n, 3) of fixes in I."""
    for name in ("gnss_position_I", "gnss_position_G"):
        places = None if log.gnss is None else log.gnss.values.get(name)
        if log.gnss is None or places is None:
            continue
        rows = np.isfinite(places).all(axis=1)
        time, places = log.gnss.time[rows], places[rows]
        if name == "gnss_position_G" and len(places):
            origin = places[0] if origin_G is None else origin_G
            places = (places - origin) @ ecef_to_enu(origin).T
        return time, places
    return np.empty(0), np.empty((0, 3))


def _heights_of_gnss(log: Log, time: Floats, places: Floats) -> _Found:
    """Heights that are never filled: constant, while the vehicle moves."""
    gnss = log.gnss
    if gnss is None or len(time) < ENOUGH or np.ptp(places[:, :2], axis=0).max() < MOVED:
        return
    level = places[:, 2] + (places[:, :2] ** 2).sum(axis=1) / (2.0 * EARTH[0])
    if np.ptp(level) > 2e-3:
        return
    sigma = gnss.values.get("gnss_sigma")
    sigma = np.full((len(gnss), 3), np.nan) if sigma is None else sigma.copy()
    sigma[:, 2] = np.inf
    yield (
        {"gnss": replace(gnss, values={**gnss.values, "gnss_sigma": sigma})},
        "heights of GNSS are constant while the vehicle moves: they are not filled, and left out",
    )


class _Motion(NamedTuple):
    """Mean velocities over `SPAN` by two witnesses, at the ends of these times."""

    time: Floats  #: (n,) [s]
    moved: Floats  #: (n, 3) by positions, in I [m/s]
    told: Floats  #: (n, 3) by velocities of the log, in I [m/s]
    limit: float  #: difference that noise of positions does not explain [m/s]


def _motion(log: Log, time: Floats, places: Floats) -> tuple[str, _Motion] | None:
    """Return the name of the velocities of a log, and its motion; None: there are too few."""
    gnss = log.gnss
    if gnss is None:
        return None
    name = next((n for n in ("gnss_velocity_I", "gnss_velocity_G") if n in gnss.values), None)
    if name is None or len(time) < ENOUGH:
        return None
    told = gnss.values[name]
    rows = np.isfinite(told).all(axis=1)
    if rows.sum() < ENOUGH:
        return None
    if name == "gnss_velocity_G":
        if (fixes := gnss.values.get("gnss_position_G")) is None:
            return None
        told = told @ ecef_to_enu(fixes[np.isfinite(fixes).all(axis=1)][0]).T
    ends, moved, mean = _motions(time, places, gnss.time[rows], told[rows])
    bends = np.abs(np.diff(places[:, :2], 2, axis=0))
    noise = math.sqrt(2.0 / 6.0) * float(np.median(bends)) / 0.6745  # of a difference
    return name, _Motion(ends, moved, mean, max(1.0, CERTAIN * noise / SPAN))


def _velocities(log: Log, time: Floats, places: Floats) -> _Found:
    """Velocities that differ from differenced positions in direction, unit or axes."""
    found = _motion(log, time, places)
    if found is None or log.gnss is None:
        return
    name, motion = found
    rows = _contradiction(motion.moved, motion.told, motion.limit)
    if rows is None:
        return
    cause = _cause(motion.moved[rows], motion.told[rows])
    if cause == UNKNOWN and _agree_otherwise(motion.moved, motion.told, motion.limit):
        return  # for some time only, see `disputed`
    values = {k: v for k, v in log.gnss.values.items() if k not in (name, "velocity_sigma")}
    yield (
        {"gnss": replace(log.gnss, values=values)},
        f"GNSS velocities contradict the positions: {cause}; they are left out",
    )


def disputed(log: Log, suite: SensorSuite) -> tuple[float, float] | None:
    """Return the time in which positions and velocities of GNSS contradict each other.

    None: in no part of the log, or not only in one.
    """
    if suite.gnss is None or suite.gnss.velocity_sigma is None:
        return None
    found = _motion(log, *_places(log, np.array(suite.gnss.reference_antenna_G)))
    if found is None:
        return None
    _, (time, moved, told, limit) = found
    apart = time[np.linalg.norm((moved - told)[:, :2], axis=1) >= limit]
    if not len(apart) or np.ptp(apart) < DISPUTE or not _agree_otherwise(moved, told, limit):
        return None
    return float(apart[0] - SPAN), float(apart[-1])


def without(log: Log, quantity: str, span: tuple[float, float]) -> Log:
    """Return a log without a quantity of GNSS, "position" or "velocity", for some time."""
    assert log.gnss is not None
    inside = (log.gnss.time >= span[0]) & (log.gnss.time <= span[1])
    values = {
        name: np.where(inside[:, np.newaxis], np.nan, value)
        if name in READINGS[f"gnss_{quantity}"].in_logs
        else value
        for name, value in log.gnss.values.items()
    }
    return replace(log, gnss=replace(log.gnss, values=values))


def _contradiction(moved: Floats, mean: Floats, limit: float) -> Any:
    """Return the rows (n,) above a speed if they contradict each other; None: they do not.

    The velocities of the log choose the rows: positions would choose those with the largest
    noise, which are faster than the motion. Positions choose if the log has hardly any velocity.
    """
    by_places, told = (v[:, 0] + 1j * v[:, 1] for v in (moved, mean))
    for chosen, other in ((told, by_places), (by_places, told)):
        rows = np.abs(chosen) > limit
        if rows.sum() >= ENOUGH:
            ratios = other[rows] / chosen[rows]
            ratio = complex(np.median(ratios.real), np.median(ratios.imag))
            off = abs(1.0 - ratio) > OFF * abs(ratio) if chosen is told else abs(ratio) < SILENT
            return rows if off else None
    return None


def _agree_otherwise(moved: Floats, mean: Floats, limit: float) -> bool:
    """Return True if velocities agree with the positions where they do not differ by a limit.

    Velocities in another direction or unit are wrong all the time. A receiver that drifts or jumps
    is wrong for some time.
    """
    by_places, told = (v[:, 0] + 1j * v[:, 1] for v in (moved, mean))
    others = np.abs(by_places - told) < limit
    apart = np.flatnonzero(~others)
    if not len(apart) or len(apart) < 0.8 * (apart[-1] - apart[0] + 1):
        return False  # they differ again and again
    a, b = told[others], by_places[others]
    if len(a) < max(ENOUGH, len(told) // 3) or not (np.any(a) and np.any(b)):
        return False
    ratio = complex(np.vdot(a, b) / np.vdot(a, a))  # of the positions' velocities to the told ones
    alike = np.abs(np.vdot(a, b)) / math.sqrt(float(np.vdot(a, a).real * np.vdot(b, b).real))
    return bool(abs(1.0 - ratio) < OFF and alike > CORRELATED)


def _motions(
    time: Floats, places: Floats, stamps: Floats, told: Floats
) -> tuple[Floats, Floats, Floats]:
    """Return times, and mean velocities over the second before by positions and by velocities.

    Over a second, noise of the positions matters little.
    """
    begin = np.searchsorted(time, time - SPAN)
    length = time - time[begin]
    use = np.flatnonzero((length > 0.5 * SPAN) & (length < 2.0 * SPAN))
    begin, length = begin[use], length[use, np.newaxis]
    order = np.argsort(stamps, kind="stable")
    stamps, told = stamps[order], told[order]
    integral = np.zeros_like(told)
    steps = np.diff(stamps)[:, np.newaxis]
    integral[1:] = np.cumsum(0.5 * (told[1:] + told[:-1]) * steps, axis=0)
    at = np.column_stack([np.interp(time, stamps, column) for column in integral.T])
    return time[use], (places[use] - places[begin]) / length, (at[use] - at[begin]) / length


def _differs(moved: Floats, mean: Floats) -> float:
    """Return the median difference of horizontal velocities over the median speed [-]."""
    difference = np.linalg.norm((mean - moved)[:, :2], axis=1)
    speed = float(np.median(np.linalg.norm(moved[:, :2], axis=1)))
    return float(np.median(difference)) / speed if speed > 0.0 else math.inf


def _cause(moved: Floats, mean: Floats) -> str:
    """Return the likely cause of velocities that differ from the motion."""
    east, north, up = mean.T
    course = np.degrees(np.arctan2(east, north)) % 360.0
    speed = np.hypot(east, north)
    angle = course.copy()
    angle[angle > 180.0] -= 360.0
    turned = np.column_stack([speed * np.sin(angle), speed * np.cos(angle), up])
    tries = {
        "course in radians taken for degrees": turned,
        "north, east, down in place of east, north, up": np.column_stack([north, east, -up]),
        "the sign is reversed": -mean,
    }
    tries |= {f"velocities in {unit}": mean / factor for factor, unit in _SPEEDS.items()}
    best = min(tries, key=lambda cause: _differs(moved, tries[cause]))
    if _differs(moved, tries[best]) < 0.3:
        return best
    return UNKNOWN


def _beside(log: Log, time: Floats, places: Floats) -> tuple[Floats, Floats] | None:
    """Return heights by the barometer (n,) and by GNSS at these times; None: too few."""
    barometer = log.barometer
    if barometer is None or len(time) < ENOUGH:
        return None
    inside = (barometer.time >= time[0]) & (barometer.time <= time[-1])
    if inside.sum() < ENOUGH:
        return None
    ups = np.interp(barometer.time[inside], time, places[:, 2])
    return barometer.values["barometer"][inside], ups


def _unit_of_barometer(log: Log, time: Floats, places: Floats) -> _Found:
    """Heights in another unit, or pressures."""
    if log.barometer is None or not len(log.barometer):
        return
    mean = float(log.barometer.values["barometer"].mean())
    if abs(mean) > HIGHEST and not log.barometer_from_start:
        yield (
            {"barometer": None},
            f"mean barometric height is {mean:.6g} m: pressure in Pa in place of a height? It is "
            "left out",
        )
        return
    both = _beside(log, time, places)
    if both is None or np.ptp(both[1]) < MOVED or np.ptp(both[0]) == 0.0:
        return
    heights, ups = (values - values.mean() for values in both)
    slope = float(ups @ heights / (ups @ ups))
    near = min(_LENGTHS, key=lambda unit: abs(math.log(max(slope / unit, 1e-12))))
    if abs(np.corrcoef(heights, ups)[0, 1]) > ALIKE and abs(slope / near - 1.0) < 0.25:
        yield (
            {"barometer": None},
            f"the barometer changes by {slope:.3g} per meter of GNSS height: in {_LENGTHS[near]}? "
            "It is left out",
        )


def _level_of_barometer(log: Log, time: Floats, places: Floats) -> _Found:
    """Heights above another level than the heights by GNSS."""
    both = _beside(log, time, places)
    if both is None or log.barometer_from_start:
        return
    apart = float(np.median(both[0] - both[1]))
    if abs(apart) > APART:
        yield (
            {"barometer_from_start": True},
            f"heights of the barometer are {apart:.0f} m above those of GNSS in the median: above "
            "sea level beside heights above home? Only their changes are used",
        )


def _unit_of_heading(log: Log) -> _Found:
    """Headings beyond a whole turn and what the vehicle has turned."""
    headings = None if log.attitude is None else log.attitude.values.get("heading")
    if headings is None or not len(headings):
        return
    turned = np.cumsum(log.imu.values["gyro"][1:, 2] * np.diff(log.imu.time))
    largest, most = float(np.abs(headings).max()), 2.0 * math.pi + 1.5 * float(np.ptp(turned))
    if largest > most:
        yield (
            {"attitude": None},
            f"headings reach {largest:.3g} rad, at most {most:.3g} expected: in degrees? They are "
            "left out",
        )


def _unit_of_field(log: Log, strength: float) -> _Found:
    """Magnetic fields in another unit than tesla."""
    if log.magnetometer is None or not len(log.magnetometer):
        return
    size = float(np.median(np.linalg.norm(log.magnetometer.values["magnetometer"], axis=1)))
    if 1.0 / MAX_FIELD <= size / strength <= MAX_FIELD:
        return
    near = {abs(math.log(size / strength / n)): f"field in {u}?" for n, u in _FIELDS.items()}
    cause = near[min(near)] if min(near) < math.log(MAX_FIELD) else "unit of the field?"
    yield (
        {"magnetometer": None},
        f"mean magnetic field is {size:.3g} T, {strength:.3g} expected: {cause} It is left out",
    )

"""Measurements of a log as the filter of a suite receives them, and the rows of its calls."""

import math
from collections.abc import Iterator, Mapping
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from quad_gym.estimation.filters import LONGEST_STEP
from quad_gym.estimation.inputs import (
    HEADING_ALONE,
    Measurement,
    checked_measurement,
    sigmas_of,
    values_of,
)
from quad_gym.estimation.starts import level
from quad_gym.frames import ecef_to_enu
from quad_gym.logs.formats import Floats, Log, Stream
from quad_gym.params import checks as check
from quad_gym.params.aids import ReadingDefinition
from quad_gym.params.gnss import GnssParams
from quad_gym.params.portable import turned
from quad_gym.params.sensor_table import AID_PARAMS, READINGS, SENSOR_OF, SENSOR_PARAMS
from quad_gym.params.suites import SensorSuite
from quad_gym.records.inputs import SAME_TIME, Outcome
from quad_gym.rotations import euler_to_dcm, quaternion_to_dcm

# --------------------------------------------------------------------------------------------------
# Checks of the units and axes of a log, as plain sentences.
#
# Each sentence states a number, the expected one, and the likely cause.
# --------------------------------------------------------------------------------------------------

MIN_FORCE, MAX_FORCE = 5.0, 20.0
"""Median specific force of a flight [m/s^2], near gravity; a crash hardly changes it."""
FORCE_CAUSES = (
    (0.5, "gravity subtracted from the accelerometer?"),
    (2.0, "accelerometer in g?"),
    (25.0, "unit or scale of the accelerometer?"),
    (50.0, "accelerometer in ft/s^2?"),
    (500.0, "unit or scale of the accelerometer?"),
    (math.inf, "accelerometer in milli-g or cm/s^2?"),
)
"""Likely causes of other values, each up to a median specific force [m/s^2]."""
MAX_RATE = 35.0  #: largest angular rate that gyros measure [rad/s]: 2000 deg/s
MAX_MEAN_RATE = 10.0
"""Mean angular rate of a vehicle over a log [rad/s]: one and a half turns per second."""


class MisfitError(ValueError):
    """The suite cannot be used with the log."""


def implausible(log: Log, body: str) -> Iterator[str]:
    """Yield sentences on units and axes of the IMU of a log."""
    gyro, accel = (log.imu.values[name] for name in ("gyro", "accel"))
    yield from _force(accel, body)
    yield from _rates(gyro)


def nothing_in_common(unused: tuple[str, ...]) -> str:
    """Return a sentence on a suite that has none of the sensors of a log."""
    return f"this suite uses no measurement of this log, which has {', '.join(unused)}"


def _force(accel: Floats, body: str) -> Iterator[str]:
    """Units and axes of the accelerometer, by gravity."""
    size, upward = float(np.median(np.linalg.norm(accel, axis=1))), np.median(accel, axis=0)
    if not MIN_FORCE <= size <= MAX_FORCE:
        cause = next(cause for most, cause in FORCE_CAUSES if size <= most)
        yield f"median specific force is {size:.1f} m/s^2, 9.8 expected: {cause}"
    axis = int(np.argmax(np.abs(upward)))
    if abs(upward[axis]) < 0.5 * size or (axis == 2 and upward[2] > 0.0):
        return
    sign = "+" if upward[axis] > 0.0 else "-"
    pointing = f"median specific force points along the body's {sign}{'xyz'[axis]}"
    if axis == 2:
        other = {"flu": "frd", "frd": "flu"}[body]
        yield f"{pointing} axis, +z expected: body='{other}' (--body {other})?"
    else:
        yield f"{pointing} axis, +z expected: axes of the IMU other than forward, left and up?"


def _rates(gyro: Floats) -> Iterator[str]:
    """Units of the gyro."""
    sizes = np.linalg.norm(gyro, axis=1)
    if np.abs(gyro).max() > MAX_RATE:
        yield (
            f"angular rates reach {np.abs(gyro).max():.3g} rad/s, gyros measure up to "
            f"{MAX_RATE:g} rad/s: gyro in deg/s?"
        )
    elif sizes.mean() > MAX_MEAN_RATE:
        yield (
            f"mean angular rate is {sizes.mean():.3g} rad/s, at most {MAX_MEAN_RATE:g} expected: "
            "gyro in deg/s?"
        )


# --------------------------------------------------------------------------------------------------
# A fictitious position for logs in which nothing measures position or velocity.
#
# Roll and pitch are then dead reckoning, and drift. As EKF2 and EKF3 do, the filter assumes that
# the vehicle stays near its first place, with a wide standard deviation: specific force is then
# gravity on average, which keeps roll and pitch. The estimated position itself has no meaning.
#
# Source: PX4, EKF2_NOAID_NOISE, 10 m.
# --------------------------------------------------------------------------------------------------

SIGMA, PERIOD = 10.0, 1.0  #: standard deviation [m], and time between measurements [s]
SENTENCE = (
    f"nothing measures the position: a fictitious one, with a standard deviation of {SIGMA:g} m, "
    "keeps roll and pitch; the estimated position and velocity have no meaning"
)


def lacks_position(log: Log, suite: SensorSuite) -> bool:
    """Return True if no sensor of a filter measures position or velocity in a log."""
    moving = {"position", "velocity"}
    return not any(
        getattr(suite, SENSOR_OF[name]) is not None and SENSOR_OF[name] in log.streams
        for name, reading in READINGS.items()
        if moving & {*reading.observes}
    )


def held(log: Log, suite: SensorSuite, place: Any) -> tuple[Log, SensorSuite]:
    """Return a log with fictitious positions at a place (3,) in I, and a suite that uses them.

    With a barometer or range finder, they are level only.
    """
    heights = any(
        getattr(suite, name) is not None and name in log.streams
        for name, kind in AID_PARAMS.items()
        if "height" in kind.observes
    )
    time = np.arange(log.imu.time[0], log.imu.time[-1], PERIOD)
    sigma = np.tile([SIGMA, SIGMA, np.inf if heights else SIGMA], (len(time), 1))
    places = np.tile(np.asarray(place, np.float64), (len(time), 1))
    reference = GnssParams() if suite.gnss is None else suite.gnss
    gnss = GnssParams(
        rate=suite.imu.rate,
        primary_antenna_B=(0.0, 0.0, 0.0),
        secondary_antenna_B=None,
        reference_antenna_G=reference.reference_antenna_G,
        position_sigma_I=(SIGMA, SIGMA, SIGMA),
    )
    values = {"gnss_position_I": places, "gnss_sigma": sigma}
    return replace(log, gnss=Stream(time, time, values)), suite.replace(gnss=gnss)


# --------------------------------------------------------------------------------------------------
# Measurements of a log, as the filter of a suite receives them.
# --------------------------------------------------------------------------------------------------


UNMEASURED = 1e4  #: standard deviation along an axis that was not measured [m]


class _Column(NamedTuple):
    """A reading of a stream, which a suite uses."""

    reading: ReadingDefinition
    keyword: str  #: of a filter's `update`
    values: Floats  #: (n, ...) of the blocks that the suite has
    known: NDArray[np.bool_]  #: (n,) rows in which one of them was measured
    turns: bool  #: True for vectors in I, which a filter receives in G
    sigmas: Floats | None  #: (n, ...) accuracy that a receiver reports


class LogMeasurements:
    """Measurements of a log that a suite uses.

    Attributes:
        streams: Streams that the suite uses, by name; the IMU first.
        unused: Names of the others.
        R_GI: (3, 3) axes of I in G.
    """

    def __init__(self, log: Log, suite: SensorSuite, reported_noise: bool) -> None:
        self.log, self.suite, self._reported = log, suite, reported_noise
        given = {name: stream for name, stream in log.streams.items() if name != "imu"}
        used = {name: stream for name, stream in given.items() if self._uses(name)}
        self.streams = {"imu": log.imu, **used}
        self._names = list(self.streams)
        if "camera" in used:
            assert suite.camera is not None
            have = used["camera"].values["pixels"].shape[1]
            if have != len(suite.camera.features_I):
                raise MisfitError(
                    f"the log must have the {len(suite.camera.features_I)} features of the suite, "
                    f"got {have}"
                )
        self._columns: dict[str, list[_Column]] = {}
        left_out = [name for name in given if name not in used]
        for name in (name for name in used if name in SENSOR_PARAMS):
            self._columns[name] = []
            for reading in SENSOR_PARAMS[name].readings(name):
                keys = [key for key in reading.in_logs if key in used[name].values]
                if suite.blocks_of(reading.name):
                    self._columns[name] += [self._column(used[name], reading, key) for key in keys]
                elif keys:
                    left_out.append(reading.name)
        self.unused = tuple(left_out)
        self.R_GI, self._origin = np.eye(3), np.zeros(3)
        if suite.gnss is not None:
            self._origin = np.array(suite.gnss.reference_antenna_G)
            self.R_GI = ecef_to_enu(self._origin).T

    def _uses(self, name: str) -> bool:
        """Return True if the suite uses a stream: attitudes as baselines that the log lacks."""
        if name != "attitude":
            return getattr(self.suite, name) is not None
        gnss, given = self.suite.gnss, self.log.gnss
        told = given is not None and {*READINGS["gnss_baseline"].in_logs} & set(given.values)
        return gnss is not None and gnss.has_baseline and not told

    def _column(self, stream: Stream, reading: ReadingDefinition, key: str) -> _Column:
        """Return a reading of a stream, under one of its names in a log."""
        values, count = stream.values[key], self.suite.blocks_of(reading.name)
        blocks = values.reshape(len(stream), -1, reading.length)[:, :count]
        if blocks.shape[1] < count:
            raise MisfitError(
                f"the log must have the {count} blocks of {key} that the suite has, got "
                f"{blocks.shape[1]}"
            )
        return _Column(
            reading,
            reading.keyword,
            blocks.reshape(len(stream), *self.suite.shape_of(reading.name)),
            reading.known(blocks),
            reading.in_G and key != reading.keyword,
            stream.values.get(reading.sigma) if reading.reported else None,
        )

    def number(self, name: str) -> int:
        """Return the number of a stream."""
        return self._names.index(name)

    def by_number(self, number: int, k: int) -> Measurement:
        """Return measurement k of a stream, of which something was measured, by its number."""
        found = self.at(self._names[number], k)
        assert found is not None
        return found

    def present(self, number: int, rows: Any) -> NDArray[np.bool_]:
        """Return True for the rows of a stream, by its number, in which something was measured."""
        name = self._names[number]
        found = np.full(len(rows), name == "attitude")
        for column in self._columns.get(name, ()):
            found |= column.known[rows]
        return found

    def at(self, name: str, k: int) -> Measurement | None:
        """Return measurement k of a stream; None: nothing was measured."""
        found = checked_measurement(self.suite, self.keywords(name, k))
        if name == "attitude" and "heading" in self.streams[name].values:
            sigmas_of(found, "gnss_baseline")[:] = HEADING_ALONE
        return found if found["valid"].any() else None

    def keywords(self, name: str, k: int) -> dict[str, Any]:
        """Return measurement k of a stream as keywords of `update`; of an attitude, a baseline."""
        if name == "attitude":
            assert self.suite.gnss is not None
            baseline_I = turned(self._attitude(k).T, self.suite.gnss.baseline_B)
            return {"gnss_baseline_G": turned(self.R_GI, baseline_I)}
        found: dict[str, Any] = {}
        for column in self._columns[name]:
            if not column.known[k] or column.keyword in found:
                continue
            value = column.values[k]
            if column.turns:
                value = turned(self.R_GI, value)
            elif column.reading.from_center:
                value = value - self._origin
            found[column.keyword] = value
            if column.sigmas is not None:
                self._add_noise(found, name, column.reading, column.sigmas[k])
        return found

    def heading(self, time: float) -> float | None:
        """Return the heading by attitudes of the log near a time; None: unknown."""
        attitude = self.log.attitude
        if attitude is None or not len(attitude):
            return None
        k = int(np.argmin(np.abs(attitude.time - time)))
        R_BI = self._attitude(k)
        near = abs(attitude.time[k] - time) < LONGEST_STEP
        return math.atan2(R_BI[0, 1], R_BI[0, 0]) if near else None

    def _attitude(self, k: int) -> Floats:
        """Return an attitude R_BI of the log, level if only its heading is known."""
        assert self.log.attitude is not None
        values = self.log.attitude.values
        if "quaternion" in values:
            return quaternion_to_dcm(values["quaternion"][k])
        return level(float(values["heading"][k]))

    def _add_noise(
        self, found: dict[str, Any], sensor: str, reading: ReadingDefinition, sigma: Any
    ) -> None:
        """Add the accuracy that a receiver reports: infinity for an axis that was not measured."""
        if np.isinf(sigma).any():
            known = sigma if self._reported else np.full_like(sigma, np.nan)
            own = getattr(getattr(self.suite, sensor), reading.noise)
            known = np.where(np.isnan(known), own, known)
            found[reading.sigma] = np.where(np.isinf(sigma), UNMEASURED, known)
        elif self._reported and np.isfinite(sigma).all():
            found[reading.sigma] = sigma


# --------------------------------------------------------------------------------------------------
# The calls of a filter that replays a log, as rows that an exported filter repeats.
#
# A row has a name and numbers; NaN: not measured.
#
# | row | numbers |
# |---|---|
# | `origin` | reference antenna in G |
# | `start` | `time`, then the fields of `qg_start` (exported header), absent vectors as NaN |
# | `rest` | position, heading, time: a level vehicle at rest |
# | `level` | none: heights of the barometer are relative to the first one |
# | `imu` | angular rate, specific force, duration: a prediction |
# | `gnss` | time, position and its sigmas, baseline, velocity and its sigma |
# | `camera`, `barometer`, ... | time, the measurement |
# | `estimate` | none: the estimate is printed |
#
# Samples of the IMU and magnetic fields are in the axes of their sensors, from which the exported
# filter rotates them to B. Time stamps are corrected by the suite's delays. Positions, baselines
# and velocities are in G, positions relative to the reference antenna; their sigmas are in I.
# --------------------------------------------------------------------------------------------------

_STARTS = (
    "gnss_position_G",
    "gnss_sigma",
    "gnss_baseline_G",
    "gnss_velocity_G",
    "velocity_sigma",
    "heading",
    "magnetometer",
    "course",
    "time",
    "tilt_sigma",
    "rest_sigma",
)
"""Keywords of `initialize` that exported filters have, too."""


class FilterCalls:
    """Rows of the calls for a part of a log, in their order."""

    def __init__(self, suite: SensorSuite, log: Log) -> None:
        self._suite, self.rows = suite, list[str]()
        self._sensed = {"imu": log.as_sensed("imu").values}
        if log.magnetometer is not None:
            self._sensed["magnetometer"] = log.as_sensed("magnetometer").values
        if suite.gnss is not None:
            self._add("origin", *suite.gnss.reference_antenna_G)

    def start(
        self, given: Mapping[str, Any], field: int | None, barometer_from_start: bool
    ) -> None:
        """Add the start of the filter, with row `field` of the magnetometer, if it uses one."""
        if "position" in given:
            check.keywords(given, ("position", "heading", "time"), "start with samples=")
            self._add("rest", *given["position"], given["heading"], given["time"])
        else:
            check.keywords(given, _STARTS, "start with samples=")
            known = {"gnss_baseline_G", "heading", "magnetometer"} & set(given)
            if not (known or given.get("course")):
                raise ValueError(
                    "a log for an exported filter must have a baseline or a magnetic field at its "
                    "start, or give a heading or the course"
                )
            magnetometer = given.get("magnetometer")
            if magnetometer is not None:
                magnetometer = self._field(magnetometer, field)
            self._add(
                "start",
                given["time"],
                *given["gnss_position_G"],
                *_three(given.get("gnss_sigma")),
                *_three(given.get("gnss_baseline_G")),
                *_three(given.get("gnss_velocity_G")),
                given.get("velocity_sigma", math.nan),
                given.get("heading", math.nan),
                *_three(magnetometer),
                bool(given.get("course")),
                *(given.get(name, math.nan) for name in ("tilt_sigma", "rest_sigma")),
            )
        if barometer_from_start and self._suite.barometer is not None:
            self._add("level")

    def _field(self, field_B: Any, row: int | None) -> Floats:
        """Return the magnetic field of a start in the axes of the sensor."""
        if row is not None:
            return self._sensed["magnetometer"]["magnetometer"][row]
        return euler_to_dcm(self._suite.log_compass_rotation).T @ np.asarray(field_B)

    def take(self, given: Any, name: str, row: int, measurement: Measurement | None) -> None:
        """Add the calls for an INPUT that a filter has taken.

        Args:
            given: INPUT.
            name: Name of the stream.
            row: Row there; of samples, the one that holds for this time.
            measurement: The measurement; None: a sample.
        """
        now, time = float(given["now"]), float(given["time"])
        if measurement is not None:
            if given["outcome"] == Outcome.OK:
                self._update(name, time, row, measurement)
            return
        if given["keeps"]:
            self.keep()
        if time - now > SAME_TIME and math.isfinite(given["gyro"][0]):
            sample = self._sensed["imu"]
            self._add("imu", *sample["gyro"][row], *sample["accel"][row], time - now)

    def _update(self, name: str, time: float, row: int, given: Measurement) -> None:
        """Add the measurement of a stream with its time stamp."""
        if sigmas_of(given, "gnss_baseline")[0] == HEADING_ALONE:
            raise ValueError(
                "a log for an exported filter must have attitudes or baselines, got headings alone"
            )
        if name in self._sensed:
            self._add(name, time, *self._sensed[name][name][row])
            return
        sensor = "gnss" if name == "attitude" else name
        numbers: list[float] = []
        for reading in SENSOR_PARAMS[sensor].readings(sensor):
            count = max(self._suite.blocks_of(reading.name), 1)
            numbers += values_of(given, reading.name, count).ravel().tolist()
            if reading.reported:
                numbers += sigmas_of(given, reading.name).tolist()
        self._add(sensor, time, *numbers)

    def keep(self) -> None:
        """Add the output of the estimate."""
        self._add("estimate")

    def _add(self, name: str, *numbers: float) -> None:
        self.rows.append(",".join((name, *(repr(float(number)) for number in numbers))) + "\n")


def _three(given: Any) -> Floats:
    """Return three numbers, of one or three; NaN for None."""
    return np.broadcast_to(np.asarray(math.nan if given is None else given, np.float64), 3)

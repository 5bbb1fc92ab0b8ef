"""Logs: measurements of a flight, as columns of tables and as samples of a file."""

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, make_dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from quad_gym.frames import geodetic_to_ecef
from quad_gym.params import checks as check
from quad_gym.params.sensor_table import AID_PARAMS, SENSOR_PARAMS
from quad_gym.params.suites import SensorSuite
from quad_gym.records import REAL
from quad_gym.records.inputs import MOUNTING
from quad_gym.rotations import euler_to_dcm

# --------------------------------------------------------------------------------------------------
# Mounting of the sensors of a vehicle's logs: rotations to B, and mean biases.
# --------------------------------------------------------------------------------------------------


def mounting_of(suite: SensorSuite) -> NDArray[Any]:
    """Return the mounting of a suite, (1,) MOUNTING."""
    found = np.zeros(1, MOUNTING)
    numbers = (*suite.log_rotation, *suite.log_accel_bias, *suite.log_gyro_bias)
    found["imu_turns"], found["compass_turns"] = any(numbers), any(suite.log_compass_rotation)
    found["R_imu"] = euler_to_dcm(suite.log_rotation)
    found["R_compass"] = euler_to_dcm(suite.log_compass_rotation)
    found["gyro_bias"], found["accel_bias"] = suite.log_gyro_bias, suite.log_accel_bias
    return found


def sensed(values: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return numbers of a sensor in the precision of the process, as exported filters take them."""
    return values.astype(REAL).astype(np.float64)


def rotated(R: NDArray[np.float64], vectors: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the products of a matrix (3, 3) and vectors (n, 3), with plain sums.

    These have the same bits in exported filters.
    """
    x, y, z = vectors.T
    return np.column_stack([a * x + b * y + c * z for a, b, c in R])


# --------------------------------------------------------------------------------------------------
# Logs: measurements of a flight, and the columns of tables that hold them.
#
# A table has a row per sample or measurement; measurements with the same time stamp may share a
# row. Missing values are NaN, or empty cells in a file. Rows are in the order of arrival, unless a
# column `received` has the times of arrival: a row with an earlier `time` than the IMU sample above
# it was delayed.
# --------------------------------------------------------------------------------------------------

Floats = NDArray[np.float64]


class LogColumn(NamedTuple):
    """Columns of a log, one for each number of a quantity."""

    names: tuple[str, ...]  #: names of the columns
    unit: str  #: unit of the numbers
    frame: str  #: frame of the numbers; "-": none
    meaning: str  #: description of the quantity


def _xyz(name: str) -> tuple[str, ...]:
    return tuple(f"{name}_{axis}" for axis in "xyz")


def _enu(name: str) -> tuple[str, ...]:
    return tuple(f"{name}_{axis}" for axis in ("east", "north", "up"))


def _of_aid(name: str) -> LogColumn:
    """Return the columns of an aiding sensor: of its blocks by number, of vectors by axis."""
    kind = AID_PARAMS[name]
    names = [f"{name}_{k}" for k in range(kind.most_blocks)] if kind.most_blocks > 1 else [name]
    if kind.length > 1:
        names = [axis for each in names for axis in _xyz(each)[: kind.length]]
    return LogColumn(tuple(names), kind.unit, kind.frame, kind.meaning)


_MOTORS, _COMMANDS = (tuple(f"{word}_{k}" for k in range(4)) for word in ("motor", "command"))

# fmt: off
LOG_COLUMNS = {
    "time": LogColumn(("time",), "s", "-", "time stamp; of a mean, the end of its interval"),
    "received": LogColumn(("received",), "s", "-", "time of arrival; default: the order of rows"),
    "gyro": LogColumn(_xyz("gyro"), "rad/s", "B", "angular rate"),
    "accel": LogColumn(_xyz("accel"), "m/s^2", "B", "specific force, about +9.8 upward at rest"),
    "gnss": LogColumn(_xyz("gnss"), "m", "ECEF", "primary antenna, from the center of the Earth"),
    "gnss_lla": LogColumn(("gnss_lat", "gnss_lon", "gnss_alt"), "deg, m", "WGS-84", "as `gnss`"),
    "gnss_enu": LogColumn(_enu("gnss"), "m", "I", "primary antenna, from the origin"),
    "gnss_sigma": LogColumn(_enu("gnss_sigma"), "m", "I", "reported position sigma"),
    "gnss_velocity": LogColumn(_xyz("gnss_velocity"), "m/s", "ECEF", "primary antenna"),
    "gnss_velocity_enu": LogColumn(_enu("gnss_velocity"), "m/s", "I", "primary antenna"),
    "gnss_velocity_sigma": LogColumn(("gnss_velocity_sigma",), "m/s", "-", "reported sigma"),
    "gnss_baseline": LogColumn(_xyz("gnss_baseline"), "m", "ECEF", "primary to secondary antenna"),
    "gnss_baseline_enu": LogColumn(_enu("gnss_baseline"), "m", "I", "between the antennas"),
    **{name: _of_aid(name) for name in AID_PARAMS},
    "attitude": LogColumn(tuple(f"attitude_{a}" for a in "wxyz"), "-", "B to I", "quaternion"),
    "heading": LogColumn(("heading",), "rad", "I", "of the body x axis, from east toward north"),
    "motors": LogColumn(_MOTORS, "V", "-", "voltages of the motors, up to the next row with them"),
    "commands": LogColumn(_COMMANDS, "-", "-", "commands of the motors from 0 to 1, as `motors`"),
    "battery": LogColumn(("battery",), "V", "-", "voltage of the battery"),
}
# fmt: on
"""Columns of a table, by the keys under which a dictionary may hold their numbers together.

The camera has further columns: `pixel_0_u`, `pixel_0_v`, `pixel_1_u` and so on [pixels from the
image's center], or together `pixels` (n, features, 2).
"""


@dataclass(frozen=True, eq=False)
class Stream:
    """Measurements of one sensor."""

    time: Floats  #: (n,) time stamps [s]
    received: Floats  #: (n,) times of arrival [s]
    values: dict[str, Floats]  #: measurements (n, ...) by name

    def __len__(self) -> int:
        return len(self.time)

    def rows(self, chosen: Any) -> "Stream":
        """Return some of the measurements."""
        values = {name: value[chosen] for name, value in self.values.items()}
        return Stream(self.time[chosen], self.received[chosen], values)


MEASURED = ("imu", *SENSOR_PARAMS, "attitude")
"""Sensors of a log, in the order in which measurements that arrive together are processed."""


_AidStreams: Any = make_dataclass(
    "_AidStreams",
    [(name, Stream | None, field(default=None, kw_only=True)) for name in AID_PARAMS],
    frozen=True,
    eq=False,
)


@dataclass(frozen=True, eq=False)
class Log(_AidStreams):
    """Measurements of the sensors in a flight, each sensor at its own times.

    Each sensor of `quad_gym.params.sensor_table` has a field with its name: a stream of (n, ...)
    measurements under this name, or None.

    Frames are the package's: B with x forward, y left, z up; I with east, north, up.
    """

    imu: Stream  #: IMU samples: gyro [rad/s] and accel [m/s^2], (n, 3) each, in B
    gnss: Stream | None = None
    """GNSS measurements, under the keywords of a filter's `update` or, in I, with this ending:
    gnss_position_G (n, 3) from the center of the Earth, or gnss_position_I from the origin [m];
    gnss_velocity_G or gnss_velocity_I [m/s]; gnss_baseline_G or gnss_baseline_I [m]; reported
    standard deviations gnss_sigma (n, 3) [m], infinite along an axis that was not measured, and
    velocity_sigma (n,) [m/s]"""
    camera: Stream | None = None  #: images: pixels (n, features, 2) from the image's center
    attitude: Stream | None = None
    """attitudes by motion capture: quaternion (n, 4), body to inertial; or heading (n,) [rad]"""
    motors: Stream | None = None
    """commands, no measurements, that hold until the next: motors (n, 4), voltages [V]; or commands
    (n, 4) from 0 to 1"""
    battery: Stream | None = None  #: voltages of the battery: battery (n,) [V]
    barometer_from_start: bool = False
    """True: heights from pressure refer to another level, so that only their changes are used"""
    about: dict[str, Any] = field(default_factory=dict)
    """additional information, such as the file of the log"""
    sources: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)
    """by sensor: `taken`, the source in the file; `rows` with measurements; `dropped`, numbers of
    rows by reason; `others`, further sources"""
    notes: tuple[str, ...] = ()  #: sentences on the choice of sources and on dropped rows
    problems: tuple[str, ...] = ()  #: sentences on wrong quantities
    in_sensor_axes: Mapping[str, Stream] = field(default_factory=dict)
    """of a corrected log: IMU and magnetometer before their rotation and mean biases"""

    def __post_init__(self) -> None:
        if len(self.imu) < 2:
            raise ValueError(f"a log must have at least two IMU samples, got {len(self.imu)}")
        steps = np.diff(self.imu.time)
        if not (steps > 0.0).all():
            k = int(np.flatnonzero(~(steps > 0.0))[0])
            raise ValueError(
                "time of IMU samples must increase, got "
                f"{self.imu.time[k + 1]:.6f} s after {self.imu.time[k]:.6f} s (sample {k + 1})"
            )
        for stream in self.streams.values():
            if not (np.isfinite(stream.time).all() and np.isfinite(stream.received).all()):
                raise ValueError("time and received must be finite where something was measured")

    @property
    def streams(self) -> dict[str, Stream]:
        """Streams of all sensors with measurements, by name."""
        found = {name: getattr(self, name) for name in MEASURED}
        return {name: s for name, s in found.items() if s is not None and len(s)}

    def corrected(self, suite: SensorSuite) -> "Log":
        """Return the log without delays and mean biases of a suite, in the axes of B."""
        delays = {**vars(suite.log_delays), "attitude": suite.log_delays.gnss}  # of one system
        changes: dict[str, Any] = {
            name: replace(stream, time=stream.time - delays[name])
            for name, stream in self.streams.items()
            if delays.get(name)
        }
        mounting, before = mounting_of(suite)[0], dict(self.in_sensor_axes)
        if mounting["imu_turns"]:
            values, before["imu"] = self.imu.values, self.imu
            turned = {
                name: rotated(mounting["R_imu"], sensed(values[name]) - mounting[f"{name}_bias"])
                for name in ("gyro", "accel")
            }
            changes["imu"] = replace(self.imu, values=turned)
        compass = changes.get("magnetometer", self.magnetometer)
        if mounting["compass_turns"] and compass is not None:
            before["magnetometer"] = compass
            field_B = rotated(mounting["R_compass"], sensed(compass.values["magnetometer"]))
            changes["magnetometer"] = replace(compass, values={"magnetometer": field_B})
        return replace(self, **changes, in_sensor_axes=before) if changes else self

    def as_sensed(self, name: str) -> Stream:
        """Return the IMU or the magnetometer in the axes of the sensor, in the same rows."""
        stream: Stream = getattr(self, name)
        if (whole := self.in_sensor_axes.get(name)) is None:
            return stream
        order = np.argsort(whole.time, kind="stable")
        return whole.rows(order[np.searchsorted(whole.time[order], stream.time)])

    def between(self, first: float | None, last: float | None) -> "Log":
        """Return the log from a time of arrival [s] to another; None: from its start, to its end.

        Raises:
            ValueError: If nothing is between them.
        """
        low, high = (-np.inf if first is None else first), (np.inf if last is None else last)
        time = self.imu.time
        if not ((time >= low) & (time <= high)).any():
            raise ValueError(
                f"a log must have samples of the IMU from {low:g} s to {high:g} s, got some from "
                f"{time[0]:.3f} s to {time[-1]:.3f} s"
            )
        streams = {**self.streams, "motors": self.motors, "battery": self.battery}
        changes: dict[str, Any] = {
            name: s.rows((s.received >= low) & (s.received <= high))
            for name, s in streams.items()
            if s is not None
        }
        return replace(self, **changes)

    def until(self, time: float) -> "Log":
        """Return the log up to a time of arrival [s]."""
        return self.between(None, time)

    def origin(self, near_G: Floats | None, within: float = 1e5) -> Floats | None:
        """Return the origin of I in ECEF: `near_G` if the first fix is close to it, else that fix.

        None, which also means `near_G`, if no position is relative to the center of the Earth.
        """
        if self.gnss is None or "gnss_position_G" not in self.gnss.values:
            return None
        fixes = self.gnss.values["gnss_position_G"]
        known = fixes[np.isfinite(fixes).all(axis=1)]
        if not len(known):
            return None
        if near_G is not None and np.linalg.norm(known[0] - near_G) < within:
            return near_G
        return known[0].copy()


def ecef_of(lat: Floats, lon: Floats, height: Floats) -> Floats:
    """Return (n, 3) positions in ECEF [m] from latitude, longitude [deg] and height; NaN stays."""
    found = np.full((len(lat), 3), np.nan)
    for k in np.flatnonzero(np.isfinite(lat) & np.isfinite(lon) & np.isfinite(height)):
        check.number("gnss_lat [deg]", float(lat[k]), least=-90.0, most=90.0)
        found[k] = geodetic_to_ecef(np.radians(lat[k]), np.radians(lon[k]), height[k])
    return found


# --------------------------------------------------------------------------------------------------
# The common form of all formats: stamped samples by sensor and instance, as a file has them.
#
# A reader of a format only translates its file to sources. All further steps are common
# to all formats: `clocks.py` cleans times, `reading.py` selects among the sources of a sensor,
# `quantities.py` compares sensors with each other, and `reading.py` puts the steps together.
# --------------------------------------------------------------------------------------------------

SENSORS = (
    "imu",
    "gyro",
    "accel",
    "gnss",
    "gnss_velocity",
    *AID_PARAMS,
    "attitude",
    "camera",
    "motors",
    "battery",
)
"""Sensors that a source may have; `gyro` and `accel` are the halves of an IMU, `gnss_velocity` has
velocities apart from positions."""

COMMANDS = ("motors", "battery")
"""Sources that are no measurements of the motion."""

TO_FLU = np.array([1.0, -1.0, -1.0])
"""Vectors of a body with x forward, y right, z down as forward, left, up, and the reverse."""


@dataclass(frozen=True, eq=False, kw_only=True)
class LogSource:
    """Samples of one sensor, in the order of the file, with all its defects."""

    sensor: str  #: one of SENSORS
    topic: str  #: topic, message or columns in the file
    instance: int = 0  #: number of the sensor among several
    time: Floats  #: (n,) time stamps [s]; NaN: none
    received: Floats | None = None  #: (n,) times of arrival by the recorder's clock [s]
    row: Any = None  #: (n,) rows of a table whose order is the order of arrival
    values: dict[str, Floats]  #: measurements (n, ...) by name, as in `Stream`; NaN: not measured
    tier: int = 0  #: 0: made for the autopilot's filter, or raw; greater: a substitute
    rank: float = 0.0  #: preference of the autopilot; greater is preferred
    because: str = ""  #: reason of the preference, such as "CAL_MAG1_PRIO 75"
    dropped: Mapping[str, int] = field(default_factory=dict)  #: numbers of rows left out, by reason

    def __len__(self) -> int:
        return len(self.time)

    @property
    def name(self) -> str:
        """Name of the source in sentences."""
        return f"{self.topic} {self.instance}" if self.instance else self.topic

    def keep(self, chosen: Any, reason: str) -> "LogSource":
        """Return the source with some of its rows, and count the others."""
        count = len(self) - int(np.count_nonzero(chosen))
        if not count:
            return self
        arrays: dict[str, Any] = {"time": self.time[chosen]}
        for name in ("received", "row"):
            value = getattr(self, name)
            arrays[name] = None if value is None else value[chosen]
        arrays["values"] = {name: value[chosen] for name, value in self.values.items()}
        dropped = {**self.dropped, reason: self.dropped.get(reason, 0) + count}
        return replace(self, **arrays, dropped=dropped)

    def stream(self) -> Stream:
        """Return the measurements without their origin."""
        received = self.time if self.received is None else np.maximum(self.received, self.time)
        return Stream(self.time, received, self.values)


@dataclass(eq=False)
class RawLog:
    """Contents of a file: the sources of all sensors, and sentences about them."""

    file: str
    sources: Sequence[LogSource]
    barometer_from_start: bool = False
    """True: heights from pressure refer to another level than positions"""
    notes: list[str] = field(default_factory=list)  #: sentences on choices and dropped rows
    problems: list[str] = field(default_factory=list)  #: sentences on wrong quantities

    @property
    def where(self) -> str:
        """Name of the file at the beginning of an error; empty: there is none."""
        return f"{self.file}: " if self.file else ""


def stack(topic: Mapping[str, Any], names: Sequence[str]) -> Floats:
    """Return (n, len(names)) columns of a topic side by side; NaN for a missing one."""
    count = len(next(iter(topic.values())))
    columns = [np.asarray(topic.get(n, np.full(count, np.nan)), np.float64) for n in names]
    return np.column_stack(columns)


def positive(values: Floats) -> Floats:
    """Return valid standard deviations; NaN for the rest, as receivers write 0 for unknown."""
    return np.where(np.isfinite(values) & (values > 0.0), values, np.nan)


@contextmanager
def reading(path: Path | str, kind: str, logs: str, library: str, extra: str) -> Iterator[Path]:
    """Name file and library in errors of a library that reads a log.

    Raises:
        ImportError: If the library is not installed.
        ValueError: If it cannot read the file.
        OSError: If there is no such file.
    """
    file = Path(path)
    try:
        yield file
    except ImportError:
        install = f"install it with pip install 'quad-gym[{extra}]'"
        raise ImportError(f"{logs} need {library}: {install}") from None
    except Exception as error:  # a library raises what it meets in a damaged file
        if not file.exists():
            raise FileNotFoundError(f"there is no file {file}") from None
        raise ValueError(f"{file.name} must be {kind}: {error}") from None

"""Logs of ROS: bags of ROS 1 (.bag) and of ROS 2 (folders with metadata.yaml).

Axes follow REP 103: body x forward, y left, z up; world east, north, up.

| message | contents used |
|---|---|
| `sensor_msgs/Imu` | gyro and accelerometer, also on two topics |
| `sensor_msgs/NavSatFix` | position above the ellipsoid, and the diagonal of its covariance |
| `TwistStamped`, `TwistWithCovarianceStamped`, `Vector3Stamped` of a receiver | velocity |
| `sensor_msgs/FluidPressure` | height in the standard atmosphere, relative to another level |
| `sensor_msgs/MagneticField` | magnetic field |
| `sensor_msgs/Range` | distance to the ground, on topics for it |
| `PoseStamped`, `TransformStamped`, `PointStamped` of motion capture | position, attitude |

Quantities with a covariance of -1 were not measured. Of several topics with a message, the words
of their names decide: raw before fused, static before differential, a receiver's before commands;
whole words count more than parts of them. The header's stamp is the time stamp, and the time of
recording the time of arrival.
"""

import re
from array import array
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from quad_gym.logs.formats.log import Floats, LogSource, RawLog, ecef_of, positive, reading


class _Kind(NamedTuple):
    """Use of a type of message."""

    sensor: str
    needs: frozenset[str] = frozenset()  #: words of which one must be in the topic's name
    avoids: frozenset[str] = frozenset()  #: words of which none must be in it
    prefers: frozenset[str] = frozenset()  #: words that make a topic preferable


_RECEIVER = frozenset({"gps", "gnss", "fix", "navsat", "rtk", "ublox"})
_VELOCITY = _RECEIVER | {"vel", "velocity"}
_COMMAND = frozenset(
    {"cmd", "command", "setpoint", "target", "goal", "desired", "reference", "ref", "control"}
)
_FUSED = frozenset({"fused", "filtered", "filter", "odom", "odometry", "ekf", "ukf", "estimate"})
_LOCAL = _COMMAND | _FUSED | {"local", "body", "imu"}
_MOCAP = frozenset(
    {"vicon", "mocap", "optitrack", "qualisys", "leica", "vrpn", "motion", "tracker", "prism"}
)
_KINDS = {
    "Imu": _Kind("imu", prefers=frozenset({"raw"})),
    "NavSatFix": _Kind("gnss", prefers=frozenset({"raw", "fix"})),
    "TwistStamped": _Kind("gnss_velocity", _VELOCITY, _LOCAL, _RECEIVER),
    "TwistWithCovarianceStamped": _Kind("gnss_velocity", _VELOCITY, _LOCAL, _RECEIVER),
    "Vector3Stamped": _Kind("gnss_velocity", _VELOCITY, _LOCAL, _RECEIVER),
    "FluidPressure": _Kind("barometer", frozenset(), frozenset(), frozenset({"static", "baro"})),
    "MagneticField": _Kind("magnetometer", prefers=frozenset({"raw"})),
    "Range": _Kind("range_finder"),
    "PoseStamped": _Kind("pose", _MOCAP, _COMMAND),
    "TransformStamped": _Kind("pose", _MOCAP, _COMMAND),
    "PointStamped": _Kind("pose", _MOCAP, _COMMAND),
}
_WORST = frozenset({"diff", "differential", "airspeed", "pitot", "temperature"})
_DOWN = (
    "down",
    "ground",
    "altimeter",
    "lidar",
    "sonar",
    "range",
    "rangefinder",
    "hrlv",
    "distance",
)


def read_bag(path: Path | str) -> RawLog:
    """Read a bag.

    Args:
        path: Path of a `.bag` file, or of the folder of a bag of ROS 2.

    Raises:
        ImportError: If rosbags is not installed.
        ValueError: If it is no bag, or has no IMU samples.
        OSError: If it does not exist.
    """
    topics: dict[str, tuple[str, array[float]]] = {}
    with reading(path, "a bag of ROS", "bags of ROS", "rosbags", "ros") as file:
        from rosbags.highlevel import AnyReader
        from rosbags.typesys import Stores, get_typestore

        store = get_typestore(Stores.ROS2_HUMBLE)
        with AnyReader([file], default_typestore=store) as reader:
            known = [c for c in reader.connections if _name(c) in _KINDS]
            for connection, recorded, raw in reader.messages(connections=known) if known else ():
                message = reader.deserialize(raw, connection.msgtype)
                row = topics.setdefault(connection.topic, (_name(connection), array("d")))[1]
                stamp = message.header.stamp
                row.append(stamp.sec + 1e-9 * stamp.nanosec)
                row.append(1e-9 * recorded)
                row.extend(_numbers(_name(connection), message))
    if not any(kind == "Imu" for kind, _ in topics.values()):
        raise ValueError(f"{file.name} must have messages sensor_msgs/Imu, got none")
    sources = [
        source
        for topic, (kind, rows) in sorted(topics.items())
        for source in _sources(
            topic, kind, np.frombuffer(rows, np.float64).reshape(-1, _SIZES[kind])
        )
    ]
    return RawLog(file=file.name, sources=sources, barometer_from_start=True)


def _name(connection: Any) -> str:
    return str(connection.msgtype).rsplit("/", 1)[-1]


_SIZES = {
    "Imu": 10,
    "NavSatFix": 10,
    "TwistStamped": 5,
    "TwistWithCovarianceStamped": 5,
    "Vector3Stamped": 5,
    "FluidPressure": 3,
    "MagneticField": 5,
    "Range": 5,
    "PoseStamped": 9,
    "TransformStamped": 9,
    "PointStamped": 9,
}
"""Numbers that are kept of a message, with its stamp and its time of recording."""


def _xyz(v: Any) -> tuple[float, float, float]:
    return v.x, v.y, v.z


def _numbers(kind: str, m: Any) -> list[float]:
    """Return the numbers of a message."""
    match kind:
        case "Imu":
            measured = (m.angular_velocity_covariance[0], m.linear_acceleration_covariance[0])
            return [
                *_xyz(m.angular_velocity),
                *_xyz(m.linear_acceleration),
                *(float(first != -1.0) for first in measured),
            ]
        case "NavSatFix":
            variances = np.asarray(m.position_covariance, np.float64)[::4]
            known = m.position_covariance_type > 0
            told = [m.latitude, m.longitude, m.altitude, float(m.status.status), float(known)]
            return [*told, *variances]
        case "TwistStamped":
            return [*_xyz(m.twist.linear)]
        case "TwistWithCovarianceStamped":
            return [*_xyz(m.twist.twist.linear)]
        case "Vector3Stamped":
            return [*_xyz(m.vector)]
        case "FluidPressure":
            return [m.fluid_pressure]
        case "MagneticField":
            return [*_xyz(m.magnetic_field)]
        case "Range":
            return [m.range, m.min_range, m.max_range]
        case "PointStamped":
            return [*_xyz(m.point), *[np.nan] * 4]
        case "PoseStamped":
            place, q = m.pose.position, m.pose.orientation
        case _:
            place, q = m.transform.translation, m.transform.rotation
    return [*_xyz(place), q.w, q.x, q.y, q.z]


def _rank(topic: str, kind: _Kind) -> float | None:
    """Return the preference of a topic by the words of its name; None: of something else.

    Whole words count more than parts, and words of the last part of the name more than others.
    """
    words = set(re.split(r"[/_\-.]+", topic.lower()))
    parts = {word for word in kind.needs if word in topic.lower()}
    if words & kind.avoids or (kind.needs and not parts):
        return None
    rank = 2.0 * len(words & kind.prefers) - 4.0 * bool(words & _FUSED) - 8.0 * bool(words & _WORST)
    return rank + (4.0 * bool(words & kind.needs) if kind.needs else 0.0)


def _sources(topic: str, kind: str, rows: Floats) -> Iterator[LogSource]:
    """Yield the sources of a topic."""
    rank = _rank(topic, _KINDS[kind])
    if rank is None:
        return
    time, received, numbers = rows[:, 0], rows[:, 1], rows[:, 2:]
    some: dict[str, Any] = {"topic": topic, "time": time, "received": received, "rank": rank}
    sensor = _KINDS[kind].sensor
    match kind:
        case "Imu":
            yield from _halves(numbers, some)
        case "NavSatFix":
            (lat, lon), (status, told) = numbers.T[:2], numbers.T[3:5]
            fixed = (status >= 0.0) & (np.abs(lat) <= 90.0) & ((lat != 0.0) | (lon != 0.0))
            place = ecef_of(*np.where(fixed, numbers.T[:3], np.nan))
            sigma = np.sqrt(np.maximum(numbers[:, 5:], 0.0))
            sigma[(told == 0.0) | ~(sigma > 0.0).all(axis=1)] = np.nan
            values = {"gnss_position_G": place, "gnss_sigma": positive(sigma)}
            yield LogSource(sensor=sensor, values=values, **some).keep(fixed, "no fix")
        case "FluidPressure":
            yield LogSource(sensor=sensor, values={"pressure": numbers[:, 0]}, **some)
        case "Range" if any(word in topic.lower() for word in _DOWN):
            distance, low, high = numbers.T
            good = (distance >= low) & (distance <= high)
            source = LogSource(sensor=sensor, values={"range_finder": distance}, **some)
            yield source.keep(good, "no distance")
        case "MagneticField":
            yield LogSource(sensor=sensor, values={"magnetometer": numbers}, **some)
        case _ if sensor == "gnss_velocity":
            yield LogSource(sensor=sensor, values={"gnss_velocity_I": numbers}, **some)
        case _ if sensor == "pose":
            yield LogSource(
                sensor="gnss", values={"gnss_position_I": numbers[:, :3]}, tier=2, **some
            )
            yield LogSource(sensor="attitude", values={"quaternion": numbers[:, 3:]}, **some)


def _halves(numbers: Floats, some: dict[str, Any]) -> Iterator[LogSource]:
    """Yield an IMU, or the half of it that was measured: neither marked so, nor always zero."""
    halves = {"gyro": (numbers[:, :3], numbers[:, 6]), "accel": (numbers[:, 3:6], numbers[:, 7])}
    values = {
        name: np.where(measured[:, np.newaxis] > 0.0, v, np.nan)
        for name, (v, measured) in halves.items()
    }
    whole = {name: v for name, v in values.items() if np.nan_to_num(v).any()}
    if len(whole) == 2:
        yield LogSource(sensor="imu", values=whole, **some)
    for name, v in whole.items() if len(whole) < 2 else ():
        yield LogSource(sensor=name, values={name: v}, **some)

"""Logs of ROS: bags of ROS 1 (.bag) and of ROS 2 (folders with metadata.yaml).

Axes follow REP 103: body x forward, y left, z up; world east, north, up.

| message | contents used |
|---|---|
| `sensor_msgs/Imu` | gyro and accelerometer |
| `sensor_msgs/NavSatFix` | position above the ellipsoid, and the diagonal of its covariance |
| `geometry_msgs/TwistStamped`, topic with `gps`, `gnss` or `fix` in its name | velocity |
| `sensor_msgs/FluidPressure` | height in the standard atmosphere, relative to another level |
| `sensor_msgs/MagneticField` | magnetic field |

Of several topics with a message, the first by name is used. The header's stamp is the time stamp,
and the time of recording the time of arrival, unless the two clocks differ by more than 10 s.
"""

from pathlib import Path
from typing import Any

import numpy as np

from quad_gym.estimation.logs.log import Floats, Log, Stream, ecef_of, reading

_OTHER_CLOCK = 10.0  #: [s]
_SEA_LEVEL, _SCALE, _EXPONENT = 101325.0, 44330.77, 0.190263
"""Pressure [Pa], height [m] and exponent of the standard atmosphere (ISO 2533)."""
_KINDS = ("Imu", "NavSatFix", "TwistStamped", "FluidPressure", "MagneticField")
_RECEIVERS = ("gps", "gnss", "fix")


def read_bag(path: Path | str) -> Log:
    """Read a bag.

    Args:
        path: Path of a `.bag` file, or of the folder of a bag of ROS 2.

    Raises:
        ImportError: If rosbags is not installed.
        ValueError: If it is no bag, or has no IMU samples.
        OSError: If it does not exist.
    """
    rows: dict[str, list[tuple[float, float, Any]]] = {kind: [] for kind in _KINDS}
    with reading(path, "a bag of ROS", "bags of ROS", "rosbags", "ros") as file:
        from rosbags.highlevel import AnyReader
        from rosbags.typesys import Stores, get_typestore

        store = get_typestore(Stores.ROS2_HUMBLE)
        with AnyReader([file], default_typestore=store) as reader:
            chosen = _chosen(reader.connections)
            for connection, recorded, raw in reader.messages(connections=list(chosen)):
                message = reader.deserialize(raw, connection.msgtype)
                stamp = message.header.stamp
                taken = stamp.sec + 1e-9 * stamp.nanosec
                rows[_kind(connection)].append((taken, 1e-9 * recorded, message))
    if not rows["Imu"]:
        raise ValueError(f"{file.name} must have messages sensor_msgs/Imu, got none")
    imu = _stream(rows["Imu"], gyro="angular_velocity", accel="linear_acceleration")
    assert imu is not None
    heights = _stream(rows["FluidPressure"], barometer="fluid_pressure")
    if heights is not None:
        ratio = heights.values["barometer"] / _SEA_LEVEL
        heights.values["barometer"] = _SCALE * (1.0 - ratio**_EXPONENT)
    return Log(
        imu=imu.increasing(),
        gnss=_gnss(rows["NavSatFix"], rows["TwistStamped"]),
        barometer=heights,
        magnetometer=_stream(rows["MagneticField"], magnetometer="magnetic_field"),
        barometer_from_start=True,
        about={"file": file.name},
    )


def _kind(connection: Any) -> str:
    return str(connection.msgtype).rsplit("/", 1)[-1]


def _chosen(connections: Any) -> list[Any]:
    """The connections of the first topic of each kind."""
    topics: dict[str, str] = {}
    used = []
    for connection in sorted(connections, key=lambda c: str(c.topic)):
        kind, topic = _kind(connection), str(connection.topic)
        velocity = any(word in topic.lower() for word in _RECEIVERS)
        if kind not in _KINDS or (kind == "TwistStamped" and not velocity):
            continue
        if topics.setdefault(kind, topic) == topic:
            used.append(connection)
    return used


def _times(rows: list[tuple[float, float, Any]]) -> tuple[Floats, Floats]:
    """Return times of measurement and arrival."""
    time, received = (np.array([row[i] for row in rows]) for i in (0, 1))
    if np.median(np.abs(received - time)) > _OTHER_CLOCK:
        received = time
    return time, np.maximum(time, received)


def _numbers(value: Any) -> Any:
    return (value.x, value.y, value.z) if hasattr(value, "x") else value


def _stream(rows: list[tuple[float, float, Any]], **fields: str) -> Stream | None:
    """Return measurements of one sensor: fields of its messages by name."""
    if not rows:
        return None
    values = {
        name: np.array([_numbers(getattr(row[2], field)) for row in rows], np.float64)
        for name, field in fields.items()
    }
    return Stream(*_times(rows), values)


def _gnss(
    fixes: list[tuple[float, float, Any]], velocities: list[tuple[float, float, Any]]
) -> Stream | None:
    """Return positions, and velocities in separate rows."""
    fixes = [row for row in fixes if row[2].status.status >= 0]
    rows = fixes + velocities
    if not rows:
        return None
    position, velocity, sigma = (np.full((len(rows), 3), np.nan) for _ in range(3))
    places = np.array([(m.latitude, m.longitude, m.altitude) for _, _, m in fixes]).reshape(-1, 3)
    position[: len(fixes)] = ecef_of(*places.T)
    for k, (_, _, m) in enumerate(fixes):
        variances = np.array(m.position_covariance, np.float64)[::4]
        if m.position_covariance_type > 0 and (variances > 0.0).all():
            sigma[k] = np.sqrt(variances)
    for k, (_, _, m) in enumerate(velocities):
        velocity[len(fixes) + k] = _numbers(m.twist.linear)
    values = {"position_G": position, "velocity_I": velocity, "position_sigma_I": sigma}
    time, received = _times(rows)
    return Stream(time, received, values).rows(np.argsort(received, kind="stable"))

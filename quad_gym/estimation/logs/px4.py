"""Logs of PX4: sensor data of its file format ULog, in the frames of this package.

PX4's body is FRD (x forward, y right, z down) and its world NED (north, east, down); a body here is
FLU (x forward, y left, z up) and the world ENU (east, north, up):

    (x, y, z)_FLU = (x, -y, -z)_FRD,    (e, n, u)_ENU = (e, n, -d) of (n, e, d)_NED

| topic | contents used |
|---|---|
| `sensor_combined` | gyro and accelerometer: means over the time before `timestamp` |
| `vehicle_gps_position`, or `sensor_gps` | position, velocity, and their reported accuracy |
| `vehicle_air_data` | height from static pressure, relative to another level |
| `vehicle_magnetometer`, or `sensor_mag` | magnetic field [gauss] |

A sample's `timestamp_sample` is its time stamp, and `timestamp` its time of arrival. For a GNSS
receiver without time stamps, the delay is PX4's parameter EKF2_GPS_DELAY, or 0.11 s.

Source: the PX4 user guide, "ULog File Format" and the definitions of these messages.
"""

from pathlib import Path
from typing import Any

import numpy as np

from quad_gym.estimation.logs.log import Floats, Log, Stream, ecef_of, reading

GNSS_DELAY = 0.11  #: delay of receivers if the log does not contain it [s]: PX4's default

LEAST_FIX = 3  #: smallest `fix_type` of a three-dimensional position

_GAUSS = 1e-4  #: [T]
_TO_FLU = np.array([1.0, -1.0, -1.0])


def read_ulog(path: Path | str) -> Log:
    """Read a log of PX4.

    Args:
        path: Path of a `.ulg` file.

    Raises:
        ImportError: If pyulog is not installed.
        ValueError: If the file is not a ULog, is damaged, or has no IMU samples.
        OSError: If there is no such file.
    """
    with reading(path, "a ULog", "logs of PX4", "pyulog", "ulog") as file:
        from pyulog import ULog

        ulog = ULog(str(file))
    topics: dict[str, dict[str, Any]] = {}
    for data in ulog.data_list:
        if data.multi_id == 0:
            topics[data.name] = data.data
    if "sensor_combined" not in topics:
        raise ValueError(f"{file.name} must have the topic sensor_combined, got {sorted(topics)}")
    delay = ulog.initial_parameters.get("EKF2_GPS_DELAY")
    imu = topics["sensor_combined"]
    gyro, accel = (_triples(imu, name) * _TO_FLU for name in ("gyro_rad", "accelerometer_m_s2"))
    return Log(
        imu=Stream(*_times(imu), {"gyro": gyro, "accel": accel}).increasing(),
        gnss=_gnss(
            _one_of(topics, "vehicle_gps_position", "sensor_gps"),
            GNSS_DELAY if delay is None else 1e-3 * float(delay),
        ),
        barometer=_barometer(_one_of(topics, "vehicle_air_data")),
        magnetometer=_magnetometer(_one_of(topics, "vehicle_magnetometer", "sensor_mag")),
        barometer_from_start=True,
        about={"file": file.name},
    )


def _one_of(topics: dict[str, dict[str, Any]], *names: str) -> dict[str, Any] | None:
    """The first of some topics that has samples."""
    for name in names:
        if name in topics and len(topics[name]["timestamp"]):
            return topics[name]
    return None


def _times(topic: dict[str, Any], delay: float = 0.0) -> tuple[Floats, Floats]:
    """Return times of measurement and arrival [s]; `delay` if only the latter is known."""
    received = 1e-6 * np.asarray(topic["timestamp"], np.float64)
    taken = received - delay
    if "timestamp_sample" in topic:
        stamps = 1e-6 * np.asarray(topic["timestamp_sample"], np.float64)
        taken = np.where(stamps > 0.0, stamps, taken)
    return np.minimum(taken, received), received


def _triples(topic: dict[str, Any], name: str) -> Floats:
    """Return an array (n, 3) of a field of three numbers."""
    return np.column_stack([np.asarray(topic[f"{name}[{i}]"], np.float64) for i in range(3)])


def _gnss(topic: dict[str, Any] | None, delay: float) -> Stream | None:
    """Return positions and velocities with a fix; NaN: not reported."""
    if topic is None:
        return None
    time, received = _times(topic, delay)
    if "latitude_deg" in topic:
        lat = np.asarray(topic["latitude_deg"], np.float64)
        lon = np.asarray(topic["longitude_deg"], np.float64)
        height = np.asarray(topic["altitude_ellipsoid_m"], np.float64)
    else:  # before PX4 1.14
        lat, lon = (1e-7 * np.asarray(topic[w], np.float64) for w in ("lat", "lon"))
        height = 1e-3 * np.asarray(topic["alt_ellipsoid"], np.float64)
    position = ecef_of(lat, lon, height)
    fixed = (np.asarray(topic["fix_type"]) >= LEAST_FIX) & np.isfinite(position).all(axis=1)
    velocity = np.column_stack([topic["vel_e_m_s"], topic["vel_n_m_s"], -topic["vel_d_m_s"]])
    valid = np.asarray(topic.get("vel_ned_valid", np.ones(len(time))), bool) & fixed
    eph, epv = (np.asarray(topic[name], np.float64) for name in ("eph", "epv"))
    values = {
        "position_G": position,
        "velocity_I": np.where(valid[:, np.newaxis], velocity, np.nan).astype(np.float64),
        "position_sigma_I": _positive(np.column_stack([eph, eph, epv])),
        "velocity_sigma": _positive(np.asarray(topic["s_variance_m_s"], np.float64)),
    }
    return Stream(time, received, values).rows(fixed)


def _positive(values: Floats) -> Floats:
    """Return valid standard deviations; NaN for the rest."""
    return np.where(np.isfinite(values) & (values > 0.0), values, np.nan)


def _barometer(topic: dict[str, Any] | None) -> Stream | None:
    """Return heights from pressure."""
    if topic is None:
        return None
    time, received = _times(topic)
    return Stream(time, received, {"barometer": np.asarray(topic["baro_alt_meter"], np.float64)})


def _magnetometer(topic: dict[str, Any] | None) -> Stream | None:
    """Return magnetic fields."""
    if topic is None:
        return None
    time, received = _times(topic)
    if "magnetometer_ga[0]" in topic:
        gauss = _triples(topic, "magnetometer_ga")
    else:  # of a single sensor
        gauss = np.column_stack([np.asarray(topic[axis], np.float64) for axis in "xyz"])
    return Stream(time, received, {"magnetometer": gauss * _GAUSS * _TO_FLU})

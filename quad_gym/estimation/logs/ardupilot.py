"""Logs of ArduPilot: sensor data of its binary files (.bin), in the frames of this package.

The body is FRD and the world NED, as in `px4.py`.

| message | contents used |
|---|---|
| `IMU` | gyro and accelerometer |
| `GPS`, `GPA` | position, ground speed and course, velocity down; `HAcc`, `VAcc`, `SAcc` of `GPA` |
| `BARO` | height from static pressure, relative to another level |
| `MAG` | magnetic field, corrected for offsets [mGauss] |

Of several sensors of a kind, the first is used. Positions have the height above mean sea level,
which `GPS` reports. Its messages have the time of arrival; the delay is the parameter GPS_DELAY_MS
(GPS1_DELAY_MS), or 0.2 s if that is zero, ArduPilot's default for receivers of unknown type.

Source: ArduPilot, "Onboard Message Log Messages"; `AP_GPS_Backend::get_lag`.
"""

from pathlib import Path
from typing import Any

import numpy as np

from quad_gym.estimation.logs.log import Floats, Log, Stream, ecef_of, reading

GNSS_DELAY = 0.2  #: delay of receivers if the log does not contain it [s]

_LEAST_FIX = 3
_MILLIGAUSS = 1e-7  #: [T]
_TO_FLU = np.array([1.0, -1.0, -1.0])
_KINDS = ("IMU", "GPS", "GPA", "BARO", "MAG", "PARM")


def read_bin(path: Path | str) -> Log:
    """Read a log of ArduPilot.

    Args:
        path: Path of a `.bin` file.

    Raises:
        ImportError: If pymavlink is not installed.
        ValueError: If the file is no such log, or has no IMU samples.
        OSError: If there is no such file.
    """
    found: dict[str, list[dict[str, Any]]] = {kind: [] for kind in _KINDS}
    with reading(path, "a log of ArduPilot", "logs of ArduPilot", "pymavlink", "ardupilot") as file:
        from pymavlink.DFReader import DFReader_binary

        reader = DFReader_binary(str(file))
        while (message := reader.recv_match(type=list(_KINDS))) is not None:
            if getattr(message, "I", 0) == 0:
                found[message.get_type()].append(message.to_dict())
    if not found["IMU"]:
        raise ValueError(f"{file.name} must be a log of ArduPilot with messages IMU, got none")
    parameters = {row["Name"]: row["Value"] for row in found["PARM"]}
    delay = parameters.get("GPS_DELAY_MS") or parameters.get("GPS1_DELAY_MS") or 0.0
    axes = {"gyro": _axes("Gyr"), "accel": _axes("Acc")}
    imu = _stream(found["IMU"], axes, _TO_FLU)
    assert imu is not None
    return Log(
        imu=imu.increasing(),
        gnss=_gnss(found["GPS"], found["GPA"], 1e-3 * delay or GNSS_DELAY),
        barometer=_stream(found["BARO"], {"barometer": ("Alt",)}),
        magnetometer=_stream(found["MAG"], {"magnetometer": _axes("Mag")}, _MILLIGAUSS * _TO_FLU),
        barometer_from_start=True,
        about={"file": file.name},
    )


def _axes(name: str) -> tuple[str, ...]:
    return tuple(f"{name}{axis}" for axis in "XYZ")


def _column(rows: list[dict[str, Any]], name: str) -> Floats:
    return np.array([row.get(name, np.nan) for row in rows], np.float64)


def _stream(
    rows: list[dict[str, Any]], fields: dict[str, tuple[str, ...]], factor: float | Floats = 1.0
) -> Stream | None:
    """Return measurements of one sensor: fields of its messages by name."""
    if not rows:
        return None
    time, values = 1e-6 * _column(rows, "TimeUS"), {}
    for name, columns in fields.items():
        table = np.column_stack([_column(rows, column) for column in columns]) * factor
        values[name] = table if len(columns) > 1 else table[:, 0]
    return Stream(time, time, values)


def _gnss(
    rows: list[dict[str, Any]], accuracy: list[dict[str, Any]], delay: float
) -> Stream | None:
    """Return positions and velocities with a fix, with the accuracy reported at that time."""
    rows = [row for row in rows if row["Status"] >= _LEAST_FIX]
    if not rows:
        return None
    received = 1e-6 * _column(rows, "TimeUS")
    lat, lon, height, speed, down = (_column(rows, n) for n in ("Lat", "Lng", "Alt", "Spd", "VZ"))
    course = np.radians(_column(rows, "GCrs"))
    reported = {row["TimeUS"]: row for row in accuracy}
    sigmas = [reported.get(row["TimeUS"], {}) for row in rows]
    h, v, s = (_column(sigmas, name) for name in ("HAcc", "VAcc", "SAcc"))
    values = {
        "position_G": ecef_of(lat, lon, height),
        "velocity_I": np.column_stack([speed * np.sin(course), speed * np.cos(course), -down]),
        "position_sigma_I": np.column_stack([h, h, v]),
        "velocity_sigma": s,
    }
    for name in ("position_sigma_I", "velocity_sigma"):
        values[name] = np.where(values[name] > 0.0, values[name], np.nan)
    return Stream(received - delay, received, values)

"""Logs of ArduPilot: sensor data of its binary files (.bin), in the frames of this package.

The body is FRD and the world NED, as in `px4.py`.

| message | contents used |
|---|---|
| `IMU` | gyro and accelerometer |
| `GPS`, `GPA` | position, ground speed and course, velocity down; `HAcc`, `VAcc`, `SAcc` of `GPA` |
| `BARO` | height from static pressure, relative to another level |
| `MAG` | magnetic field, corrected for offsets [mGauss] |
| `OF`, `RFND` | optical flow; distance to the ground |
| `RCOU` | commands of the motors from 0 to 1, of pulses between MOT_PWM_MIN and MOT_PWM_MAX |
| `BAT`, `CURR` | voltage of the battery |

A sensor's number is the field `I`, or part of the name (`IMU2`, `BAR2`). Of several ones, the one
is taken that the primary estimator used (`XKF4`, `NKF4`, `XKFS`), that EK3_PRIMARY or
COMPASS_PRIMARY selects, or that was used as GPS (`U`). Times are the vehicle's clock: `TimeUS`;
before 2015 `TimeMS`, and `T` in GPS, where `TimeMS` is the time of the week. Positions have the
height above mean sea level, which `GPS` reports. Messages have the time of arrival; the delay of
GNSS is the parameter GPS_DELAY_MS (GPS1_DELAY_MS), or 0.2 s if that is zero, ArduPilot's default
for receivers of unknown type.

Source: ArduPilot, "Onboard Message Log Messages"; `AP_GPS_Backend::get_lag`.
"""

import os
import re
from array import array
from collections import defaultdict
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, redirect_stderr, redirect_stdout
from io import StringIO
from pathlib import Path
from tempfile import TemporaryFile

import numpy as np

from quad_gym.logs.formats.log import (
    TO_FLU,
    Floats,
    LogSource,
    RawLog,
    ecef_of,
    positive,
    reading,
    stack,
)

GNSS_DELAY = 0.2  #: delay of receivers if the log does not contain it [s]

_MIN_FIX = 3
_MILLIGAUSS = 1e-7  #: [T]
_DOWN = 25  #: orientation of a range finder that looks down
_PULSES = (1000.0, 2000.0)  #: pulses of motors, if the log does not contain them [us]
_FIRST_MOTOR = 33  #: SERVOn_FUNCTION of the first motor
_AXES = {name: [f"{name}{axis}" for axis in "XYZ"] for name in ("Gyr", "Acc", "Mag")}
_FIELDS = {
    "IMU": (*_AXES["Gyr"], *_AXES["Acc"]),
    "GPS": ("T", "Status", "Lat", "Lng", "Alt", "Spd", "GCrs", "VZ", "U"),
    "GPA": ("HAcc", "VAcc", "SAcc"),
    "BARO": ("Alt", "Press"),
    "MAG": tuple(_AXES["Mag"]),
    "OF": ("Qual", "flowX", "flowY"),
    "RFND": ("Dist", "Dist1", "Orient", "Orient1", "Stat"),
    "RCOU": tuple(f"C{k}" for k in range(1, 15)),
    "BAT": ("Volt",),
    "XKF4": ("PI",),
    "NKF4": ("PI",),
    "XKFS": ("MI", "BI", "GI"),
}
_ALSO = {"BAR": "BARO", "CURR": "BAT"}  #: other names of messages
_NUMBERS = ("I", "Instance", "C")  #: fields with the number of a sensor or estimator
_MESSAGE = re.compile(r"([XN]KF[4S]|[A-Z]+)(\d?)")

_Table = Mapping[str, Floats]
_Tables = Mapping[str, Mapping[int, _Table]]


def read_bin(path: Path | str) -> RawLog:
    """Read a log of ArduPilot.

    Args:
        path: Path of a `.bin` file.

    Raises:
        ImportError: If pymavlink is not installed.
        ValueError: If the file is no such log, or has no IMU samples.
        OSError: If there is no such file.
    """
    kind = "a log of ArduPilot", "logs of ArduPilot", "pymavlink", "ardupilot"
    with reading(path, *kind) as file, _quiet() as printed:
        tables, parameters = _tables(file)
    if "IMU" not in tables:
        raise ValueError(f"{file.name} must be a log of ArduPilot with messages IMU, got none")
    return RawLog(
        file=file.name,
        sources=[
            *_inertial(tables, parameters),
            *_gnss(tables, parameters),
            *_compasses(tables, parameters),
            *_aids(tables, parameters),
        ],
        barometer_from_start=True,
        notes=list(_damage(printed)),
    )


def _damage(printed: bytearray) -> Iterator[str]:
    """Yield sentences on damaged parts of a file, from what pymavlink has printed."""
    if count := printed.count(b"bad header"):
        yield f"damaged bytes of the file that are skipped: {count}"
    if b"unknown msg type" in printed:
        yield "the file is not read beyond a damaged message, whose type is unknown"


@contextmanager
def _quiet() -> Iterator[bytearray]:
    """Keep from the terminal what pymavlink prints, a line for each damaged byte; yield it."""
    printed, kept = bytearray(), os.dup(2)  # as its indexer is in C
    with TemporaryFile() as file, redirect_stdout(StringIO()), redirect_stderr(StringIO()) as lines:
        os.dup2(file.fileno(), 2)
        try:
            yield printed
        finally:
            os.dup2(kept, 2)
            os.close(kept)
            file.seek(0)
            printed += file.read() + lines.getvalue().encode()


def _tables(file: Path) -> tuple[_Tables, dict[str, float]]:
    """Return columns of the messages by name and number, with `time`, and the parameters."""
    from pymavlink.DFReader import DFReader_binary

    reader = DFReader_binary(str(file))
    places: dict[str, tuple[str, int]] = {}
    for layout in reader.formats.values():
        match = _MESSAGE.fullmatch(layout.name)
        kind = "" if match is None else _ALSO.get(match[1], match[1])
        if match is not None and kind in _FIELDS:
            places[layout.name] = kind, max(0, int(match[2] or 1) - 1)
    columns: dict[tuple[str, int], list[array[float]]] = defaultdict(list)
    parameters: dict[str, float] = {}
    while (message := reader.recv_match(type=[*places, "PARM"])) is not None:
        name = message.get_type()
        if name == "PARM":
            parameters[message.Name] = float(message.Value)
            continue
        kind, number = places[name]
        number = next((int(getattr(message, n)) for n in _NUMBERS if hasattr(message, n)), number)
        rows = columns[kind, number]
        if not rows:
            rows += [array("d") for _ in range(1 + len(_FIELDS[kind]))]
        if hasattr(message, "TimeUS"):
            time = 1e-6 * message.TimeUS
        elif kind == "GPS":
            time = 1e-3 * getattr(message, "T", np.nan)
        else:
            time = 1e-3 * getattr(message, "TimeMS", np.nan)
        rows[0].append(time)
        for row, field in zip(rows[1:], _FIELDS[kind], strict=True):
            row.append(getattr(message, field, np.nan))
    tables: dict[str, dict[int, _Table]] = defaultdict(dict)
    for (kind, number), rows in sorted(columns.items()):
        names = ("time", *_FIELDS[kind])
        arrays = (np.frombuffer(row, np.float64) for row in rows)
        tables[kind][number] = dict(zip(names, arrays, strict=True))
    return tables, parameters


def _most(values: Floats) -> int | None:
    """Return the most frequent number; None: there is none."""
    known = values[np.isfinite(values)]
    if not len(known):
        return None
    found, counts = np.unique(known, return_counts=True)
    return int(found[np.argmax(counts)])


def _primary(tables: _Tables, parameters: Mapping[str, float]) -> tuple[int, str] | None:
    """Return the number of the estimator that flew, and how it is known."""
    for kind in ("XKF4", "NKF4"):
        for table in tables.get(kind, {}).values():
            if (found := _most(table["PI"])) is not None:
                return found, f"the primary estimator ({kind}) used it"
    for name in ("EK3_PRIMARY", "EK2_PRIMARY"):
        if name in parameters:
            return int(parameters[name]), f"{name} {parameters[name]:g}"
    return None


def _inertial(tables: _Tables, parameters: Mapping[str, float]) -> Iterator[LogSource]:
    primary = _primary(tables, parameters)
    mask = int(parameters.get("EK3_IMU_MASK", parameters.get("EK2_IMU_MASK", 7.0)))
    cores = [k for k in range(8) if mask >> k & 1]
    for number, table in tables["IMU"].items():
        values = {
            "gyro": stack(table, _AXES["Gyr"]) * TO_FLU,
            "accel": stack(table, _AXES["Acc"]) * TO_FLU,
        }
        flew = primary is not None and cores[primary[0] : primary[0] + 1] == [number]
        yield LogSource(
            sensor="imu",
            topic="IMU",
            instance=number,
            time=table["time"],
            values=values,
            rank=float(flew),
            because=primary[1] if primary is not None and flew else "",
        )


def _gnss(tables: _Tables, parameters: Mapping[str, float]) -> Iterator[LogSource]:
    """Yield positions and velocities with a fix, with the accuracy reported at that time."""
    for number, table in tables.get("GPS", {}).items():
        delay = parameters.get(f"GPS{number + 1}_DELAY_MS") or 0.0
        delay = delay or parameters.get("GPS_DELAY_MS" + "2" * bool(number)) or 0.0
        received, speed, course = table["time"], table["Spd"], np.radians(table["GCrs"])
        reported = tables.get("GPA", {}).get(number)
        h, v, s = np.full((3, len(received)), np.nan)
        if reported is not None:
            place = np.clip(
                np.searchsorted(reported["time"], received), 0, len(reported["time"]) - 1
            )
            same = reported["time"][place] == received
            h, v, s = (np.where(same, reported[n][place], np.nan) for n in ("HAcc", "VAcc", "SAcc"))
        fixed = (table["Status"] >= _MIN_FIX) & (np.abs(table["Lat"]) <= 90.0)
        fixed &= (table["Lat"] != 0.0) | (table["Lng"] != 0.0)
        place_lla = np.where(fixed, np.stack([table["Lat"], table["Lng"], table["Alt"]]), np.nan)
        values = {
            "gnss_position_G": ecef_of(*place_lla),
            "gnss_velocity_I": np.column_stack(
                [speed * np.sin(course), speed * np.cos(course), -table["VZ"]]
            ),
            "gnss_sigma": positive(np.column_stack([h, h, v])),
            "velocity_sigma": positive(s),
        }
        used = float(np.nanmean(table["U"])) if np.isfinite(table["U"]).any() else 0.0
        yield LogSource(
            sensor="gnss",
            topic="GPS",
            instance=number,
            time=received - (1e-3 * delay or GNSS_DELAY),
            received=received,
            values=values,
            rank=used,
            because="the vehicle used it (U)" if used > 0.5 else "",
        ).keep(fixed, "no fix")


def _compasses(tables: _Tables, parameters: Mapping[str, float]) -> Iterator[LogSource]:
    """Yield compasses; the first of COMPASS_PRIO1_ID and later is the one with number 0.

    A priority that names the device of another number is ambiguous, and has no effect.
    """
    chosen, because = None, ""
    primary = _primary(tables, parameters)
    sets = tables.get("XKFS", {}).get(0 if primary is None else primary[0])
    used = None if sets is None else _most(sets["MI"])
    first = parameters.get("COMPASS_PRIO1_ID")
    if "COMPASS_PRIMARY" in parameters:
        chosen, because = int(parameters["COMPASS_PRIMARY"]), "COMPASS_PRIMARY"
    elif used is not None:
        chosen, because = used, "the estimator used it (XKFS)"
    elif first and first == parameters.get("COMPASS_DEV_ID"):
        chosen, because = 0, "COMPASS_PRIO1_ID"
    for number, table in tables.get("MAG", {}).items():
        off = parameters.get(f"COMPASS_USE{number + 1 if number else ''}", 1.0) == 0.0
        yield LogSource(
            sensor="magnetometer",
            topic="MAG",
            instance=number,
            time=table["time"],
            values={"magnetometer": stack(table, _AXES["Mag"]) * _MILLIGAUSS * TO_FLU},
            rank=float(number == chosen) - float(off),
            because=because if number == chosen else "",
        )


def _aids(tables: _Tables, parameters: Mapping[str, float]) -> Iterator[LogSource]:
    """Yield barometers, flow, distances, motors and batteries."""
    first = int(parameters.get("BARO_PRIMARY", 0.0))
    for number, table in tables.get("BARO", {}).items():
        key, name = (
            ("barometer", "Alt") if np.isfinite(table["Alt"]).any() else ("pressure", "Press")
        )
        yield _aid("barometer", "BARO", number, table, {key: table[name]}, float(number == first))
    for number, table in tables.get("OF", {}).items():
        flow = stack(table, ["flowY", "flowX"])
        source = _aid("optical_flow", "OF", number, table, {"optical_flow": flow})
        yield source.keep(~(table["Qual"] <= 0.0), "no quality")
    for number, table in tables.get("RFND", {}).items():
        old = np.isfinite(table["Dist1"]).any()
        distance, side = (table[name + "1" * bool(old)] for name in ("Dist", "Orient"))
        good = (distance > 0.0) & ~(np.isfinite(side) & (side != _DOWN)) & ~(table["Stat"] < 4.0)
        source = _aid("range_finder", "RFND", number, table, {"range_finder": distance})
        yield source.keep(good, "no distance downward")
    low = parameters.get("MOT_PWM_MIN") or _PULSES[0]
    high = parameters.get("MOT_PWM_MAX") or _PULSES[1]
    outputs = {int(parameters.get(f"SERVO{k}_FUNCTION", 32.0 + k)): k for k in range(14, 0, -1)}
    names = [f"C{outputs.get(_FIRST_MOTOR + k, k + 1)}" for k in range(4)]
    for number, table in tables.get("RCOU", {}).items():
        commands = np.clip((stack(table, names) - low) / (high - low), 0.0, 1.0)
        yield _aid("motors", "RCOU", number, table, {"commands": commands})
    for number, table in tables.get("BAT", {}).items():
        yield _aid("battery", "BAT", number, table, {"battery": table["Volt"]})


def _aid(
    sensor: str,
    topic: str,
    number: int,
    table: _Table,
    values: dict[str, Floats],
    rank: float = 0.0,
) -> LogSource:
    return LogSource(
        sensor=sensor, topic=topic, instance=number, time=table["time"], values=values, rank=rank
    )

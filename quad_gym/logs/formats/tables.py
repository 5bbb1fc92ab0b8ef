"""Logs from tables: data frames, mappings and CSV files, also with columns of others."""

import csv
import gzip
import tomllib
import zlib
from array import array
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, TextIO

import numpy as np

from quad_gym.logs.formats.log import LOG_COLUMNS, Floats, LogSource, RawLog, ecef_of
from quad_gym.params import checks as check
from quad_gym.params.sensor_table import AID_PARAMS, READINGS

# --------------------------------------------------------------------------------------------------
# Logs from tables: data frames, mappings of columns, comma-separated files.
# --------------------------------------------------------------------------------------------------

_SENSOR_AND_NAME = {
    "gyro": ("imu", "gyro"),
    "accel": ("imu", "accel"),
    "gnss": ("gnss", "gnss_position_G"),
    "gnss_lla": ("gnss", "gnss_position_G"),
    "gnss_enu": ("gnss", "gnss_position_I"),
    "gnss_sigma": ("gnss", "gnss_sigma"),
    "gnss_velocity": ("gnss", "gnss_velocity_G"),
    "gnss_velocity_enu": ("gnss", "gnss_velocity_I"),
    "gnss_velocity_sigma": ("gnss", "velocity_sigma"),
    "gnss_baseline": ("gnss", "gnss_baseline_G"),
    "gnss_baseline_enu": ("gnss", "gnss_baseline_I"),
    "heading": ("attitude", "heading"),
    "attitude": ("attitude", "quaternion"),
    "motors": ("motors", "motors"),
    "commands": ("motors", "commands"),
}
"""Sensors of quantities, and names of their values in a source; of others, both are the key."""

_TIMES = ("time", "received")  #: columns that no sensor measures

_TOGETHER = ("imu", "gnss")
"""Sensors with several quantities in a source; of others, each quantity is a source by itself."""

DISORDER = 0.1  #: share of steps back in time, of the IMU, that no recorder writes

EPISODE = (
    "it has one row for each control step, without the other samples of the IMU, so that no filter "
    "can process it: show it with quad-gym fly --replay FILE.npz"
)
"""Reason why a recorded flight is no log."""

_CONVERTED = {
    ".bbl": "a blackbox of Betaflight or INAV: convert it with blackbox_decode, and map the "
    "columns of its .csv (columns=, --columns)",
    ".bfl": "a blackbox of Betaflight: convert it with blackbox_decode, and map the columns of "
    "its .csv (columns=, --columns)",
    ".px4log": "a log of sdlog2 (PX4 before 2016): convert it with sdlog2_dump.py of PX4, and map "
    "the columns of its .csv (columns=, --columns)",
    ".txt": "no table that names its columns: records of DJI must first be converted, as with "
    "DatCon or dji-log-parser, to a .csv whose columns are mapped (columns=, --columns); they lack "
    "the samples of the IMU unless they come from the aircraft (.DAT)",
    ".dat": "a record of DJI: convert it with DatCon, and map the columns of its .csv (columns=, "
    "--columns)",
    ".tlog": "telemetry of MAVLink, whose IMU is too slow for a filter: use the log of the "
    "autopilot (.bin, .ulg), or convert it with mavlogdump.py --format csv and map its columns "
    "(columns=, --columns)",
    ".npz": f"an archive of arrays. If it is an episode that quad_gym recorded, {EPISODE}",
    ".log": "a text log of ArduPilot: use the binary log (.bin) of the same flight",
}
"""Files of others, by their endings, and how to read them."""

Columns = Mapping[str, Floats]


def opened(path: Path) -> TextIO:
    """Open a table of text, compressed (.gz) or not."""
    if path.suffix.lower() == ".gz":
        return gzip.open(path, "rt", newline="", encoding="utf-8-sig")
    return path.open(newline="", encoding="utf-8-sig")


def csv_columns(path: Path) -> Columns:
    """Return the columns of a file by their headings; an empty cell is NaN."""
    if (advice := _CONVERTED.get(path.suffix.lower())) is not None and path.exists():
        raise ValueError(f"{path.name} is {advice}")
    numbers, count = array("d"), 0
    try:
        with opened(path) as file:
            separator = max(",;\t", key=file.readline().count)
            file.seek(0)
            rows = csv.reader(file, delimiter=separator)
            names = [name.strip() for name in next(rows, [])]
            for row in filter(None, rows):
                count += 1
                if len(row) != len(names):
                    raise ValueError(
                        f"{path.name} must have {len(names)} cells in each row, got {len(row)} in "
                        f"row {count}"
                    )
                numbers.extend(_number(path, cell, count) for cell in row)
    except (UnicodeDecodeError, csv.Error, EOFError, gzip.BadGzipFile, zlib.error):
        raise ValueError(
            f"{path.name} must be a table of text (.csv), a log (.ulg, .bin), a bag or a folder"
        ) from None
    if len(set(names)) < len(names):
        raise ValueError(f"{path.name} must have distinct column names, got {names}")
    if not count:
        raise ValueError(f"{path.name} must have at least one row of numbers, got none")
    table = np.frombuffer(numbers, np.float64).reshape(count, len(names))
    return {name: table[:, i] for i, name in enumerate(names)}


def _number(path: Path, cell: str, row: int) -> float:
    try:
        return float(cell) if cell.strip() else np.nan
    except ValueError as error:
        raise ValueError(f"{path.name} must contain numbers: {error} in row {row}") from None


def checked_columns(given: Mapping[Any, Any]) -> Columns:
    """Return columns of one number each, checked."""
    known = {name for column in LOG_COLUMNS.values() for name in column.names}
    found: dict[str, Floats] = {}
    for key, value in given.items():
        name = str(key)
        array_ = np.asarray(value)
        if array_.dtype == object or array_.dtype.kind not in "iuf":
            try:
                array_ = np.asarray(value, dtype=np.float64)
            except (TypeError, ValueError):
                raise ValueError(f"column {name} must contain numbers") from None
        if name == "pixels" and array_.ndim == 3 and array_.shape[2] == 2:
            for i in range(array_.shape[1]):
                for j, axis in enumerate("uv"):
                    found[f"pixel_{i}_{axis}"] = array_[:, i, j].astype(np.float64)
        elif array_.ndim == 2 and name in LOG_COLUMNS:
            names = _names_of(name, array_.shape[1])
            check.array(f"column {name}", array_, (None, len(names)), allow_nan=True)
            found.update({n: array_[:, i].astype(np.float64) for i, n in enumerate(names)})
        else:
            if name not in known and _pixel_of(name) is None:
                raise ValueError(_unknown(name, list(map(str, given)), known))
            found[name] = check.array(f"column {name}", array_, (None,), allow_nan=True)
    lengths = {len(column) for column in found.values()}
    if len(lengths) > 1:
        raise ValueError(f"columns of a log must have equal lengths, got {sorted(lengths)}")
    for name in ("time", *LOG_COLUMNS["gyro"].names, *LOG_COLUMNS["accel"].names):
        if name not in found:
            raise ValueError(f"a log must have a column {name}, got {', '.join(found) or 'none'}")
    return found


def _unknown(name: str, given: Sequence[str], known: Iterable[str]) -> str:
    """Explain that a column is unknown."""
    if {"filter_status", "nees", "estimation_error"} <= set(given):  # of `Flight.to_csv`
        return f"this is an episode that quad_gym recorded: {EPISODE}"
    return (
        f"columns of a log must have known names, got {name}{check.did_you_mean(name, known)}. "
        "Remove it, or map it (columns=, --columns). "
        f"Known are {', '.join(sorted(known))} and pixels"
    )


def _names_of(key: str, width: int) -> tuple[str, ...]:
    """Return the columns of a quantity with a width; of several blocks, as many as are given."""
    names, kind = LOG_COLUMNS[key].names, AID_PARAMS.get(key)
    if kind is None or kind.most_blocks == 1 or width % kind.length:
        return names
    return names[:width]


def _pixel_of(name: str) -> tuple[int, int] | None:
    """Feature and axis of a column such as `pixel_3_u`."""
    words = name.split("_")
    if len(words) == 3 and words[0] == "pixel" and words[1].isdecimal() and words[2] in ("u", "v"):
        return int(words[1]), "uv".index(words[2])
    return None


def recording_of(columns: Columns, body: str, file: str) -> RawLog:
    """Return the contents of checked columns, in the order of arrival."""
    columns, notes = _in_order(columns)
    return RawLog(file=file, sources=list(sources_of(columns, body)), notes=notes)


def _in_order(columns: Columns) -> tuple[Columns, list[str]]:
    """Return the rows in the order of time if theirs cannot be the order of arrival."""
    time = columns["time"]
    back = np.diff(time[np.isfinite(columns["gyro_x"])]) < 0.0
    if "received" in columns or not len(back) or back.mean() < DISORDER:
        return columns, []
    order = np.argsort(time, kind="stable")
    sentence = "the rows of the table are not in the order of time: they are sorted"
    return {name: column[order] for name, column in columns.items()}, [sentence]


def _together(columns: Columns, key: str) -> Floats | None:
    """Return the numbers of a quantity (n, ...); None: the table has none."""
    names = LOG_COLUMNS[key].names
    have = [name in columns for name in names]
    if not any(have):
        return None
    kind = AID_PARAMS.get(key)
    if kind is not None and kind.most_blocks > 1:  # as many as there are, in order
        blocks = 1 + max(np.flatnonzero(have)) // kind.length
        names = names[: kind.length * blocks]
        have = have[: len(names)]
    if not all(have):
        missing = names[have.index(False)]
        raise ValueError(f"a log must have a column {missing} with {names[have.index(True)]}")
    block = np.column_stack([columns[name] for name in names])
    return block if len(names) > 1 else block[:, 0]


def sources_of(columns: Columns, body: str) -> Iterator[LogSource]:
    """Yield a source for each sensor with columns."""
    found = _quantities(columns, body)
    for reading in READINGS.values():
        given = [key for key in found if _named(key)[1] in reading.in_logs]
        if len(given) > 1:
            raise ValueError(f"a log must have one of {', '.join(given)}, not both")
    sources: dict[str, dict[str, Floats]] = {}
    for key, numbers in found.items():
        sensor, name = _named(key)
        sources.setdefault(sensor if sensor in _TOGETHER else key, {})[name] = numbers
    if len(sources.get("imu", {})) == 1:  # the half of one
        sources |= {name: {name: half} for name, half in sources.pop("imu").items()}
    if (pixels := _image(columns)) is not None:
        sources["camera"] = {"pixels": pixels}
    for key, values in sources.items():
        half = key in ("gyro", "accel")
        yield from _source(columns, key if half else _named(key)[0], values)


def _named(key: str) -> tuple[str, str]:
    """Return the sensor of a quantity, and the name of its values in a source."""
    return _SENSOR_AND_NAME.get(key, (key, key))


def _quantities(columns: Columns, body: str) -> dict[str, Floats]:
    """Return the numbers (n, ...) of all quantities of sensors, vectors in the axes of B."""
    axes = np.array([1.0, 1.0, 1.0] if body == "flu" else [1.0, -1.0, -1.0])
    found = {}
    for key, column in LOG_COLUMNS.items():
        numbers = None if key in _TIMES else _together(columns, key)
        if numbers is not None:
            if key == "gnss_lla":
                numbers = ecef_of(*numbers.T)
            in_B = column.frame == "B" and numbers.shape[1:] == (3,)
            found[key] = numbers * axes if in_B else numbers
    return found


def _source(columns: Columns, sensor: str, values: dict[str, Floats]) -> Iterator[LogSource]:
    """Yield the rows in which something was measured, if there are any."""
    rows = np.zeros(len(columns["time"]), bool)
    for name, value in values.items():
        if "sigma" not in name:
            known = np.isfinite(value).reshape(len(rows), -1)
            rows |= known.all(axis=1) if sensor == "imu" else known.any(axis=1)
    if rows.any():
        received = columns.get("received")
        yield LogSource(
            sensor=sensor,
            topic="table",
            time=columns["time"][rows],
            received=None if received is None else received[rows],
            row=np.flatnonzero(rows),
            values={name: value[rows] for name, value in values.items()},
        )


def _image(columns: Columns) -> Floats | None:
    """(n, features, 2) pixels of all rows."""
    found = {name: place for name in columns if (place := _pixel_of(name)) is not None}
    if not found:
        return None
    features = 1 + max(feature for feature, _ in found.values())
    pixels = np.full((len(columns["time"]), features, 2), np.nan)
    for name, (feature, axis) in found.items():
        pixels[:, feature, axis] = columns[name]
    return pixels


# --------------------------------------------------------------------------------------------------
# Maps of columns: tables of others, with their names, units, axes and clocks, as logs.
#
# A map is a file (.toml) with a table for each quantity of LOG_COLUMNS that the log has:
#
#     [gyro]
#     columns = ["wx", "wy", "wz"]   # in the file
#     unit = "deg/s"                 # of the columns, or of each; default: LOG_COLUMNS has it
#     axes = ["x", "-y", "-z"]       # ours, of the columns in their order; default: x, y, z
#     scale = 1.0                    # factor before the unit, or one for each column
#     clock = "imu_time"             # column of its time stamps; default: the one of [time]
#     clock_unit = "ms"              # default: s
#
#     [gnss_enu]                     # measurements from a reference trajectory:
#     rate = 10.0                    # their rate [Hz]; default: all rows
#     sigma = 0.01                   # standard deviation of white noise that is added
#     seed = 0                       # of the noise
#
# `[time]` has `columns`, `unit` and `offset` [s], and `body = "frd"` at the top as in `read_log`. A
# barometer may be a pressure. Rows without a number are no measurements.
# --------------------------------------------------------------------------------------------------

_KEYS = (
    "columns",
    "unit",
    "axes",
    "scale",
    "offset",
    "clock",
    "clock_unit",
    "rate",
    "sigma",
    "seed",
)
_DEGREE, _G = np.pi / 180.0, 9.80665
_UNITS: dict[str, dict[str, float]] = {
    "s": {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9, "min": 60.0},
    "rad/s": {"rad/s": 1.0, "deg/s": _DEGREE, "mdeg/s": 1e-3 * _DEGREE, "mrad/s": 1e-3},
    "m/s^2": {"m/s^2": 1.0, "g": _G, "mg": 1e-3 * _G, "cm/s^2": 0.01, "ft/s^2": 0.3048},
    "rad": {"rad": 1.0, "deg": _DEGREE},
    "deg": {"deg": 1.0, "rad": 1.0 / _DEGREE},
    "m": {"m": 1.0, "mm": 1e-3, "cm": 0.01, "km": 1e3, "ft": 0.3048},
    "m/s": {"m/s": 1.0, "cm/s": 0.01, "mm/s": 1e-3, "km/h": 1.0 / 3.6, "knots": 0.514444},
    "T": {"T": 1.0, "G": 1e-4, "mG": 1e-7, "uT": 1e-6, "nT": 1e-9},
    "V": {"V": 1.0, "mV": 1e-3},
    "-": {"-": 1.0, "%": 0.01},
}
"""Units, by the one of LOG_COLUMNS, and how much of it one of them is."""
_PRESSURES = {"Pa": 1.0, "hPa": 100.0, "mbar": 100.0, "kPa": 1e3, "bar": 1e5}


def read_table(path: Path, file: Path) -> RawLog:
    """Return the contents of a comma-separated table by a map."""
    return mapped(csv_columns(path), file, path.name)


def mapped(given: Mapping[Any, Any], file: Path, name: str) -> RawLog:
    """Return the contents of columns by a map, see `read_table`."""
    try:
        contents = tomllib.loads(file.read_text(encoding="utf-8"))
    except (UnicodeDecodeError, tomllib.TOMLDecodeError) as error:
        raise ValueError(f"{file.name} must be a map of columns (.toml): {error}") from None
    try:
        sources = list(_sources(given, contents))
    except ValueError as error:
        raise ValueError(f"{name} with the map {file.name}: {error}") from None
    by_pressure = any("pressure" in source.values for source in sources)
    return RawLog(file=name, sources=sources, barometer_from_start=by_pressure)


def _sources(given: Mapping[Any, Any], contents: dict[str, Any]) -> Iterator[LogSource]:
    """Yield the sources of all quantities with the same clock together."""
    body = check.choice("body", contents.pop("body", "flu"), ("flu", "frd"))
    check.keywords(contents, tuple(LOG_COLUMNS), "a map of columns")
    for key, entry in contents.items():
        check.instance(f"[{key}]", entry, dict)
        check.keywords(entry, _KEYS, f"[{key}]")
    for key in ("time", "gyro", "accel"):
        if key not in contents:
            raise ValueError(f"a map must have [{key}]")
    default = _numbers(given, "time", contents.pop("time"))[:, 0]
    own = {entry["clock"] for entry in contents.values() if "clock" in entry}
    clocks = {None: default} | {c: _clock(given, c, contents) for c in sorted(own)}
    for clock, time in clocks.items():
        columns: dict[str, Floats] = {"time": time}
        for key, entry in contents.items():
            if entry.get("clock") != clock:
                continue
            if key == "barometer" and entry.get("unit") in _PRESSURES:
                yield _pressure(given, entry, time)
                continue
            values = _made(key, _numbers(given, key, entry), entry, time)
            columns |= dict(zip(LOG_COLUMNS[key].names, values.T, strict=True))
        yield from sources_of(columns, body)


def _clock(given: Mapping[Any, Any], name: str, contents: Mapping[str, Any]) -> Floats:
    """Return the time stamps by another column."""
    entry = next(e for e in contents.values() if e.get("clock") == name)
    unit = check.choice("clock_unit", entry.get("clock_unit", "s"), tuple(_UNITS["s"]))
    return _column(given, name) * _UNITS["s"][unit]


def _column(given: Mapping[Any, Any], name: str) -> Floats:
    if name not in given:
        have = ", ".join(map(str, given))
        raise ValueError(
            f"there is no column {name}{check.did_you_mean(name, map(str, given))}, but {have}"
        )
    try:
        return np.asarray(given[name], np.float64)
    except (TypeError, ValueError):
        raise ValueError(f"column {name} must contain numbers") from None


def _listed(entry: Mapping[str, Any], word: str, default: Any, count: int) -> Sequence[Any]:
    """Return a value for each column."""
    value = entry.get(word, default)
    values = value if isinstance(value, list) else [value] * count
    if len(values) != count:
        raise ValueError(f"{word} must have {count} values, got {len(values)}")
    return values


def _numbers(given: Mapping[Any, Any], key: str, entry: Mapping[str, Any]) -> Floats:
    """Return the numbers of a quantity (n, k), in our unit and axes."""
    names = LOG_COLUMNS[key].names
    columns = entry.get("columns")
    columns = [columns] if isinstance(columns, str) else columns
    if not isinstance(columns, list) or len(columns) != len(names):
        raise ValueError(f"[{key}] must have {len(names)} columns, got {columns!r}")
    ours = LOG_COLUMNS[key].unit.split(", ")
    ours = ours * len(names) if len(ours) == 1 else [ours[0], ours[0], ours[1]]
    units = _listed(entry, "unit", None, len(names))
    scales = _listed(entry, "scale", 1.0, len(names))
    table = []
    for column, our, unit, scale in zip(columns, ours, units, scales, strict=True):
        known = _UNITS[our]
        factor = known[check.choice(f"unit of [{key}]", unit or our, tuple(known))]
        table.append(_column(given, column) * (factor * check.number("scale", scale)))
    values = np.column_stack(table) + check.number("offset", entry.get("offset", 0.0))
    if (axes := entry.get("axes")) is None:
        return values
    words = [check.choice(f"axes of [{key}]", a, ("x", "y", "z", "-x", "-y", "-z")) for a in axes]
    if len(names) != 3 or sorted(word[-1] for word in words) != ["x", "y", "z"]:
        raise ValueError(f"axes of [{key}] must be x, y and z of three columns, got {axes!r}")
    signs = [-1.0 if word[0] == "-" else 1.0 for word in words]
    return values[:, ["xyz".index(word[-1]) for word in words]] * signs


def _pressure(given: Mapping[Any, Any], entry: Mapping[str, Any], time: Floats) -> LogSource:
    """Return a barometer that is given as a pressure."""
    factor = _PRESSURES[entry["unit"]]
    values = _numbers(given, "barometer", {**entry, "unit": "m", "scale": factor})[:, 0]
    rows = np.isfinite(values)
    return LogSource(
        sensor="barometer",
        topic="table",
        time=time[rows],
        row=np.flatnonzero(rows),
        values={"pressure": values[rows]},
    )


def _made(key: str, values: Floats, entry: Mapping[str, Any], time: Floats) -> Floats:
    """Return measurements at a rate, with noise, from a reference."""
    if "rate" in entry:
        rate = check.positive(f"rate of [{key}]", entry["rate"])
        known = np.isfinite(time) & np.isfinite(values).all(axis=1)
        period = np.floor((time - np.min(time[known], initial=np.inf)) * rate + 1e-6)
        first = np.zeros(len(time), bool)
        first[np.unique(np.where(known, period, -1.0), return_index=True)[1]] = True
        values = np.where((first & known)[:, np.newaxis], values, np.nan)
    if "sigma" not in entry:
        return values
    sigma = check.positive(f"sigma of [{key}]", entry["sigma"])
    rng = np.random.default_rng(check.seed("seed", entry.get("seed", 0)))
    if key != "attitude":
        return values + sigma * rng.normal(size=values.shape)
    w, x, y, z = values.T
    a, b, c = 0.5 * sigma * rng.normal(size=(3, len(values)))  # a small turn in B
    return values + np.column_stack(
        [
            -x * a - y * b - z * c,
            w * a + y * c - z * b,
            w * b + z * a - x * c,
            w * c + x * b - y * a,
        ]
    )

"""Maps of columns: tables of others, with their names, units, axes and clocks, as logs.

A map is a file (.toml) with a table for each quantity of LOG_COLUMNS that the log has:

    [gyro]
    columns = ["wx", "wy", "wz"]   # in the file
    unit = "deg/s"                 # of the columns, or of each; default: LOG_COLUMNS has it
    axes = ["x", "-y", "-z"]       # ours, of the columns in their order; default: x, y, z
    scale = 1.0                    # factor before the unit, or one for each column
    clock = "imu_time"             # column of its time stamps; default: the one of [time]
    clock_unit = "ms"              # default: s

    [gnss_enu]                     # measurements from a reference trajectory:
    rate = 10.0                    # their rate [Hz]; default: all rows
    sigma = 0.01                   # standard deviation of white noise that is added
    seed = 0                       # of the noise

`[time]` has `columns`, `unit` and `offset` [s], and `body = "frd"` at the top as in `read_log`. A
barometer may be a pressure. Rows without a number are no measurements.
"""

import tomllib
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from quad_gym.estimation.logs import tables
from quad_gym.estimation.logs.log import LOG_COLUMNS, Floats
from quad_gym.estimation.logs.source import LogSource, RawLog
from quad_gym.params import checks as check

_KEYS = (
    *("columns", "unit", "axes", "scale", "offset", "clock", "clock_unit"),
    *("rate", "sigma", "seed"),
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
    return mapped(tables.csv_columns(path), file, path.name)


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
        yield from tables.sources_of(columns, body)


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

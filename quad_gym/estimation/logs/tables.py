"""Logs from tables: data frames, mappings of columns, comma-separated files."""

import csv
import gzip
from array import array
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, TextIO

import numpy as np

from quad_gym.estimation.logs.log import LOG_COLUMNS, Floats, ecef_of
from quad_gym.estimation.logs.source import LogSource, RawLog
from quad_gym.params import checks as check
from quad_gym.params.aid_table import AID_PARAMS

_FORMS = {
    "gnss": ("", "_lla", "_enu"),
    "gnss_velocity": ("", "_enu"),
    "gnss_baseline": ("", "_enu"),
}
"""Forms in which quantities may be given."""

DISORDER = 0.1  #: share of steps back in time, of the IMU, that no recorder writes

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
    except (UnicodeDecodeError, csv.Error, EOFError, gzip.BadGzipFile):
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
                raise ValueError(
                    f"columns of a log must be {', '.join(sorted(known))} or pixels, got {name}: "
                    "remove it, or map it (columns=, --columns)"
                )
            found[name] = check.array(f"column {name}", array_, (None,), allow_nan=True)
    lengths = {len(column) for column in found.values()}
    if len(lengths) > 1:
        raise ValueError(f"columns of a log must have equal lengths, got {sorted(lengths)}")
    for name in ("time", *LOG_COLUMNS["gyro"].names, *LOG_COLUMNS["accel"].names):
        if name not in found:
            raise ValueError(f"a log must have a column {name}, got {', '.join(found) or 'none'}")
    return found


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
    axes = np.array([1.0, 1.0, 1.0] if body == "flu" else [1.0, -1.0, -1.0])

    def source(sensor: str, **values: Floats | None) -> Iterator[LogSource]:
        """The rows in which something was measured."""
        given = {name: v for name, v in values.items() if v is not None}
        rows = np.zeros(len(columns["time"]), bool)
        for name, value in given.items():
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
                values={name: v[rows] for name, v in given.items()},
            )

    vectors = [name for name, kind in AID_PARAMS.items() if (kind.length, kind.frame) == (3, "B")]
    turned = {key: _together(columns, key) for key in ("gyro", "accel", *vectors)}
    turned = {key: None if v is None else v * axes for key, v in turned.items()}
    halves = {name: turned[name] for name in ("gyro", "accel") if turned[name] is not None}
    if len(halves) == 2:
        yield from source("imu", **halves)
    for name, values in halves.items() if len(halves) < 2 else ():
        yield from source(name, **{name: values})
    gnss: dict[str, Floats | None] = {
        "position_sigma_I": _together(columns, "gnss_sigma"),
        "velocity_sigma": _together(columns, "gnss_velocity_sigma"),
    }
    for key, quantity in zip(_FORMS, ("position", "velocity", "baseline"), strict=True):
        forms = {form: _together(columns, key + form) for form in _FORMS[key]}
        given = [key + form for form, values in forms.items() if values is not None]
        if len(given) > 1:
            raise ValueError(f"a log must have one of {', '.join(given)}, not both")
        gnss[f"{quantity}_G"], gnss[f"{quantity}_I"] = forms[""], forms.get("_enu")
        if (places := forms.get("_lla")) is not None:
            gnss[f"{quantity}_G"] = ecef_of(*places.T)
    yield from source("gnss", **gnss)
    yield from source("camera", pixels=_image(columns))
    for name in (*AID_PARAMS, "battery"):
        yield from source(name, **{name: turned.get(name, _together(columns, name))})
    yield from source("attitude", quaternion=_together(columns, "attitude"))
    yield from source("attitude", heading=_together(columns, "heading"))
    yield from source("motors", motors=_together(columns, "motors"))
    yield from source("motors", commands=_together(columns, "commands"))


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

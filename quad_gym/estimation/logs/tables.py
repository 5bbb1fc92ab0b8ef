"""Logs from tables: data frames, mappings of columns, comma-separated files."""

import csv
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from quad_gym.estimation.logs.euroc import is_euroc, read_euroc
from quad_gym.estimation.logs.log import LOG_COLUMNS, Floats, Log, Stream, ecef_of
from quad_gym.params import checks as check

_FORMS = {
    "gnss": ("", "_lla", "_enu"),
    "gnss_velocity": ("", "_enu"),
    "gnss_baseline": ("", "_enu"),
}
"""Forms in which quantities may be given."""


def read_log(log: Any, *, body: str = "flu") -> Log:
    """Read a log from a table or a file.

    Args:
        log: A pandas DataFrame, a mapping of columns, or a path: of a comma-separated table with a
            line of names (.csv), of a log of PX4 (.ulg) or ArduPilot (.bin), of a bag of ROS 1
            (.bag) or ROS 2 (a folder), or of a folder in the format of EuRoC; see the modules
            of `quad_gym.estimation.logs`. A mapping may hold the numbers of a quantity together,
            such as `"gyro"` (n, 3). See LOG_COLUMNS.
        body: Axes of IMU and magnetometer in a table: "flu" (x forward, y left, z up), or "frd" (x
            forward, y right, z down).

    Raises:
        ValueError: If columns are missing, unknown, or of unequal length, hold values that are
            infinite or not numbers, or the IMU samples are not in the order of time.
        ImportError: If the library that reads this format is not installed.
        OSError: If there is no such file.
    """
    check.choice("body", body, ("flu", "frd"))
    if isinstance(log, Log):
        return log
    if isinstance(log, (str, Path)):
        path = Path(log)
        if path.suffix.lower() in (".ulg", ".ulog"):
            from quad_gym.estimation.logs.px4 import read_ulog

            return read_ulog(path)
        if path.suffix.lower() == ".bin":
            from quad_gym.estimation.logs.ardupilot import read_bin

            return read_bin(path)
        if path.suffix.lower() == ".bag" or (path / "metadata.yaml").is_file():
            from quad_gym.estimation.logs.ros import read_bag

            return read_bag(path)
        if is_euroc(path):
            return read_euroc(path)
        return _log_of(_csv_columns(path), body, {"file": path.name})
    if isinstance(log, Mapping):
        return _log_of(_columns(log), body, {})
    if hasattr(log, "columns") and hasattr(log, "to_numpy"):
        return _log_of(_columns({name: log[name] for name in log.columns}), body, {})
    raise ValueError(
        "log must be a DataFrame, a mapping of columns, or a path of a .csv, .ulg, .bin, bag "
        f"or folder, got "
        f"{type(log).__name__}"
    )


def _csv_columns(path: Path) -> dict[str, Floats]:
    """The columns of a file; an empty cell is NaN."""
    with path.open(newline="", encoding="utf-8-sig") as file:
        rows = csv.reader(file)
        try:
            names = [name.strip() for name in next(rows, [])]
            cells = [row for row in rows if row]
        except (UnicodeDecodeError, csv.Error):
            raise ValueError(f"{path.name} must be a table of text (.csv)") from None
    if len(set(names)) < len(names):
        raise ValueError(f"{path.name} must have distinct column names, got {names}")
    if not cells:
        raise ValueError(f"{path.name} must have at least one row of numbers, got none")
    table = np.empty((len(cells), len(names)))
    for k, row in enumerate(cells):
        if len(row) != len(names):
            raise ValueError(
                f"{path.name} must have {len(names)} cells in each row, got {len(row)} in row "
                f"{k + 1}"
            )
        try:
            table[k] = [float(cell) if cell.strip() else np.nan for cell in row]
        except ValueError as error:
            raise ValueError(f"{path.name} must hold numbers: {error} in row {k + 1}") from None
    return _columns({name: table[:, i] for i, name in enumerate(names)})


def _columns(given: Mapping[Any, Any]) -> dict[str, Floats]:
    """Columns of one number each, checked."""
    known = {name for column in LOG_COLUMNS.values() for name in column.names}
    found: dict[str, Floats] = {}
    for key, value in given.items():
        name = str(key)
        array = np.asarray(value)
        if array.dtype == object or array.dtype.kind not in "iuf":
            try:
                array = np.asarray(value, dtype=np.float64)
            except (TypeError, ValueError):
                raise ValueError(f"column {name} must hold numbers") from None
        if name == "pixels" and array.ndim == 3 and array.shape[2] == 2:
            for i in range(array.shape[1]):
                for j, axis in enumerate("uv"):
                    found[f"pixel_{i}_{axis}"] = array[:, i, j].astype(np.float64)
        elif array.ndim == 2 and name in LOG_COLUMNS:
            names = LOG_COLUMNS[name].names
            check.array(f"column {name}", array, (None, len(names)), allow_nan=True)
            found.update({n: array[:, i].astype(np.float64) for i, n in enumerate(names)})
        else:
            if name not in known and _pixel_of(name) is None:
                raise ValueError(
                    f"columns of a log must be {', '.join(sorted(known))} or pixels, got {name}: "
                    "remove it"
                )
            found[name] = check.array(f"column {name}", array, (None,), allow_nan=True)
    lengths = {len(column) for column in found.values()}
    if len(lengths) > 1:
        raise ValueError(f"columns of a log must have equal lengths, got {sorted(lengths)}")
    for name in ("time", *LOG_COLUMNS["gyro"].names, *LOG_COLUMNS["accel"].names):
        if name not in found:
            raise ValueError(f"a log must have a column {name}, got {', '.join(found) or 'none'}")
    return found


def _pixel_of(name: str) -> tuple[int, int] | None:
    """Feature and axis of a column such as `pixel_3_u`."""
    words = name.split("_")
    if len(words) == 3 and words[0] == "pixel" and words[1].isdecimal() and words[2] in ("u", "v"):
        return int(words[1]), "uv".index(words[2])
    return None


def _log_of(columns: dict[str, Floats], body: str, about: dict[str, Any]) -> Log:
    """A log of checked columns."""
    time = columns["time"]
    # in the order of rows: no row arrives before the row above it
    received = columns.get("received")
    if received is None:
        filled = np.where(np.isnan(time), -np.inf, time)
        received = np.maximum.accumulate(filled)
    axes = np.array([1.0, 1.0, 1.0] if body == "flu" else [1.0, -1.0, -1.0])

    def together(key: str) -> Floats | None:
        names = LOG_COLUMNS[key].names
        have = [name in columns for name in names]
        if not any(have):
            return None
        if not all(have):
            missing = names[have.index(False)]
            raise ValueError(f"a log must have a column {missing} with {names[have.index(True)]}")
        block = np.column_stack([columns[name] for name in names])
        return block if len(names) > 1 else block[:, 0]

    def stream(values: dict[str, Floats | None], needs: tuple[str, ...]) -> Stream | None:
        """The rows in which something of `needs` was measured."""
        given = {name: v for name, v in values.items() if v is not None}
        rows = np.zeros(len(time), bool)
        for name in needs:
            if name in given:
                rows |= np.isfinite(given[name]).reshape(len(time), -1).any(axis=1)
        if not rows.any():
            return None
        assert received is not None
        return Stream(time[rows], received[rows], {name: v[rows] for name, v in given.items()})

    gyro, accel = together("gyro"), together("accel")
    assert gyro is not None
    assert accel is not None
    whole = np.isfinite(gyro).all(axis=1) & np.isfinite(accel).all(axis=1)
    imu = Stream(
        time[whole], received[whole], {"gyro": gyro[whole] * axes, "accel": accel[whole] * axes}
    )
    gnss: dict[str, Floats | None] = {
        "position_sigma_I": together("gnss_sigma"),
        "velocity_sigma": together("gnss_velocity_sigma"),
    }
    for quantity, key in (
        ("position", "gnss"),
        ("velocity", "gnss_velocity"),
        ("baseline", "gnss_baseline"),
    ):
        forms = {form: together(key + form) for form in _FORMS[key]}
        given = [form for form, values in forms.items() if values is not None]
        if len(given) > 1:
            raise ValueError(
                f"a log must have one of {', '.join(key + form for form in given)}, not both"
            )
        gnss[f"{quantity}_G"], gnss[f"{quantity}_I"] = forms[""], forms.get("_enu")
        if (places := forms.get("_lla")) is not None:
            gnss[f"{quantity}_G"] = ecef_of(*places.T)
    field_B = together("magnetometer")
    measured = [f"{q}_{frame}" for q in ("position", "velocity", "baseline") for frame in "GI"]
    return Log(
        imu=imu,
        gnss=stream(gnss, tuple(measured)),
        camera=stream({"pixels": _image(columns)}, ("pixels",)),
        barometer=stream({"barometer": together("barometer")}, ("barometer",)),
        magnetometer=stream(
            {"magnetometer": None if field_B is None else field_B * axes}, ("magnetometer",)
        ),
        motors=stream({"motors": together("motors")}, ("motors",)),
        about=about,
    )


def _image(columns: dict[str, Floats]) -> Floats | None:
    """(n, features, 2) pixels of all rows."""
    found = {name: place for name in columns if (place := _pixel_of(name)) is not None}
    if not found:
        return None
    features = 1 + max(feature for feature, _ in found.values())
    pixels = np.full((len(columns["time"]), features, 2), np.nan)
    for name, (feature, axis) in found.items():
        pixels[:, feature, axis] = columns[name]
    return pixels

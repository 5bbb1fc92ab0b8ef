"""Files of a `Flight`: a bitwise exact NumPy archive, and tables for other programs.

The archive (`.npz`, readable by `numpy.load` alone) holds

| entry | contents |
|---|---|
| `header` | JSON text: "format" (always "quad_gym flight"), "version" (1), "task", "observation", "about", and the scalars of the scene |
| `columns/NAME` | one float64 array (n, ...) per column of `quad_gym.flights.columns.COLUMNS` |
| `scene/NAME` | one float64 array per array of `quad_gym.flights.flight_scene.FlightScene` |

A table has one number per column: vectors as `_x`, `_y`, `_z` (quaternions as `_w`, `_x`, `_y`,
`_z`; without axes, `_1` ...), and the standard deviations `sigma_...` instead of the covariance.
"""  # noqa: E501 - a table

import dataclasses
import json
import os
import zipfile
import zlib
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from quad_gym.flights.columns import COLUMNS, Column, row_dtype
from quad_gym.flights.flight_scene import FlightScene

FORMAT, VERSION = "quad_gym flight", 1
_STATES = ("position", "velocity", "attitude", "accel_bias", "gyro_bias")


def save_flight(rows: NDArray[Any], scene: FlightScene, about: dict[str, Any], path: Path) -> Path:
    """Write the archive; the file appears only when it is complete."""
    header: dict[str, Any] = {"format": FORMAT, "version": VERSION, "about": about}
    arrays: dict[str, Any] = {
        f"columns/{c.name}": np.ascontiguousarray(rows[c.name]) for c in COLUMNS
    }
    for field in dataclasses.fields(FlightScene):
        value = getattr(scene, field.name)
        if isinstance(value, np.ndarray):
            arrays[f"scene/{field.name}"] = value
        else:
            header[field.name] = value
    path.parent.mkdir(parents=True, exist_ok=True)
    unfinished = path.with_name(path.name + ".part")
    try:
        with unfinished.open("wb") as stream:
            np.savez_compressed(stream, header=np.array(json.dumps(header)), **arrays)
        os.replace(unfinished, path)
    finally:
        unfinished.unlink(missing_ok=True)
    return path


def load_flight(path: Path) -> tuple[NDArray[Any], FlightScene, dict[str, Any]]:
    """Read rows, scene and further information from an archive; refuse damaged and other files."""
    try:
        archive = np.load(path, allow_pickle=False)
        if not isinstance(archive, np.lib.npyio.NpzFile):
            raise ValueError(f"{path} is not a flight: it is a single array")
        with archive:
            entries = {name: archive[name] for name in archive.files}
    except FileNotFoundError:
        raise
    except (zipfile.BadZipFile, zlib.error, EOFError, OSError, KeyError) as error:
        raise ValueError(f"{path} is damaged or cut off: {error}") from None
    except ValueError as error:
        if "not a flight" in str(error):
            raise
        raise ValueError(f"{path} is not a flight, or damaged: {error}") from None
    header = _header(path, entries)
    try:
        found: dict[str, Any] = {}
        for field in dataclasses.fields(FlightScene):
            value = entries.get(f"scene/{field.name}", header.get(field.name))
            if value is not None:
                found[field.name] = value
            elif field.default is field.default_factory is dataclasses.MISSING:
                raise ValueError(f"it lacks {field.name}")  # older files lack optional fields
        scene = FlightScene(**found)
        rows = _rows(entries, len(scene.features_I))
        return rows, scene, dict(header["about"])
    except (KeyError, ValueError, TypeError) as error:
        raise ValueError(f"{path} is not a complete flight: {error}") from None


def _header(path: Path, entries: dict[str, NDArray[Any]]) -> dict[str, Any]:
    try:
        header = json.loads(str(entries["header"]))
        known = header["format"] == FORMAT
    except (KeyError, TypeError, ValueError):
        known = False
    if not known:
        raise ValueError(f"{path} is not a flight: it was not written by quad_gym")
    if header.get("version") != VERSION:
        raise ValueError(
            f"{path} has version {header.get('version')!r} of the format; this quad_gym reads "
            f"version {VERSION}: use the quad_gym that wrote it, or a newer one"
        )
    return dict(header)


def _rows(entries: dict[str, NDArray[Any]], features: int) -> NDArray[Any]:
    count = len(entries.get("columns/time", ()))
    if not count:
        raise ValueError("it has no rows")
    rows = np.zeros(count, row_dtype(features))
    for column in COLUMNS:
        if f"columns/{column.name}" not in entries:
            raise ValueError(f"it lacks columns/{column.name}")
        values = entries[f"columns/{column.name}"]
        if values.shape != rows[column.name].shape or values.dtype != np.float64:
            raise ValueError(
                f"column {column.name} must be float64 of shape {rows[column.name].shape}, "
                f"got {values.dtype} of {values.shape}"
            )
        rows[column.name] = values
    return rows


def table(rows: NDArray[Any]) -> dict[str, NDArray[np.float64]]:
    """Return the columns of a flight's table, with one number per row, by name."""
    found: dict[str, NDArray[np.float64]] = {}
    for column in COLUMNS:
        values = rows[column.name]
        if column.name == "covariance":
            sigmas = np.sqrt(np.maximum(np.diagonal(values, axis1=1, axis2=2), 0.0))
            names = [f"sigma_{state}_{axis}" for state in _STATES for axis in "xyz"]
            found |= {name: sigmas[:, k] for k, name in enumerate(names)}
        elif column.name == "pixels":
            for k in range(values.shape[1]):
                found |= {f"pixels_{k + 1}_{axis}": values[:, k, j] for j, axis in enumerate("xy")}
        elif values.ndim == 1:
            found[column.name] = values
        else:
            for k, part in enumerate(_parts(column, values.shape[1])):
                found[f"{column.name}_{part}"] = values[:, k]
    return found


def _parts(column: Column, count: int) -> Sequence[str]:
    """Return the suffixes of a column's names in a table, one per number."""
    if column.name == "gnss_decision":
        return "position", "baseline", "velocity"
    if column.name in ("action", "rotor_speeds", "feature_decision"):
        return [str(k + 1) for k in range(count)]
    return "wxyz" if column.name.endswith("quaternion") else "xyz"

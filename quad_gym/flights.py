"""`Flight`: the record of one flight, step by step, to store, export, inspect and replay."""

import dataclasses
import functools
import json
import os
import zipfile
import zlib
from bisect import bisect_left
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from quad_gym.analysis.metrics import nees, state_error
from quad_gym.analysis.reports import without_numpy, write_csv
from quad_gym.batch.flight_batch import FlightBatch
from quad_gym.batch.quantities import QUANTITIES
from quad_gym.packing import params_record
from quad_gym.params import checks as check
from quad_gym.params.aids import AidParams, ReadingDefinition
from quad_gym.params.sensor_table import READINGS, SENSOR_PARAMS
from quad_gym.params.trajectories import Trajectory
from quad_gym.records import BLOCKS_OF, Source
from quad_gym.rotations import quaternion_to_dcm

if TYPE_CHECKING:
    import pandas


# --------------------------------------------------------------------------------------------------
# Columns of the record of a flight.
# --------------------------------------------------------------------------------------------------


class Column(NamedTuple):
    """One quantity of a flight."""

    name: str
    shape: tuple[int | str, ...]  #: shape of one row; a word: as many as there are of these
    unit: str
    frame: str  #: I: inertial (east, north, up), B: body, C: image; "-": none
    meaning: str
    several: str = ""  #: the reading whose blocks it has as rows; empty: none
    labels: tuple[str, ...] = ()
    """suffixes of its numbers in a table; empty: of axes, or numbers"""


def _decision(sensor: str) -> Column:
    """The gate's decisions on the readings of a sensor, or on the blocks of its only one."""
    reading, *others = readings = SENSOR_PARAMS[sensor].readings(sensor)
    if others:
        labels = tuple(each.label for each in readings)
        words = f"gate decisions on {', '.join(labels[:-1])} and {labels[-1]}, see `GateDecision`"
        name, shape = f"{sensor}_decision", (len(labels),)
        return Column(name, shape, "-", "-", f"{words}; 0: no gate", labels=labels)
    one = reading.block or reading.name
    if reading.most_blocks == 1:
        about = f"gate decision on `{one}`, see `GateDecision`"
        return Column(f"{one}_decision", (), "-", "-", about)
    about = f"gate decision on each {reading.block or 'block'}, see `GateDecision`"
    return Column(f"{one}_decision", reading.dimensions[:1], "-", "-", about, reading.name)


_DECISIONS = {sensor: _decision(sensor) for sensor in SENSOR_PARAMS}
"""Columns of the gate's decisions, by sensor."""


def _of_sensors() -> list[str | Column]:
    """The readings of each sensor, followed by the gate's decisions on them."""
    found: list[str | Column] = []
    for sensor, kind in SENSOR_PARAMS.items():
        found += [*(reading.name for reading in kind.readings(sensor)), _DECISIONS[sensor]]
    return found


# fmt: off
_ROWS: tuple[str | Column, ...] = (
    "time",
    # the truth
    "position", "velocity", "quaternion", "body_rates", "rotor_speeds", "accel_bias", "gyro_bias",
    "disturbance", "wind", "faults",
    # the filter
    "estimated_position", "estimated_velocity", "estimated_quaternion",
    "estimated_accel_bias", "estimated_gyro_bias",
    Column("covariance", (15, 15), "mixed", "mixed", "the filter's covariance of position, velocity, attitude error, accelerometer and gyro bias"),
    "filter_status", "filter_diverged",
    Column("nees", (), "-", "-", "normalized estimation error squared; 15 on average if the filter is consistent"),
    "nis", "nis_dimension",
    # the state that the controller observed
    "observed_position", "observed_quaternion",
    # the latest measurements since the previous row
    "gyro", "accel",
    *_of_sensors(),
    # the task: the action and the reward of the step that led to this row
    "action", "reference_position", "gates_passed", "reward",
    "position_error", "estimation_error",
)
# fmt: on


def _column(row: str | Column) -> Column:
    """Return a column, which may be a quantity of flights."""
    if isinstance(row, Column):
        return row
    quantity = QUANTITIES[row]
    unit = "0 or 1" if quantity.kind is bool else quantity.unit
    several = row if row in READINGS and READINGS[row].most_blocks > 1 else ""
    return Column(row, quantity.shape, unit, quantity.frame, quantity.meaning, several)


COLUMNS = tuple(map(_column, _ROWS))  #: columns of a flight, in order

READ = tuple(row for row in _ROWS if isinstance(row, str) and row != "reference_position")
"""Columns that are quantities of a batch, copied unchanged."""

WITH_FILTER = (
    *(name for name in READ if QUANTITIES[name].filtered),
    "covariance",
    "nees",
    *(decision.name for decision in _DECISIONS.values()),
)
"""Columns that are NaN if no filter, and so no sensor, runs."""


_SEVERAL = tuple(name for name, reading in READINGS.items() if reading.most_blocks > 1)
"""Readings of several blocks, of which a row has as many as the suite."""
_LATER = frozenset(
    name
    for sensor, kind in SENSOR_PARAMS.items()
    if issubclass(kind, AidParams)
    for name in (*(reading.name for reading in kind.readings(sensor)), _DECISIONS[sensor].name)
)
"""Columns that older files lack: aiding sensors besides GNSS and camera were not recorded."""


def row_dtype(blocks: Mapping[str, int]) -> np.dtype[Any]:
    """Return the data type of a row, for numbers of blocks by reading."""

    def shape(column: Column) -> tuple[int, ...]:
        return tuple(blocks[column.several] if isinstance(n, str) else n for n in column.shape)

    return np.dtype([(column.name, "f8", shape(column)) for column in COLUMNS])


# --------------------------------------------------------------------------------------------------
# `FlightScene`: surroundings and vehicle of a flight, which pictures need besides the rows.
# --------------------------------------------------------------------------------------------------

Floats = NDArray[np.float64]


@dataclass(frozen=True, eq=False, kw_only=True)
class FlightScene:
    """Constants of a flight: vehicle, sensors, reference and surroundings."""

    task: str
    """Kind of task, see `TaskParams`"""
    observation: str
    """source of the controller's observations: "truth", "estimate", "noisy" or "measurements\""""
    control_rate: float
    """Control rate, and so rows per second [Hz]"""
    rotor_positions_B: Floats
    """(4, 3) positions of the rotor hubs in B [m]"""
    max_rotor_speed: float
    """Rotor speed at full voltage [rad/s]"""
    hover_rotor_speed: float
    """Rotor speed in hover [rad/s]"""
    antennas_B: Floats
    """(2, 3) positions of the primary and the secondary antenna in B [m]; NaN: missing"""
    camera_B: Floats
    """(3,) projection center in B [m]; NaN: no camera"""
    R_CB: Floats
    """(3, 3) rotation from body to camera"""
    camera_rate: float
    """Images per second [Hz]; 0: no camera"""
    focal_length: float
    """Focal length [pixels]"""
    half_image: Floats
    """(2,) half width and half height of the image [pixels]"""
    features_I: Floats
    """(n, 3) positions of the features in I [m]"""
    anchors_I: Floats = field(default_factory=lambda: np.zeros((0, 3)))
    """(n, 3) places in I to which other sensors measure, such as anchors of radio ranges [m]"""
    gates_I: Floats
    """(n, 3) centers of the course's gates in I; (0, 3) for other tasks [m]"""
    gate_radius: float
    """Distance from the center of a gate below which the gate is passed [m]"""
    reference_omega: float
    """Fundamental frequency of the reference [rad/s]"""
    reference_center: Floats
    """(3,) constant term of the reference in I [m]"""
    reference_cos: Floats
    """(k, 3) cosine coefficients of the reference in I [m]"""
    reference_sin: Floats
    """(k, 3) sine coefficients of the reference in I [m]"""
    obstacles: Floats = field(default_factory=lambda: np.zeros((0, 9)))
    """(n, 9) obstacles: shape (see `records.Shape`), center in I, half length, half thickness and
    half height (cylinder: radius, radius, half height), horizontal direction of the length [m]"""
    geofence_I: Floats = field(default_factory=lambda: np.zeros((0, 3)))
    """(2, 3) lowest and highest corner of the geofence in I; (0, 3): no geofence [m]"""
    trajectory_times: Floats = field(default_factory=lambda: np.zeros(0))
    """(m + 1,) times of the segments of a trajectory as the reference; (0,): no trajectory [s]"""
    trajectory_coefficients: Floats = field(default_factory=lambda: np.zeros((8, 0, 4)))
    """(8, m, 4) coefficients as in `quad_gym.Trajectory`, rotated as in the flight"""
    trajectory_closed: bool = False
    """True: the trajectory repeats"""
    trajectory_phase: float = 0.0
    """Time on the trajectory at which the episode begins [s]"""

    @property
    def has_camera(self) -> bool:
        """True if there is a camera, with at least one feature."""
        return len(self.features_I) > 0

    @property
    def has_gnss(self) -> bool:
        """True if there is GNSS."""
        return bool(np.isfinite(self.antennas_B[0]).all())

    def reference(self, times: Floats) -> Floats:
        """Return the position (n, 3) of the reference in I [m] at times [s]."""
        if len(self.trajectory_times):
            return self._trajectory(np.atleast_1d(times) + self.trajectory_phase)
        harmonics = np.arange(1, len(self.reference_cos) + 1)
        angles = self.reference_omega * np.outer(times, harmonics)[..., np.newaxis]
        swing = self.reference_cos * np.cos(angles) + self.reference_sin * np.sin(angles)
        return np.asarray(self.reference_center + swing.sum(axis=1))

    @property
    def reference_period(self) -> float:
        """Time after which the reference repeats or ends [s]; 0: a fixed point."""
        if len(self.trajectory_times):
            return float(self.trajectory_times[-1])
        moves = bool(np.any(self.reference_cos) or np.any(self.reference_sin))
        return 2.0 * np.pi / self.reference_omega if moves else 0.0

    @property
    def pieces(self) -> int:
        """Number of line segments that draw the whole reference."""
        return max(160, min(8 * len(self.trajectory_times), 2000))

    @functools.cached_property
    def _trajectory(self) -> Trajectory:
        return Trajectory(
            times=self.trajectory_times,
            coefficients=self.trajectory_coefficients,
            closed=bool(self.trajectory_closed),
        )

    def project_features(self, position: Floats, R_BI: Floats) -> Floats:
        """Project the features into the image of a camera at a pose.

        Args:
            position: (..., 3) position of the center of mass in I [m].
            R_BI: (..., 3, 3) rotation from inertial to body.

        Returns:
            (..., n, 2) pixels from the center of the image, also outside the image; NaN for a
            feature behind the camera.
        """
        X_B = (self.features_I - position[..., np.newaxis, :]) @ np.swapaxes(R_BI, -1, -2)
        X_C = (X_B - self.camera_B) @ self.R_CB.T
        in_front = X_C[..., 2:] > 1e-9
        depth = np.where(in_front, X_C[..., 2:], np.nan)
        return np.asarray(self.focal_length * X_C[..., :2] / depth)

    def frustum_corners(self, position: Floats, R_BI: Floats, depth: float) -> Floats:
        """Return the projection center, and the image's corners at a depth along the optical axis.

        Returns:
            (5, 3) in I [m].
        """
        x, y = self.half_image / self.focal_length
        corners_C = depth * np.array([[x, y, 1.0], [-x, y, 1.0], [-x, -y, 1.0], [x, -y, 1.0]])
        corners_B = self.camera_B + np.concatenate([np.zeros((1, 3)), corners_C @ self.R_CB])
        return np.asarray(position + corners_B @ R_BI)


# --------------------------------------------------------------------------------------------------
# Files of a `Flight`: a bitwise exact NumPy archive, and tables for other programs.
#
# The archive (`.npz`, readable by `numpy.load` alone) holds
#
# | entry | contents |
# |---|---|
# | `header` | JSON text: "format" (always "quad_gym flight"), "version" (1), "task", "observation", "about", and the scalars of the scene |
# | `columns/NAME` | one float64 array (n, ...) per column of `quad_gym.flights.COLUMNS` |
# | `scene/NAME` | one float64 array per array of `quad_gym.flights.FlightScene` |
#
# A table has one number per column: vectors as `_x`, `_y`, `_z` (quaternions as `_w`, `_x`, `_y`,
# `_z`; without axes, `_1` ...), and the standard deviations `sigma_...` instead of the covariance.
# --------------------------------------------------------------------------------------------------

FORMAT, VERSION = "quad_gym flight", 1
_STATES = ("position", "velocity", "attitude", "accel_bias", "gyro_bias")


def save_flight(rows: NDArray[Any], scene: FlightScene, about: dict[str, Any], path: Path) -> Path:
    """Write the archive; the file appears only when it is complete."""
    header: dict[str, Any] = {"format": FORMAT, "version": VERSION, "about": about}
    arrays: dict[str, Any] = {
        f"columns/{c.name}": np.ascontiguousarray(rows[c.name]) for c in COLUMNS
    }
    for entry in dataclasses.fields(FlightScene):
        value = getattr(scene, entry.name)
        if isinstance(value, np.ndarray):
            arrays[f"scene/{entry.name}"] = value
        else:
            header[entry.name] = value
    path.parent.mkdir(parents=True, exist_ok=True)
    unfinished = path.with_name(path.name + ".part")
    try:
        with unfinished.open("wb") as stream:
            text = json.dumps(header, default=without_numpy)
            np.savez_compressed(stream, header=np.array(text), **arrays)
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
        if "pickle" in str(error):  # what NumPy assumes any other file to be
            raise ValueError(f"{path} is not a flight: it is no archive of arrays") from None
        raise ValueError(f"{path} is not a flight, or damaged: {error}") from None
    header = _header(path, entries)
    try:
        found: dict[str, Any] = {}
        for entry in dataclasses.fields(FlightScene):
            value = entries.get(f"scene/{entry.name}", header.get(entry.name))
            if value is not None:
                found[entry.name] = value
            elif entry.default is entry.default_factory is dataclasses.MISSING:
                raise ValueError(f"it lacks {entry.name}")  # older files lack optional fields
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
    none = np.zeros((count, 0))
    shapes = {name: entries.get(f"columns/{name}", none).shape for name in _SEVERAL}
    blocks = {name: shape[1] if len(shape) > 1 else 0 for name, shape in shapes.items()}
    blocks["pixels"] = features
    rows = np.zeros(count, row_dtype(blocks))
    for column in COLUMNS:
        if f"columns/{column.name}" not in entries:
            if column.name not in _LATER:
                raise ValueError(f"it lacks columns/{column.name}")
            rows[column.name] = np.nan
            continue
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
        elif values.ndim == 3:
            for k, j in np.ndindex(values.shape[1:]):
                found[f"{column.name}_{k}_{'xyz'[j]}"] = values[:, k, j]
        elif values.ndim == 1:
            found[column.name] = values
        else:
            for k, part in enumerate(_parts(column, values.shape[1])):
                found[f"{column.name}_{part}"] = values[:, k]
    return found


def _parts(column: Column, count: int) -> Sequence[str]:
    """Return the suffixes of a column's names in a table, one per number."""
    if column.labels:
        return column.labels
    if column.several or column.name in ("action", "rotor_speeds"):
        return [str(k) for k in range(count)]
    return ("wxyz" if column.name.endswith("quaternion") else "xyz")[:count]


# --------------------------------------------------------------------------------------------------
# `Flight`: the record of one flight, step by step, to store, export, inspect and replay.
#
# A flight has one row per control step and one for the start; `COLUMNS` describes a row. Quantities
# that were not measured since the previous row, or not estimated, are NaN.
# --------------------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class Flight:
    """One flight; `flight["position"]` is a column, (n, ...) with one row per control step.

    Args:
        rows: (n,) records with the fields of `COLUMNS`.
        scene: Vehicle, sensors, reference and surroundings.
        about: Additional information, such as seed and policy, in JSON types. Its "task", if any,
            is the title of pictures.
    """

    rows: NDArray[Any]
    scene: FlightScene
    about: dict[str, Any] = field(default_factory=dict)

    def __len__(self) -> int:
        return len(self.rows)

    def __getitem__(self, name: str) -> NDArray[Any]:
        return np.asarray(self.rows[name])

    @property
    def estimated(self) -> bool:
        """True if a filter ran."""
        return bool(np.isfinite(self.rows["estimated_position"][-1]).all())

    def until(self, time: float) -> "Flight":
        """Return the flight up to a time [s], without copying; at least its first row.

        Raises:
            ValueError: If the time is NaN.
        """
        if np.isnan(time):
            raise ValueError(f"time must be a number, got {time!r}")
        count = int(np.searchsorted(self.rows["time"], time + 1e-9, side="right"))
        return dataclasses.replace(self, rows=self.rows[: max(count, 1)])

    def save(self, path: Path | str) -> Path:
        """Write a compressed NumPy archive (npz); see `quad_gym.flights`."""
        return save_flight(self.rows, self.scene, self.about, Path(path))

    @classmethod
    def load(cls, path: Path | str) -> "Flight":
        """Read a file written by `save`; the result is bitwise identical.

        Raises:
            ValueError: If the file is damaged, of another kind, or of an unknown version.
        """
        return cls(*load_flight(Path(path)))

    def to_csv(self, path: Path | str) -> Path:
        """Write a table for spreadsheets, with the covariance's standard deviations.

        Parts of a column end in an axis or in a number from 0, as `pixels_0_x` and `action_3`.
        """
        file = Path(path)
        file.parent.mkdir(parents=True, exist_ok=True)
        return write_csv(file, table(self.rows))

    def to_pandas(self) -> "pandas.DataFrame":
        """Return the table of `to_csv` as a pandas DataFrame, indexed by time.

        Raises:
            ImportError: If pandas is not installed.
        """
        pandas = check.package("pandas", "to_pandas", "pandas")
        return pandas.DataFrame(table(self.rows)).set_index("time")


_IDENTITY = ("tick", "episode", "key")


class FlightRecorder:
    """Recorder of one flight of a batch; it reads the batch and never changes it.

    Args:
        batch: The flights.
        flight: Index of the recorded flight.
        about: Information to be stored with the flight.

    Raises:
        ValueError: If there is no such flight.
    """

    def __init__(
        self, batch: FlightBatch, flight: int = 0, about: dict[str, Any] | None = None
    ) -> None:
        flight = check.whole("flight", flight, least=0, most=batch.count - 1)
        self._batch, self._which = batch, np.array([flight])
        self._about = dict(about or {})
        blocks = {name: batch.sensors.blocks_of(name) for name in _SEVERAL}
        self._rows = np.zeros(256, row_dtype(blocks))
        self._count = 0
        self._copies: list[NDArray[np.uint32]] = []
        """instants not yet converted to rows: a copy takes a hundredth of the time of a row"""
        self._ticks: list[float] = []  #: of the rows and the copies
        self._episode = b""  #: number and key of the recorded episode
        self._scene: FlightScene | None = None
        self._model = params_record(batch.vehicle, batch.sensors)[0]

    @property
    def flight(self) -> Flight:
        """Flight since the start of the present episode; it shares memory with the recorder.

        Raises:
            ValueError: If nothing has been recorded yet.
        """
        if self._scene is None:
            raise ValueError("there is no flight yet: reset the environment first")
        self._fill_rows(self._scene)
        return Flight(self._rows[: self._count], self._scene, self._about)

    def keep(self) -> None:
        """Record the present instant; the first instant of an episode starts a new flight.

        After a snapshot has been restored, the instant replaces those that are not earlier. One of
        another episode starts a new flight.
        """
        tick, number, key = (self._batch.record(n, self._which)[0] for n in _IDENTITY)
        episode = number.tobytes() + key.tobytes()
        if tick == 0.0 or self._scene is None or episode != self._episode:
            self._rows, self._count = np.zeros_like(self._rows), 0  # flights keep their rows
            self._scene, self._episode = self._scene_of_episode(), episode
            self._copies, self._ticks = [], []
        elif tick <= self._ticks[-1]:
            self._fill_rows(self._scene)
            self._rows, self._count = self._rows.copy(), bisect_left(self._ticks, tick)
            del self._ticks[self._count :]
        self._ticks.append(float(tick))
        self._copies.append(self._batch.copied_record(int(self._which[0])))

    def _fill_rows(self, scene: FlightScene) -> None:
        """Convert the copies to rows."""
        if not self._copies:
            return
        batch, self._copies = self._batch.with_records(self._copies), []
        begin, self._count = self._count, self._count + batch.count
        while self._count > len(self._rows):
            self._rows = np.concatenate([self._rows, np.zeros_like(self._rows)])
        _fill(self._rows[begin : self._count], batch, scene)

    def _scene_of_episode(self) -> FlightScene:
        batch, model, world = self._batch, self._model, self._batch.world

        def read(name: str) -> Any:
            return batch.record(name, self._which)[0]

        camera, gnss, antennas_B = batch.sensors.camera, batch.sensors.gnss, np.full((2, 3), np.nan)
        if gnss is not None:
            antennas_B[0] = model["antenna"]
            if gnss.has_baseline:
                antennas_B[1] = model["antenna"] + model["baseline"]
        gate_count = batch.task.gate_count if batch.task.kind == "waypoints" else 0
        obstacles = [
            (float(o.shape), *center, *o.half_size, *o.axis)
            for o, center in zip(world.obstacles, read("obstacle_center"), strict=False)
        ]
        anchors = [place for aid in batch.sensors.aids.values() for place in aid.places_I]
        path: dict[str, Any] = {}
        if (found := batch.trajectory(int(self._which[0]))) is not None:
            for name in ("times", "coefficients", "closed"):
                path[f"trajectory_{name}"] = getattr(found[0], name)
            path["trajectory_phase"] = found[1]
        return FlightScene(
            task=batch.task.kind,
            observation=Source(batch.source).name.lower(),
            control_rate=batch.clocks.control_rate,
            rotor_positions_B=np.array(batch.vehicle.rotor_positions_B),
            max_rotor_speed=float(model["motor_speed_per_volt"] * model["max_voltage"]),
            hover_rotor_speed=float(model["motor_speed_per_volt"] * model["hover_voltage"]),
            antennas_B=antennas_B,
            camera_B=np.array(camera.position_B if camera else [np.nan] * 3),
            R_CB=np.array(model["R_CB"]),
            camera_rate=camera.rate if camera else 0.0,
            focal_length=float(model["focal_length"]),
            half_image=np.array(model["half_image"]),
            features_I=np.array(batch.feature_places()[self._which[0]]),
            anchors_I=np.array(anchors).reshape(-1, 3),
            gates_I=read("gates")[:gate_count],
            gate_radius=batch.task.gate_radius,
            reference_omega=float(read("ref_omega")),
            reference_center=read("ref_center"),
            reference_cos=read("ref_cos"),
            reference_sin=read("ref_sin"),
            obstacles=np.array(obstacles).reshape(-1, 9),
            geofence_I=np.array(world.geofence or np.zeros((0, 3))),
            **path,
        )


def _fill(rows: NDArray[Any], batch: FlightBatch, scene: FlightScene) -> None:
    """Fill rows of `COLUMNS` with the instants of one flight, which `batch` has as flights."""
    for name in READ:
        if rows[name].size and (batch.run_filter or name not in WITH_FILTER):
            rows[name] = batch.read(name)
    course = scene.task == "waypoints"
    rows["reference_position"] = (
        batch.record("ref_center") if course else scene.reference(rows["time"])
    )
    if not batch.run_filter:
        for name in WITH_FILTER:
            rows[name] = np.nan
        return
    gate = batch.record("gate")
    rows["covariance"] = batch.covariance()
    rows["nees"] = _nees(rows, batch.record("R_hat"), rotation_vector=batch.sensors.flow_alone)
    for sensor, decision in _DECISIONS.items():
        found = [
            _decided(rows, gate, reading) for reading in SENSOR_PARAMS[sensor].readings(sensor)
        ]
        rows[decision.name] = np.hstack(found).reshape(rows[decision.name].shape)


def _decided(
    rows: NDArray[Any], gate: NDArray[np.float64], reading: ReadingDefinition
) -> NDArray[np.float64]:
    """Decisions (n, blocks) on a reading, whose measurements the rows have; NaN: not measured."""
    values = rows[reading.name]
    count = values.shape[1] if reading.most_blocks > 1 else 1
    seen = np.isfinite(values.reshape(len(values), count, reading.length)).all(axis=2)
    return np.where(seen, gate[:, BLOCKS_OF[reading.name]][:, :count], np.nan)


def _nees(
    rows: NDArray[Any], R_hat: NDArray[np.float64], *, rotation_vector: bool
) -> NDArray[np.float64]:
    """NEES (n,) of rows, by `state_error`; NaN where it is undefined."""
    words = ("position", "velocity", "accel_bias", "gyro_bias")
    estimate = {word: rows[f"estimated_{word}"] for word in words} | {"R_BI": R_hat}
    try:
        truth = {word: rows[word] for word in words} | {
            "R_BI": quaternion_to_dcm(rows["quaternion"])
        }
        error = state_error(truth, estimate, rotation_vector=rotation_vector)
        return nees(error, rows["covariance"])
    except ValueError:  # a state that is not finite, or a singular covariance: which row has it?
        if len(rows) == 1:
            return np.array([np.nan])
        parts = (slice(len(rows) // 2), slice(len(rows) // 2, None))
        found = [_nees(rows[p], R_hat[p], rotation_vector=rotation_vector) for p in parts]
        return np.concatenate(found)

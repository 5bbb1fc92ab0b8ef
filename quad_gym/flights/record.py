"""`Flight`: the record of one flight, step by step, to store, export, inspect and replay.

A flight has one row per control step and one for the start; `COLUMNS` describes a row. Quantities
that were not measured since the previous row, or not estimated, are NaN.
"""

import dataclasses
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from quad_gym.analysis.metrics import nees, state_error
from quad_gym.batch.flight_batch import FlightBatch
from quad_gym.batch.quantities import QUANTITIES
from quad_gym.flights.flight_scene import FlightScene
from quad_gym.packing.flight import params_record
from quad_gym.records import AID_BLOCKS, FEATURE_BLOCKS, Source
from quad_gym.rotations import quaternion_to_dcm

if TYPE_CHECKING:
    import pandas
    import rerun

Floats = NDArray[np.float64]


class Column(NamedTuple):
    """One quantity of a flight."""

    name: str
    shape: tuple[int, ...]  # shape of one row; FEATURES stands for the camera's number of features
    unit: str
    frame: str  # I: inertial (east, north, up), B: body, C: image; "-": none
    meaning: str


FEATURES = -1

# fmt: off
_ROWS: tuple[str | Column, ...] = (
    "time",
    # the truth
    *("position", "velocity", "quaternion", "body_rates", "rotor_speeds", "accel_bias", "gyro_bias"),
    *("disturbance", "wind", "faults"),
    # the filter
    *("estimated_position", "estimated_velocity", "estimated_quaternion"),
    *("estimated_accel_bias", "estimated_gyro_bias"),
    Column("covariance", (15, 15), "mixed", "mixed", "the filter's covariance of position, velocity, attitude error, accelerometer and gyro bias"),
    *("filter_status", "filter_diverged"),
    Column("nees", (), "-", "-", "normalized estimation error squared; 15 on average if the filter is consistent"),
    *("nis", "nis_dimension"),
    # the state that the controller observed
    *("observed_position", "observed_quaternion"),
    # the latest measurements since the previous row
    *("gyro", "accel", "gnss_position", "gnss_baseline", "gnss_velocity"),
    Column("gnss_decision", (3,), "-", "-", "gate decisions on position, baseline and velocity, see `GateDecision`; 0: no gate"),
    "pixels",
    Column("feature_decision", (FEATURES,), "-", "-", "gate decision on each feature, see `GateDecision`"),
    # the task: the action and the reward of the step that led to this row
    *("action", "reference_position", "gates_passed", "reward"),
    *("position_error", "estimation_error"),
)
# fmt: on


def _column(row: str | Column) -> Column:
    """Return a column, which may be a quantity of flights."""
    if isinstance(row, Column):
        return row
    quantity = QUANTITIES[row]
    shape = tuple(FEATURES if isinstance(size, str) else size for size in quantity.shape)
    unit = "0 or 1" if quantity.kind is bool else quantity.unit
    return Column(row, shape, unit, quantity.frame, quantity.meaning)


COLUMNS = tuple(map(_column, _ROWS))  # columns of a flight, in order

_READ = tuple(row for row in _ROWS if isinstance(row, str) and row != "reference_position")
"""Columns that are quantities of a batch, copied unchanged."""

_WITH_FILTER = (
    *(name for name in _READ if QUANTITIES[name].filtered),
    *("covariance", "nees", "gnss_decision", "feature_decision"),
)
"""Columns that are NaN if no filter, and so no sensor, runs."""


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
        """Return the flight up to a time [s], without copying; at least its first row."""
        count = int(np.searchsorted(self.rows["time"], time + 1e-9, side="right"))
        return dataclasses.replace(self, rows=self.rows[: max(count, 1)])

    def save(self, path: Path | str) -> Path:
        """Write a compressed NumPy archive (npz); see `quad_gym.flights.files`."""
        from quad_gym.flights.files import save_flight

        return save_flight(self, Path(path))

    @classmethod
    def load(cls, path: Path | str) -> "Flight":
        """Read a file written by `save`; the result is bitwise identical.

        Raises:
            ValueError: If the file is damaged, of another kind, or of an unknown version.
        """
        from quad_gym.flights.files import load_flight

        return load_flight(Path(path))

    def to_csv(self, path: Path | str) -> Path:
        """Write a table for spreadsheets, with the covariance's standard deviations."""
        from quad_gym.flights.files import write_flight_csv

        return write_flight_csv(self, Path(path))

    def to_pandas(self) -> "pandas.DataFrame":
        """Return the table of `to_csv` as a pandas DataFrame, indexed by time.

        Raises:
            ImportError: If pandas is not installed.
        """
        from quad_gym.flights.files import flight_frame

        return flight_frame(self)

    def to_rerun(self) -> "rerun.RecordingStream":
        """Return a recording for the Rerun viewer: 3D, camera image and plots on one timeline.

        `flight.to_rerun().spawn()` opens the viewer; `flight.to_rerun().save("flight.rrd")` writes
        a file for it. `quad_gym.flights.rerun` lists the contents.

        Raises:
            ImportError: If rerun-sdk is not installed.
        """
        from quad_gym.flights.rerun import rerun_recording

        return rerun_recording(self)


def row_dtype(features: int) -> np.dtype[Any]:
    """Return the data type of a row for a number of features."""
    return np.dtype(
        [(c.name, "f8", tuple(features if n == FEATURES else n for n in c.shape)) for c in COLUMNS]
    )


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
        if not 0 <= flight < batch.count:
            raise ValueError(f"flight must be within 0 and {batch.count - 1}, got {flight}")
        self._batch, self._which = batch, np.array([flight])
        self._about = dict(about or {})
        camera = batch.sensors.camera
        features = 0 if camera is None else len(camera.features_I)
        self._rows = np.zeros(256, row_dtype(features))
        self._count = 0
        self._copies: list[NDArray[np.uint64]] = []
        """instants not yet converted to rows: a copy takes a hundredth of the time of a row"""
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
        """Record the present instant; the first instant of an episode starts a new flight."""
        tick = self._batch.record("tick", self._which)[0]
        if tick == 0.0 or self._scene is None:
            self._rows, self._count = np.zeros_like(self._rows), 0  # flights keep their rows
            self._scene = self._scene_of_episode()
            self._copies = []
        self._copies.append(self._batch.copied_record(int(self._which[0])))

    def _fill_rows(self, scene: FlightScene) -> None:
        """Convert the copies to rows."""
        if not self._copies:
            return
        batch, self._copies = self._batch.with_records(self._copies), []
        for k in range(batch.count):
            if self._count == len(self._rows):
                self._rows = np.concatenate([self._rows, np.zeros_like(self._rows)])
            _fill(self._rows[self._count], batch, np.array([k]), scene)
            self._count += 1

    def _read(self, name: str) -> Any:
        return self._batch.record(name, self._which)[0]

    def _scene_of_episode(self) -> FlightScene:
        batch, model = self._batch, self._model
        camera = batch.sensors.camera
        antennas_B, gnss = np.full((2, 3), np.nan), batch.sensors.gnss
        if gnss is not None:
            antennas_B[0] = model["antenna"]
        if gnss is not None and gnss.has_baseline:
            antennas_B[1] = model["antenna"] + model["baseline"]
        gate_count = batch.task.gate_count if batch.task.kind == "waypoints" else 0
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
            gates_I=self._read("gates")[:gate_count],
            gate_radius=batch.task.gate_radius,
            reference_omega=float(self._read("ref_omega")),
            reference_center=self._read("ref_center"),
            reference_cos=self._read("ref_cos"),
            reference_sin=self._read("ref_sin"),
            obstacles=self._obstacles(),
            geofence_I=np.array(batch.world.geofence or np.zeros((0, 3))),
            **self._trajectory_of_episode(),
        )

    def _obstacles(self) -> Floats:
        """Return the obstacles (n, 9) of the present episode, see `FlightScene`."""
        obstacles, centers = self._batch.world.obstacles, self._read("obstacle_center")
        rows = [
            (float(o.shape), *center, *o.half_size, *o.axis)
            for o, center in zip(obstacles, centers, strict=False)
        ]
        return np.array(rows).reshape(-1, 9)

    def _trajectory_of_episode(self) -> dict[str, Any]:
        """Return the scene's fields of a trajectory, if the task follows one."""
        found = self._batch.trajectory(int(self._which[0]))
        if found is None:
            return {}
        trajectory, phase = found
        return {
            "trajectory_times": trajectory.times,
            "trajectory_coefficients": trajectory.coefficients,
            "trajectory_closed": trajectory.closed,
            "trajectory_phase": phase,
        }


def _fill(row: Any, batch: FlightBatch, which: NDArray[np.intp], scene: FlightScene) -> None:
    """Fill a row with the present instant of one flight.

    Args:
        row: Record with the fields of `COLUMNS`.
        batch: The flights.
        which: (1,) index of the flight.
        scene: Scene of its episode.
    """
    for name in _READ:
        if batch.run_filter or name not in _WITH_FILTER:
            row[name] = batch.read(name, which)[0]
    row["reference_position"] = scene.reference(row["time"])[0]
    if scene.task == "waypoints":
        row["reference_position"] = batch.record("ref_center", which)[0]
    if batch.run_filter:
        factor, R_hat, gate = (batch.record(name, which)[0] for name in ("L", "R_hat", "gate"))
        _fill_covariance(row, factor, R_hat)
        _fill_decisions(row, gate)
    else:
        for name in _WITH_FILTER:
            row[name] = np.nan


def _fill_covariance(row: Any, factor: Floats, R_hat: Floats) -> None:
    row["covariance"] = factor @ factor.T
    words = ("position", "velocity", "accel_bias", "gyro_bias")
    truth = {word: row[word] for word in words}
    estimate = {word: row[f"estimated_{word}"] for word in words} | {"R_BI": R_hat}
    try:
        truth["R_BI"] = quaternion_to_dcm(row["quaternion"])
        row["nees"] = nees(state_error(truth, estimate), row["covariance"])
    except ValueError:  # a state that is not finite, or a singular covariance
        row["nees"] = np.nan


def _fill_decisions(row: Any, gate: Floats) -> None:
    """Fill in the decisions of the filter's gate; NaN without a measurement."""
    for block, name in enumerate(("gnss_position", "gnss_baseline", "gnss_velocity")):
        row["gnss_decision"][block] = np.nan if np.isnan(row[name]).all() else gate[block]
    seen = np.isfinite(row["pixels"]).all(axis=1)
    decisions = gate[FEATURE_BLOCKS:AID_BLOCKS][: len(seen)]
    row["feature_decision"] = np.where(seen, decisions, np.nan)

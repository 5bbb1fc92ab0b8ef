"""`Flight`: the record of one flight, step by step, to store, export, inspect and replay.

A flight has one row per control step and one for the start; `COLUMNS` describes a row. Quantities
that were not measured since the previous row, or not estimated, are NaN.
"""

import dataclasses
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from quad_gym.analysis.metrics import nees, state_error
from quad_gym.analysis.reports import write_csv
from quad_gym.batch.flight_batch import FlightBatch
from quad_gym.flights import files
from quad_gym.flights.columns import READ, WITH_FILTER, row_dtype
from quad_gym.flights.flight_scene import FlightScene
from quad_gym.packing.flight import params_record
from quad_gym.params import checks as check
from quad_gym.records import AID_BLOCKS, FEATURE_BLOCKS, Source
from quad_gym.rotations import quaternion_to_dcm

if TYPE_CHECKING:
    import pandas


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
        return files.save_flight(self.rows, self.scene, self.about, Path(path))

    @classmethod
    def load(cls, path: Path | str) -> "Flight":
        """Read a file written by `save`; the result is bitwise identical.

        Raises:
            ValueError: If the file is damaged, of another kind, or of an unknown version.
        """
        return cls(*files.load_flight(Path(path)))

    def to_csv(self, path: Path | str) -> Path:
        """Write a table for spreadsheets, with the covariance's standard deviations."""
        file = Path(path)
        file.parent.mkdir(parents=True, exist_ok=True)
        return write_csv(file, files.table(self.rows))

    def to_pandas(self) -> "pandas.DataFrame":
        """Return the table of `to_csv` as a pandas DataFrame, indexed by time.

        Raises:
            ImportError: If pandas is not installed.
        """
        pandas = check.package("pandas", "to_pandas", "pandas")
        return pandas.DataFrame(files.table(self.rows)).set_index("time")


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
        if batch.run_filter or name not in WITH_FILTER:
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
    for block, name in enumerate(("gnss_position", "gnss_baseline", "gnss_velocity")):
        measured = ~np.isnan(rows[name]).all(axis=1)
        rows["gnss_decision"][:, block] = np.where(measured, gate[:, block], np.nan)
    seen = np.isfinite(rows["pixels"]).all(axis=2)
    decisions = gate[:, FEATURE_BLOCKS:AID_BLOCKS][:, : seen.shape[1]]
    rows["feature_decision"] = np.where(seen, decisions, np.nan)


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

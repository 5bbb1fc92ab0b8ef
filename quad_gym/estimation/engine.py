"""The memory of a filter for one vehicle, and the stages of flights that run on it.

All lanes of its block hold the same flight, or, while the heading is unknown, each lane of several
blocks holds a flight with another heading (`starts.py`).
"""

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from quad_gym.estimation.inputs import (
    ONE_PREDICTION,
    ONE_UPDATE,
    Measurement,
    Tape,
)
from quad_gym.kernels import entries
from quad_gym.kernels.entries import linked_table
from quad_gym.kernels.stages import needed_stages
from quad_gym.packing import (
    RecordsOfOneForm,
    blocks_of,
    form_of,
    pack_sensors,
    pack_tick,
    params_block,
    params_record,
    slow_errors_of,
)
from quad_gym.params.suites import SensorSuite
from quad_gym.params.vehicle import VehicleParams
from quad_gym.records import (
    FLIGHT_BLOCK,
    KEPT,
    MEASUREMENT,
    REPORTED,
    SAMPLE,
    SETTINGS,
    STEP_BLOCK,
    WIDTH,
    WORK_BLOCK,
    FilterForm,
    aligned_zeros,
    field_of_flights,
    in_double,
    joint_covariance,
    lower_triangle,
    parts_of,
    places_of_lanes,
    room_of,
)

Floats = NDArray[np.float64]

_NO_RESULTS = (
    np.empty(0, np.int64),
    np.empty(0, np.uint64),
    np.empty((0, 0), np.uint64),
    0,
    0,
)
_PARTS = frozenset({"filter", "watch", "slow", "aids"})


class Engine(RecordsOfOneForm):
    """Records, parameters and stages of one filter.

    Args:
        sensors: The suite that the filter assumes.
        kind: "ukf" or "ekf".
    """

    def __init__(self, sensors: SensorSuite, kind: str) -> None:
        self.sensors = sensors
        self.features = 0 if sensors.camera is None else len(sensors.camera.features_I)
        params = params_record(VehicleParams(), sensors)
        for name in ("gravity", "ground_height"):
            params[name] = getattr(sensors.estimator, name)
        pack_tick(params[0], sensors)  # which depends on gravity
        self.params, self._ticks = params_block(params), params_block(params)
        self.steps = aligned_zeros(1, STEP_BLOCK)
        errors = slow_errors_of(sensors)
        self.steps["rate"][0, : len(errors)] = [[1.0 / error.tau] for error in errors]
        self.steps["sigma"][0, : len(errors)] = [[error.sigma] for error in errors]
        lever_arm = FilterForm.LEVER_SAMPLES if any(sensors.imu.lever_arm_B) else FilterForm(0)
        assumed = sensors.replace(estimator=sensors.estimator.replace(kind=kind))
        self.form = form_of(assumed, innovations=True, lever_arm=lever_arm)
        self.settings = np.zeros(1, SETTINGS)
        self.settings["run_filter"] = True
        self.settings["form"] = int(self.form)
        pack_sensors(self.settings[0], sensors)
        self._choose_stages()
        self._room = room_of(_PARTS)
        self._work = aligned_zeros(1, WORK_BLOCK)
        self._work["mask"] = 1.0
        self.blocks = aligned_zeros(1, FLIGHT_BLOCK)
        self._linked: NDArray[Any] | None = None
        self._calls: dict[tuple[int, int], Callable[[], Any]] = {}
        self._sample, self._measurement = np.zeros(1, SAMPLE), np.zeros(1, MEASUREMENT)

    def _choose_stages(self) -> None:
        """Choose the stages that the filter needs."""
        needed = needed_stages(self.settings[0])
        self._stages = {stage: needed[stage] for stage in entries.FILTER_STAGES if stage in needed}

    def _without_process(self) -> dict[str, Any]:
        return {"_calls": {}, "_linked": None}

    # ---- memory -------------------------------------------------------------------------------

    @property
    def lanes(self) -> int:
        """Number of flights in memory, equal ones included."""
        return len(self.blocks) * WIDTH

    def allocate(self, count: int) -> None:
        """Make room for flights, at least one block of them; earlier contents are lost."""
        self._calls.clear()
        self.blocks = aligned_zeros(max(1, -(-count // WIDTH)), FLIGHT_BLOCK)

    def read(self, name: str) -> NDArray[Any]:
        """Return a copy of a field of all lanes, (lanes, ...)."""
        return field_of_flights(self.blocks, name, self.lanes)

    def write(self, name: str, values: NDArray[Any]) -> None:
        """Write a field of all lanes, from (lanes, ...)."""
        lanes = values.reshape(len(self.blocks), WIDTH, *values.shape[1:])
        self.blocks[name] = np.moveaxis(lanes, 1, -1)

    def fill(self, name: str, value: NDArray[Any]) -> None:
        """Write one value into a field of all lanes."""
        self.blocks[name] = value[..., np.newaxis]

    def fill_block(self, block: int, value: NDArray[Any]) -> None:
        """Write one value (3,) into a block of the measurement of all lanes."""
        self.blocks["measurement"][:, block] = value[..., np.newaxis]

    @property
    def slow_states(self) -> int:
        """Number of time-correlated errors among the states."""
        return int(self.settings["slow_states"][0])

    def covariances(self) -> Floats:
        """Return the covariances (lanes, 15 + n, 15 + n) of r, v, e, b_a, b_g and slow errors."""
        return joint_covariance(self.read("P"), self.read("P_slow")[:, : self.slow_states])

    def write_covariances(self, covariances: Floats) -> None:
        """Write the covariances of all lanes."""
        n, lower = self.slow_states, lower_triangle(covariances)
        self.write("P", lower[:, :15, :15])
        if n:
            rows = self.read("P_slow")
            rows[:, :n, : 15 + n] = lower[:, 15:]
            self.write("P_slow", rows)

    def copy(self) -> NDArray[np.uint32]:
        """Return a copy of the filter's memory for `restore`: (n,) of one lane if all are equal.

        Otherwise it is (blocks, n) of all lanes.
        """
        return self.record(0) if len(self.blocks) == 1 else self._parts.copy()

    def record(self, lane: int) -> NDArray[np.uint32]:
        """Return a copy of the memory of one lane, (n,), for `restore`."""
        block, lane = divmod(lane, WIDTH)
        return self._parts[block, places_of_lanes(self._room.dtype)[:, lane]]

    def restore(self, copied: NDArray[np.uint32]) -> None:
        """Restore a copy; one of a single lane becomes all lanes of one block."""
        count = len(copied) if copied.ndim == 2 else 1
        if count != len(self.blocks):
            self.allocate(count * WIDTH)
        for parts, own in zip(self._parts, copied if copied.ndim == 2 else [copied], strict=True):
            self._put(parts, own)

    def put_in_slot(self, slot: NDArray[np.uint64], copied: NDArray[np.uint32]) -> None:
        """Write the first block of a copy into a slot (words,) of a tape."""
        self._put(slot.view(np.uint32), copied[0] if copied.ndim == 2 else copied)

    def _put(self, parts: NDArray[np.uint32], copied: NDArray[np.uint32]) -> None:
        """Write a block, or one lane for all lanes, into the memory of a block."""
        if len(copied) == len(parts):
            parts[:] = copied
        else:
            parts[places_of_lanes(self._room.dtype)] = copied[:, np.newaxis]

    @property
    def memory(self) -> NDArray[np.uint64]:
        """The memory of the parts that the filter uses, (blocks, words)."""
        return self._memory_of(self.blocks)

    @property
    def _parts(self) -> NDArray[np.uint32]:
        first, size = self._room.skipped // 4, self._room.dtype.itemsize // 4
        return parts_of(self.blocks)[:, first : first + size]

    def _memory_of(self, blocks: NDArray[Any]) -> NDArray[np.uint64]:
        first, size = self._room.skipped // 8, self._room.dtype.itemsize // 8
        return blocks.view(np.uint64).reshape(len(blocks), -1)[:, first : first + size]

    def of_copies(self, slots: NDArray[np.uint64], name: str) -> NDArray[Any]:
        """Return a field of the first lane in the copies (n, words) of a tape, (n, ...)."""
        return in_double(slots.view(self._room.dtype)[name][:, 0, ..., 0])

    # ---- operations ---------------------------------------------------------------------------

    def start(self, x_I: Floats) -> None:
        """Start from the fix in the record, with clocks at zero and all memory cleared."""
        self._table()
        self.blocks["tick"], self.blocks["w_before"] = 0.0, np.nan
        for k in range(len(self.blocks)):
            block = self.blocks[k : k + 1]
            entries.start_filter(block, self.params, self.settings, self._work, x_I)

    def predict(self, sample: Any) -> None:
        """Propagate the estimate over the time of a SAMPLE."""
        self._sample[0] = sample
        self._run_one(ONE_PREDICTION)

    def update(self, measurement: Measurement) -> None:
        """Update the estimate with measurements."""
        self._measurement[:] = measurement
        self._run_one(ONE_UPDATE)

    def _run_one(self, operation: NDArray[Any]) -> None:
        """Run one operation on all blocks."""
        for k in range(len(self.blocks)):
            call = self._calls.get((k, id(operation)))
            if call is None:
                call = entries.run_tape.bound(
                    self.blocks[k : k + 1],
                    self.params,
                    self._ticks,
                    self.steps,
                    self.settings,
                    self._work,
                    self._table(),
                    self._sample,
                    self._measurement,
                    operation,
                    *_NO_RESULTS,
                )
                self._calls[k, id(operation)] = call
            call()

    def run(self, tape: Tape, slots: NDArray[Any] | None = None) -> tuple[Floats, Floats]:
        """Run the operations of a tape.

        Args:
            tape: Inputs and operations.
            slots: (tape.slots, words) copies that the tape restores before it makes its own; None:
                there are none.

        Returns:
            Estimates (blocks, n, KEPT, WIDTH), and innovations (blocks, m, k, REPORTED, WIDTH) of
            the k blocks of a measurement.
        """
        slots = self.empty_slots(tape) if slots is None else slots
        numbers = (self.params, self._ticks, self.steps)
        blocks = (self.blocks[k : k + 1] for k in range(len(self.blocks)))
        rows = [self.run_block(tape, slots, block, *numbers) for block in blocks]
        kept, reported = (np.array(found) for found in zip(*rows, strict=True))
        return kept, reported

    def empty_slots(self, tape: Tape) -> NDArray[Any]:
        """Return room for the copies of a tape."""
        return np.empty((tape.slots, self.memory.shape[1]), np.uint64)

    def run_block(
        self,
        tape: Tape,
        slots: NDArray[Any],
        block: NDArray[Any],
        params: NDArray[Any],
        ticks: NDArray[Any],
        steps: NDArray[Any],
    ) -> tuple[Floats, Floats]:
        """Run the operations of a tape on a block, with its parameters; see `run`."""
        measured = np.array(blocks_of(self.sensors), np.int64)
        kept = np.empty((tape.kept, KEPT, WIDTH))
        reported = np.empty((tape.reported, len(measured), REPORTED, WIDTH))
        entries.run_tape(
            block,
            params,
            ticks,
            steps,
            self.settings,
            self._work.copy(),
            self._table(),
            tape.samples,
            tape.measurements,
            tape.operations,
            measured,
            self._memory_of(block)[0],
            slots,
            kept.ctypes.data,
            reported.ctypes.data,
        )
        return kept, reported

    def impose(self, noise: dict[str, Any]) -> dict[str, NDArray[Any]]:
        """Set parameters for the start; return the earlier values."""
        kept = {name: self.params[name].copy() for name in noise}
        for name, value in noise.items():
            self.params[name] = np.asarray(value)[..., np.newaxis]
        return kept

    def restore_noise(self, kept: dict[str, NDArray[Any]]) -> None:
        """Restore the noise from before `impose`."""
        for name, numbers in kept.items():
            self.params[name] = numbers

    def _table(self) -> NDArray[Any]:
        """Return the table of the stages that the filter runs."""
        if self._linked is None:
            self._linked = linked_table(self._stages, entries.FILTER_ENTRIES)
        return self._linked

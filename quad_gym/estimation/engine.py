"""The memory of a filter for one vehicle, and the stages of flights that run on it.

All lanes of its block hold the same flight, or, while the heading is unknown, each lane of several
blocks holds a flight with another heading (`headings.py`).
"""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from quad_gym.estimation.samples import Measurement, Sample
from quad_gym.kernels import single
from quad_gym.kernels.compiling.linked import linked_table
from quad_gym.kernels.compiling.stages import Stage, needed_stages
from quad_gym.packing.aids import pack_sensors
from quad_gym.packing.flight import form_of, pack_tick, params_block, params_record
from quad_gym.params.sensors import SensorSuite
from quad_gym.params.vehicle import VehicleParams
from quad_gym.records import (
    AID_BLOCKS,
    BASELINE_BLOCK,
    FEATURE_SLICE,
    FLIGHT_BLOCK,
    POSITION_BLOCK,
    SETTINGS,
    VELOCITY_BLOCK,
    WIDTH,
    WORK_BLOCK,
    FilterForm,
    aligned_zeros,
    room_of,
)

Floats = NDArray[np.float64]

_PARTS = frozenset({"filter", "watch", "slow", "aids"})


class Engine:
    """Records, parameters and stages of one filter.

    Args:
        sensors: The suite that the filter assumes.
        kind: "ukf" or "ekf".
    """

    def __init__(self, sensors: SensorSuite, kind: str) -> None:
        self.sensors = sensors
        self.features = 0 if sensors.camera is None else len(sensors.camera.features_I)
        params = params_record(VehicleParams(), sensors)
        params["gravity"] = sensors.estimator.gravity
        self.params = params_block(params)
        self._dt = 0.0
        self._set_dt(sensors.imu.dt)
        lever_arm = FilterForm.LEVER_SAMPLES if any(sensors.imu.lever_arm_B) else FilterForm(0)
        estimator = sensors.estimator.replace(kind=kind)
        self.form = form_of(estimator, innovations=True, lever_arm=lever_arm)
        self.settings = np.zeros(1, SETTINGS)
        self.settings["run_filter"] = True
        self.settings["form"] = int(self.form)
        pack_sensors(self.settings[0], sensors)
        needed = needed_stages(self.settings[0])
        self._stages = {stage: needed[stage] for stage in single.FILTER_STAGES if stage in needed}
        self._room = room_of(_PARTS)
        self._work = aligned_zeros(1, WORK_BLOCK)
        self._work["mask"] = 1.0
        self.blocks = aligned_zeros(1, FLIGHT_BLOCK)

    # ---- memory -------------------------------------------------------------------------------

    @property
    def lanes(self) -> int:
        """Number of flights in memory, equal ones included."""
        return len(self.blocks) * WIDTH

    def allocate(self, count: int) -> None:
        """Make room for flights, at least one block of them; earlier contents are lost."""
        self.blocks = aligned_zeros(max(1, -(-count // WIDTH)), FLIGHT_BLOCK)

    def read(self, name: str) -> NDArray[Any]:
        """Return a copy of a field of all lanes, (lanes, ...)."""
        values = np.moveaxis(self.blocks[name], -1, 1)
        return values.reshape(-1, *values.shape[2:]).copy()

    def write(self, name: str, values: NDArray[Any]) -> None:
        """Write a field of all lanes, from (lanes, ...)."""
        lanes = values.reshape(len(self.blocks), WIDTH, *values.shape[1:])
        self.blocks[name] = np.moveaxis(lanes, 1, -1)

    def fill(self, name: str, value: NDArray[Any]) -> None:
        """Write one value into a field of all lanes."""
        self.blocks[name] = value[..., np.newaxis]

    @property
    def slow_states(self) -> int:
        """Number of time-correlated errors among the states."""
        return int(self.settings["slow_states"][0])

    def factors(self) -> Floats:
        """Return the lower factors (lanes, 15 + n, 15 + n) of all states' covariances."""
        n = self.slow_states
        joint = np.zeros((self.lanes, 15 + n, 15 + n))
        joint[:, :15, :15] = self.read("L")
        joint[:, 15:] = self.read("L_slow")[:, :n, : 15 + n]
        return joint

    def write_factors(self, factors: Floats) -> None:
        """Write the factors of all lanes."""
        n = self.slow_states
        self.write("L", factors[:, :15, :15])
        if n:
            rows = self.read("L_slow")
            rows[:, :n, : 15 + n] = factors[:, 15:]
            self.write("L_slow", rows)

    def copy(self) -> NDArray[Any]:
        """Return a copy of the filter's memory for `restore`: one lane if all are equal."""
        words = self._words()
        return words[:, :, :1].copy() if len(words) == 1 else words.copy()

    def restore(self, words: NDArray[Any]) -> None:
        """Restore a copy."""
        if len(words) != len(self.blocks):
            self.allocate(len(words) * WIDTH)
        self._words()[...] = words

    def _words(self) -> NDArray[Any]:
        """Return the memory of the parts that the filter uses, (blocks, words, WIDTH)."""
        raw = self.blocks.view(np.uint64).reshape(len(self.blocks), -1, WIDTH)
        first = self._room.skipped // (8 * WIDTH)
        return raw[:, first : first + self._room.dtype.itemsize // (8 * WIDTH)]

    # ---- stages -------------------------------------------------------------------------------

    def start(self, x_I: Floats) -> None:
        """Start from the fix in the record, with clocks at zero and all memory cleared."""
        self._table()
        self.blocks["tick"], self.blocks["w_before"] = 0.0, np.nan
        for k in range(len(self.blocks)):
            block = self.blocks[k : k + 1]
            single.start_filter(block, self.params, self.settings, self._work, x_I)

    def predict(self, sample: Sample) -> None:
        """Propagate the estimate over the time of a sample."""
        self._set_dt(sample.dt)
        blocks = self.blocks
        blocks["tick"] += sample.dt / self.sensors.imu.dt  # a clock, independent of the steps
        self.fill("gyro", sample.gyro)
        self.fill("accel", sample.accel)
        # for the lever arms of a velocity and of the accelerometer
        self.fill("w_before", sample.gyro_before)
        self.fill("w_meas", sample.gyro)
        self._run(Stage.PREDICT)

    def update(self, measurement: Measurement) -> None:
        """Update the estimate with measurements."""
        m, blocks = measurement, self.blocks
        valid = blocks["block_valid"]
        valid[:] = 0.0
        valid[:, POSITION_BLOCK] = m.position_G is not None
        valid[:, BASELINE_BLOCK] = m.baseline_G is not None
        valid[:, VELOCITY_BLOCK] = m.velocity_G is not None
        for aid, value in m.aids.items():
            valid[:, AID_BLOCKS + aid] = 1.0
            blocks["aid_measurement"][:, aid, : len(value)] = value[:, np.newaxis]
        given = {
            "gnss_position": m.position_G,
            "gnss_baseline": m.baseline_G,
            "gnss_velocity": m.velocity_G,
        }
        for name, numbers in given.items():
            if numbers is not None:
                self.fill(name, numbers)
        if m.pixels is not None:
            seen = np.asarray(~np.isnan(m.pixels).any(axis=1))[:, np.newaxis]
            valid[:, FEATURE_SLICE][:, : self.features] = seen
            image = np.where(seen, m.pixels, 0.0)[..., np.newaxis]
            blocks["pixels"][:, : self.features] = image
        self._set_dt(self.sensors.imu.dt)  # `tick` counts these
        kept = self.impose(m.noise)
        self._run(Stage.UPDATE)
        self.restore_noise(kept)

    def impose(self, noise: dict[str, Any]) -> dict[str, NDArray[Any]]:
        """Set the noise of a measurement in the parameters; return the earlier values."""
        kept = {name: self.params[name].copy() for name in noise}
        for name, value in noise.items():
            if name == "aid_sigma":
                for aid, sigma in value.items():
                    self.params[name][0, aid] = sigma
            else:
                self.params[name] = np.asarray(value)[..., np.newaxis]
        return kept

    def restore_noise(self, kept: dict[str, NDArray[Any]]) -> None:
        """Restore the noise from before `impose`."""
        for name, numbers in kept.items():
            self.params[name] = numbers

    def _set_dt(self, dt: float) -> None:
        """Set the duration of a prediction in the parameters."""
        if dt != self._dt:
            self._dt = dt
            pack_tick(self.params[0], self.sensors, dt)

    def _table(self) -> NDArray[Any]:
        """Return the table of the stages that the filter runs."""
        return linked_table(self._stages, single.FILTER_ENTRIES)

    def _run(self, stage: Stage) -> None:
        p = self.params
        others = (p, p, self.settings, self._work, self._table(), self.features)
        address, count = self.blocks.ctypes.data, len(self.blocks)
        single.run_stage(address, FLIGHT_BLOCK.itemsize, count, int(stage), *others)

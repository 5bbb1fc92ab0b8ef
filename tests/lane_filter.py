"""The filter's stages on blocks of flights, with access to single flights."""

import numpy as np

from quad_gym.kernels.entries import (
    FILTER_ENTRIES,
    FILTER_STAGES,
    linked_table,
    run_stage,
    start_filter,
)
from quad_gym.kernels.stages import Stage, needed_stages
from quad_gym.packing import form_of, pack_sensors, params_block, params_record
from quad_gym.params.sensor_table import READINGS
from quad_gym.params.vehicle import VehicleParams
from quad_gym.records import (
    BASELINE_BLOCK,
    BLOCKS_OF,
    FEATURE_BLOCKS,
    FLIGHT_BLOCK,
    PARAMS_BLOCK,
    POSITION_BLOCK,
    SETTINGS,
    WIDTH,
    WORK_BLOCK,
    aligned_zeros,
    field_of_flights,
)

EIGHT = 8
"""Number of filters: one block or more, with 2, 4 or 8 lanes each."""
STATE = ("r_hat", "v_hat", "R_hat", "b_a_hat", "b_g_hat", "P")


class LaneFilter:
    """EIGHT filters in as many blocks as they need."""

    def __init__(self, sensors):
        self.features = 0 if sensors.camera is None else len(sensors.camera.features_I)
        self.form = int(form_of(sensors))
        self.params = aligned_zeros(EIGHT // WIDTH, PARAMS_BLOCK)
        self.params[:] = params_block(params_record(VehicleParams(), sensors))
        self.blocks = aligned_zeros(EIGHT // WIDTH, FLIGHT_BLOCK)
        self.work = aligned_zeros(1, WORK_BLOCK)
        self.settings = np.zeros(1, SETTINGS)
        self.settings["run_filter"] = True
        pack_sensors(self.settings[0], sensors)

    def put(self, number, **values):
        """Set fields of one flight."""
        block, lane = divmod(number, WIDTH)
        for name, value in values.items():
            if name in BLOCKS_OF:  # a reading
                blocks, numbers = BLOCKS_OF[name], slice(READINGS[name].length)
                self.blocks["measurement"][block, blocks, numbers, lane] = value
            else:
                self.blocks[name][block, ..., lane] = value

    def put_params(self, number, **values):
        """Set parameters of one flight."""
        block, lane = divmod(number, WIDTH)
        for name, value in values.items():
            self.params[name][block, ..., lane] = value

    def set_valid(self, number, measured, valid):
        """Set the validity of measurement blocks of one flight."""
        block, lane = divmod(number, WIDTH)
        self.blocks["block_valid"][block, measured, lane] = valid

    def get(self, name):
        """A field or reading of all flights, (EIGHT, ...)."""
        if name in BLOCKS_OF:
            blocks, numbers = BLOCKS_OF[name], slice(READINGS[name].length)
            return field_of_flights(self.blocks, "measurement", EIGHT)[:, blocks, numbers]
        return field_of_flights(self.blocks, name, EIGHT)

    def measure(self, number, recording, k, *, position=True, baseline=True, camera=True):
        """Set one flight's measurements from tick k of a recording; missing ones become NaN."""
        pixels = recording.pixels[k]
        seen = np.isfinite(pixels).all(axis=1) & camera
        self.put(
            number,
            gnss_position=recording.gnss_position[k] if position else np.nan,
            gnss_baseline=recording.gnss_baseline[k] if baseline else np.nan,
            gyro=recording.gyro[k],
            accel=recording.accel[k],
        )
        block, lane = divmod(number, WIDTH)
        self.set_valid(number, POSITION_BLOCK, position)
        self.set_valid(number, BASELINE_BLOCK, baseline)
        self.set_valid(number, slice(FEATURE_BLOCKS, FEATURE_BLOCKS + self.features), seen)
        shown = np.where(seen[:, None], pixels, np.nan)
        features = slice(FEATURE_BLOCKS, FEATURE_BLOCKS + self.features)
        self.blocks["measurement"][block, features, :2, lane] = shown

    def initialize(self, mask=(True,) * EIGHT):
        for block, params, settings, work in self._each(mask):
            start_filter(block, params, settings, work, np.zeros(3))

    def update(self, mask=(True,) * EIGHT):
        self._run(Stage.UPDATE, mask)

    def predict(self):
        self._run(Stage.PREDICT, (True,) * EIGHT)

    def _run(self, stage, mask):
        needed = needed_stages(self.settings[0])
        stages = {stage: needed[stage] for stage in FILTER_STAGES if stage in needed}
        table = linked_table(stages, FILTER_ENTRIES)
        for block, params, settings, work in self._each(mask):
            others = (params, params, settings, work, table, self.features)
            run_stage(block.ctypes.data, 0, 1, int(stage), *others)

    def _each(self, mask):
        """Set each block's part of the mask; yield the block, parameters, settings and work."""
        self.settings["form"] = self.form
        for k, chosen in enumerate(np.reshape(mask, (-1, WIDTH))):
            self.work["mask"][0] = chosen
            yield self.blocks[k : k + 1], self.params[k : k + 1], self.settings, self.work

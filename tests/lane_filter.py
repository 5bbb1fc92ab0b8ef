"""The filter's kernels for blocks of flights, and how flights get into their blocks."""

import numpy as np

from quad_gym.kernels.compiling import entry
from quad_gym.kernels.filter.align import initialize
from quad_gym.kernels.filter.predict import predict
from quad_gym.kernels.filter.update import update
from quad_gym.kernels.simd.blocks import lanes_of
from quad_gym.packing.flight import form_of, params_block, params_record
from quad_gym.params.vehicle import VehicleParams
from quad_gym.records import (
    FLIGHT,
    FLIGHT_BLOCK,
    PARAMS_BLOCK,
    WIDTH,
    WORK_BLOCK,
    aligned_zeros,
    field_of_flights,
)

EIGHT = 8
"""Filters that fly together: one block or more, as lanes are 2, 4 or 8."""
STATE = ("r_hat", "v_hat", "R_hat", "b_a_hat", "b_g_hat", "L")


@entry
def initialize_lanes(blocks, params, work):
    begins, unknown = lanes_of(work[0]).begins > 0.0, (0.0, 0.0, 0.0)
    initialize(lanes_of(blocks[0]), lanes_of(params[0]), begins, unknown)


@entry
def update_lanes(blocks, params, work, feature_count, form):
    scratch = lanes_of(work[0])
    chosen = scratch.begins > 0.0
    update(lanes_of(blocks[0]), lanes_of(params[0]), scratch, feature_count, chosen, form)


@entry
def predict_lanes(blocks, params, work, form):
    predict(lanes_of(blocks[0]), lanes_of(params[0]), lanes_of(work[0]), form)


class LaneFilter:
    """EIGHT filters in as many blocks as they fill."""

    def __init__(self, sensors):
        self.features = 0 if sensors.camera is None else len(sensors.camera.features_I)
        self.form = int(form_of(sensors.estimator))
        self.params = aligned_zeros(EIGHT // WIDTH, PARAMS_BLOCK)
        self.params[:] = params_block(params_record(VehicleParams(), sensors))
        self.blocks = aligned_zeros(EIGHT // WIDTH, FLIGHT_BLOCK)
        self.work = aligned_zeros(1, WORK_BLOCK)

    def put(self, number, **values):
        """Set fields of one flight."""
        block, lane = divmod(number, WIDTH)
        for name, value in values.items():
            self.blocks[name][block, ..., lane] = value

    def put_params(self, number, **values):
        """Set parameters of one flight."""
        block, lane = divmod(number, WIDTH)
        for name, value in values.items():
            self.params[name][block, ..., lane] = value

    def get(self, name):
        """A field of all flights, (EIGHT, ...)."""
        return field_of_flights(self.blocks, name, EIGHT)

    def flight(self, number):
        """One flight as a scalar record."""
        block, lane = divmod(number, WIDTH)
        record = np.zeros(1, FLIGHT)
        for name in FLIGHT.names:
            record[name][0] = self.blocks[name][block, ..., lane]
        return record

    def measure(self, number, recording, k, *, position=True, baseline=True, camera=True):
        """Hand one flight what a recording holds at tick k; what is not measured becomes NaN."""
        pixels = recording.pixels[k]
        seen = np.isfinite(pixels).all(axis=1) & camera
        self.put(
            number,
            gnss_position=recording.gnss_position[k] if position else np.nan,
            gnss_baseline=recording.gnss_baseline[k] if baseline else np.nan,
            position_valid=float(position),
            baseline_valid=float(baseline),
            gyro=recording.gyro[k],
            accel=recording.accel[k],
        )
        block, lane = divmod(number, WIDTH)
        self.blocks["feature_valid"][block, : self.features, lane] = seen
        shown = np.where(seen[:, None], pixels, np.nan)
        self.blocks["pixels"][block, : self.features, :, lane] = shown

    def initialize(self, mask=(True,) * EIGHT):
        for block, params in self._each(mask):
            initialize_lanes(block, params, self.work)

    def update(self, mask=(True,) * EIGHT):
        for block, params in self._each(mask):
            update_lanes(block, params, self.work, self.features, self.form)

    def predict(self):
        for block, params in self._each((True,) * EIGHT):
            predict_lanes(block, params, self.work, self.form)

    def _each(self, mask):
        """Blocks and their parameters, one by one, the part of a mask that is theirs in force."""
        for k, begins in enumerate(np.reshape(mask, (-1, WIDTH))):
            self.work["begins"][0] = begins
            yield self.blocks[k : k + 1], self.params[k : k + 1]

"""The filter's kernels for eight flights at once, and how flights get into their block.

The entries are cached on disk by the sources of the package's kernels, which do not include this
file: after a change of an entry here, delete its files in `__pycache__`.
"""

import numpy as np

from quad_gym.kernels.compiling import entry
from quad_gym.kernels.filter.align import initialize
from quad_gym.kernels.filter.predict import predict
from quad_gym.kernels.filter.update import update
from quad_gym.kernels.simd.blocks import lanes_of
from quad_gym.packing import form_of, params_block, params_record
from quad_gym.params import VehicleParams
from quad_gym.records import FLIGHT, FLIGHT_BLOCK, WIDTH, WORK_BLOCK, aligned_zeros

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
    """Eight filters in one block."""

    def __init__(self, sensors):
        self.features = 0 if sensors.camera is None else len(sensors.camera.features_I)
        self.form = int(form_of(sensors.estimator))
        self.params = params_block(params_record(VehicleParams(), sensors))
        self.block = aligned_zeros(1, FLIGHT_BLOCK)
        self.work = aligned_zeros(1, WORK_BLOCK)

    def put(self, lane, **values):
        """Set fields of one flight."""
        for name, value in values.items():
            self.block[name][0, ..., lane] = value

    def get(self, name):
        """A field of all flights, (8, ...)."""
        return np.moveaxis(self.block[name][0], -1, 0).copy()

    def flight(self, lane):
        """One flight as a scalar record."""
        record = np.zeros(1, FLIGHT)
        for name in FLIGHT.names:
            record[name][0] = self.block[name][0, ..., lane]
        return record

    def measure(self, lane, recording, k, *, position=True, baseline=True, camera=True):
        """Hand one flight what a recording holds at tick k; what is not measured becomes NaN."""
        pixels = recording.pixels[k]
        seen = np.isfinite(pixels).all(axis=1) & camera
        self.put(
            lane,
            gnss_position=recording.gnss_position[k] if position else np.nan,
            gnss_baseline=recording.gnss_baseline[k] if baseline else np.nan,
            position_valid=float(position),
            baseline_valid=float(baseline),
            gyro=recording.gyro[k],
            accel=recording.accel[k],
        )
        self.block["feature_valid"][0, : self.features, lane] = seen
        self.block["pixels"][0, : self.features, :, lane] = np.where(seen[:, None], pixels, np.nan)

    def initialize(self, mask=(True,) * WIDTH):
        self.work["begins"][0] = mask
        initialize_lanes(self.block, self.params, self.work)

    def update(self, mask=(True,) * WIDTH):
        self.work["begins"][0] = mask
        update_lanes(self.block, self.params, self.work, self.features, self.form)

    def predict(self):
        predict_lanes(self.block, self.params, self.work, self.form)

"""Records of a tape: inputs of a filter, and the operations that process them in order."""

from enum import IntEnum, auto

import numpy as np

from quad_gym.records.layout import block_dtype
from quad_gym.records.sizes import AID_ROWS, AIDS, MAX_BLOCKS, MAX_FEATURES, MAX_SLOW, Field

SAMPLE = np.dtype([("gyro", "f8", 3), ("accel", "f8", 3), ("dt", "f8"), ("gyro_before", "f8", 3)])
"""An IMU sample that propagates the estimate; `gyro_before` is the one before, for lever arms."""

NOISE_FIELDS = (
    "position_sigma_I",
    "baseline_noise",
    "baseline_sigma",
    "velocity_sigma",
    "pixel_sigma",
)
"""Parameters that a measurement may replace, in addition to `aid_sigma`."""

MEASUREMENT = np.dtype(
    [
        ("valid", "f8", MAX_BLOCKS),  # 1 where a block is measured
        *((name, "f8", 3) for name in ("gnss_position", "gnss_baseline", "gnss_velocity")),
        ("pixels", "f8", (MAX_FEATURES, 2)),
        ("aid_measurement", "f8", (AID_ROWS, 3)),
        # noise; NaN: as in the parameters
        ("position_sigma_I", "f8", 3),
        *((name, "f8") for name in NOISE_FIELDS[1:]),
        ("aid_sigma", "f8", AIDS),
    ]
)
"""Measurements of one instant; see `quad_gym.estimation.filtering.samples.Measurement`."""


class Operation(IntEnum):
    """Operations of a tape."""

    PREDICT = 0  #: propagate with sample `index`
    UPDATE = auto()
    """update with measurement `index`; its innovations go to row `target`, unless negative"""
    COPY = auto()  #: copy the memory of the filter into slot `target`
    RESTORE = auto()  #: restore the memory from slot `target`
    KEEP = auto()  #: store the estimate in row `target`


OPERATION = np.dtype([("code", "i8"), ("index", "i8"), ("target", "i8")])

STEP_BLOCK = block_dtype(
    (
        Field("rate", (2 + MAX_SLOW,), "1/s", "1/tau of accelerometer and gyro bias, slow errors"),
        Field("sigma", (2 + MAX_SLOW,), "mixed", "stationary standard deviation of each"),
        Field("level", (), "m", "zero of the barometer; NaN: the height at its first measurement"),
    )
)
"""Numbers that a tape needs in addition to the parameters."""

KEPT = 3 + 3 + 9 + 3 + 3 + 15 + 1
"""Length of a row of estimates: r, v, R, b_a, b_g, 15 variances, and 1 if it has diverged."""
REPORTED = 8
"""Numbers per block in a row of innovations: innovation, sigma (3 each), NIS, gate decision."""

"""Records of a filter's start and inputs, in the order of arrival and as tapes."""

from enum import IntEnum, auto
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from quad_gym.records.layout import block_dtype
from quad_gym.records.sizes import (
    MAX_BLOCKS,
    MAX_SLOW,
    MAX_STATES,
    REAL,
    SENSOR_GROUPS,
    Field,
)

# --------------------------------------------------------------------------------------------------
# Records of the inputs of a filter in the order of their arrival; see `kernels/tape.py`.
# --------------------------------------------------------------------------------------------------

FARTHEST_FIX = 1e6
"""Largest distance of a fix from the reference antenna [m]; the center of the Earth is farther."""

MIN_COURSE = 5.0
"""Speed divided by its standard deviation from which a course determines the heading."""

SAME_TIME = 1e-6  #: time stamps that differ by less are equal [s]; PX4 counts microseconds


class Outcome(IntEnum):
    """Results of a call of a filter; an exported library has the same, explained in its header."""

    OK = 0
    NOT_STARTED = auto()
    NOT_FINITE = auto()
    OUT_OF_RANGE = auto()
    TOO_OLD = auto()
    TOO_NEW = auto()
    FULL = auto()
    NO_HEADING = auto()
    CONTRADICTION = auto()


class Kept(IntEnum):
    """Kinds of what a window refers to by numbers."""

    SAMPLE = 0
    MEASUREMENT = auto()
    COPY = auto()


INPUT = np.dtype(
    [
        ("rank", "i8"),  # 0: a sample; from 1: a measurement's order among equal time stamps
        ("time", "f8"),  # of the end of the sample, or of the measurement [s]
        ("dt", "f8"),  # duration of the sample [s]; NaN: from the filter's time to `time`
        ("gyro", "f8", 3),  # NaN: no sample, only `keeps`
        ("accel", "f8", 3),
        ("keeps", "i8"),  # 1: the estimate is stored before the sample
        # results
        ("now", "f8"),  # time of the filter before the input [s]
        ("index", "i8"),  # number of the measurement
        ("outcome", "i8"),
    ]
)
"""An IMU sample or a measurement."""

EVENT = np.dtype(
    [
        ("start", "f8"),  # time at which it begins [s]
        ("time", "f8"),  # time after it [s]
        ("kind", "i8"),  # Kept.SAMPLE or Kept.MEASUREMENT
        ("index", "i8"),  # number of the sample or measurement
        ("copy", "i8"),  # number of a copy of the filter's memory before it; -1: none
    ]
)
"""An input that the filter has processed."""

PENDING = np.dtype([("time", "f8"), ("rank", "i8"), ("index", "i8")])
"""A measurement that waits for the sample of its time."""

WINDOW = np.dtype(
    [
        ("length", "f8"),  # longest delay of measurements [s]; 0: none, and no events are kept
        ("longest", "f8"),  # longest duration of a sample [s]
        ("ahead", "f8"),  # longest time that a measurement is ahead of the filter [s]
        ("copy_every", "i8"),  # events between two copies of the filter's memory
        ("event_room", "i8"),  # memory of an exported filter, in events
        ("waiting_room", "i8"),  # memory of an exported filter, in measurements that wait
        ("room", "i8", len(Kept)),  # numbers in use at a time, by Kept; 0: none is used again
        # state
        ("time", "f8"),  # up to which the filter has predicted [s]
        ("oldest", "f8"),  # oldest time stamp that can still be included [s]
        ("events", "i8"),
        ("waiting", "i8"),
        ("since_copy", "i8"),  # events since the last copy
        ("next", "i8", len(Kept)),
        ("gyro", "f8", 3),  # of the sample before
        ("has_gyro", "i8"),
        # results
        ("operations", "i8"),
        ("kept", "i8"),
        ("reported", "i8"),
        ("taken", "i8"),  # inputs; fewer than given after an error, or where memory is short
        ("shortage", "i8"),  # place of the memory that is short; -1: none
    ]
)
"""State of the window of past inputs of a filter."""

MEMORY = np.dtype(
    [(name, "i8") for name in ("events", "samples", "waits", "operations")]
    + [(name, "i8") for name in ("measurements", "copies", "copy_words", "flight")]
)
"""Addresses of the arrays of an exported filter; `copy_words` is the length of a copy."""

MOUNTING = np.dtype(
    [
        ("imu_turns", "i8"),  # 1: its samples are rotated
        ("R_imu", "f8", (3, 3)),  # from the axes of the IMU to B
        ("gyro_bias", "f8", 3),  # mean bias, in the axes of the IMU [rad/s]
        ("accel_bias", "f8", 3),  # [m/s^2]
        ("compass_turns", "i8"),
        ("R_compass", "f8", (3, 3)),
    ],
    align=True,
)
"""Mounting and mean biases of the sensors of a suite, which an exported filter corrects."""

ESTIMATE = np.dtype(
    [
        ("time", "f8"),
        ("position", "f8", 3),
        ("velocity", REAL, 3),
        ("R_BI", REAL, (3, 3)),
        ("quaternion", REAL, 4),
        *((name, REAL, 3) for name in ("accel_bias", "gyro_bias")),
        ("sigma", REAL, 15),
        ("diverged", "i4"),
    ],
    align=True,
)
"""The estimate of an exported filter, `qg_estimate` in its header."""

FIX = np.dtype(
    [
        ("time", "f8"),  # [s]
        ("rest", "i8"),  # 1: at rest at `position` in I, with `heading`
        # what was measured, where `has_...` is 1
        *((f"has_{name}", "i8") for name in ("position", "baseline", "velocity")),
        *((name, "f8", 3) for name in ("position", "sigma", "baseline", "velocity")),
        ("has_heading", "i8"),
        ("heading", "f8"),  # [rad]
        ("has_field", "i8"),
        ("field_B", "f8", 3),  # [T]
        ("field_sigma", "f8"),  # of its white noise [T]
        ("course", "i8"),  # 1: the vehicle flies nose first
        ("velocity_sigma", "f8"),  # [m/s]
        ("tilt_sigma", "f8"),  # [rad]; 0: as in the START record
        ("rest_sigma", "f8"),  # of an unmeasured velocity [m/s]; 0: as in the START record
        # the suite
        ("R_IG", "f8", (3, 3)),
        ("place_sigma", "f8"),  # of a given place [m]
        ("scale", "f8"),  # of standard deviations of the fix
        ("takes_baseline", "i8"),
        ("field_I", "f8", 3),  # [T]; zero: the suite has no magnetometer
        ("iron", "i8"),  # places of the magnetometer's errors among the slow states
        ("declination", "i8"),
        # results
        ("velocity_I", "f8", 3),
        ("levels", "i8"),  # 1: the estimate is the START record's, not of Wahba's problem
        ("outcome", "i8"),
    ]
)
"""A first fix, and measurements of the attitude; see `quad_gym.estimation.starts`."""


# --------------------------------------------------------------------------------------------------
# Measurement of a sensor as a user's estimator receives it.
# --------------------------------------------------------------------------------------------------


class SensorReading(NamedTuple):
    """Measurement of one sensor, of all flights."""

    value: NDArray[Any]  #: one row per flight; NaN where no measurement arrives at this instant
    new: NDArray[
        np.bool_
    ]  #: True where one arrives: (n,), for pixels (n, features), for ranges (n, anchors)
    age: float
    """Time since the measurement was taken, its time stamp: the latency of the sensor [s]"""


# --------------------------------------------------------------------------------------------------
# Records of a tape: inputs of a filter, and the operations that process them in order.
# --------------------------------------------------------------------------------------------------

SAMPLE = np.dtype(
    [("gyro", REAL, 3), ("accel", REAL, 3), ("dt", "f8"), ("gyro_before", REAL, 3)], align=True
)
"""An IMU sample that propagates the estimate; `gyro_before` is the one before, for lever arms."""

MEASUREMENT = np.dtype(
    [
        ("valid", REAL, MAX_BLOCKS),  # 1 where a block is measured
        ("measurement", REAL, (MAX_BLOCKS, 3)),  # as in a flight's record
        # standard deviations of readings, of positions three; 0: not given, and after the check
        # NaN: as in the parameters
        ("sigma", REAL, (SENSOR_GROUPS, 3)),
        # results of the check
        ("outcome", "i8"),
        ("culprit", "i8"),  # number of the reading at fault; plus SENSOR_GROUPS: its deviations
    ],
    align=True,
)
"""Measurements of one instant, by blocks, from a log or a caller to the filter."""


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

KEPT = 3 + 3 + 9 + 3 + 3 + 15 + 5
"""Length of a row of estimates: r, v, R, b_a, b_g, 15 variances; 1 if it has diverged; the chord
between the headings by motion and of the filter, the standard deviation of the former, 1 if the
compass is left out, and 1 if the heading is unknown."""
REPORTED = 8
"""Numbers per block in a row of innovations: innovation, sigma (3 each), NIS, gate decision."""


# --------------------------------------------------------------------------------------------------
# Record of a filter's start from one fix.
# --------------------------------------------------------------------------------------------------

START = np.dtype(
    [
        ("x_I", "f8", 3),  # horizontal direction of body x for a steep baseline; zero: unknown
        # a vehicle of known tilt: see `quad_gym.estimation.starts`
        ("antenna_I", "f8", 3),
        ("position_root", "f8", (3, 3)),  # of the covariance of the antenna's position
        ("velocity_sigma", "f8", 3),
        ("T", "f8", (3, 3)),  # from the level frame to B
        ("tilt_sigma", "f8"),
        ("tilt_of_bias", "f8"),
        ("heading", "f8"),
        ("heading_sigma", "f8"),
        ("heading_of_tilt", "f8", 2),
        ("heading_of_slow", "f8", MAX_SLOW),
        ("lever_B", "f8", 3),  # the antenna
        ("accel_bias_sigma", "f8"),
        ("gyro_bias_sigma", "f8"),
        ("slow_sigma", "f8", MAX_SLOW),
        ("slow_states", "i8"),
        # results
        ("position", "f8", 3),
        ("R_BI", "f8", (3, 3)),
        ("P", "f8", (MAX_STATES, MAX_STATES)),  # covariance in the order of memory
        ("root", "f8", (MAX_STATES, MAX_STATES + 1)),  # states by independent errors
        ("e", "f8", (3, MAX_STATES + 1)),  # error angles by independent errors
    ]
)
"""Inputs and results of a filter's start."""

"""Records of the inputs of a filter in the order of their arrival; see `kernels/window.py`."""

from enum import IntEnum, auto

import numpy as np

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
        *((name, "f8", 3) for name in ("position", "velocity")),
        *(("R_BI", "f8", (3, 3)), ("quaternion", "f8", 4)),
        *((name, "f8", 3) for name in ("accel_bias", "gyro_bias")),
        *(("sigma", "f8", 15), ("diverged", "i4")),
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
"""A first fix, and measurements of the attitude; see `quad_gym.estimation.filtering.first_fix`."""

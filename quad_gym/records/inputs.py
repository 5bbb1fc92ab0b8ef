"""Records of the inputs of a filter in the order of their arrival; see `kernels/window.py`."""

from enum import IntEnum, auto

import numpy as np

SAME_TIME = 1e-6  #: time stamps that differ by less are equal [s]; PX4 counts microseconds


class Outcome(IntEnum):
    """Results of a call of a filter, with the names and numbers of an exported library."""

    OK = 0
    NOT_STARTED = auto()  #: call an init function first
    NOT_FINITE = auto()  #: an argument is infinite or not a number
    OUT_OF_RANGE = auto()  #: an argument is out of the range that its comment states
    TOO_OLD = auto()  #: the time stamp is before qg_oldest_time
    TOO_NEW = auto()  #: the time stamp is more than QG_LONGEST_STEP later than the filter
    FULL = auto()  #: too many measurements wait for the prediction up to their time stamps
    NO_HEADING = auto()  #: a start needs one of: baseline, heading, magnetometer, course
    CONTRADICTION = auto()  #: arguments that exclude each other


class Kept(IntEnum):
    """Kinds of what a window refers to by numbers."""

    SAMPLE = 0
    MEASUREMENT = auto()
    COPY = auto()


INPUT = np.dtype(
    [
        (
            "rank",
            "i8",
        ),  # 0: an IMU sample; or a measurement's order among equal time stamps, from 1
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

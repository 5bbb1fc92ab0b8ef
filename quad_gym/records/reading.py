"""Measurement of a sensor as a user's estimator receives it."""

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray


class SensorReading(NamedTuple):
    """Measurement of one sensor, of all flights."""

    value: NDArray[Any]  #: one row per flight; NaN where no measurement arrives at this instant
    new: NDArray[
        np.bool_
    ]  #: True where one arrives: (n,), for pixels (n, features), for ranges (n, anchors)
    age: float
    """Time since the measurement was taken, its time stamp: the latency of the sensor [s]"""

"""Mounting of the sensors of a vehicle's logs: rotations to B, and mean biases."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from quad_gym.params.sensors import SensorSuite
from quad_gym.records.inputs import MOUNTING
from quad_gym.rotations import euler_to_dcm


def mounting_of(suite: SensorSuite) -> NDArray[Any]:
    """Return the mounting of a suite, (1,) MOUNTING."""
    found = np.zeros(1, MOUNTING)
    numbers = (*suite.log_rotation, *suite.log_accel_bias, *suite.log_gyro_bias)
    found["imu_turns"], found["compass_turns"] = any(numbers), any(suite.log_compass_rotation)
    found["R_imu"] = euler_to_dcm(suite.log_rotation)
    found["R_compass"] = euler_to_dcm(suite.log_compass_rotation)
    found["gyro_bias"], found["accel_bias"] = suite.log_gyro_bias, suite.log_accel_bias
    return found


def rotated(R: NDArray[np.float64], vectors: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the products of a matrix (3, 3) and vectors (n, 3), with plain sums.

    These have the same bits in exported filters.
    """
    x, y, z = vectors.T
    return np.column_stack([a * x + b * y + c * z for a, b, c in R])

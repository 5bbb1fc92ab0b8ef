"""Faults of the IMU."""

import math
from dataclasses import dataclass
from typing import Any

from quad_gym.faults.base import DirectedFault, Fault, Size
from quad_gym.params import checks as check
from quad_gym.records import FaultKind

__all__ = ["AccelBiasStep", "GyroBiasStep", "ImuSaturation"]


@dataclass(frozen=True, kw_only=True)
class AccelBiasStep(DirectedFault):
    """A step of the accelerometer's true bias in B, in addition to its random drift.

    Consumer parts have biases of up to 50 milli-g (TDK ICM-20948 data sheet); a shock or a change
    of temperature moves them by a fraction of that; engineering judgment.
    """

    size: Size = (0.05, 0.2)
    """length of the step [m/s^2]"""

    kind = FaultKind.ACCEL_BIAS_STEP


@dataclass(frozen=True, kw_only=True)
class GyroBiasStep(DirectedFault):
    """A step of the gyro's true bias in B, in addition to its random drift.

    Consumer parts have biases of up to 5 deg/s (TDK ICM-20948 data sheet); the default is some
    tenths of that; engineering judgment.
    """

    size: Size = (math.radians(0.2), math.radians(1.0))
    """length of the step [rad/s]"""

    kind = FaultKind.GYRO_BIAS_STEP


@dataclass(frozen=True, kw_only=True)
class ImuSaturation(Fault):
    """Saturation of samples at the IMU's ranges, by default the smallest ones of a consumer part.

    TDK ICM-20948 data sheet: 2, 4, 8 or 16 g; 250, 500, 1000 or 2000 deg/s. The gyro samples of the
    inner loops saturate, too.
    """

    accel_range: check.Positive = 2.0 * 9.80665
    """largest specific force along each axis, in either direction [m/s^2]"""
    gyro_range: check.Positive = math.radians(250.0)
    """largest angular rate about each axis, in either direction [rad/s]"""

    kind = FaultKind.IMU_SATURATION

    @property
    def numbers(self) -> dict[str, Any]:
        """Both ranges."""
        return {"imu_range": (self.accel_range, self.gyro_range)}

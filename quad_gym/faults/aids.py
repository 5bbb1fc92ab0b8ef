"""Faults of aiding sensors."""

from dataclasses import dataclass

from quad_gym.faults.base import Fault
from quad_gym.records import FaultKind


@dataclass(frozen=True, kw_only=True)
class BarometerLoss(Fault):
    """No altitude, as while the sensor's bus fails."""

    kind = FaultKind.BAROMETER_LOSS
    needs = "barometer"


@dataclass(frozen=True, kw_only=True)
class MagnetometerLoss(Fault):
    """No magnetic field, likewise, or as long as an autopilot distrusts it near iron."""

    kind = FaultKind.MAGNETOMETER_LOSS
    needs = "magnetometer"

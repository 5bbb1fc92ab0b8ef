"""Faults of aiding sensors."""

from dataclasses import dataclass
from functools import partial
from typing import Annotated

from quad_gym.faults.base import Fault
from quad_gym.params import checks as check
from quad_gym.records import Aid, FaultKind

__all__ = ["SensorLoss"]


@dataclass(frozen=True, kw_only=True)
class SensorLoss(Fault):
    """Loss of all measurements of an aiding sensor, as during a bus failure.

    A magnetometer is also lost while an autopilot rejects it near iron.
    """

    sensor: Annotated[str, partial(check.choice, choices=tuple(aid.name.lower() for aid in Aid))]
    """name of the lost sensor: "barometer", "magnetometer", "optical_flow" or "range_finder\""""

    @property
    def kind(self) -> FaultKind:  # type: ignore[override]
        """Kind of the fault, such as BAROMETER_LOSS."""
        return FaultKind[f"{self.sensor.upper()}_LOSS"]

    @property
    def needs(self) -> str:  # type: ignore[override]
        """Field of the sensor in a suite."""
        return self.sensor

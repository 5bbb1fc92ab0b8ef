"""Faults of aiding sensors."""

from dataclasses import dataclass

from quad_gym.faults.base import Fault
from quad_gym.params import checks as check
from quad_gym.records import Aid, FaultKind

__all__ = ["SensorLoss"]


@dataclass(frozen=True, kw_only=True)
class SensorLoss(Fault):
    """An aiding sensor measures nothing, as while its bus fails.

    Of a magnetometer also as long as an autopilot distrusts it near iron.
    """

    sensor: str
    """which: "barometer" or "magnetometer\""""

    def __post_init__(self) -> None:
        super().__post_init__()
        self._check(check.choice, "sensor", choices=tuple(aid.name.lower() for aid in Aid))

    @property
    def kind(self) -> FaultKind:  # type: ignore[override]
        """Such as BAROMETER_LOSS."""
        return FaultKind[f"{self.sensor.upper()}_LOSS"]

    @property
    def needs(self) -> str:  # type: ignore[override]
        """The sensor."""
        return self.sensor

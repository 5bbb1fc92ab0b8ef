"""Clocks: the rates of simulation, sensors and control."""

from dataclasses import dataclass
from functools import partial
from typing import Annotated

from quad_gym.params import checks as check
from quad_gym.params.checks import Checked
from quad_gym.params.sensors import SensorSuite


@dataclass(frozen=True, kw_only=True)
class Clocks(Checked):
    """Rates of simulation, sensors and control.

    A tick is one IMU sample, and every period is a whole number of ticks.
    """

    imu_rate: Annotated[float, partial(check.positive, most=1e6)] = 200.0
    """rate of IMU samples, which sets the tick [Hz]"""
    control_rate: float = 200.0
    """rate of new actions [Hz]"""
    gnss_rate: float = 200.0
    """rate of GNSS measurements [Hz]"""
    camera_rate: float = 200.0
    """frame rate of the camera [Hz]"""
    substeps: Annotated[int, partial(check.whole, most=1000)] = 1
    """Runge-Kutta steps per tick"""

    def __post_init__(self) -> None:
        super().__post_init__()
        for name in ("control_rate", "gnss_rate", "camera_rate"):
            check.ticks(name, getattr(self, name), self.imu_rate)

    @classmethod
    def of(cls, sensors: SensorSuite, control_rate: float, substeps: int = 1) -> "Clocks":
        """Return the clocks of a sensor suite and a control rate [Hz]."""
        camera = sensors.camera
        return cls(
            imu_rate=sensors.imu.rate,
            control_rate=control_rate,
            gnss_rate=sensors.gnss.rate if sensors.gnss is not None else sensors.imu.rate,
            camera_rate=camera.rate if camera is not None else sensors.imu.rate,
            substeps=substeps,
        )

    def ticks_between(self, name: str) -> int:
        """Return the number of ticks between two events of the clock `name`, such as "control"."""
        return check.ticks(f"{name}_rate", getattr(self, f"{name}_rate"), self.imu_rate)

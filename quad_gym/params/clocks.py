"""Clocks: the rates of simulation and control."""

from functools import partial
from typing import Annotated

from quad_gym.params import checks as check
from quad_gym.params.checked import Checked


class Clocks(Checked):
    """Rates of simulation and control; sensors have their own.

    A tick is one IMU sample, and every period is a whole number of ticks.
    """

    imu_rate: Annotated[float, partial(check.positive, most=1e6)] = 200.0
    """rate of IMU samples, which sets the tick [Hz]"""
    control_rate: float = 200.0
    """rate of new actions [Hz]"""
    substeps: Annotated[int, partial(check.whole, most=1000)] = 1
    """Runge-Kutta steps per tick"""

    def __post_init__(self) -> None:
        super().__post_init__()
        check.ticks("control_rate", self.control_rate, self.imu_rate)

    @property
    def step(self) -> float:
        """Duration of a Runge-Kutta step [s]."""
        return 1.0 / (self.imu_rate * self.substeps)

    @property
    def ticks_per_step(self) -> int:
        """Number of ticks in a control period."""
        return check.ticks("control_rate", self.control_rate, self.imu_rate)

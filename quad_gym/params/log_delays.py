"""Delays of the time stamps in logs."""

from dataclasses import dataclass

from quad_gym.params import checks as check
from quad_gym.params.checks import Checked


@dataclass(frozen=True, kw_only=True)
class LogDelays(Checked):
    """Times by which the stamps of a vehicle's logs are later than the measurements themselves.

    Autopilots often stamp a measurement when they receive it. A replay subtracts these delays; in
    simulated flights time stamps are exact.
    """

    gnss: float = 0.0
    """of GNSS, relative to the IMU [s]"""
    camera: float = 0.0
    """of images [s]"""
    magnetometer: float = 0.0
    """of the magnetometer [s]"""
    barometer: float = 0.0
    """of the barometer [s]"""

    def __post_init__(self) -> None:
        self._check(
            check.number, "gnss", "camera", "magnetometer", "barometer", least=-2.0, most=2.0
        )

"""Delays of the time stamps in logs."""

from dataclasses import dataclass
from typing import Annotated

from quad_gym.params import checks as check
from quad_gym.params.checked import Checked

Delay = Annotated[float, check.between(-2.0, 2.0)]


@dataclass(frozen=True, kw_only=True)
class LogDelays(Checked):
    """Times by which the stamps of a vehicle's logs are later than the measurements themselves.

    Autopilots often stamp a measurement when they receive it. A replay subtracts these delays; in
    simulated flights time stamps are exact.
    """

    gnss: Delay = 0.0
    """of GNSS, relative to the IMU [s]"""
    camera: Delay = 0.0
    """of images [s]"""
    magnetometer: Delay = 0.0
    """of the magnetometer [s]"""
    barometer: Delay = 0.0
    """of the barometer [s]"""

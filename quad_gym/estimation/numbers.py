"""Numbers of a sensor suite that a calibration finds, with their priors."""

import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from quad_gym.estimation.logs import Log
from quad_gym.params.sensors import SensorSuite


@dataclass(frozen=True, kw_only=True)
class Number:
    """A number of a suite, as a coordinate x of the search.

    A positive number is its prior value times exp(spread x), another one its prior value plus
    spread x, where x has a standard normal prior.
    """

    sensor: str
    """part of the suite, such as "imu\""""
    field: str
    """field of that part"""
    spread: float
    """standard deviation of the prior: of the logarithm, or of the number"""
    axes: tuple[int, ...] = ()
    """elements of a field of several numbers; they change together"""
    positive: bool = True
    """False: the number may have either sign"""
    unit: str = "-"

    @property
    def name(self) -> str:
        """Name, such as "gnss.position_sigma_I[2]"."""
        place = f"[{', '.join(map(str, self.axes))}]" if self.axes else ""
        return f"{self.sensor}.{self.field}{place}"

    def of(self, suite: SensorSuite) -> float:
        """Return the number in a suite."""
        value = getattr(getattr(suite, self.sensor), self.field)
        return float(value[self.axes[0]] if self.axes else value)

    def value(self, prior: float, x: float) -> float:
        """Return the number at a coordinate."""
        return prior * math.exp(self.spread * x) if self.positive else prior + self.spread * x

    def coordinate(self, prior: float, value: float) -> float:
        """Return the coordinate of a number."""
        return (math.log(value / prior) if self.positive else value - prior) / self.spread

    def put(self, suite: SensorSuite, value: float) -> SensorSuite:
        """Return a suite with another number."""
        part = getattr(suite, self.sensor)
        new: Any = value
        if self.axes:
            values = list(getattr(part, self.field))
            for axis in self.axes:
                values[axis] = value
            new = tuple(values)
        return suite.replace(**{self.sensor: part.replace(**{self.field: new})})


_LEVEL, _UP = (0, 1), (2,)
_LEVER, _PRECISE = "primary_antenna_B", 0.1  #: [m]
_WIDE, _NARROW = 1.5, 0.7  #: logarithms: factors of 4.5 and 2

# fmt: off
NUMBERS = (
    Number(sensor="imu", field="accel_noise_density", spread=2.5, unit="m/s^2/sqrt(Hz)"),
    Number(sensor="imu", field="gyro_noise_density", spread=2.0, unit="rad/s/sqrt(Hz)"),
    Number(sensor="imu", field="accel_bias_sigma", spread=_WIDE, unit="m/s^2"),
    Number(sensor="imu", field="gyro_bias_sigma", spread=_WIDE, unit="rad/s"),
    Number(sensor="gnss", field="position_sigma_I", axes=_LEVEL, spread=_WIDE, unit="m"),
    Number(sensor="gnss", field="position_sigma_I", axes=_UP, spread=_WIDE, unit="m"),
    Number(sensor="gnss", field="drift_sigma_I", axes=_LEVEL, spread=_WIDE, unit="m"),
    Number(sensor="gnss", field="drift_sigma_I", axes=_UP, spread=_WIDE, unit="m"),
    Number(sensor="gnss", field="drift_tau", spread=_WIDE, unit="s"),
    Number(sensor="gnss", field="velocity_sigma", spread=_WIDE, unit="m/s"),
    *(
        Number(sensor="gnss", field=_LEVER, axes=(k,), spread=0.15, positive=False, unit="m")
        for k in range(3)
    ),
    Number(sensor="barometer", field="noise_sigma", spread=_WIDE, unit="m"),
    Number(sensor="barometer", field="bias_sigma", spread=_WIDE, unit="m"),
    Number(sensor="magnetometer", field="noise_sigma", spread=_WIDE, unit="T"),
    Number(sensor="magnetometer", field="hard_iron_sigma", spread=_WIDE, unit="T"),
    Number(sensor="magnetometer", field="hard_iron_tau", spread=_NARROW, unit="s"),
    Number(sensor="magnetometer", field="declination", spread=0.3, positive=False, unit="rad"),
    Number(sensor="magnetometer", field="inclination", spread=0.1, positive=False, unit="rad"),
    Number(sensor="magnetometer", field="strength", spread=0.2, unit="T"),
)
# fmt: on
"""Numbers that a calibration finds. The spreads are engineering judgment: data sheets describe a
sensor at rest, and vibration, airflow and motor currents multiply its noise."""


def numbers_in(suite: SensorSuite, log: Log) -> list[Number]:
    """Return the numbers of the sensors that a suite has and a log contains."""
    found, paired = [], has_baselines(log)
    for number in NUMBERS:
        part = getattr(suite, number.sensor)
        if part is None or number.sensor not in log.streams:
            continue
        if number.field == _LEVER and (paired or max(part.position_sigma_I) > _PRECISE):
            continue  # the direction of a baseline would change, or noise hides the lever arm
        value = getattr(part, number.field)
        if value is not None and (not number.positive or np.all(np.asarray(value) != 0.0)):
            found.append(number)
    return found


def has_baselines(log: Log) -> bool:
    """Return True if a log has baselines between two antennas."""
    given = {} if log.gnss is None else log.gnss.values
    return "baseline_G" in given or "baseline_I" in given

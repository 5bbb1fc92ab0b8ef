"""Numbers of a sensor suite that a calibration finds, with their priors."""

import math
from dataclasses import dataclass
from typing import Any, cast

import numpy as np

from quad_gym.estimation.logs import Log
from quad_gym.params.aid_table import AID_PARAMS
from quad_gym.params.sensors import LogDelays, SensorSuite


@dataclass(frozen=True, kw_only=True)
class Number:
    """A number of a suite, as a coordinate x of the search.

    A positive number is its prior value times exp(spread x), another one its prior value plus
    spread x, where x has a standard normal prior.
    """

    sensor: str
    """part of the suite, such as "imu"; empty: the suite itself"""
    field: str  #: field of that part
    spread: float  #: standard deviation of the prior: of the logarithm, or of the number
    axes: tuple[int, ...] = ()  #: elements of a field of several numbers; they change together
    positive: bool = True  #: False: the number may have either sign
    unit: str = "-"
    step: float = 0.1  #: step of numerical derivatives, in coordinates
    limit: float = math.inf  #: largest absolute value

    @property
    def of_log(self) -> bool:
        """True if the number changes the log before the filter: a delay, or the mounting."""
        return self.field in (_MOUNTING, _COMPASS) or self.sensor == _DELAYS

    def ends(self, prior: float) -> tuple[float, float]:
        """Return bounds of the coordinate; at rest, a sensor is at most about as noisy."""
        if self.positive:
            bounded = self.noise and self.field != "drift_sigma_I"
            high = self.coordinate(prior, self.limit) if self.limit < math.inf else MAX_SPREAD
            low = _MIN_SPREAD / self.spread if bounded else -MAX_SPREAD
            return low, max(min(high, MAX_SPREAD), 0.0)
        low, high = (self.coordinate(prior, end) for end in (-self.limit, self.limit))
        return max(-MAX_SPREAD, low), min(MAX_SPREAD, high)

    @property
    def noise(self) -> bool:
        """True for a standard deviation."""
        return "sigma" in self.field or "density" in self.field

    def step_for(self, period: float) -> float:
        """Return the step of derivatives with a log whose IMU has a period [s].

        The likelihood of a delay has a kink at each sample.
        """
        return max(self.step, period / self.spread) if self.sensor == _DELAYS else self.step

    @property
    def name(self) -> str:
        """Name, such as "gnss.position_sigma_I[2]"."""
        place = f"[{', '.join(map(str, self.axes))}]" if self.axes else ""
        return f"{self.sensor}.{self.field}{place}".lstrip(".")

    def of(self, suite: SensorSuite) -> float:
        """Return the number in a suite."""
        value = getattr(self.part(suite), self.field)
        return float(value[self.axes[0]] if self.axes else value)

    def value(self, prior: float, x: float) -> float:
        """Return the number at a coordinate."""
        return prior * math.exp(self.spread * x) if self.positive else prior + self.spread * x

    def coordinate(self, prior: float, value: float) -> float:
        """Return the coordinate of a number."""
        return (math.log(value / prior) if self.positive else value - prior) / self.spread

    def put(self, suite: SensorSuite, value: float) -> SensorSuite:
        """Return a suite with another number."""
        part, new = self.part(suite), cast("Any", value)
        if self.axes:
            values = list(getattr(part, self.field))
            for axis in self.axes:
                values[axis] = value
            new = tuple(values)
        changes = {self.field: new}
        if self.field == _LEVER and part.secondary_antenna_B is not None:  # with the same baseline
            moves = np.subtract(new, part.primary_antenna_B)
            changes["secondary_antenna_B"] = tuple((part.secondary_antenna_B + moves).tolist())
        part = part.replace(**changes)
        return suite.replace(**{self.sensor: part}) if self.sensor else part

    def part(self, suite: SensorSuite) -> Any:
        """Return the part of a suite that has the number."""
        return getattr(suite, self.sensor) if self.sensor else suite


_LEVEL, _UP = (0, 1), (2,)
_LEVER, _PRECISE = "primary_antenna_B", 0.1  #: [m]
_WIDE, _NARROW = 1.5, 0.7  #: logarithms: factors of 4.5 and 2
_DELAYS, _MOUNTING, _COMPASS = "log_delays", "log_rotation", "log_compass_rotation"
MAX_SPREAD, _MIN_SPREAD = 3.0, -0.3
"""Bounds of a coordinate; and of the logarithm of a standard deviation over the suite's."""

# fmt: off
_OF_AIDS = {
    "barometer": (Number(sensor="barometer", field="bias_sigma", spread=_WIDE, unit="m"),),
    "magnetometer": (
        Number(sensor="magnetometer", field="hard_iron_sigma", spread=_WIDE, unit="T"),
        Number(sensor="magnetometer", field="hard_iron_tau", spread=_NARROW, unit="s"),
        Number(sensor="magnetometer", field="declination", spread=0.3, positive=False, unit="rad"),
        Number(sensor="magnetometer", field="inclination", spread=0.1, positive=False, unit="rad",
               limit=1.5),
        Number(sensor="magnetometer", field="strength", spread=0.2, unit="T"),
    ),
}  #: further numbers of aiding sensors than their noise
NUMBERS = (
    *(
        Number(
            sensor=_DELAYS, field=name, spread=0.3, positive=False, unit="s", step=1 / 30, limit=1.8
        )
        for name in vars(LogDelays())
    ),
    *(
        Number(sensor="", field=_MOUNTING, axes=(k,), spread=0.1, positive=False, unit="rad")
        for k in range(3)
    ),
    *(  # the declination is its yaw
        Number(sensor="", field=_COMPASS, axes=(k,), spread=0.1, positive=False, unit="rad")
        for k in range(2)
    ),
    Number(sensor="imu", field="accel_noise_density", spread=2.5, unit="m/s^2/sqrt(Hz)"),
    Number(sensor="imu", field="gyro_noise_density", spread=2.0, unit="rad/s/sqrt(Hz)"),
    Number(sensor="imu", field="accel_bias_sigma", spread=_NARROW, unit="m/s^2",
           limit=0.5),
    Number(sensor="imu", field="gyro_bias_sigma", spread=_WIDE, unit="rad/s"),
    Number(sensor="gnss", field="position_sigma_I", axes=_LEVEL, spread=_WIDE, unit="m"),
    Number(sensor="gnss", field="position_sigma_I", axes=_UP, spread=_WIDE, unit="m"),
    Number(sensor="gnss", field="drift_sigma_I", axes=_LEVEL, spread=_WIDE, unit="m"),
    Number(sensor="gnss", field="drift_sigma_I", axes=_UP, spread=_WIDE, unit="m"),
    Number(sensor="gnss", field="drift_tau", spread=_WIDE, unit="s"),
    Number(sensor="gnss", field="velocity_sigma", spread=_WIDE, unit="m/s"),
    Number(sensor="gnss", field="baseline_sigma", spread=_WIDE, unit="rad"),
    *(
        Number(sensor="gnss", field=_LEVER, axes=(k,), spread=0.15, positive=False, unit="m")
        for k in range(3)
    ),
    Number(sensor="camera", field="pixel_sigma", spread=_WIDE, unit="pixels"),
    *(
        number
        for name, kind in AID_PARAMS.items()
        for number in (
            Number(sensor=name, field="noise_sigma", spread=_WIDE, unit=kind.unit),
            *_OF_AIDS.get(name, ()),
        )
    ),
)
# fmt: on
"""Numbers that a calibration finds. The spreads are engineering judgment: data sheets describe a
sensor at rest, and vibration, airflow and motor currents multiply its noise. A flight with little
tilt cannot separate a bias of the accelerometer from the tilt: its prior is narrow, up to 0.5 m/s^2
of data sheets (TDK ICM-20948)."""


def numbers_in(suite: SensorSuite, log: Log, delays: bool, rotation: bool) -> list[Number]:
    """Return the numbers of the sensors that a suite and a log have.

    With or without delays, and with the rotation of the IMU or of the magnetometer only.
    """
    measured = {name for name in log.streams if getattr(suite, name, None) is not None}
    paired = "gnss" in measured and has_heading(log)
    others = {
        # with axes in B
        _MOUNTING: rotation and (paired or bool(measured & {"camera", "magnetometer"})),
        _COMPASS: not rotation and "magnetometer" in measured,
        "baseline_sigma": paired,
        "velocity_sigma": has(log, "velocity"),
        # of baselines, noise hides it
        _LEVER: not has(log, "baseline")
        and suite.gnss is not None
        and suite.gnss.position_sigma_I[0] <= _PRECISE,
    }
    found = []
    for number in NUMBERS:
        known = number.sensor in measured or number.field in (_MOUNTING, _COMPASS)
        if number.sensor == _DELAYS:
            known = delays and number.field in measured
        if known and others.get(number.field, True):
            value = getattr(number.part(suite), number.field)
            if value is not None and (not number.positive or np.all(np.asarray(value) != 0.0)):
                found.append(number)
    return found


def has_heading(log: Log) -> bool:
    """Return True if a log has baselines, or attitudes, which act as such."""
    return has(log, "baseline") or log.attitude is not None


def has(log: Log, quantity: str) -> bool:
    """Return True if a log has a quantity of GNSS, such as "baseline"."""
    given = {} if log.gnss is None else log.gnss.values
    values = [given[name] for name in (f"{quantity}_G", f"{quantity}_I") if name in given]
    return any(np.isfinite(value).any() for value in values)

"""The IMU and its errors, with the source of every number."""

import math
from functools import partial
from typing import Annotated, Literal

from quad_gym.params import checks as check
from quad_gym.params import portable
from quad_gym.params.aids import SensorBase

MANEUVER = 0.5
"""Typical time for which a quadrotor accelerates in one direction [s]; engineering judgment,
between a turn through a gate (some tenths of a second) and steady wind."""

Error = Annotated[float, check.between(0.0, 0.1)]

_ERRORS = tuple(
    f"{sensor}_{error}_sigma" for sensor in ("accel", "gyro") for error in ("scale", "misalignment")
)
"""Errors of scale and alignment."""


class ImuParams(SensorBase):
    """Accelerometer and gyro, with white noise and Gauss-Markov biases (report eqs. 4, 6, 7)."""

    rate: Annotated[float, partial(check.positive, least=1.0, most=1e6)] = 200.0
    """sampling rate [Hz]; one sample is one tick of the simulation; report section 4"""
    lever_arm_B: check.Place = (0.0, 0.0, 0.0)
    """(3,) position of the accelerometer in B [m]; report section 2.3"""
    samples: Literal["instant", "average"] = "instant"
    """samples with which the filter predicts a tick: "instant", a sample of the motion at the start
    of the tick (report), or "average", the mean over the tick, as real IMUs provide by delta angles
    and delta velocities. In both cases the inner loops read the gyro at the present instant: a mean
    lags by half a tick, too much for a tight rate loop"""
    accel_noise_density: check.Positive = 9.8e-3 * 0.1
    """noise density of the accelerometer [m/s^2/sqrt(Hz)]; laboratory: 0.1 milli-g/sqrt(Hz)"""
    gyro_noise_density: check.Positive = math.radians(0.05)
    """noise density of the gyro [rad/s/sqrt(Hz)]; laboratory: 0.05 deg/s/sqrt(Hz)"""
    accel_bias_sigma: check.Positive = 9.8e-3 * 100.0
    """stationary standard deviation of the accelerometer bias, per axis [m/s^2]; laboratory: 100
    milli-g"""
    gyro_bias_sigma: check.Positive = math.radians(100.0) / 3600.0
    """stationary standard deviation of the gyro bias, per axis [rad/s]; laboratory: 100 deg/h"""
    accel_bias_tau: check.Positive = 100.0
    """correlation time of the accelerometer bias [s]; laboratory"""
    gyro_bias_tau: check.Positive = 100.0
    """correlation time of the gyro bias [s]; laboratory"""
    accel_scale_sigma: Error = 0.0
    """standard deviation of the accelerometer's scale factor error, per axis, constant in an
    episode [-]. Errors of scale and alignment act on the difference from rest on level ground,
    where biases are defined: `(I + D) (f - g e3)` for the accelerometer and `(I + D) w` for the
    gyro, with the scale factor errors on the diagonal of D"""
    gyro_scale_sigma: Error = 0.0
    """standard deviation of the gyro's scale factor error, per axis, constant in an episode [-]"""
    accel_misalignment_sigma: Error = 0.0
    """standard deviation of each off-diagonal entry of the accelerometer's D, constant in an
    episode: non-orthogonal axes, and the rotation of the sensor in its housing [rad]"""
    gyro_misalignment_sigma: Error = 0.0
    """standard deviation of each off-diagonal entry of the gyro's D, constant in an episode
    [rad]"""
    accel_vibration: check.NonNegative = 0.0
    """standard deviation of the noise that rotor vibration adds to an accelerometer sample in
    hover, per axis, after the IMU's own filters [m/s^2]. The noise is white, and proportional to
    the square of the rotor speeds, as the forces of unbalanced masses are"""
    gyro_vibration: check.NonNegative = 0.0
    """standard deviation of this noise in a gyro sample [rad/s]"""

    _ideal = dict.fromkeys((*_ERRORS, "accel_vibration", "gyro_vibration"), 0.0)

    def _white_noise(self) -> tuple[str, ...]:
        return ("accel_noise_density", "gyro_noise_density")

    @property
    def dt(self) -> float:
        """Duration of a tick, the time between two samples [s]."""
        return 1.0 / self.rate

    @property
    def errs(self) -> bool:
        """True if there are errors of scale or alignment."""
        return any(getattr(self, name) for name in _ERRORS)

    @property
    def vibrates(self) -> bool:
        """True if rotor vibration reaches the IMU."""
        return self.accel_vibration > 0.0 or self.gyro_vibration > 0.0

    @property
    def accel_noise(self) -> float:
        """Standard deviation that the filter assumes for an accelerometer's white noise [m/s^2].

        The value is for hover; the filter scales the vibration in it with the measured specific
        force, as vibration is proportional to thrust.
        """
        return portable.hypot(self.accel_noise_density / math.sqrt(self.dt), self.accel_vibration)

    @property
    def accel_error_noise(self) -> float:
        """White noise by which the filter models errors of scale and alignment, per m/s^2 [-].

        The errors are proportional to the difference of the specific force from its value at rest,
        and last as long as a maneuver. Over `MANEUVER` seconds they change the velocity by as much
        as white noise whose samples are larger by the square root of the number of samples.
        """
        scale, misalignment = self.accel_scale_sigma, self.accel_misalignment_sigma
        mean_square = (scale * scale + 2.0 * (misalignment * misalignment)) / 3.0  # over the axes
        return math.sqrt(mean_square * MANEUVER / self.dt)

    @property
    def gyro_noise(self) -> float:
        """Standard deviation that the filter assumes for a gyro's white noise [rad/s]."""
        return portable.hypot(self.gyro_noise_density / math.sqrt(self.dt), self.gyro_vibration)

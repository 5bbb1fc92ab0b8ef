"""The IMU: its errors, with the source of every number."""

import math
from dataclasses import dataclass

from quad_gym.params import checks as check
from quad_gym.params.checks import Checked, Vector

MANEUVER = 0.5
"""How long a quadrotor accelerates one way [s]; our judgment, between a turn through a gate (some
tenths of a second) and steady wind."""


@dataclass(frozen=True, kw_only=True)
class ImuParams(Checked):
    """Accelerometer and gyro: white noise, Gauss-Markov biases (report equations 4, 6, 7)."""

    rate: float = 200.0
    """[Hz]; one sample is one tick of the simulation; report section 4"""
    lever_arm_B: Vector = (0.0, 0.0, 0.0)
    """(3,) position of the accelerometer in B [m]; report section 2.3"""
    samples: str = "instant"
    """what the filter predicts a tick with: "instant", a sample of the motion at its start
    (report); or "average", the mean over it, as real IMUs deliver delta angles and delta
    velocities, corrected for coning and sculling. The inner loops read the gyro at the present
    instant either way, with the noise of the last sample: a mean lags by half a tick, which a
    tight rate loop does not bear."""
    accel_noise_density: float = 9.8e-3 * 0.1
    """[m/s^2/sqrt(Hz)]; laboratory: 0.1 milli-g/sqrt(Hz)"""
    gyro_noise_density: float = math.radians(0.05)
    """[rad/s/sqrt(Hz)]; laboratory: 0.05 deg/s/sqrt(Hz)"""
    accel_bias_sigma: float = 9.8e-3 * 100.0
    """stationary standard deviation [m/s^2]; laboratory: 100 milli-g"""
    gyro_bias_sigma: float = math.radians(100.0) / 3600.0
    """stationary standard deviation [rad/s]; laboratory: 100 deg/h"""
    accel_bias_tau: float = 100.0
    """correlation time [s]; laboratory"""
    gyro_bias_tau: float = 100.0
    """correlation time [s]; laboratory"""
    accel_scale_sigma: float = 0.0
    """standard deviation of each axis' scale factor error, constant in an episode [-]. Errors of
    scale and alignment act on what differs from rest on level ground, where biases are defined:
    `(I + D) (f - g e3)`, `(I + D) w`, with the scale errors on the diagonal of D"""
    gyro_scale_sigma: float = 0.0
    """likewise [-]"""
    accel_misalignment_sigma: float = 0.0
    """standard deviation of each entry of D off its diagonal: axes that are not orthogonal, and the
    sensor's turn in its housing [rad]"""
    gyro_misalignment_sigma: float = 0.0
    """likewise [rad]"""
    accel_vibration: float = 0.0
    """standard deviation that the rotors' vibration adds to a sample in hover, per axis, after the
    IMU's own filters [m/s^2]. It is white and grows with the square of the rotor speeds, as
    the forces of unbalanced masses do"""
    gyro_vibration: float = 0.0
    """likewise [rad/s]"""

    def __post_init__(self) -> None:
        self._check(
            check.number,
            "accel_scale_sigma",
            "gyro_scale_sigma",
            "accel_misalignment_sigma",
            "gyro_misalignment_sigma",
            least=0.0,
            most=0.1,
        )
        self._check(check.number, "accel_vibration", "gyro_vibration", least=0.0)
        self._check(check.positive, "rate", least=1.0, most=1e6)
        self._check(check.positive, "accel_bias_tau", "gyro_bias_tau")
        self._check(check.positive, "accel_noise_density", "gyro_noise_density")
        self._check(check.positive, "accel_bias_sigma", "gyro_bias_sigma")
        self._check(check.place, "lever_arm_B")
        self._check(check.choice, "samples", choices=("instant", "average"))

    @property
    def dt(self) -> float:
        """The tick: time between two samples [s]."""
        return 1.0 / self.rate

    @property
    def errs(self) -> bool:
        """Whether there are errors of scale or alignment."""
        return any(
            (
                self.accel_scale_sigma,
                self.gyro_scale_sigma,
                self.accel_misalignment_sigma,
                self.gyro_misalignment_sigma,
            )
        )

    @property
    def vibrates(self) -> bool:
        """Whether the rotors' vibration reaches the IMU."""
        return self.accel_vibration > 0.0 or self.gyro_vibration > 0.0

    @property
    def believed_accel_sigma(self) -> float:
        """Standard deviation of a sample that the filter takes for white [m/s^2].

        As of hovering; where the specific force differs from g the filter counts the vibration
        of rotors that lift so much, as it grows with the thrust.
        """
        return math.hypot(self.accel_noise_density / math.sqrt(self.dt), self.accel_vibration)

    @property
    def believed_accel_error(self) -> float:
        """What the filter takes for white of errors of scale and alignment, per m/s^2 [-].

        They are proportional to how much the specific force differs from that at rest, and last as
        long as a maneuver: one of `MANEUVER` seconds moves the velocity as far as white noise does
        whose samples are larger by the square root of their number.
        """
        scale, misalignment = self.accel_scale_sigma, self.accel_misalignment_sigma
        mean_square = (scale**2 + 2.0 * misalignment**2) / 3.0  # over the axes
        return math.sqrt(mean_square * MANEUVER / self.dt)

    @property
    def believed_gyro_sigma(self) -> float:
        """Likewise of the gyro [rad/s]."""
        return math.hypot(self.gyro_noise_density / math.sqrt(self.dt), self.gyro_vibration)

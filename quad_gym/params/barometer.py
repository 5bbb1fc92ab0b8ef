"""The barometer: altitude by static pressure, and its errors."""

from dataclasses import dataclass

from quad_gym.params import checks as check
from quad_gym.params.aids import AidParams, SlowError
from quad_gym.records import Aid


@dataclass(frozen=True, kw_only=True)
class BarometerParams(AidParams):
    """A barometer: the height of the vehicle in I, with white noise and a slow bias."""

    noise_sigma: float = 0.1
    """standard deviation of white noise [m]; the air of the rotors, more than the sensor's own
    noise of some centimeters; our judgment"""
    bias_sigma: float = 0.7
    """stationary standard deviation of the bias, a Gauss-Markov process of first order [m]; Bosch
    BMP388 data sheet: relative accuracy +-8 Pa, equivalent to +-0.66 m"""
    bias_tau: float = 300.0
    """its correlation time [s]: weather and the sensor's temperature change within minutes; our
    judgment. The filter estimates the bias, as one more state"""

    aid = Aid.BAROMETER
    raw = ("m", "I", 1000.0)

    def __post_init__(self) -> None:
        super().__post_init__()
        self._check(check.positive, "noise_sigma", "bias_sigma", "bias_tau")

    @property
    def white_sigma(self) -> float:
        """Standard deviation of white noise [m]."""
        return self.noise_sigma

    @property
    def slow_scalar(self) -> SlowError:
        """The bias of the altitude [m]."""
        return SlowError(self.bias_sigma, self.bias_tau)

    def scaled_noise(self, factor: float) -> "BarometerParams":
        """A copy whose white noise is `factor` times as large."""
        return self.replace(noise_sigma=factor * self.noise_sigma)  # type: ignore[no-any-return]

"""The barometer: altitude from static pressure, and its errors."""

from quad_gym.params import checks as check
from quad_gym.params.aids import AidParams, SlowError


class BarometerParams(AidParams):
    """A barometer: height of the vehicle in I, with white noise and a time-correlated bias."""

    noise_sigma: check.Positive = 0.1
    """standard deviation of the white noise [m]; dominated by the airflow of the rotors, as the
    sensor's own noise is some centimeters; engineering judgment"""
    bias_sigma: check.Positive = 0.7
    """stationary standard deviation of the bias, a first-order Gauss-Markov process [m]; Bosch
    BMP388 data sheet: relative accuracy +-8 Pa, equivalent to +-0.66 m"""
    bias_tau: check.Positive = 300.0
    """correlation time of the bias [s]: weather and sensor temperature change within minutes;
    engineering judgment. The filter estimates the bias as an augmented state"""

    observes = ("height",)
    reads_velocity = False
    unit, frame, meaning = "m", "I", "height by static pressure"
    raw = ("m", "I", 1000.0)

    @property
    def slow_scalar(self) -> SlowError:
        """Bias of the altitude [m]."""
        return SlowError(self.bias_sigma, self.bias_tau)

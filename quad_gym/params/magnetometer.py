"""The magnetometer: the Earth's magnetic field in the body's axes, and its errors."""

import math
from dataclasses import dataclass

from quad_gym.params import checks as check
from quad_gym.params.aids import AidParams, SlowError
from quad_gym.records import Aid

MICROTESLA = 1e-6
"""[T]"""


@dataclass(frozen=True, kw_only=True)
class MagnetometerParams(AidParams):
    """A magnetometer of three axes, among the iron and the currents of a vehicle.

    It measures `(I + D) R_BI m_I + b + noise` in B, with the Earth's field m_I, soft iron D and
    hard iron b. The filter takes the field from a model of the Earth's, as do the defaults: the
    World Magnetic Model 2025 at the laboratory's reference antenna, 2026.0.
    """

    noise_sigma: float = 0.5 * MICROTESLA
    """standard deviation of white noise per axis [T]; motors' currents, more than the 0.15
    microtesla of a digit of the AK09916 in the ICM-20948 (data sheet); our judgment"""
    hard_iron_sigma: float = 1.0 * MICROTESLA
    """standard deviation per axis of what a calibration leaves of the vehicle's own field, constant
    in a flight [T]; 2.4 degrees of heading; our judgment. The filter estimates it, as three more
    states"""
    soft_iron_sigma: float = 0.0
    """standard deviation of each element of D, likewise [-]; the filter does not estimate it, but
    counts what it does to the field as hard iron"""
    strength: float = 46.28 * MICROTESLA
    """of the Earth's field [T]"""
    declination: float = math.radians(3.13)
    """from true north toward east [rad]"""
    inclination: float = math.radians(58.67)
    """below the horizon [rad]"""
    declination_sigma: float = math.radians(0.35)
    """standard deviation by which the model's declination is off, constant in a flight [rad]; the
    World Magnetic Model's error model, hypot(0.26, 5417 nT / horizontal field) degrees. The filter
    estimates it, as one more state"""

    aid = Aid.MAGNETOMETER
    raw = ("of the field", "B", 10.0)

    def __post_init__(self) -> None:
        super().__post_init__()
        self._check(
            check.positive,
            "noise_sigma",
            "hard_iron_sigma",
            "strength",
            "declination_sigma",
            most=1.0,
        )
        self._check(check.number, "soft_iron_sigma", least=0.0, most=1.0)
        self._check(check.number, "declination", least=-math.pi, most=math.pi)
        self._check(check.number, "inclination", least=-math.pi / 2, most=math.pi / 2)
        if math.cos(self.inclination) < 0.01:
            raise ValueError(
                "MagnetometerParams.inclination must leave a horizontal field that tells the "
                f"heading, 0.6 degrees from the vertical at least, got {self.inclination}"
            )

    @property
    def field_I(self) -> tuple[float, float, float]:
        """(3,) the Earth's field east, north, up [T]."""
        level = self.strength * math.cos(self.inclination)
        return (
            level * math.sin(self.declination),
            level * math.cos(self.declination),
            -self.strength * math.sin(self.inclination),
        )

    @property
    def white_sigma(self) -> float:
        """Standard deviation of white noise per axis [T]."""
        return self.noise_sigma

    @property
    def slow_vector(self) -> SlowError:
        """Hard iron [T]."""
        return SlowError(self.hard_iron_sigma)

    @property
    def believed_vector(self) -> SlowError:
        """Hard iron, and what soft iron makes of the field [T]."""
        return SlowError(math.hypot(self.hard_iron_sigma, self.soft_iron_sigma * self.strength))

    @property
    def slow_scalar(self) -> SlowError:
        """True declination less the believed one [rad]."""
        return SlowError(self.declination_sigma)

    @property
    def matrix_sigma(self) -> float:
        """Soft iron [-]."""
        return self.soft_iron_sigma

    @property
    def scale(self) -> float:
        """The strength of the field [T]."""
        return self.strength

    @property
    def numbers(self) -> tuple[float, float, float]:
        """The field in I [T]."""
        return self.field_I

    def simplified(self) -> "MagnetometerParams":
        """A copy without latency and soft iron."""
        return self.replace(latency=0.0, soft_iron_sigma=0.0)  # type: ignore[no-any-return]

    def scaled_noise(self, factor: float) -> "MagnetometerParams":
        """A copy whose white noise is `factor` times as large."""
        return self.replace(noise_sigma=factor * self.noise_sigma)  # type: ignore[no-any-return]

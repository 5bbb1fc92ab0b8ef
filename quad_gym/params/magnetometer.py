"""The magnetometer: the Earth's magnetic field in body axes, and its errors."""

import math
from functools import partial
from typing import Annotated, ClassVar

from quad_gym.params import checks as check
from quad_gym.params import portable
from quad_gym.params.aids import AidParams, FirstHeading, SlowError

MICROTESLA = 1e-6  #: one microtesla [T]


class MagnetometerParams(AidParams):
    """A three-axis magnetometer near the iron and the currents of a vehicle.

    It measures `(I + D) R_BI m_I + b + noise` in B, with the Earth's field m_I, soft iron D and
    hard iron b. The filter, like the defaults, takes the field from a model of the Earth: the World
    Magnetic Model 2025 at the laboratory's reference antenna, 2026.0.
    """

    noise_sigma: check.UpToOne = 0.5 * MICROTESLA
    """standard deviation of the white noise, per axis [T]; dominated by the motor currents, as a
    digit of the AK09916 in the ICM-20948 is 0.15 microtesla (data sheet); engineering judgment"""
    hard_iron_sigma: check.UpToOne = 1.0 * MICROTESLA
    """standard deviation of the vehicle's own field that calibration leaves, per axis, constant in
    a flight [T]; the default is 2.4 degrees of heading; engineering judgment. The filter estimates
    this field in three augmented states"""
    hard_iron_tau: Annotated[float, check.positive_or_infinite] = math.inf
    """correlation time of this field [s]: currents of motors change with thrust and attitude, and
    their field with them; infinite: constant in a flight"""
    soft_iron_sigma: Annotated[float, check.between(0.0, 1.0)] = 0.0
    """standard deviation of each element of D, constant in a flight [-]; the filter does not
    estimate D, but assumes hard iron larger by its effect on the field"""
    strength: check.UpToOne = 46.28 * MICROTESLA
    """strength of the Earth's field [T]"""
    declination: Annotated[float, partial(check.angle, most=math.pi)] = math.radians(3.13)
    """declination of the Earth's field, from true north toward east [rad]"""
    inclination: Annotated[float, partial(check.angle, most=0.5 * math.pi)] = math.radians(58.67)
    """inclination of the Earth's field below the horizon [rad]"""
    declination_sigma: check.UpToOne = math.radians(0.35)
    """standard deviation of the error of the model's declination, constant in a flight [rad]; the
    World Magnetic Model's error model, hypot(0.26, 5417 nT / horizontal field) degrees. The filter
    estimates the error in an augmented state"""

    _ideal: ClassVar = {"latency": 0.0, "soft_iron_sigma": 0.0}
    length, observes = 3, ("heading",)
    reads_velocity, shows_heading = False, True
    unit, frame, meaning = "T", "B", "magnetic field"
    raw = ("of the field", "B", 10.0)

    def __post_init__(self) -> None:
        super().__post_init__()
        if math.cos(self.inclination) < 0.01:
            must = "leave a horizontal field, from which the heading follows: at least 0.6 degrees "
            self._refuse("inclination", must + "from the vertical")

    @property
    def field_I(self) -> tuple[float, float, float]:
        """The Earth's field (3,) east, north, up [T]."""
        level = self.strength * portable.cos(self.inclination)
        return (
            level * portable.sin(self.declination),
            level * portable.cos(self.declination),
            -self.strength * portable.sin(self.inclination),
        )

    @property
    def first_heading(self) -> FirstHeading:
        """Hard iron, which turns the heading by its ratio to the level field."""
        level, slope = math.hypot(*self.field_I[:2]), abs(math.tan(self.inclination))
        iron = self.hard_iron_sigma
        return FirstHeading("hard_iron_sigma", iron, "T", level, lasting=True, slope=slope)

    @property
    def slow_vector(self) -> SlowError:
        """Hard iron, per axis [T]."""
        return SlowError(self.hard_iron_sigma, self.hard_iron_tau)

    @property
    def assumed_vector(self) -> SlowError:
        """Hard iron, increased by the effect of soft iron on the field, per axis [T]."""
        sigma = portable.hypot(self.hard_iron_sigma, self.soft_iron_sigma * self.strength)
        return SlowError(sigma, self.hard_iron_tau)

    @property
    def slow_scalar(self) -> SlowError:
        """Error of the declination, true minus modeled [rad]."""
        return SlowError(self.declination_sigma)

    @property
    def matrix_sigma(self) -> float:
        """Standard deviation of each element of the soft iron D [-]."""
        return self.soft_iron_sigma

    @property
    def scale(self) -> float:
        """Strength of the Earth's field, which normalizes observations [T]."""
        return self.strength

    @property
    def numbers(self) -> check.Matrix:
        """The Earth's field east, north, up [T]."""
        return (self.field_I,)

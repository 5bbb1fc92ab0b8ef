"""GNSS: positions, velocities, the baseline between two antennas, and their errors."""

import math
from typing import Annotated, Any, ClassVar, Self

import numpy as np

from quad_gym.frames import ecef_to_enu
from quad_gym.params import checks as check
from quad_gym.params import portable
from quad_gym.params.aids import (
    MIN_DRIFT,
    FirstHeading,
    FurtherStage,
    ReadingDefinition,
    SensorBase,
    SlowError,
)

HEADING_MEMORY = 60.0
"""Time over which a filter does not average out the constant heading error of a baseline [s]."""


STEEP = 0.2
"""Level share of a baseline below which it does not show the heading, 12 degrees from the vertical;
as in `kernels/filter/starts.py`."""

MIN_BASELINE = 1e-3  #: antennas are farther apart than this [m]


def check_baseline(name: str, baseline: np.ndarray) -> None:
    """Refuse antennas at one place, with a baseline (3,) below MIN_BASELINE [m]."""
    if np.linalg.norm(baseline) < MIN_BASELINE:
        raise ValueError(f"{name} must be apart, by at least {MIN_BASELINE:g} m")


class GnssParams(SensorBase):
    """GNSS: position of the primary antenna and, with a second antenna, the baseline between them.

    With one antenna, the initial heading of the filter is measured by the magnetometer or, without
    one, given by `InitialPoseParams`.
    """

    rate: check.Positive = 200.0
    """measurement rate [Hz]; the IMU rate must be a whole multiple of it; laboratory: a measurement
    at every tick"""
    primary_antenna_B: check.Place = (0.1013, -0.0004, 0.0472)
    """(3,) position of the primary antenna in B [m]; laboratory vehicle"""
    secondary_antenna_B: check.Place | None = (-0.0887, -0.0004, 0.0472)
    """(3,) position of the secondary antenna in B [m]; laboratory vehicle. None: one antenna, and
    no baseline"""
    reference_antenna_G: check.Vector3 = (-742080.456, -5462030.875, 3198338.956)
    """(3,) position of the reference antenna, the origin of the east-north-up frame I, in ECEF [m];
    laboratory"""
    position_sigma_I: check.Positive3 = (0.006, 0.006, 0.012)
    """(3,) standard deviation of the white position noise east, north, up [m]; laboratory (RTK)"""
    baseline_sigma: check.AngleSize = 0.05
    """standard deviation of the white noise of the baseline's direction [rad]; laboratory"""
    heading_error_sigma: Annotated[float, check.between(0.0, 1.0)] = 0.0
    """standard deviation of the heading error that all baselines of an episode have in common, due
    to unequal antennas and their mounting, a rotation about the body z axis [rad]"""
    velocity_sigma: check.Positive | None = None
    """standard deviation of the velocity from Doppler shifts, per axis [m/s]; None: velocity is not
    measured (laboratory)"""
    phase: check.Phase = 0.0
    """time of the first measurement after the start as a fraction of the measurement period, in [0,
    1), rounded to whole ticks; None: drawn at random in each episode"""
    drift_sigma_I: check.NonNegative3 = (0.0, 0.0, 0.0)
    """(3,) stationary standard deviation of the drift of positions east, north, up [m], a
    first-order Gauss-Markov process that is zero at the start of an episode, because positions are
    relative to the place of the start"""
    drift_tau: check.Positive = 60.0
    """correlation time of the drift [s]; the filter estimates it in three augmented states"""
    latency: check.NonNegative = 0.0
    """delay from a measurement to its arrival at the filter, which receives it with its time stamp
    [s]; rounded to whole ticks, at most MAX_UNDER_WAY measurement periods. Receivers take about 0.1
    s: the autopilot PX4 assumes 0.11 s (parameter EKF2_GPS_DELAY)"""

    measures: ClassVar = (
        ReadingDefinition(
            name="gnss_position",
            word="position",
            length=3,
            unit="m",
            frame="I",
            meaning="primary antenna, from the reference antenna",
            observes=("position", "height", "velocity"),
            raw=("m", "I", 1000.0),
            sigma="gnss_sigma",
            noise="position_sigma_I",
            from_center=True,
            sigma_unit="m",
            sigmas=3,
            least_sigma=1e-9,
            reported=True,
            in_G=True,
            marked=True,
        ),
        ReadingDefinition(
            name="gnss_baseline",
            word="baseline",
            length=3,
            unit="m",
            frame="I",
            meaning="primary to secondary antenna",
            observes=("heading",),
            raw=("-", "I", 1.0),
            sigma="baseline_sigma",
            noise="baseline_sigma",
            sigma_unit="rad",
            direction=True,
            in_G=True,
            marked=True,
        ),
        ReadingDefinition(
            name="gnss_velocity",
            word="velocity",
            length=3,
            unit="m/s",
            frame="I",
            meaning="velocity of the primary antenna, where the receiver measures it",
            observes=("velocity",),
            raw=("m/s", "I", 200.0),
            sigma="velocity_sigma",
            noise="velocity_sigma",
            sigma_unit="m/s",
            reported=True,
            in_G=True,
        ),
    )
    _ideal: ClassVar = {"latency": 0.0, "heading_error_sigma": 0.0}
    words = "GNSS"
    stages: ClassVar = (
        FurtherStage("turn_baseline", "heading_errs", ("errors",)),
        FurtherStage("corrupt_gnss", "faults"),
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.has_baseline:
            check_baseline("GnssParams.secondary_antenna_B and primary_antenna_B", self.baseline_B)
        if np.linalg.norm(self.reference_antenna_G) < 1e6:
            self._refuse("reference_antenna_G", "be a place on the Earth in ECEF meters")

    @property
    def measured_blocks(self) -> tuple[int, ...]:
        """Number of blocks of position, baseline and velocity: 1, or 0 where not measured."""
        return (1, int(self.has_baseline), int(self.has_velocity))

    @property
    def has_velocity(self) -> bool:
        """True if the receiver measures its velocity."""
        return self.velocity_sigma is not None

    @property
    def reads_velocity(self) -> bool:
        """True if a measurement depends on the velocity."""
        return self.has_velocity

    def require_filter(self) -> None:
        """Refuse positions with hardly any noise, by the square of which a filter divides."""
        if min(self.position_sigma_I) < 1e-9:
            self._refuse("position_sigma_I", "be at least 1e-9 m for a filter")

    @property
    def has_baseline(self) -> bool:
        """True with two antennas."""
        return self.secondary_antenna_B is not None

    @property
    def baseline_B(self) -> np.ndarray:
        """Baseline (3,) from the primary to the secondary antenna, in B [m].

        Raises:
            ValueError: With one antenna.
        """
        if self.secondary_antenna_B is None:
            raise ValueError("GnssParams.secondary_antenna_B must be given for a baseline")
        return np.array(self.secondary_antenna_B) - np.array(self.primary_antenna_B)

    @property
    def first_heading(self) -> FirstHeading | None:
        """Noise of the baseline; None: with one antenna, or a baseline that is too steep."""
        if not self.has_baseline:
            return None
        x, y, z = self.baseline_B
        share = math.hypot(x, y) / math.hypot(x, y, z)
        if share < STEEP:
            return None
        return FirstHeading("baseline_sigma", self.baseline_sigma, "rad", share, lasting=False)

    @property
    def drifts(self) -> bool:
        """True if positions have a time-correlated error."""
        return any(self.drift_sigma_I)

    @property
    def drift(self) -> tuple[SlowError, ...]:
        """The drift of positions, as a filter assumes it."""
        if not self.drifts:
            return ()
        return tuple(SlowError(max(s, MIN_DRIFT), self.drift_tau) for s in self.drift_sigma_I)

    def drift_after(self, time: float) -> tuple[float, ...]:
        """Return the standard deviations (3,) of the drift a time [s] after it was zero [m]."""
        grown = math.sqrt(portable.approached(2.0 * time / self.drift_tau))
        return tuple(sigma * grown for sigma in self.drift_sigma_I) if self.drifts else ()

    @property
    def raw_scales(self) -> tuple[float, ...]:
        """The length of the baseline, which makes it a direction [m]; others are in their units."""
        return (1.0, portable.norm(self.baseline_B) if self.has_baseline else 1.0, 1.0)

    @property
    def packed(self) -> dict[str, Any]:
        """Antennas, drift between two measurements, and noise of baselines."""
        drift = SlowError(1.0, self.rate * self.drift_tau)  # in measurements
        decay, drive = drift.over(1.0)
        found: dict[str, Any] = {
            "R_IG": ecef_to_enu(self.reference_antenna_G),
            "primary_antenna_B": self.primary_antenna_B,
            "antenna": self.primary_antenna_B,
            "position_sigma_I": self.position_sigma_I,
            "baseline_sigma": self.baseline_sigma,
            "heading_error_sigma": self.heading_error_sigma,
            "velocity_sigma": self.velocity_sigma or 0.0,
            "drift_step": 1.0 / drift.tau,
            "drift_decay": decay,
            "drift_drive": np.array(self.drift_sigma_I) * drive,
        }
        if self.has_baseline:
            found["baseline"] = self.baseline_B
            found["secondary_antenna_B"] = np.array(self.primary_antenna_B) + self.baseline_B
            found["baseline_length"] = portable.norm(self.baseline_B)
            found["first_baseline_sigma"] = self.first_baseline_sigma
            found["baseline_noise"] = self.baseline_noise
        return found

    @classmethod
    def from_mark(
        cls, sensor: Self | None, position_sigma: float, heading_sigma: float
    ) -> dict[str, Any]:
        """Return an antenna at the center of mass, and a baseline, where they are not measured.

        The baseline is along the x axis or, where positions are measured, vertical, so that it does
        not show the heading.
        """
        if sensor is not None and sensor.has_baseline:
            return {}
        baseline = np.array((1.0, 0.0, 0.0) if sensor is None else (0.0, 0.0, 1.0))
        antenna = np.zeros(3) if sensor is None else np.array(sensor.primary_antenna_B)
        found: dict[str, Any] = {
            "baseline": baseline,
            "baseline_length": 1.0,
            "secondary_antenna_B": antenna + baseline,
            "baseline_sigma": heading_sigma,
            "first_baseline_sigma": heading_sigma,
            "baseline_noise": heading_sigma,
        }
        if sensor is None:
            found |= {"R_IG": np.eye(3), "position_sigma_I": (position_sigma,) * 3}
        return found

    @property
    def options(self) -> dict[str, bool]:
        """Drift of positions, and constant errors of baselines."""
        return {"drifts": self.drifts, "heading_errs": self.heading_errs}

    @property
    def heading_errs(self) -> bool:
        """True if baselines have a constant error, which the filter models as white noise."""
        return self.has_baseline and self.heading_error_sigma > 0.0

    @property
    def counted_as_noise(self) -> tuple[str, ...]:
        """Baselines, if they have a constant error."""
        return ("gnss_baseline",) if self.heading_errs else ()

    @property
    def first_baseline_sigma(self) -> float:
        """Standard deviation of a single baseline's direction, all errors included [rad]."""
        return portable.hypot(self.baseline_sigma, self.heading_error_sigma)

    @property
    def baseline_noise(self) -> float:
        """Standard deviation that the filter assumes for the white noise of a baseline [rad].

        Averaging reduces white noise, but not a constant error. The constant error is therefore
        multiplied by the square root of the number of measurements in `HEADING_MEMORY`: after that
        time the heading is hardly more certain than after the first baseline, unless another sensor
        observes it.
        """
        count = max(self.rate * HEADING_MEMORY, 1.0)
        return portable.hypot(self.baseline_sigma, math.sqrt(count) * self.heading_error_sigma)

"""Faults of GNSS."""

from dataclasses import dataclass
from typing import Any

from quad_gym.faults.base import DirectedFault, Fault, Size
from quad_gym.params import checks as check
from quad_gym.records import FaultKind

__all__ = ["BaselineLoss", "GnssJump", "GnssOutage", "GnssOutliers", "GnssRamp"]


@dataclass(frozen=True, kw_only=True)
class GnssOutage(Fault):
    """Loss of all fixes, of position, velocity and baseline, as under a bridge or indoors.

    Outages of 30 s and of a minute are the usual test of inertial navigation: S. Godha and M. E.
    Cannon, GPS Solutions 11(3), 2007. The fix that starts the filter is always available and valid.
    """

    kind = FaultKind.GNSS_OUTAGE
    needs = "gnss"


@dataclass(frozen=True, kw_only=True)
class GnssOutliers(Fault):
    """Positions with large, independent errors, as from signals reflected by a wall.

    A position is an outlier with probability `share`. It is then displaced by `size` standard
    deviations of a fix in a random direction; the standard deviation includes the drift
    (`GnssParams.drift_sigma_I`). Velocities and baselines stay valid. Reflected signals have errors
    of tens of meters and more, ten to a hundred times the usual error of a fix: L.-T. Hsu, GPS
    Solutions 22(1), 2018.
    """

    share: check.UpToOne = 0.05
    """probability that a position is an outlier while the fault is active"""
    size: Size = (10.0, 100.0)
    """size of an outlier [standard deviations of a fix]"""

    kind = FaultKind.GNSS_OUTLIERS
    needs = "gnss"


@dataclass(frozen=True, kw_only=True)
class GnssRamp(DirectedFault):
    """A ramp in the positions, which jump back when the fault ends; velocities stay valid.

    A spoofer drags a vehicle along in this way, slowly enough to stay undetected: A. J. Kerns, D.
    P. Shepard, J. A. Bhatti and T. E. Humphreys, J. Field Robotics 31(4), 2014. No gate on single
    innovations detects a ramp that is slow enough.
    """

    speed: Size = (0.1, 0.5)
    """rate of the ramp [m/s]"""

    kind = FaultKind.GNSS_RAMP
    needs = "gnss"

    @property
    def numbers(self) -> dict[str, Any]:
        """Speed as the size, and direction."""
        return super().numbers | {"size": self.speed}


@dataclass(frozen=True, kw_only=True)
class GnssJump(DirectedFault):
    """A constant position offset, as when carrier-phase ambiguities are fixed wrongly.

    The offset is then a small multiple of the carrier's wavelength, 0.19 m on L1.
    """

    size: Size = (0.19, 0.95)
    """length of the offset [m]; default: one to five wavelengths"""

    kind = FaultKind.GNSS_JUMP
    needs = "gnss"


@dataclass(frozen=True, kw_only=True)
class BaselineLoss(Fault):
    """Loss of the baseline while positions continue, as with a shaded secondary antenna."""

    kind = FaultKind.BASELINE_LOSS
    needs = "gnss"

"""Faults of GNSS."""

from dataclasses import dataclass
from typing import Any

from quad_gym.faults.base import DirectedFault, Fault, Span, share_of_one, span
from quad_gym.records import FaultKind

__all__ = ["BaselineLoss", "GnssJump", "GnssOutage", "GnssOutliers", "GnssRamp"]


@dataclass(frozen=True, kw_only=True)
class GnssOutage(Fault):
    """No fixes: neither position nor velocity nor baseline, as under a bridge or indoors.

    Outages of 30 s and a minute are the usual trial of inertial navigation: S. Godha and M. E.
    Cannon, GPS Solutions 11(3), 2007. The fix that starts the filter is always there, and valid.
    """

    kind = FaultKind.GNSS_OUTAGE
    needs = "gnss"


@dataclass(frozen=True, kw_only=True)
class GnssOutliers(Fault):
    """Some positions are far off, each for itself, as by signals that come by way of a wall.

    A position is an outlier with probability `share`, and then lies `size` standard deviations of a
    fix off, in any direction; the slow error (`GnssParams.drift_sigma_I`) counts. Velocities and
    baselines stay valid. Reflected signals err by tens of meters and more, ten times and a hundred
    times a fix's usual error: L.-T. Hsu, GPS Solutions 22(1), 2018.
    """

    share: float = 0.05
    """of positions, while the fault is active"""
    size: Span = (10.0, 100.0)
    """[standard deviations]"""

    kind = FaultKind.GNSS_OUTLIERS
    needs = "gnss"

    def __post_init__(self) -> None:
        super().__post_init__()
        self._check(share_of_one, "share")
        self._check(span, "size", open_end=True)

    @property
    def numbers(self) -> dict[str, Any]:
        """What kernels read of it."""
        return {"share": self.share, "size": self.size}


@dataclass(frozen=True, kw_only=True)
class GnssRamp(DirectedFault):
    """Positions that drift away steadily, and jump back when the fault goes; velocities stay valid.

    As a spoofer drags a vehicle along, slowly enough not to be noticed: A. J. Kerns, D. P. Shepard,
    J. A. Bhatti and T. E. Humphreys, J. Field Robotics 31(4), 2014. No gate on single innovations
    finds a ramp that is slow enough.
    """

    speed: Span = (0.1, 0.5)
    """[m/s]"""

    kind = FaultKind.GNSS_RAMP
    needs = "gnss"
    size_field = "speed"


@dataclass(frozen=True, kw_only=True)
class GnssJump(DirectedFault):
    """Positions that are off by a constant, as when carrier-phase ambiguities are fixed wrongly.

    Then the offset is some multiples of the carrier's wavelength, 0.19 m on L1.
    """

    size: Span = (0.19, 0.95)
    """[m]; one to five wavelengths"""

    kind = FaultKind.GNSS_JUMP
    needs = "gnss"


@dataclass(frozen=True, kw_only=True)
class BaselineLoss(Fault):
    """No baseline, while positions go on, as when the secondary antenna is shaded."""

    kind = FaultKind.BASELINE_LOSS
    needs = "gnss"

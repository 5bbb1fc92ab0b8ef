"""Faults of the vehicle."""

from dataclasses import dataclass
from typing import Any

from quad_gym.faults.base import DirectedFault, Fault, Span, ends, span
from quad_gym.params import checks as check
from quad_gym.records import FaultKind

__all__ = ["PositionJump", "RotorLoss"]


@dataclass(frozen=True, kw_only=True)
class PositionJump(DirectedFault):
    """The vehicle itself is displaced at once, unfelt by the IMU; it happens when the fault comes.

    No real vehicle jumps, but its filter may find that the world is not where it was: a reference
    station or a map that was moved, a vehicle carried while its IMU was off. It is the trial of a
    filter's way back. A jump of the measurements alone is `GnssJump`. The default sizes
    reach beyond the bounds of `Hover`, 1.6 m; give that environment `out_of_bounds=3.0`.
    """

    size: Span = (1.0, 2.0)
    """[m]"""

    kind = FaultKind.POSITION_JUMP


@dataclass(frozen=True, kw_only=True)
class RotorLoss(Fault):
    """One rotor loses a share of its thrust and torque, as with a chipped blade; 1: all of it.

    Flying on three rotors is possible, but not with the controllers here: S. Sun, G. Cioffi, C. de
    Visser and D. Scaramuzza, IEEE Robotics and Automation Letters 6(2), 2021.
    """

    share: Span = (0.1, 0.3)
    """lost, at most 1; our judgment of what chipped blades cost"""
    rotor: int | None = None
    """0 to 3; None: drawn each time it comes"""

    kind = FaultKind.ROTOR_LOSS

    def __post_init__(self) -> None:
        super().__post_init__()
        self._check(span, "share", open_end=True)
        if ends(self.share)[1] > 1.0:
            raise ValueError(f"RotorLoss.share must be at most 1, got {self.share}")
        if self.rotor is not None:
            self._check(check.whole, "rotor", least=0)
            if self.rotor > 3:
                raise ValueError(f"RotorLoss.rotor must be 0, 1, 2 or 3, got {self.rotor}")

    @property
    def numbers(self) -> dict[str, Any]:
        """What kernels read of it."""
        pick = (0.0, 1.0) if self.rotor is None else ((self.rotor + 0.5) / 4.0, 0.0)
        return {"size": self.share, "fault_pick": pick}

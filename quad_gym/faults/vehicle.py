"""Faults of the vehicle."""

from dataclasses import dataclass
from functools import partial
from typing import Annotated, Any

from quad_gym.faults.base import DirectedFault, Fault, Size, ends
from quad_gym.params import checks as check
from quad_gym.records import FaultKind

__all__ = ["PositionJump", "RotorLoss"]


@dataclass(frozen=True, kw_only=True)
class PositionJump(DirectedFault):
    """Sudden displacement of the vehicle at the onset of the fault, without any acceleration.

    No real vehicle jumps, but its surroundings may not be where its filter assumes them: a
    reference station or a map was moved, or the vehicle was carried while its IMU was off. The
    fault tests whether a filter recovers. `GnssJump` moves only the measurements. The default sizes
    exceed the bounds of `Hover`, 1.6 m; use `out_of_bounds=3.0` with that environment.
    """

    size: Size = (1.0, 2.0)
    """length of the displacement [m]"""

    kind = FaultKind.POSITION_JUMP


@dataclass(frozen=True, kw_only=True)
class RotorLoss(Fault):
    """Loss of a fraction of one rotor's thrust and torque, as with a chipped blade; 1: total loss.

    Flying on three rotors is possible, but not with the controllers here: S. Sun, G. Cioffi, C. de
    Visser and D. Scaramuzza, IEEE Robotics and Automation Letters 6(2), 2021.
    """

    share: Size = (0.1, 0.3)
    """fraction of thrust and torque that is lost, at most 1 [-]; engineering judgment for chipped
    blades"""
    rotor: Annotated[int, partial(check.whole, least=0)] | None = None
    """index of the rotor, 0 to 3; None: drawn at each onset"""

    kind = FaultKind.ROTOR_LOSS

    def __post_init__(self) -> None:
        super().__post_init__()
        if ends(self.share)[1] > 1.0:
            raise ValueError(f"RotorLoss.share must be at most 1, got {self.share}")
        if self.rotor is not None and self.rotor > 3:
            raise ValueError(f"RotorLoss.rotor must be 0, 1, 2 or 3, got {self.rotor}")

    @property
    def numbers(self) -> dict[str, Any]:
        """Lost fraction as the size, and the range from which the rotor is drawn."""
        pick = (0.0, 1.0) if self.rotor is None else ((self.rotor + 0.5) / 4.0, 0.0)
        return {"size": self.share, "fault_pick": pick}

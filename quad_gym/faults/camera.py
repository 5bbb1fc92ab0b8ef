"""Faults of the camera."""

from dataclasses import dataclass
from typing import Any

from quad_gym.faults.base import Fault, share_of_one
from quad_gym.params import checks as check
from quad_gym.params.sensors import SensorSuite
from quad_gym.records import FaultKind

__all__ = ["CameraOcclusion", "WrongAssociations"]


@dataclass(frozen=True, kw_only=True)
class CameraOcclusion(Fault):
    """Features that the camera does not see: something is in the way, or the image is dark."""

    share: float = 1.0
    """of features, each hidden with this probability as long as the fault stays; 1: all"""

    kind = FaultKind.CAMERA_OCCLUSION
    needs = "camera"

    def __post_init__(self) -> None:
        super().__post_init__()
        self._check(share_of_one, "share")

    @property
    def numbers(self) -> dict[str, Any]:
        """What kernels read of it."""
        return {"share": self.share}


@dataclass(frozen=True, kw_only=True)
class WrongAssociations(Fault):
    """Features taken for others, in some of the images in which two or more are seen.

    Matching by appearance without a geometric check leaves some percent wrong matches and more; see
    M. A. Fischler and R. C. Bolles, Communications of the ACM 24(6), 1981, on why.
    """

    share: float = 0.05
    """of images, while the fault is active"""
    how: str = "swap"
    """"swap": two features, drawn among those seen, are swapped; "copy": one of them
    is reported in the direction of the other, which keeps its own"""

    kind = FaultKind.WRONG_ASSOCIATIONS
    needs = "camera"

    def __post_init__(self) -> None:
        super().__post_init__()
        self._check(share_of_one, "share")
        self._check(check.choice, "how", choices=("swap", "copy"))

    def check_suite(self, sensors: SensorSuite) -> None:
        """Refuse a suite without a camera, or with a single feature."""
        super().check_suite(sensors)
        if sensors.camera is not None and len(sensors.camera.features_I) < 2:
            raise ValueError(
                "faults must concern sensors that there are: WrongAssociations needs a camera that "
                "knows at least two features"
            )

    @property
    def numbers(self) -> dict[str, Any]:
        """What kernels read of it."""
        return {"share": self.share, "fault_swaps": self.how == "swap"}

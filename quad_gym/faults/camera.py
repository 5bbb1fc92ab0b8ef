"""Faults of the camera."""

from dataclasses import dataclass
from typing import Any, Literal

from quad_gym.faults.base import Fault
from quad_gym.params import checks as check
from quad_gym.params.sensors import SensorSuite
from quad_gym.records import FaultKind

__all__ = ["CameraOcclusion", "WrongAssociations"]


@dataclass(frozen=True, kw_only=True)
class CameraOcclusion(Fault):
    """Features that the camera does not see: something is in the way, or the image is dark."""

    share: check.UpToOne = 1.0
    """probability that a feature is hidden, drawn for each feature at each onset; 1: all
    features"""

    kind = FaultKind.CAMERA_OCCLUSION
    needs = "camera"


@dataclass(frozen=True, kw_only=True)
class WrongAssociations(Fault):
    """Features mistaken for others, in some of the images with two or more visible features.

    Matching by appearance without a geometric check leaves several percent wrong matches or more;
    see M. A. Fischler and R. C. Bolles, Communications of the ACM 24(6), 1981, for the reasons.
    """

    share: check.UpToOne = 0.05
    """probability that an image has a wrong association while the fault is active"""
    how: Literal["swap", "copy"] = "swap"
    """form of the error: "swap": two features, drawn among the visible ones, are swapped; "copy":
    one of them is reported in the direction of the other, which is reported in its own"""

    kind = FaultKind.WRONG_ASSOCIATIONS
    needs = "camera"

    def check_suite(self, sensors: SensorSuite) -> None:
        """Refuse a suite without a camera, or with a single feature."""
        super().check_suite(sensors)
        if sensors.camera is not None and len(sensors.camera.features_I) < 2:
            raise ValueError(
                "faults must concern sensors of the suite: WrongAssociations needs a camera with "
                "at least two features"
            )

    @property
    def numbers(self) -> dict[str, Any]:
        """Share of images, and the form of the error."""
        return super().numbers | {"fault_swaps": self.how == "swap"}

"""The camera: where it is, what it sees, and its errors."""

import math
from dataclasses import dataclass

import numpy as np

from quad_gym.params import checks as check
from quad_gym.params.checks import Checked, Matrix, Vector
from quad_gym.records import MAX_FEATURES


@dataclass(frozen=True, kw_only=True)
class CameraParams(Checked):
    """A pinhole camera that sees known features."""

    rate: float = 200.0
    """[Hz]; a whole division of the IMU's; the laboratory measures at every tick"""
    position_B: Vector = (0.1159, -0.0004, -0.0435)
    """(3,) projection center in B [m]; laboratory vehicle"""
    attitude: Vector = (math.radians(120.0), 0.0, math.radians(90.0))
    """(3,) Euler angles of R_CB, camera z along the optical axis [rad]; laboratory"""
    pixel_size: float = 2e-6
    """[m]; laboratory"""
    focal_length: float = 1657.72
    """[pixels]; laboratory"""
    image_size: Vector = (3840.0, 2160.0)
    """(2,) width and height, with the origin of coordinates at the center [pixels]; laboratory"""
    pixel_sigma: float = 20.0
    """standard deviation per axis [pixels]; laboratory"""
    features_I: Matrix = ((0.0, 0.0, 0.0), (0.0, 0.0, 0.7))
    """(n, 3) known points in I, at most MAX_FEATURES [m]; laboratory"""
    phase: float | None = 0.0
    """when the first image after the start comes, as a share of the period in [0, 1), in whole
    ticks; None: at random in each episode"""
    latency: float = 0.0
    """from when an image is taken to when its features reach the filter, with its time stamp, in
    whole ticks; at most MAX_UNDER_WAY periods [s]"""
    max_range: float = math.inf
    """distance beyond which a feature is too small to be found [m]"""
    exposure: float = 0.0
    """time over which an image is exposed: turning at w smears a feature over `focal_length w
    exposure` pixels, in which it is found anywhere; the filter knows how fast it turns [s]"""
    ground_hides: bool = False
    """whether the ground (`WorldParams.ground_height`) hides features below it, and all of them
    from a camera below it"""

    def __post_init__(self) -> None:
        self._check(check.number, "latency", least=0.0)
        self._check(check.number, "exposure", least=0.0, most=1.0)
        check.flag("CameraParams.ground_hides", self.ground_hides)
        if not (isinstance(self.max_range, float) and self.max_range == math.inf):
            self._check(check.positive, "max_range")
        self._check(check.phase, "phase")
        self._check(check.positive, "rate", "pixel_size", "focal_length", "pixel_sigma")
        self._check(check.place, "position_B")
        self._check(check.vector, "attitude", length=3)
        self._check(check.vector, "image_size", length=2)
        if min(self.image_size) <= 0.0:
            raise ValueError(
                f"CameraParams.image_size must be greater than 0, got {self.image_size}"
            )
        if np.size(self.features_I) == 0:
            raise ValueError("CameraParams.features_I must hold at least one feature, got none")
        self._check(check.matrix, "features_I", rows=None, columns=3)
        if len(self.features_I) > MAX_FEATURES:
            raise ValueError(
                f"CameraParams.features_I must hold at most {MAX_FEATURES} features, "
                f"got {len(self.features_I)}"
            )

    @property
    def limited(self) -> bool:
        """Whether range, blur or ground limit what is seen."""
        return self.max_range < math.inf or self.exposure > 0.0 or self.ground_hides

    @property
    def blur(self) -> float:
        """Standard deviation of a place in a smear, per body rate [pixels/(rad/s)]."""
        return self.focal_length * self.exposure / math.sqrt(12.0)

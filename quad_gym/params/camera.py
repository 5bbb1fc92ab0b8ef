"""The camera: mounting, intrinsics, features and errors."""

import math
from functools import partial
from typing import Annotated, Any, ClassVar

import numpy as np

from quad_gym.params import checks as check
from quad_gym.params import portable
from quad_gym.params.aids import FurtherStage, ReadingDefinition, SensorBase
from quad_gym.params.checks import Matrix, Vector

MAX_FEATURES = 16  #: largest number of a camera's features

Positive2 = Annotated[Vector, partial(check.vector, length=2, least=0.0, open_end=True)]


def _features(name: str, value: Any) -> Matrix:
    """`value` as positions of at least one and at most MAX_FEATURES features."""
    if np.size(value) == 0:
        raise ValueError(f"{name} must contain at least one feature, got none")
    found = check.matrix(name, value, rows=None, columns=3)
    if len(found) > MAX_FEATURES:
        raise ValueError(f"{name} must contain at most {MAX_FEATURES} features, got {len(found)}")
    return found


class CameraParams(SensorBase):
    """A pinhole camera that measures the image coordinates of known features."""

    rate: check.Positive = 200.0
    """frame rate [Hz], which must divide the IMU rate; laboratory: an image at every tick"""
    position_B: check.Place = (0.1159, -0.0004, -0.0435)
    """(3,) projection center in B [m]; laboratory vehicle"""
    attitude: check.Angles3 = (math.radians(120.0), 0.0, math.radians(90.0))
    """(3,) Euler angles of R_CB (roll, pitch and yaw in the 3-1-2 sequence), with the camera's z
    axis along the optical axis [rad]; laboratory"""
    focal_length: check.Positive = 1657.72
    """focal length [pixels]; laboratory"""
    image_size: Positive2 = (3840.0, 2160.0)
    """(2,) width and height of the image, with the origin of image coordinates at its center
    [pixels]; laboratory"""
    pixel_sigma: check.Positive = 20.0
    """standard deviation of each image coordinate of a feature [pixels]; laboratory"""
    features_I: Annotated[Matrix, _features] = ((0.0, 0.0, 0.0), (0.0, 0.0, 0.7))
    """(n, 3) positions of the known features in I, at most MAX_FEATURES of them [m]; laboratory"""
    phase: check.Phase = 0.0
    """time of the first image after the start as a fraction of the frame period, in [0, 1), rounded
    to whole ticks; None: drawn at random in each episode"""
    latency: check.NonNegative = 0.0
    """delay from an image to the arrival of its features at the filter, which receives them with
    the time stamp of the image [s]; rounded to whole ticks, at most MAX_UNDER_WAY frame periods"""
    max_range: Annotated[float, check.positive_or_infinite] = math.inf
    """distance beyond which a feature is too small to be detected [m]"""
    exposure: Annotated[float, check.between(0.0, 1.0)] = 0.0
    """exposure time of an image [s]: a body rate w smears a feature over `focal_length w exposure`
    pixels, on which its measured position is uniformly distributed; the filter inflates the pixel
    noise accordingly"""
    ground_hides: bool = False
    """True: the ground (`WorldParams.ground_height`) occludes features below it, and all features
    if the camera is below it"""

    measures: ClassVar = (
        ReadingDefinition(
            name="pixels",
            length=2,
            unit="pixels",
            frame="C",
            meaning="features, from the image's center",
            observes=("position", "height", "velocity", "heading"),
            raw=("half images", "C", 2.0),
            sigma="pixel_sigma",
            noise="pixel_sigma",
            sigma_unit="pixels",
            most_blocks=MAX_FEATURES,
            block="feature",
            direction=True,
        ),
    )
    _ideal: ClassVar = {
        "latency": 0.0,
        "max_range": math.inf,
        "exposure": 0.0,
        "ground_hides": False,
    }

    stages: ClassVar = (
        FurtherStage("limit_camera", "camera_limited"),
        FurtherStage("corrupt_features", "faults"),
    )
    reads_velocity = False

    @property
    def measured_blocks(self) -> tuple[int, ...]:
        """Number of features."""
        return (len(self.features_I),)

    @property
    def raw_spans(self) -> check.Matrix:
        """Half the image's width and height [pixels]."""
        return ((self.image_size[0] / 2, self.image_size[1] / 2, 1.0),)

    @property
    def packed(self) -> dict[str, Any]:
        """Mounting, image, motion blur and features."""
        return {
            "focal_length": self.focal_length,
            "pixel_sigma": self.pixel_sigma,
            "max_range": self.max_range,
            "camera": self.position_B,
            "R_CB": portable.euler_dcm(self.attitude),
            "half_image": np.array(self.image_size) / 2,
            "blur": self.blur,
            "features": self.features_I,
        }

    @property
    def options(self) -> dict[str, bool]:
        """Limits of images."""
        return {
            "camera_limited": self.limited,
            "camera_blurs": self.exposure > 0.0,
            "ground_hides": self.ground_hides,
        }

    @property
    def limited(self) -> bool:
        """True if range, motion blur or the ground limit the features that are visible."""
        return self.max_range < math.inf or self.exposure > 0.0 or self.ground_hides

    @property
    def blur(self) -> float:
        """Standard deviation of the motion blur per body rate [pixels/(rad/s)]."""
        return self.focal_length * self.exposure / math.sqrt(12.0)

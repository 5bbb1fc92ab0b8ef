"""Kinds of faults: of sensors, one by one, and of the vehicle."""

import math
from functools import partial
from typing import Annotated, Any, Literal

from quad_gym.faults.base import DirectedFault, Fault, Size, ends
from quad_gym.params import checks as check
from quad_gym.params.sensors import SensorSuite
from quad_gym.records import Aid, FaultKind

__all__ = [
    "AccelBiasStep",
    "BaselineLoss",
    "CameraOcclusion",
    "GnssJump",
    "GnssOutage",
    "GnssOutliers",
    "GnssRamp",
    "GyroBiasStep",
    "ImuSaturation",
    "PositionJump",
    "RotorLoss",
    "SensorLoss",
    "WrongAssociations",
]


class GnssOutage(Fault):
    """Loss of all fixes, of position, velocity and baseline, as under a bridge or indoors.

    Outages of 30 s and of a minute are the usual test of inertial navigation: S. Godha and M. E.
    Cannon, GPS Solutions 11(3), 2007. The fix that starts the filter is always available and valid.
    """

    needs = "gnss"


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

    needs = "gnss"


class GnssRamp(DirectedFault):
    """A ramp in the positions, which jump back when the fault ends; velocities stay valid.

    A spoofer drags a vehicle along in this way, slowly enough to stay undetected: A. J. Kerns, D.
    P. Shepard, J. A. Bhatti and T. E. Humphreys, J. Field Robotics 31(4), 2014. No gate on single
    innovations detects a ramp that is slow enough.
    """

    speed: Size = (0.1, 0.5)
    """rate of the ramp [m/s]"""

    needs = "gnss"

    @property
    def numbers(self) -> dict[str, Any]:
        """Speed as the size, and direction."""
        return super().numbers | {"size": self.speed}


class GnssJump(DirectedFault):
    """A constant position offset, as when carrier-phase ambiguities are fixed wrongly.

    The offset is then a small multiple of the carrier's wavelength, 0.19 m on L1.
    """

    size: Size = (0.19, 0.95)
    """length of the offset [m]; default: one to five wavelengths"""

    needs = "gnss"


class BaselineLoss(Fault):
    """Loss of the baseline while positions continue, as with a shaded secondary antenna."""

    needs = "gnss"


class CameraOcclusion(Fault):
    """Features that the camera does not see: something is in the way, or the image is dark."""

    share: check.UpToOne = 1.0
    """probability that a feature is hidden, drawn for each feature at each onset; 1: all
    features"""

    needs = "camera"


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


class AccelBiasStep(DirectedFault):
    """A step of the accelerometer's true bias in B, in addition to its random drift.

    Consumer parts have biases of up to 50 milli-g (TDK ICM-20948 data sheet); a shock or a change
    of temperature moves them by a fraction of that; engineering judgment.
    """

    size: Size = (0.05, 0.2)
    """length of the step [m/s^2]"""


class GyroBiasStep(DirectedFault):
    """A step of the gyro's true bias in B, in addition to its random drift.

    Consumer parts have biases of up to 5 deg/s (TDK ICM-20948 data sheet); the default is some
    tenths of that; engineering judgment.
    """

    size: Size = (math.radians(0.2), math.radians(1.0))
    """length of the step [rad/s]"""


class ImuSaturation(Fault):
    """Saturation of samples at the IMU's ranges, by default the smallest ones of a consumer part.

    TDK ICM-20948 data sheet: 2, 4, 8 or 16 g; 250, 500, 1000 or 2000 deg/s. The gyro samples of the
    inner loops saturate, too.
    """

    accel_range: check.Positive = 2.0 * 9.80665
    """largest specific force along each axis, in either direction [m/s^2]"""
    gyro_range: check.Positive = math.radians(250.0)
    """largest angular rate about each axis, in either direction [rad/s]"""

    @property
    def numbers(self) -> dict[str, Any]:
        """Both ranges."""
        return {"imu_range": (self.accel_range, self.gyro_range)}


class SensorLoss(Fault):
    """Loss of all measurements of an aiding sensor, as during a bus failure.

    A magnetometer is also lost while an autopilot rejects it near iron.
    """

    sensor: Annotated[str, partial(check.choice, choices=tuple(aid.name.lower() for aid in Aid))]
    """name of the lost sensor, such as "barometer\""""

    @property
    def kind(self) -> FaultKind:  # type: ignore[override]
        """Kind of the fault, such as BAROMETER_LOSS."""
        return FaultKind[f"{self.sensor.upper()}_LOSS"]

    @property
    def needs(self) -> str:  # type: ignore[override]
        """Field of the sensor in a suite."""
        return self.sensor


class PositionJump(DirectedFault):
    """Sudden displacement of the vehicle at the onset of the fault, without any acceleration.

    No real vehicle jumps, but its surroundings may not be where its filter assumes them: a
    reference station or a map was moved, or the vehicle was carried while its IMU was off. The
    fault tests whether a filter recovers. `GnssJump` moves only the measurements. The default sizes
    exceed the bounds of `Hover`, 1.6 m; use `out_of_bounds=3.0` with that environment.
    """

    size: Size = (1.0, 2.0)
    """length of the displacement [m]"""


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

    def __post_init__(self) -> None:
        super().__post_init__()
        if ends(self.share)[1] > 1.0:
            self._refuse("share", "be at most 1")
        if self.rotor is not None and self.rotor > 3:
            self._refuse("rotor", "be 0, 1, 2 or 3")

    @property
    def numbers(self) -> dict[str, Any]:
        """Lost fraction as the size, and the range from which the rotor is drawn."""
        pick = (0.0, 1.0) if self.rotor is None else ((self.rotor + 0.5) / 4.0, 0.0)
        return {"size": self.share, "fault_pick": pick}

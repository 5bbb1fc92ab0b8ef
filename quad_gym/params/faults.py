"""Faults: what sensors and rotors suffer in the field, and when; frozen parameters with sources.

Every environment and `FlightBatch` take `faults=`: one fault, several, or the names of presets. ::

    import gymnasium
    from quad_gym import FlightBatch
    from quad_gym.params.faults import CameraOcclusion, GnssOutage, GnssOutliers, WrongAssociations

    gymnasium.make("QuadGym/Circle-v0", sensors="rtk", faults="gnss_outage")
    gymnasium.make("QuadGym/Circle-v0", sensors="rtk", faults="gnss_outliers+rotor_loss")
    FlightBatch(1000, sensors="rtk", faults=(
        GnssOutage(start=20.0, duration=60.0),           # scheduled
        CameraOcclusion(start=(18.0, 20.0), duration=62.0),  # from some instant between
        GnssOutliers(share=0.05, size=(10.0, 100.0)),    # all the time
        WrongAssociations(rate=0.1, duration=1.0),       # now and then: a Poisson process
    ))

Which faults are active is told by `info["faults"]` (name: True or False), by
`FlightBatch.active_faults()`, and by the fields of a flight's record, such as "fault_active",
"outlier" and "feature_mistaken", for `FlightBatch.read`. Neither filter nor controller knows.
"""

import math
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np

from quad_gym.params import checks as check
from quad_gym.params.checks import Checked, Vector
from quad_gym.params.portable import norm
from quad_gym.params.sensors import SensorSuite
from quad_gym.records import FaultKind

__all__ = [
    "AccelBiasStep",
    "BaselineLoss",
    "CameraOcclusion",
    "Fault",
    "GnssJump",
    "GnssOutage",
    "GnssOutliers",
    "GnssRamp",
    "GyroBiasStep",
    "ImuSaturation",
    "PositionJump",
    "RotorLoss",
    "WrongAssociations",
    "ends",
]

_SENSORS = {"gnss": "GNSS", "camera": "a camera"}

Span = float | tuple[float, float]
"""A number, or the ends of a range from which it is drawn uniformly each time a fault comes."""


def ends(value: Span) -> tuple[float, float]:
    """Both ends of a range; of a number, twice the number."""
    return value if isinstance(value, tuple) else (value, value)


def _span(name: str, value: Any, *, least: float = 0.0, open_end: bool = False) -> Span:
    """`value` as a finite number of at least `least`, or as a range (low, high) of such."""
    if isinstance(value, (tuple, list, np.ndarray)):
        if len(value) != 2:
            raise ValueError(f"{name} must be a number or (low, high), got {value!r}")
        low, high = (check.number(name, end, least=least, open_end=open_end) for end in value)
        if low > high:
            raise ValueError(f"{name} must be (low, high) in this order, got {value!r}")
        return low, high
    return check.number(name, value, least=least, open_end=open_end)


def _share(name: str, value: Any) -> float:
    """`value` as a number above 0 and up to 1."""
    share = check.positive(name, value)
    if share > 1.0:
        raise ValueError(f"{name} must be at most 1, got {value!r}")
    return share


@dataclass(frozen=True, kw_only=True)
class Fault(Checked):
    """When a fault comes and goes; what it is, the kinds of faults below say.

    By default it lasts from the start of an episode to its end. All that is random is drawn inside
    the kernels, from each flight's own stream. A flight has one fault of each kind, which may come
    again and again (`rate`).
    """

    start: Span = 0.0
    """when it comes, since the start of the episode [s]"""
    duration: Span = math.inf
    """how long it stays [s]"""
    rate: float = 0.0
    """how often it comes while it is not there, in place of `start`: at random, as a Poisson
    process [1/s]; 0: once, at `start`"""
    probability: float = 1.0
    """share of episodes in which it can come at all"""

    kind: ClassVar[FaultKind]
    needs: ClassVar[str] = ""
    """the part of a sensor suite that it concerns"""

    def __post_init__(self) -> None:
        if type(self) is Fault:
            raise ValueError("faults must be of a kind, such as GnssOutage, got a bare Fault")
        self._check(_span, "start")
        if not (isinstance(self.duration, float) and self.duration == math.inf):
            self._check(_span, "duration", open_end=True)
        self._check(check.number, "rate", least=0.0)
        self._check(_share, "probability")
        if self.rate > 0.0 and self.start != 0.0:
            raise ValueError(
                f"{type(self).__name__} takes start or rate, not both, got start={self.start} and "
                f"rate={self.rate}"
            )

    @property
    def name(self) -> str:
        """As `info["faults"]` calls it."""
        return self.kind.name.lower()

    def check_suite(self, sensors: SensorSuite) -> None:
        """Refuse a sensor suite that lacks what the fault concerns.

        Raises:
            ValueError: If it does.
        """
        if self.needs and getattr(sensors, self.needs) is None:
            raise ValueError(
                f"faults must concern sensors that there are: {type(self).__name__} needs "
                f"{_SENSORS[self.needs]}, which this sensor suite does not have"
            )


@dataclass(frozen=True, kw_only=True)
class _Directed(Fault):
    """A fault with a direction, drawn uniformly from all directions unless it is given."""

    direction: Vector | None = None
    """(3,) along which it lies, of any length; None: drawn each time it comes"""

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.direction is not None:
            self._check(check.vector, "direction", length=3)
            if not any(self.direction):
                raise ValueError(f"{type(self).__name__}.direction must not be zero")

    @property
    def unit(self) -> np.ndarray:
        """(3,) the given direction as a unit vector; zeros: drawn."""
        given = np.zeros(3) if self.direction is None else np.array(self.direction)
        return given / (norm(given) or 1.0)


# ---- GNSS --------------------------------------------------------------------------------------


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
        self._check(_share, "share")
        self._check(_span, "size", open_end=True)


@dataclass(frozen=True, kw_only=True)
class GnssRamp(_Directed):
    """Positions that drift away steadily, and jump back when the fault goes; velocities stay valid.

    As a spoofer drags a vehicle along, slowly enough not to be noticed: A. J. Kerns, D. P. Shepard,
    J. A. Bhatti and T. E. Humphreys, J. Field Robotics 31(4), 2014. No gate on single innovations
    finds a ramp that is slow enough.
    """

    speed: Span = (0.1, 0.5)
    """[m/s]"""

    kind = FaultKind.GNSS_RAMP
    needs = "gnss"

    def __post_init__(self) -> None:
        super().__post_init__()
        self._check(_span, "speed", open_end=True)


@dataclass(frozen=True, kw_only=True)
class GnssJump(_Directed):
    """Positions that are off by a constant, as when carrier-phase ambiguities are fixed wrongly.

    Then the offset is some multiples of the carrier's wavelength, 0.19 m on L1.
    """

    size: Span = (0.19, 0.95)
    """[m]; one to five wavelengths"""

    kind = FaultKind.GNSS_JUMP
    needs = "gnss"

    def __post_init__(self) -> None:
        super().__post_init__()
        self._check(_span, "size", open_end=True)


@dataclass(frozen=True, kw_only=True)
class BaselineLoss(Fault):
    """No baseline, while positions go on, as when the secondary antenna is shaded."""

    kind = FaultKind.BASELINE_LOSS
    needs = "gnss"


# ---- camera ------------------------------------------------------------------------------------


@dataclass(frozen=True, kw_only=True)
class CameraOcclusion(Fault):
    """Features that the camera does not see: something is in the way, or the image is dark."""

    share: float = 1.0
    """of features, each hidden with this probability as long as the fault stays; 1: all"""

    kind = FaultKind.CAMERA_OCCLUSION
    needs = "camera"

    def __post_init__(self) -> None:
        super().__post_init__()
        self._check(_share, "share")


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
        self._check(_share, "share")
        self._check(check.choice, "how", choices=("swap", "copy"))

    def check_suite(self, sensors: SensorSuite) -> None:
        """Refuse a suite without a camera, or with a single feature."""
        super().check_suite(sensors)
        if sensors.camera is not None and len(sensors.camera.features_I) < 2:
            raise ValueError(
                "faults must concern sensors that there are: WrongAssociations needs a camera that "
                "knows at least two features"
            )


# ---- IMU ---------------------------------------------------------------------------------------


@dataclass(frozen=True, kw_only=True)
class AccelBiasStep(_Directed):
    """A step of the accelerometer's true bias, in addition to its slow wandering; B axes.

    Consumer parts are off by up to 50 milli-g (TDK ICM-20948 data sheet); a knock or a change of
    temperature moves them by some of that, our judgment.
    """

    size: Span = (0.05, 0.2)
    """[m/s^2]"""

    kind = FaultKind.ACCEL_BIAS_STEP

    def __post_init__(self) -> None:
        super().__post_init__()
        self._check(_span, "size", open_end=True)


@dataclass(frozen=True, kw_only=True)
class GyroBiasStep(_Directed):
    """A step of the gyro's true bias, likewise.

    Consumer parts are off by up to 5 deg/s (TDK ICM-20948 data sheet); some tenths of that, our
    judgment.
    """

    size: Span = (math.radians(0.2), math.radians(1.0))
    """[rad/s]"""

    kind = FaultKind.GYRO_BIAS_STEP

    def __post_init__(self) -> None:
        super().__post_init__()
        self._check(_span, "size", open_end=True)


@dataclass(frozen=True, kw_only=True)
class ImuSaturation(Fault):
    """Samples end at the IMU's ranges; the default is the smallest of a consumer part.

    TDK ICM-20948 data sheet: 2, 4, 8 or 16 g; 250, 500, 1000 or 2000 deg/s. The gyro's reading that
    the inner loops use saturates, too.
    """

    accel_range: float = 2.0 * 9.80665
    """per axis [m/s^2]"""
    gyro_range: float = math.radians(250.0)
    """per axis [rad/s]"""

    kind = FaultKind.IMU_SATURATION

    def __post_init__(self) -> None:
        super().__post_init__()
        self._check(check.positive, "accel_range", "gyro_range")


# ---- the vehicle -------------------------------------------------------------------------------


@dataclass(frozen=True, kw_only=True)
class PositionJump(_Directed):
    """The vehicle itself is displaced at once, unfelt by the IMU; it happens when the fault comes.

    No real vehicle jumps, but its filter may find that the world is not where it was: a reference
    station or a map that was moved, a vehicle carried while its IMU was off. It is the trial of a
    filter's way back. A jump of the measurements alone is `GnssJump`.
    """

    size: Span = (1.0, 2.0)
    """[m]"""

    kind = FaultKind.POSITION_JUMP

    def __post_init__(self) -> None:
        super().__post_init__()
        self._check(_span, "size", open_end=True)


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
        self._check(_span, "share", open_end=True)
        if ends(self.share)[1] > 1.0:
            raise ValueError(f"RotorLoss.share must be at most 1, got {self.share}")
        if self.rotor is not None:
            self._check(check.whole, "rotor", least=0)
            if self.rotor > 3:
                raise ValueError(f"RotorLoss.rotor must be 0, 1, 2 or 3, got {self.rotor}")

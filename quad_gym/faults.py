"""Faults of sensors and rotors, with their schedules: frozen parameters with sources.

All environments and `FlightBatch` take `faults=`: a fault, several, or names of presets. ::

    import gymnasium
    from quad_gym import FlightBatch
    from quad_gym.faults import CameraOcclusion, GnssOutage, GnssOutliers, WrongAssociations

    gymnasium.make("QuadGym/Circle-v0", sensors="rtk", faults="gnss_outage")
    gymnasium.make("QuadGym/Circle-v0", sensors="rtk", faults="gnss_outliers+rotor_loss")
    FlightBatch(1000, sensors="rtk", faults=(
        GnssOutage(start=20.0, duration=60.0),           # scheduled
        CameraOcclusion(start=(18.0, 20.0), duration=62.0),  # from a random instant on
        GnssOutliers(share=0.05, size=(10.0, 100.0)),    # all the time
        WrongAssociations(rate=0.1, duration=1.0),       # now and then: a Poisson process
    ))

The active faults are in `info["faults"]` (name: True or False), in `FlightBatch.active_faults()`,
and in fields of a flight's record for `FlightBatch.record`, such as "fault_active", "outlier" and
"feature_mistaken". They are hidden from filter and controller.
"""

import math
import re
from collections.abc import Iterable
from functools import partial
from typing import Annotated, Any, ClassVar, Literal

import numpy as np
from numpy.typing import NDArray

from quad_gym.params import checks as check
from quad_gym.params.checks import Checked
from quad_gym.params.portable import norm
from quad_gym.params.sensor_table import AID_PARAMS, in_words
from quad_gym.params.suites import SensorSuite
from quad_gym.records import FAULT_KINDS, Aid, FaultKind, FieldFault

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
    "MagnetometerDisturbance",
    "PositionJump",
    "RotorLoss",
    "SensorLoss",
    "Span",
    "WrongAssociations",
    "ends",
]


# --------------------------------------------------------------------------------------------------
# The base of all faults: start, duration and rate, sizes and directions.
# --------------------------------------------------------------------------------------------------

Span = float | tuple[float, float]
"""A number, or a range (low, high) from which it is drawn uniformly at each onset of a fault."""


def ends(value: Span) -> tuple[float, float]:
    """Return both ends of a range; for a number, the number twice."""
    return value if isinstance(value, tuple) else (value, value)


def span(name: str, value: Any, *, open_end: bool = False) -> Span:
    """Return `value` as a finite number of at least 0, or as a range (low, high)."""
    if not isinstance(value, (tuple, list, np.ndarray)):
        return check.number(name, value, least=0.0, open_end=open_end)
    if len(value) != 2:
        raise ValueError(f"{name} must be a number or (low, high), got {value!r}")
    low, high = (check.number(name, end, least=0.0, open_end=open_end) for end in value)
    if low > high:
        raise ValueError(f"{name} must be (low, high) in this order, got {value!r}")
    return low, high


def _duration(name: str, value: Any) -> Span:
    """Return `value` as a number above 0, which may be infinite, or as a range of such numbers."""
    endless = isinstance(value, float) and value == math.inf
    return value if endless else span(name, value, open_end=True)


def _angle_span(name: str, value: Any) -> Span:
    """Return `value` as an angle above 0, or as a range of such angles, of at most a turn [rad]."""
    found = span(name, value, open_end=True)
    for end in found if isinstance(found, tuple) else (found,):
        check.angle(name, end)
    return found


Size = Annotated[Span, partial(span, open_end=True)]
Angle = Annotated[Span, _angle_span]


class Fault(Checked):
    """Schedule of a fault; its subclasses are the kinds of faults.

    By default, a fault lasts from the start of an episode to its end. All random quantities are
    drawn inside the kernels, from each flight's own stream. A flight has at most one fault of each
    kind, which may recur (`rate`).
    """

    start: Annotated[Span, span] = 0.0
    """time of onset since the start of the episode [s]; a range: drawn uniformly"""
    duration: Annotated[Span, _duration] = math.inf
    """time from onset to end [s]; a range: drawn uniformly at each onset"""
    rate: check.NonNegative = 0.0
    """rate of onset while inactive, in place of `start`: a Poisson process [1/s]; 0: a single onset
    at `start`"""
    probability: check.UpToOne = 1.0
    """probability that the fault can occur in an episode"""

    kind: ClassVar[FaultKind]
    needs: ClassVar[str] = ""
    """field of the sensor suite that the fault concerns"""

    def __init_subclass__(cls) -> None:
        """Set the kind: the one with the name of the class."""
        super().__init_subclass__()
        name = re.sub("(?<=[a-z])(?=[A-Z])", "_", cls.__name__).upper()
        if name in FaultKind.__members__:
            cls.kind = FaultKind[name]

    def __post_init__(self) -> None:
        if type(self) is Fault:
            raise ValueError("faults must be of a kind, such as GnssOutage, got a bare Fault")
        super().__post_init__()
        if self.rate > 0.0 and self.start != 0.0:
            raise ValueError(
                f"{type(self).__name__} takes start or rate, not both, got start={self.start} and "
                f"rate={self.rate}"
            )

    @property
    def name(self) -> str:
        """Name of the fault in `info["faults"]`."""
        return self.kind.name.lower()

    @property
    def numbers(self) -> dict[str, Any]:
        """Numbers that the kernels read of a fault, in addition to its times.

        "share", "size" (a Span) and "direction" have their own places for each kind; any other name
        is a field of the settings record.
        """
        return {name: getattr(self, name) for name in ("share", "size") if hasattr(self, name)}

    def check_suite(self, sensors: SensorSuite) -> None:
        """Refuse a sensor suite that lacks the sensor of the fault."""
        if self.needs and getattr(sensors, self.needs) is None:
            raise ValueError(
                f"faults must concern sensors of the suite: {type(self).__name__} needs "
                f"{in_words(self.needs)}, which this sensor suite does not have"
            )


class DirectedFault(Fault):
    """A fault with a size and a direction, drawn uniformly from all directions by default."""

    direction: check.Vector3 | None = None
    """(3,) direction of the fault, of any length; None: drawn at each onset"""

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.direction is not None and not any(self.direction):
            raise ValueError(f"{type(self).__name__}.direction must not be zero")

    @property
    def numbers(self) -> dict[str, Any]:
        """Size, and direction (3,) as a unit vector; zeros: drawn."""
        given = np.zeros(3) if self.direction is None else np.array(self.direction)
        return super().numbers | {"direction": given / (norm(given) or 1.0)}


# --------------------------------------------------------------------------------------------------
# Kinds of faults: of sensors, one by one, and of the vehicle.
# --------------------------------------------------------------------------------------------------


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
        if sensors.blocks_of("pixels") < 2:
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


_AIDS = tuple(aid.name.lower() for aid in Aid)
"""Names of the sensors that can be lost."""


class SensorLoss(Fault):
    """Loss of all measurements of an aiding sensor, as during a bus failure.

    A magnetometer is also lost while an autopilot rejects it near iron.
    """

    sensor: Annotated[str, partial(check.choice, choices=_AIDS)]
    """name of the lost sensor, such as "barometer\""""

    @property
    def kind(self) -> FaultKind:  # type: ignore[override]
        """Kind of the fault, such as BAROMETER_LOSS."""
        return FaultKind[f"{self.sensor.upper()}_LOSS"]

    @property
    def needs(self) -> str:  # type: ignore[override]
        """Field of the sensor in a suite."""
        return self.sensor


class MagnetometerDisturbance(DirectedFault):
    """A wrong compass: turned about body z, near iron, or frozen at one reading.

    Wrong orientations in an autopilot's parameters, iron and currents near the sensor, and drivers
    that repeat the last reading are usual in logs of hobby vehicles. PX4's checks before a flight
    refuse compasses that are inconsistent or in a field of the wrong strength for these reasons.
    """

    how: Literal["turned", "iron", "frozen"] = "turned"
    """form of the disturbance: "turned" by an `angle` about body z, to either side; "iron", a
    constant field in B with the strength `iron`; "frozen", which repeats the last reading"""
    angle: Angle = (math.radians(30.0), math.radians(180.0))
    """angle, with "turned" [rad]; the orientations in an autopilot's parameters are multiples of 45
    degrees"""
    iron: Size = (10e-6, 40e-6)
    """strength of the added field, with "iron" [T]; engineering judgment: a fraction of the Earth's
    field of 25e-6 to 65e-6 T"""

    needs = "magnetometer"

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.direction is not None and self.how != "iron":
            self._refuse("direction", 'be given with how="iron" only')

    @property
    def numbers(self) -> dict[str, Any]:
        """Angle or strength as the size, direction, and the form."""
        size = self.iron if self.how == "iron" else self.angle
        kind = FieldFault[self.how.upper()]
        return super().numbers | {"size": size, "fault_field": int(kind)}


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


# --------------------------------------------------------------------------------------------------
# Faults by name, and the values of the keyword `faults`.
# --------------------------------------------------------------------------------------------------

FaultsGiven = str | Fault | Iterable[str | Fault] | None
"""A fault, the name of a preset or several joined by "+", several of both, or None."""

_SOON = (2.0, 5.0)
"""Times [s] at which vehicles have left the ground and most of an episode lies ahead."""
_A_WHILE = (2.0, 5.0)
"""Some seconds [s]: a bridge, a tree, a shadow; our judgment, for episodes of 10 s."""

PRESETS: dict[str, tuple[Fault, ...]] = {
    "none": (),
    "gnss_outage": (GnssOutage(start=_SOON, duration=_A_WHILE),),
    "gnss_outliers": (GnssOutliers(),),
    "gnss_ramp": (GnssRamp(start=_SOON),),
    "gnss_jump": (GnssJump(start=_SOON, duration=_A_WHILE),),
    "baseline_loss": (BaselineLoss(start=_SOON, duration=_A_WHILE),),
    "position_jump": (PositionJump(start=_SOON),),
    "camera_occlusion": (CameraOcclusion(start=_SOON, duration=_A_WHILE),),
    "wrong_associations": (WrongAssociations(),),
    "imu_bias_step": (AccelBiasStep(start=_SOON), GyroBiasStep(start=_SOON)),
    "imu_saturation": (ImuSaturation(),),
    "rotor_loss": (RotorLoss(start=_SOON),),
    **{
        f"{sensor}_loss": (SensorLoss(sensor=sensor, start=_SOON, duration=_A_WHILE),)
        for sensor in AID_PARAMS
    },
    "magnetometer_disturbance": (MagnetometerDisturbance(start=_SOON, duration=_A_WHILE),),
}
"""Presets of faults by name, for episodes of ten seconds and more."""

ALL = "all"  #: name of all presets that a sensor suite can have


def faults_of(given: FaultsGiven, sensors: SensorSuite) -> tuple[Fault, ...]:
    """Return the faults that the keyword `faults` selects, in the order of `FaultKind`.

    "all" stands for every preset that the suite can have. At most one fault of each kind is
    accepted, and only faults of sensors in the suite.
    """
    given = () if given is None else (given,) if isinstance(given, (str, Fault)) else given
    if not isinstance(given, Iterable):
        raise ValueError(f"faults must be faults or names of presets, got {given!r}")
    found: list[Fault | None] = [None] * FAULT_KINDS
    for part in given:
        for fault in _named(part, sensors) if isinstance(part, str) else (part,):
            if not isinstance(fault, Fault):
                raise ValueError(f"faults must be faults or names of presets, got {fault!r}")
            if found[fault.kind] is not None:
                raise ValueError(
                    f"faults must contain one of each kind, got two {type(fault).__name__}; a "
                    "fault that recurs has a rate"
                )
            fault.check_suite(sensors)
            found[fault.kind] = fault
    return tuple(fault for fault in found if fault is not None)


def needs_sensors(fault: Fault) -> bool:
    """Return True for a fault of measurements, without effect where no sensors run."""
    return not isinstance(fault, (PositionJump, RotorLoss))


def felt_without_sensors(given: FaultsGiven, sensors: SensorSuite) -> tuple[Fault, ...]:
    """Return the faults that affect the vehicle itself, and thus also control on the truth."""
    return tuple(fault for fault in faults_of(given, sensors) if not needs_sensors(fault))


def _named(names: str, sensors: SensorSuite) -> Iterable[Fault]:
    """Yield the faults of presets joined by "+"."""
    for name in names.split("+"):
        if name == ALL:
            everything = (fault for preset in PRESETS.values() for fault in preset)
            yield from (fault for fault in everything if possible(fault, sensors))
        else:
            yield from PRESETS[check.choice("faults", name, (*PRESETS, ALL))]


def possible(faults: Any, sensors: SensorSuite) -> bool:
    """True if a sensor suite has the sensors that some faults need."""
    try:
        faults_of(faults, sensors)
    except ValueError:
        return False
    return True


def named_faults(faults: Iterable[Fault], bits: NDArray[Any]) -> dict[str, NDArray[np.bool_]]:
    """Return which faults are active, by name, from sums (...,) of 2^FaultKind."""
    whole = bits.astype(np.int64)
    return {fault.name: (whole >> fault.kind) % 2 > 0 for fault in faults}

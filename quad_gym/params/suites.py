"""Sensor suites: IMU, GNSS, camera, aiding sensors and the filter that fuses them, by name.

| name | GNSS | camera and features | IMU |
|---|---|---|---|
| `standard` | as `lab` | as `lab` | as `lab`, but samples are means over the tick |
| `lab` | RTK, two antennas, every tick | every tick, two points at the origin | the report's |
| `rtk` | RTK, two antennas, 10 Hz | 25 Hz, twelve markers on the ground | industrial MEMS |
| `consumer` | single frequency, one antenna, 10 Hz; barometer, magnetometer | none | cheap MEMS |
| `indoor` | none: starts from a mark | 25 Hz, sixteen markers on the walls | good MEMS |
| `one_wall` | none: starts from a mark | 25 Hz, eight markers on one wall | cheap MEMS |
| `stale` | as `rtk`, 120 ms late, uncompensated | as `rtk`, 10 ms late, uncompensated | as `rtk` |
| `crazyflie` | none: starts from a mark; optical flow, range finder | none | as `indoor` |
| `uwb` | none: starts from a mark; ranges to four anchors | none | as `indoor` |
| `mocap` | positions and heading by motion capture, 50 Hz | none | as a Crazyflie's in flight |
| `field` | as `consumer`, with noise and delay of a real flight | none | noise of that flight |

`one_wall` and `stale` were made for `QuadGym/LookAround-v0` and `QuadGym/StaleRace-v0`: markers in
one direction only, and a filter that ignores time stamps. They, `crazyflie`, `uwb`, `mocap` and
`field` are not among SUITES, on which results for all tasks are based.

The IMU runs at 200 Hz, so cameras of 30 Hz run at 25 Hz, which divides that rate. Except in `lab`,
the phases of GNSS and camera are drawn in each episode, the fix that starts the filter is used
once, and an innovation gate with a false alarm probability of 1e-4 protects the filter.

`rtk`, `consumer` and `indoor` also have sensor errors besides noise and bias: delays, accelerometer
axes that are not quite orthogonal, vibration of the rotors, constant heading errors, motion blur
and a limited range of the camera. Gyros have no error of scale or alignment by default: in a turn
this is a bias proportional to the rate, for which a filter of 15 states has no state
(docs/sensors-and-filter.md explains the effect).

The noise of `observation="noisy"` is as large as the filter's errors with each suite. Except in
`lab`, it is the root mean square error of the estimate per axis from 20 s to 30 s after the start,
in 256 flights of the circle under control on the estimate (hovering start, tuned PD control, seeds
5000 to 5255); for the body rates, it is the noise of the gyro with the error of its estimated bias.
"""

import math
from dataclasses import field
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np

from quad_gym.params import checks as check
from quad_gym.params import portable
from quad_gym.params.aids import AidParams
from quad_gym.params.barometer import BarometerParams
from quad_gym.params.camera import CameraParams
from quad_gym.params.checks import Checked
from quad_gym.params.files import Saved, is_params_file, read_params
from quad_gym.params.filter import FilterParams
from quad_gym.params.gnss import GnssParams
from quad_gym.params.imu import ImuParams
from quad_gym.params.magnetometer import MICROTESLA, MagnetometerParams
from quad_gym.params.optical_flow import OpticalFlowParams
from quad_gym.params.range_finder import RangeFinderParams
from quad_gym.params.sensor_table import (
    READINGS,
    SENSOR_OF,
    SENSOR_PARAMS,
    SensorParams,
    SensorTable,
    in_words,
)
from quad_gym.params.uwb_range import UwbRangeParams
from quad_gym.records import ALLOWED_TOGETHER, FEATURE_BLOCKS, MAX_UNDER_WAY, Aid

# --------------------------------------------------------------------------------------------------
# A sensor suite: IMU, GNSS, camera, and the filter that fuses them.
#
# As everywhere in `params`: SI units, body frame B with x forward and z up along the thrust; the
# laboratory's numbers from the Aerial Robotics course (ASE 479W, The University of Texas at
# Austin).
# --------------------------------------------------------------------------------------------------

Delay = Annotated[float, check.between(-2.0, 2.0)]


class InitialPoseParams(Checked):
    """Accuracy of the initial position and heading where there is no GNSS to measure them.

    The vehicle is put down on a marked spot. The filter starts from the position of the spot and
    the heading of the vehicle, with these errors, and assumes that the vehicle is level. The
    heading of the spot is also used where the GNSS baseline lies within 12 degrees of the vertical,
    so that it hardly observes the heading, and with a single antenna and no magnetometer.
    """

    position_sigma: check.Positive = 0.05
    """standard deviation of the initial position, per axis [m]; a vehicle put on its mark by
    hand"""
    heading_sigma: check.AngleSize = 0.05
    """standard deviation of the initial heading [rad]; a vehicle lined up by eye, some 3 degrees"""


class NoisyObservationParams(Checked):
    """Standard deviations of the noise of `observation="noisy"`.

    They are as large as the errors of the converged filter. The defaults are for the laboratory's
    sensors; suites of other sensors have their own values.
    """

    position: check.NonNegative = 0.0018
    """standard deviation of the position, per axis [m]; measured on the laboratory's circle"""
    velocity: check.NonNegative = 0.012
    """standard deviation of the velocity, per axis [m/s]; measured on the laboratory's circle"""
    attitude: Annotated[float, check.between(0.0, math.pi)] = 0.006
    """standard deviation of the attitude, per axis [rad]; measured on the laboratory's circle"""
    body_rates: check.NonNegative = 0.0123
    """standard deviation of the body rates, per axis [rad/s]; the gyro's noise at 200 Hz"""


class LogDelays(Checked, more=dict.fromkeys(SENSOR_PARAMS, (Delay, 0.0))):
    """Times by which the stamps of a vehicle's logs are later than the measurements themselves.

    Autopilots often stamp a measurement when they receive it. A replay subtracts these delays; in
    simulated flights time stamps are exact. Each sensor of a suite has a field with its name, such
    as `barometer`, relative to the IMU [s].
    """

    if TYPE_CHECKING:  # of the fields that follow from the table

        def __init__(self, **sensors: float) -> None: ...

        def __getattr__(self, name: str) -> float: ...


def blocks_together(suite: "SensorSuite") -> int:
    """Return the number of blocks at an instant of all sensors; those of GNSS always have room."""
    others = (name for name in READINGS if SENSOR_OF[name] != "gnss")
    return FEATURE_BLOCKS + sum(map(suite.blocks_of, others))


def delay_ticks(name: str, latency: float, rate: float, imu_rate: float) -> int:
    """Return a latency [s] in ticks, with at most MAX_UNDER_WAY measurements in transit."""
    ticks, longest = round(latency * imu_rate), MAX_UNDER_WAY * check.ticks(name, rate, imu_rate)
    if ticks > longest:
        raise ValueError(
            f"{name} must be at most {MAX_UNDER_WAY} periods of the sensor, {longest / imu_rate:g} "
            f"s, got {latency:g} s"
        )
    return ticks


class SensorSuite(SensorTable, Saved):
    """All sensors of a vehicle and the filter that fuses them."""

    initial_pose: InitialPoseParams = field(default_factory=InitialPoseParams)
    """accuracy of the initial pose where GNSS does not measure it"""
    estimator: FilterParams = field(default_factory=FilterParams)
    """Kalman filter that fuses the measurements"""
    noisy: NoisyObservationParams = field(default_factory=NoisyObservationParams)
    """noise of `observation="noisy"`"""
    log_delays: LogDelays = field(default_factory=LogDelays)
    """delays of time stamps in this vehicle's logs, which a replay subtracts"""
    log_rotation: check.Angles3 = (0.0, 0.0, 0.0)
    """roll, pitch and yaw from the axes of the IMU in this vehicle's logs to B [rad], by which a
    replay rotates the samples; 3-1-2 Euler angles"""
    log_compass_rotation: check.Angles3 = (0.0, 0.0, 0.0)
    """the same of the magnetometer [rad]"""
    log_accel_bias: check.Vector3 = (0.0, 0.0, 0.0)
    """mean bias of the accelerometer in this vehicle's logs, in the axes of the IMU, which a replay
    subtracts [m/s^2]; the filter starts with what is left"""
    log_gyro_bias: check.Vector3 = (0.0, 0.0, 0.0)
    """mean bias of the gyro in this vehicle's logs [rad/s]"""

    def __post_init__(self) -> None:
        super().__post_init__()
        for sensor in self.sensors.values():
            label = type(sensor).__name__
            check.ticks(f"{label}.rate", sensor.rate, self.imu.rate)
            delay_ticks(f"{label}.latency", sensor.latency, sensor.rate, self.imu.rate)
        together = blocks_together(self)
        if together > ALLOWED_TOGETHER:
            raise ValueError(
                f"sensors must have at most {ALLOWED_TOGETHER - FEATURE_BLOCKS} camera features "
                "and measurements of other sensors at an instant, got "
                f"{together - FEATURE_BLOCKS}"
            )

    @property
    def sensors(self) -> dict[str, SensorParams]:
        """Parameters of the sensors in the suite, other than the IMU, by field."""
        found = {name: getattr(self, name) for name in SENSOR_PARAMS}
        return {name: params for name, params in found.items() if params is not None}

    @property
    def aids(self) -> dict[Aid, AidParams]:
        """Parameters of the aiding sensors in the suite."""
        found = {aid: getattr(self, aid.name.lower()) for aid in Aid}
        return {aid: params for aid, params in found.items() if params is not None}

    def blocks_of(self, reading: str) -> int:
        """Return the number of blocks that the suite measures of a reading; 0: none."""
        return self._counts[reading]

    @cached_property
    def _counts(self) -> dict[str, int]:
        """Numbers of blocks by reading."""
        found = dict.fromkeys(READINGS, 0)
        for name, sensor in self.sensors.items():
            readings = (reading.name for reading in sensor.readings(name))
            found |= zip(readings, sensor.measured_blocks, strict=True)
        return found

    def gives(self, reading: str) -> bool:
        """Return True if a reading is measured, or the mark of the start gives it in its place."""
        lacks = getattr(self, SENSOR_OF[reading]) is None
        return self.blocks_of(reading) > 0 or (lacks and READINGS[reading].marked)

    def shape_of(self, reading: str) -> tuple[int, ...]:
        """Return the shape of a reading: of a number, of a block, or of several."""
        kind, count = READINGS[reading], self.blocks_of(reading)
        return (count,) * (kind.most_blocks > 1) + (kind.length,) * (kind.length > 1)

    @property
    def heading_aid(self) -> Aid | None:
        """Aiding sensor that initializes the heading where no baseline does; None: none."""
        if self.gives("gnss_baseline"):
            return None
        return next((aid for aid, params in self.aids.items() if params.shows_heading), None)

    @property
    def heading_source(self) -> SensorParams | None:
        """Sensor that gives the heading of a filter's start; None: the mark of the start does."""
        aid = self.heading_aid
        if aid is not None:
            return self.aids[aid]
        others = (s for s in self.sensors.values() if not isinstance(s, AidParams))
        return next((sensor for sensor in others if sensor.first_heading is not None), None)

    @property
    def flow_alone(self) -> bool:
        """True if the filter keeps the heading unobservable: flow, but no positions."""
        measured = (reading for name, reading in READINGS.items() if self.blocks_of(name))
        places = any("position" in reading.observes for reading in measured)
        corrected = self.estimator.attitude_reset  # not the report's form
        return corrected and self.optical_flow is not None and not places

    @property
    def has_fixes(self) -> bool:
        """True if GNSS measures positions; a filter without them uses all features of images."""
        return self.blocks_of("gnss_position") > 0

    @property
    def heading_by_motion(self) -> int:
        """1 if the filter compares its heading with the motion, by GNSS velocities; 0: it does not.

        With a baseline or a camera, which measure the heading better, it is 2: the motion only
        shows a heading that is unknown. Without GNSS velocities or a gate it is 0.
        """
        gates = self.estimator.false_alarm_probability > 0.0
        if not gates or not self.blocks_of("gnss_velocity"):
            return 0
        directions = (name for name, reading in READINGS.items() if reading.direction)
        return 2 if any(map(self.blocks_of, directions)) else 1

    @property
    def drifts(self) -> bool:
        """True if positions have a time-correlated error, which the filter estimates."""
        return any(sensor.drift for sensor in self.sensors.values())

    def drift_after(self, time: float) -> tuple[float, ...]:
        """Return the standard deviations of this error a time [s] after it was zero [m]."""
        return tuple(s for sensor in self.sensors.values() for s in sensor.drift_after(time))

    @property
    def counted_as_noise(self) -> tuple[str, ...]:
        """Readings with a constant error that the filter models as white noise."""
        return tuple(name for sensor in self.sensors.values() for name in sensor.counted_as_noise)

    def require_filter(self) -> None:
        """Refuse a suite whose filter misinterprets the IMU samples, or would overflow."""
        for sensor in self.sensors.values():
            sensor.require_filter()
        if self.imu.samples == "average" and self.estimator.integration == "euler":
            raise ValueError(
                "sensors must have FilterParams.integration='midpoint' with ImuParams.samples="
                "'average': 'euler' uses a sample as the motion at the start of its tick"
            )

    def require_like(self, true_sensors: "SensorSuite") -> None:
        """Refuse true sensors with which a filter that assumes this suite cannot fly.

        Noise, biases, drift, latency, initial pose, mounting and feature positions may differ. The
        set of sensors, their schedules and their measured quantities must not: both sides share a
        clock and the measurements that the filter expects.
        """
        if true_sensors.imu.rate != self.imu.rate:
            raise ValueError("true_sensors must have the IMU rate of sensors, as it is the tick")
        if true_sensors.imu.samples != self.imu.samples:
            raise ValueError(
                "true_sensors must have the IMU samples of sensors, which order a tick: "
                f"{true_sensors.imu.samples!r} is not {self.imu.samples!r}"
            )
        for name in SENSOR_PARAMS:
            if (getattr(true_sensors, name) is None) != (getattr(self, name) is None):
                raise ValueError(f"true_sensors must have a {name} if sensors has, and only then")
        true = true_sensors._schedule
        for what, believed in self._schedule.items():
            if true[what] != believed:
                raise ValueError(
                    f"true_sensors must have the {what} of sensors, {believed}, got {true[what]}"
                )

    @property
    def _schedule(self) -> dict[str, object]:
        """Rates, phases and measured quantities of the sensors."""
        found: dict[str, object] = {}
        for name, sensor in self.sensors.items():
            word = in_words(name).removeprefix("a ")
            found |= {f"{word} rate [Hz]": sensor.rate, f"{word} phase": sensor.phase}
            for reading in sensor.readings(name):
                count = self.blocks_of(reading.name)
                found[f"number of {reading.block or reading.name} measurements"] = count
        return found

    def with_rates(self, *, imu: float | None = None, **sensors: float | None) -> "SensorSuite":
        """Return a copy whose sensors run at other rates [Hz]; None keeps a rate.

        A new IMU rate changes the tick: sensors that measured at every tick continue to do so.

        Raises:
            ValueError: If a rate is not positive or does not divide the IMU rate, or if the suite
                lacks the sensor whose rate is given.
        """
        check.keywords(sensors, ("imu", *SENSOR_PARAMS), "with_rates")
        imu_rate = self.imu.rate if imu is None else imu
        check.positive("imu_rate", imu_rate, least=1.0, most=1e6)
        rates = {name: rate for name, rate in sensors.items() if rate is not None}
        for name, rate in rates.items():
            if getattr(self, name) is None:
                lacking = f"{name}_rate must not be given without {in_words(name)}"
                raise ValueError(f"{lacking}, got {rate} Hz")
        changed = {}
        for name, sensor in self.sensors.items():
            follows = sensor.rate == self.imu.rate or imu_rate < sensor.rate
            rate = rates.get(name, imu_rate if follows else sensor.rate)
            check.ticks(f"{name}_rate", rate, imu_rate)
            changed[name] = sensor.replace(rate=rate)
        return self.replace(imu=self.imu.replace(rate=imu_rate), **changed)

    def simplified(self) -> "SensorSuite":
        """Return a copy with white noise, bias and drift only, and without delays.

        The difference shows the effect of latency, vibration, misalignment, constant heading
        errors, motion blur, range and ground on a flight. White noise stays as it is.
        """
        changed = {name: sensor.simplified() for name, sensor in self.sensors.items()}
        return self.replace(imu=self.imu.simplified(), **changed)

    def scaled_noise(self, factor: float) -> "SensorSuite":
        """Return a copy with all white noise multiplied by `factor`, for sensors and filter."""
        check.positive("factor", factor)
        changed = {name: sensor.scaled_noise(factor) for name, sensor in self.sensors.items()}
        return self.replace(imu=self.imu.scaled_noise(factor), **changed)


# --------------------------------------------------------------------------------------------------
# Sensor suites by name, with the source of every number.
# --------------------------------------------------------------------------------------------------

_MILLI_G = 9.80665e-3
_DEG_PER_HOUR = math.radians(1.0) / 3600.0

_GNSS_LATENCY = 0.1  #: [s]; PX4 assumes 0.11 s (EKF2_GPS_DELAY)
# time constants of MEMS biases, hundreds of seconds: N. El-Sheimy, H. Hou and X. Niu, IEEE Trans.
# Instrumentation and Measurement 57(1), 2008
_MEMS = ImuParams(samples="average", gyro_bias_tau=300.0, accel_bias_tau=300.0)
_CAMERA = CameraParams(
    rate=25.0,
    # markers are found within a pixel (S. Garrido-Jurado and others, Pattern Recognition 47(6),
    # 2014), a calibration of lens and mounting leaves one or two; our judgment
    pixel_sigma=2.5,
    # exposure, transfer and search for markers; typical of small computers, 30 to 60 ms
    latency=0.04,
    exposure=0.003,  # daylight, or a well-lit hall; our judgment
    max_range=13.0,  # where a marker of 0.2 m subtends 25 pixels; our judgment
    ground_hides=True,
    phase=None,
)

FIELD_FILTER = FilterParams(
    integration="midpoint",
    attitude_reset=True,
    bearing_noise_at="pinhole",
    initial_covariance_scale=1.0,
    initial_tilt_sigma=0.03,  # of vehicles that stand or hover at the start of an episode
    initial_velocity_variance=0.03**2,  # of the same vehicles
    reuse_first_fix=False,
    recursive_update_threshold=0.3,  # its square is a tenth of the noise
    false_alarm_probability=1e-4,
)
"""The filter of all suites except `lab`: consistent from its start, with an innovation gate."""


def _noise(
    position: float, velocity: float, attitude: float, body_rates: float
) -> NoisyObservationParams:
    """Return the measured noise of noisy observations, see above."""
    return NoisyObservationParams(
        position=position, velocity=velocity, attitude=attitude, body_rates=body_rates
    )


RTK = SensorSuite(
    imu=_MEMS.replace(
        # Analog Devices ADIS16470 data sheet: rate noise density 0.008 deg/s/sqrt(Hz), noise
        # density 100 ug/sqrt(Hz), in-run bias stability 8 deg/h and 13 ug
        gyro_noise_density=math.radians(0.008),
        accel_noise_density=0.1 * _MILLI_G,
        # what turning on and temperature leave of its factory calibration; our judgment, some ten
        # times the in-run stability of the gyro, and what a level on the ground leaves of the
        # accelerometer
        gyro_bias_sigma=80.0 * _DEG_PER_HOUR,
        accel_bias_sigma=2.0 * _MILLI_G,
        # what its factory calibration leaves, 0.1 % and 0.03 deg; our judgment
        accel_scale_sigma=0.001,
        accel_misalignment_sigma=0.0005,
        # balanced rotors, an isolated IMU, and its filters; our judgment
        accel_vibration=0.05,
        gyro_vibration=0.002,
    ),
    gnss=GnssParams(
        latency=_GNSS_LATENCY,
        rate=10.0,  # u-blox ZED-F9P data sheet: RTK up to 20 Hz, moving base up to 10 Hz
        # the same: 0.01 m + 1 ppm CEP, so sigma = 0.0085 m an axis at short range, twice that up
        position_sigma_I=(0.0085, 0.0085, 0.017),
        # the same: heading 0.4 deg with antennas 1 m apart, so 7 mm, on the laboratory's 0.19 m
        baseline_sigma=math.radians(0.4) / 0.19,
        # antennas' phase centers are unequal by some millimeters that depend on the direction of
        # satellites and hardly change in a flight, and mounted to a degree or so; our judgment
        heading_error_sigma=math.radians(0.5),
        velocity_sigma=0.05,  # the same
        phase=None,
    ),
    camera=_CAMERA.replace(
        # three rows of four markers on the ground of the flying field
        features_I=tuple((x, y, 0.0) for x in (-4.5, -1.5, 1.5, 4.5) for y in (-3.0, 0.0, 3.0))
    ),
    estimator=FIELD_FILTER,
    noisy=_noise(0.00135, 0.0032, 0.00021, 0.0028),
)
"""A survey vehicle: real-time kinematic GNSS with two antennas, and markers on the ground."""

CONSUMER = SensorSuite(
    imu=_MEMS.replace(
        # TDK InvenSense ICM-20948 data sheet: 0.015 deg/s/sqrt(Hz), 230 ug/sqrt(Hz), zero-g
        # tolerance +-50 mg on the board, taken for two sigma
        gyro_noise_density=math.radians(0.015),
        accel_noise_density=0.23 * _MILLI_G,
        accel_bias_sigma=25.0 * _MILLI_G,
        # what zeroing the gyro at rest before each flight leaves, 0.1 deg/s; our judgment
        gyro_bias_sigma=math.radians(0.1),
        # the same data sheet: scale +-0.5 %, taken for two sigma, and cross-axis sensitivity +-2 %,
        # of which a calibration in six orientations leaves a quarter; our judgment
        accel_scale_sigma=0.0025,
        accel_misalignment_sigma=0.005,
        # rotors that have not been balanced, an IMU on foam; our judgment
        accel_vibration=0.2,
        gyro_vibration=0.01,
    ),
    gnss=GnssParams(
        latency=_GNSS_LATENCY,
        rate=10.0,  # u-blox MAX-M10S data sheet: 10 Hz with four constellations
        # fixes scatter by decimeters from one to the next; our judgment
        position_sigma_I=(0.2, 0.2, 0.4),
        # the same data sheet: 1.5 m CEP, so sigma = 1.27 m an axis over a day; half of it within a
        # correlation time of a minute (D. L. Wilson's records of a hand-held receiver), the rest
        # slower than a flight and so the same at the place of the start
        drift_sigma_I=(0.6, 0.6, 1.0),
        drift_tau=60.0,
        velocity_sigma=0.05,  # the same data sheet: velocity accuracy 0.05 m/s
        # one antenna has no baseline: the magnetometer measures the heading
        primary_antenna_B=(0.0, 0.0, 0.0472),
        secondary_antenna_B=None,
        phase=None,
    ),
    camera=None,
    barometer=BarometerParams(rate=20.0),
    magnetometer=MagnetometerParams(
        rate=20.0,
        # iron near the motors, as far as a calibration by hand leaves it: 3.6 degrees of heading;
        # our judgment
        hard_iron_sigma=1.5 * MICROTESLA,
    ),
    estimator=FIELD_FILTER,  # with the GNSS drift among its states
    noisy=_noise(0.123, 0.024, 0.0040, 0.011),
)
"""A hobby vehicle: a single-frequency receiver, barometer, magnetometer, a cheap IMU, no camera."""


def _on_walls(distance: float, low: float, high: float) -> tuple[tuple[float, ...], ...]:
    """Sixteen markers around a square room, alternately low and high, evenly spread in azimuth."""
    points = []
    for k in range(16):
        azimuth = 2.0 * math.pi * (k + 0.5) / 16
        direction = np.array([portable.cos(azimuth), portable.sin(azimuth)])
        x, y = distance * direction / np.abs(direction).max()
        points.append((float(x), float(y), high if k % 2 else low))
    return tuple(points)


INDOOR = SensorSuite(
    imu=_MEMS.replace(
        # Bosch BMI088 data sheet: 0.014 deg/s/sqrt(Hz), 175 ug/sqrt(Hz), zero-g offset 20 mg
        gyro_noise_density=math.radians(0.014),
        accel_noise_density=0.175 * _MILLI_G,
        accel_bias_sigma=20.0 * _MILLI_G,
        # what zeroing at rest leaves; our judgment
        gyro_bias_sigma=math.radians(0.05),
        # typical of consumer MEMS, of the order of the ICM-20948's; our judgment
        accel_scale_sigma=0.0025,
        accel_misalignment_sigma=0.005,
        # the IMU withstands vibration well; our judgment
        accel_vibration=0.1,
        gyro_vibration=0.005,
    ),
    gnss=None,
    camera=_CAMERA.replace(
        attitude=(math.radians(90.0), 0.0, math.radians(90.0)),  # looking level ahead
        features_I=_on_walls(distance=8.0, low=0.5, high=3.0),  # a hall of 16 m by 16 m
    ),
    estimator=FIELD_FILTER,
    noisy=_noise(0.0077, 0.0128, 0.00056, 0.0061),
)
"""A hall without GNSS, with markers on all walls in the view of the camera."""


def _changed(suite: SensorSuite, **parts: dict[str, Any]) -> SensorSuite:
    """Return a suite with changed fields of its parts."""
    return suite.replace(**{n: getattr(suite, n).replace(**fields) for n, fields in parts.items()})


ONE_WALL = _changed(
    INDOOR.replace(imu=CONSUMER.imu),
    camera={
        "focal_length": 3325.0,  # 3840 pixels over 60 degrees: 1920 / tan(30 degrees)
        "features_I": tuple((-8.0, y, z) for y in (-3.0, -1.0, 1.0, 3.0) for z in (0.8, 2.8)),
    },
).replace(
    # as above, but of LookAround with PD control that faces the wall, 127 flights
    noisy=_noise(0.0079, 0.0139, 0.00089, 0.0107)
)
"""The suite of `LookAround`: `indoor` with a cheap IMU, a narrow camera, and markers on the west
wall. Without a marker the position is dead reckoning. Once its standard deviation exceeds a fifth
of the markers' distance, after some 3 s, the next image may leave an overconfident estimate: over
random trajectories under PD control, the NEES is 32 on average after 4 s, and 14.9 in the median
(15 expected)."""

STALE = _changed(
    RTK,
    # as of receivers of hobby vehicles: ArduPilot assumes 0.12 s of a u-blox M8, from flight logs,
    # and 0.22 s of a 6 (AP_GPS_UBLOX, get_lag). With 0.04, 0.12 and 0.2 s, PD control passes all
    # gates of StaleRace in 100, 99 and 90 % of 200 episodes, and a policy that was trained with
    # 0.04 s in 99, 46 and 2 %
    gnss={"latency": 0.12},
    camera={"latency": 0.01},
    estimator={"delay_compensation": "none"},
)
"""The suite of `StaleRace`: `rtk` with a filter that does not compensate delays."""

STANDARD = SensorSuite(
    imu=ImuParams(samples="average"),
    # the laboratory's pixels are coarse, so that images need be processed in steps after outages
    # alone, and no measurement of it is corrupted, so that none has to be rejected
    estimator=FIELD_FILTER.replace(false_alarm_probability=0.0),
    noisy=_noise(0.0020, 0.0150, 0.0011, 0.0124),
)
"""The environments' default: the laboratory's sensors with a consistent filter."""

CRAZYFLIE = SensorSuite(
    imu=INDOOR.imu,  # the BMI088 of the Crazyflie 2.1
    gnss=None,
    camera=None,
    # the Flow deck v2: PMW3901 and VL53L1X
    optical_flow=OpticalFlowParams(phase=None),
    range_finder=RangeFinderParams(phase=None),
    estimator=FIELD_FILTER,
    noisy=_noise(0.2, 0.08, 0.031, 0.0061),
)
"""A small vehicle indoors that navigates by optical flow and a range finder: nothing observes its
heading and horizontal position, whose errors grow."""

UWB = CRAZYFLIE.replace(
    # the Loco positioning deck in place of the Flow deck
    optical_flow=None,
    range_finder=None,
    uwb_range=UwbRangeParams(phase=None),
    noisy=_noise(0.040, 0.038, 0.0133, 0.0062),
)
"""A small vehicle indoors that measures its ranges to four anchors by ultra-wideband radio."""

MOCAP = SensorSuite(
    imu=INDOOR.imu.replace(
        # noise and biases that explain a flight of a Crazyflie 2.1 (S. I. Ullah and J. Baca,
        # NanoBench, arXiv:2603.09908, B3_figure8_fast_rep2), vibration among them
        accel_noise_density=0.03,
        gyro_noise_density=0.01,
        accel_bias_sigma=0.3,
        gyro_bias_sigma=0.015,
        accel_vibration=0.0,
        gyro_vibration=0.0,
    ),
    gnss=GnssParams(
        rate=50.0,  # systems capture at 100 Hz and more, and radios pass on some of it
        # capture, transfer and radio; our judgment. The flight above is explained by 0.1 s, which
        # is the offset of its clock as well
        latency=0.02,
        # two sets of markers, before and behind the center of mass of a small vehicle
        primary_antenna_B=(0.05, 0.0, 0.0),
        secondary_antenna_B=(-0.05, 0.0, 0.0),
        # markers are found to a millimeter, and time stamps jitter by some milliseconds at 1 m/s;
        # our judgment
        position_sigma_I=(0.005, 0.005, 0.005),
        baseline_sigma=0.02,  # attitudes of small bodies are right to a degree; our judgment
        phase=None,
    ),
    camera=None,
    estimator=FIELD_FILTER,
    noisy=_noise(0.0026, 0.0183, 0.0088, 0.142),
)
"""A laboratory with motion capture, which passes position and heading of a small vehicle."""

FIELD = _changed(
    CONSUMER,
    # noise that explains real flights of a small quadrotor: "quad122a" of P. Riseborough's
    # InertialNav (BSD-3-Clause), an ArduPilot vehicle with a disturbed compass, replayed with the
    # delays in its log. Roll and pitch differ by 1.1 degrees rms from the autopilot's estimate
    imu={"accel_noise_density": 0.1, "gyro_noise_density": 0.001, "accel_bias_sigma": 0.15},
    gnss={
        "rate": 5.0,
        "latency": 0.2,
        "position_sigma_I": (0.4, 0.4, 0.8),
        "drift_sigma_I": (1.5, 1.5, 2.2),
        "velocity_sigma": 0.3,
    },
    estimator={"initial_tilt_sigma": 0.05},
).replace(
    barometer=BarometerParams(rate=10.0, noise_sigma=0.2, bias_sigma=3.0),
    magnetometer=MagnetometerParams(
        rate=10.0,
        noise_sigma=1.5 * MICROTESLA,
        hard_iron_sigma=2.4 * MICROTESLA,
        hard_iron_tau=30.0,  # currents of the motors change
    ),
    noisy=_noise(0.572, 0.136, 0.0087, 0.0176),
)
"""A hobby vehicle as it flies: `consumer` with noise that explains the log of a real flight."""

_ALL = {
    "standard": STANDARD,
    "lab": SensorSuite(),
    "rtk": RTK,
    "consumer": CONSUMER,
    "indoor": INDOOR,
    "one_wall": ONE_WALL,
    "stale": STALE,
    "crazyflie": CRAZYFLIE,
    "uwb": UWB,
    "mocap": MOCAP,
    "field": FIELD,
}
ALL_SUITES = tuple(_ALL)  #: names of all sensor suites
SUITES = ALL_SUITES[:5]  #: names of the sensor suites for all tasks


def sensor_suite(name: str | Path) -> SensorSuite:
    """A built-in sensor suite, or the suite in a file.

    Args:
        name: One of ALL_SUITES, where "lab" is exactly the report's; or a file that ends with
            ".toml", as `SensorSuite.save` writes it, see `quad_gym.params.files`.

    Raises:
        ValueError: If there is no such suite, or a name or value in the file is invalid.
        OSError: If the file cannot be read.
    """
    if is_params_file(name):
        return read_params(
            Path(name), SensorSuite, lambda base: _ALL[check.choice("base", base, ALL_SUITES)]
        )
    if not isinstance(name, str) or name not in _ALL:
        raise ValueError(
            f"sensors must be one of {', '.join(ALL_SUITES)}, or a file of a suite (.toml), got "
            f"{name!r}{check.did_you_mean(name, ALL_SUITES)}"
        )
    return _ALL[name]


def given_suite(name: str, given: Any) -> SensorSuite:
    """Return a suite that is given as one or by its name, under the name of the argument."""
    suite = sensor_suite(given) if isinstance(given, str | Path) else given
    return check.instance(name, suite, SensorSuite)


def suite_label(name: str) -> str:
    """The name of a suite in titles and names of files: for a file, without folder and ending."""
    return Path(name).stem if is_params_file(name) else name


def contents_of_suite_files(*names: Any) -> dict[str, Any]:
    """Suites in files among the names, as an entry of a record of results: files may change."""
    found = {str(name): sensor_suite(name) for name in names if is_params_file(name)}
    return {"suite_files": found} if found else {}

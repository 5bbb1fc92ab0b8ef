"""A sensor suite: IMU, GNSS, camera, and the filter that fuses them.

As everywhere in `params`: SI units, body frame B with x forward and z up along the thrust; the
laboratory's numbers from the Aerial Robotics course (ASE 479W, The University of Texas at Austin).
"""

from dataclasses import field
from typing import TYPE_CHECKING, Annotated

from quad_gym.params import checks as check
from quad_gym.params.aid_table import AID_PARAMS, AidTable
from quad_gym.params.aids import AidParams
from quad_gym.params.camera import CameraParams
from quad_gym.params.checked import Checked
from quad_gym.params.filter import FilterParams
from quad_gym.params.gnss import GnssParams
from quad_gym.params.imu import ImuParams
from quad_gym.params.suite_files import Saved
from quad_gym.records import FEATURE_BLOCKS, MAX_TOGETHER, MAX_UNDER_WAY, Aid

SensorParams = GnssParams | CameraParams | AidParams  #: parameters of a sensor other than the IMU

SENSOR_PARAMS: dict[str, type[SensorParams]] = {
    "gnss": GnssParams,
    "camera": CameraParams,
    **AID_PARAMS,
}
"""Parameters of all sensors but the IMU by their fields in `SensorSuite`."""

Delay = Annotated[float, check.between(-2.0, 2.0)]
_WORDS = {"gnss": "GNSS"}  #: sensors in messages, where the name of the field is none


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
    heading_sigma: check.Positive = 0.05
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
    attitude: check.NonNegative = 0.006
    """standard deviation of the attitude, per axis [rad]; measured on the laboratory's circle"""
    body_rates: check.NonNegative = 0.0123
    """standard deviation of the body rates, per axis [rad/s]; the gyro's noise at 200 Hz"""


class LogDelays(Checked, more=dict.fromkeys(AID_PARAMS, (Delay, 0.0))):
    """Times by which the stamps of a vehicle's logs are later than the measurements themselves.

    Autopilots often stamp a measurement when they receive it. A replay subtracts these delays; in
    simulated flights time stamps are exact. Each other sensor of a suite has a field with its name,
    such as `barometer` [s].
    """

    gnss: Delay = 0.0
    """of GNSS, relative to the IMU [s]"""
    camera: Delay = 0.0
    """of images [s]"""

    if TYPE_CHECKING:  # of the fields that follow from the table

        def __init__(self, *, gnss: float = 0.0, camera: float = 0.0, **aids: float) -> None: ...

        def __getattr__(self, name: str) -> float: ...


def delay_ticks(name: str, latency: float, rate: float, imu_rate: float) -> int:
    """Return a latency [s] in ticks, with at most MAX_UNDER_WAY measurements in transit."""
    ticks, longest = round(latency * imu_rate), MAX_UNDER_WAY * check.ticks(name, rate, imu_rate)
    if ticks > longest:
        raise ValueError(
            f"{name} must be at most {MAX_UNDER_WAY} periods of the sensor, {longest / imu_rate:g} "
            f"s, got {latency:g} s"
        )
    return ticks


class MainSensors(Checked):
    """IMU, GNSS and camera."""

    imu: ImuParams = field(default_factory=ImuParams)
    """IMU, whose samples are the ticks of the simulation"""
    gnss: GnssParams | None = field(default_factory=GnssParams)
    """GNSS; None: no GNSS, and the filter starts from `initial_pose`"""
    camera: CameraParams | None = field(default_factory=CameraParams)
    """camera; None: no camera"""


class SensorSuite(AidTable, MainSensors, Saved):
    """All sensors of a vehicle and the filter that fuses them."""

    initial_pose: InitialPoseParams = field(default_factory=InitialPoseParams)
    """accuracy of the initial pose where GNSS does not measure it"""
    estimator: FilterParams = field(default_factory=FilterParams)
    """Kalman filter that fuses the measurements"""
    noisy: NoisyObservationParams = field(default_factory=NoisyObservationParams)
    """noise of `observation="noisy"`"""
    log_delays: LogDelays = field(default_factory=LogDelays)
    """delays of time stamps in this vehicle's logs, which a replay subtracts"""
    log_rotation: check.Vector3 = (0.0, 0.0, 0.0)
    """roll, pitch and yaw from the axes of the IMU in this vehicle's logs to B [rad], by which a
    replay rotates the samples; 3-1-2 Euler angles"""
    log_compass_rotation: check.Vector3 = (0.0, 0.0, 0.0)
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
        features = 0 if self.camera is None else len(self.camera.features_I)
        count = FEATURE_BLOCKS + features + sum(params.blocks for params in self.aids.values())
        if count > MAX_TOGETHER:
            most = MAX_TOGETHER - FEATURE_BLOCKS
            raise ValueError(
                f"sensors must have at most {most} camera features and measurements of other "
                f"sensors at an instant, got {count - FEATURE_BLOCKS}"
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

    @property
    def heading_aid(self) -> Aid | None:
        """Aiding sensor that initializes the heading where no baseline does; None: none."""
        alone = self.gnss is not None and not self.gnss.has_baseline
        return Aid["MAGNETOMETER"] if alone and self.magnetometer is not None else None

    @property
    def flow_alone(self) -> bool:
        """True if the filter keeps the heading unobservable: flow, but no positions."""
        places = any("position" in params.observes for params in self.aids.values())
        measures_in_I = places or self.gnss is not None or self.camera is not None
        corrected = self.estimator.attitude_reset  # not the report's form
        return corrected and self.optical_flow is not None and not measures_in_I

    @property
    def drifts(self) -> bool:
        """True if GNSS positions have a time-correlated error, which the filter estimates."""
        return self.gnss is not None and self.gnss.drifts

    def require_filter(self) -> None:
        """Refuse a suite whose filter misinterprets the IMU samples, or would overflow."""
        if self.gnss is not None:
            self.gnss.require_filter()
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
            word = _WORDS.get(name, name)
            found |= {f"{word} rate [Hz]": sensor.rate, f"{word} phase": sensor.phase}
        if (gnss := self.gnss) is not None:
            found["presence of a GNSS baseline (secondary_antenna_B)"] = gnss.has_baseline
            gives = gnss.velocity_sigma is not None
            found["presence of GNSS velocities (velocity_sigma)"] = gives
        if self.camera is not None:
            found["number of camera features"] = len(self.camera.features_I)
        return found

    def with_rates(
        self,
        *,
        imu: float | None = None,
        gnss: float | None = None,
        camera: float | None = None,
        **aids: float | None,
    ) -> "SensorSuite":
        """Return a copy whose sensors run at other rates [Hz]; None keeps a rate.

        A new IMU rate changes the tick: sensors that measured at every tick continue to do so.

        Raises:
            ValueError: If a rate is not positive or does not divide the IMU rate, or if the suite
                lacks the sensor whose rate is given.
        """
        check.keywords(aids, tuple(AID_PARAMS), "with_rates")
        imu_rate = self.imu.rate if imu is None else imu
        check.positive("imu_rate", imu_rate, least=1.0, most=1e6)
        given = {"gnss": gnss, "camera": camera, **aids}
        rates = {name: rate for name, rate in given.items() if rate is not None}
        for name, rate in rates.items():
            if getattr(self, name) is None:
                lacking = _WORDS.get(name, f"a {name}")
                raise ValueError(f"{name}_rate must not be given without {lacking}, got {rate} Hz")
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

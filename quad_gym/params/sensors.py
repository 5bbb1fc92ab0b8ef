"""Sensors: frozen parameters with the source of every number.

As in `params`: SI units, body frame B with x forward and z up along the thrust; the laboratory's
numbers from the Aerial Robotics course (ASE 479W, The University of Texas at Austin).
"""

import math
from collections.abc import Iterator
from dataclasses import dataclass, field

import numpy as np

from quad_gym.params import checks as check
from quad_gym.params.checks import Checked, Matrix, Vector
from quad_gym.params.filter import FilterParams
from quad_gym.records import MAX_FEATURES, MAX_UNDER_WAY

LEAST_DRIFT = 1e-6
"""Slow error that a filter assumes in an axis that has none beside one that has [m]: its covariance
stays regular."""


@dataclass(frozen=True, kw_only=True)
class ImuParams(Checked):
    """Accelerometer and gyro: white noise, Gauss-Markov biases (report equations 4, 6, 7)."""

    rate: float = 200.0
    """[Hz]; one sample is one tick of the simulation; report section 4"""
    lever_arm_B: Vector = (0.0, 0.0, 0.0)
    """(3,) position of the accelerometer in B [m]; report section 2.3"""
    samples: str = "instant"
    """what the filter predicts a tick with: "instant", a sample of the motion at its start
    (report); or "average", the mean over it, as real IMUs deliver delta angles and delta
    velocities, corrected for coning and sculling. The inner loops read the gyro at the present
    instant either way, with the noise of the last sample: a mean lags by half a tick, which a
    tight rate loop does not bear."""
    accel_noise_density: float = 9.8e-3 * 0.1
    """[m/s^2/sqrt(Hz)]; laboratory: 0.1 milli-g/sqrt(Hz)"""
    gyro_noise_density: float = math.radians(0.05)
    """[rad/s/sqrt(Hz)]; laboratory: 0.05 deg/s/sqrt(Hz)"""
    accel_bias_sigma: float = 9.8e-3 * 100.0
    """stationary standard deviation [m/s^2]; laboratory: 100 milli-g"""
    gyro_bias_sigma: float = math.radians(100.0) / 3600.0
    """stationary standard deviation [rad/s]; laboratory: 100 deg/h"""
    accel_bias_tau: float = 100.0
    """correlation time [s]; laboratory"""
    gyro_bias_tau: float = 100.0
    """correlation time [s]; laboratory"""
    accel_scale_sigma: float = 0.0
    """standard deviation of each axis' scale factor error, constant in an episode [-]. Errors of
    scale and alignment act on what differs from rest on level ground, where biases are defined:
    `(I + D) (f - g e3)`, `(I + D) w`, with the scale errors on the diagonal of D"""
    gyro_scale_sigma: float = 0.0
    """likewise [-]"""
    accel_misalignment_sigma: float = 0.0
    """standard deviation of each entry of D off its diagonal: axes that are not orthogonal, and the
    sensor's turn in its housing [rad]"""
    gyro_misalignment_sigma: float = 0.0
    """likewise [rad]"""
    accel_vibration: float = 0.0
    """standard deviation that the rotors' vibration adds to a sample in hover, per axis, after the
    IMU's own filters [m/s^2]. It is white and grows with the square of the rotor speeds, as
    the forces of unbalanced masses do"""
    gyro_vibration: float = 0.0
    """likewise [rad/s]"""

    def __post_init__(self) -> None:
        self._check(
            check.number,
            "accel_scale_sigma",
            "gyro_scale_sigma",
            "accel_misalignment_sigma",
            "gyro_misalignment_sigma",
            least=0.0,
            most=0.1,
        )
        self._check(check.number, "accel_vibration", "gyro_vibration", least=0.0)
        self._check(check.positive, "rate", least=1.0, most=1e6)
        self._check(check.positive, "accel_bias_tau", "gyro_bias_tau")
        self._check(check.positive, "accel_noise_density", "gyro_noise_density")
        self._check(check.positive, "accel_bias_sigma", "gyro_bias_sigma")
        self._check(check.vector, "lever_arm_B", length=3)
        self._check(check.choice, "samples", choices=("instant", "average"))

    @property
    def dt(self) -> float:
        """The tick: time between two samples [s]."""
        return 1.0 / self.rate

    @property
    def errs(self) -> bool:
        """Whether there are errors of scale or alignment."""
        return any(
            (
                self.accel_scale_sigma,
                self.gyro_scale_sigma,
                self.accel_misalignment_sigma,
                self.gyro_misalignment_sigma,
            )
        )

    @property
    def vibrates(self) -> bool:
        """Whether the rotors' vibration reaches the IMU."""
        return self.accel_vibration > 0.0 or self.gyro_vibration > 0.0

    @property
    def believed_accel_sigma(self) -> float:
        """Standard deviation of a sample that the filter takes for white [m/s^2].

        It counts the vibration at the rotor speeds of hovering, which those of gentle flight hardly
        leave: a thrust 10 % larger vibrates 10 % more.
        """
        return math.hypot(self.accel_noise_density / math.sqrt(self.dt), self.accel_vibration)

    @property
    def believed_gyro_sigma(self) -> float:
        """Likewise of the gyro [rad/s]."""
        return math.hypot(self.gyro_noise_density / math.sqrt(self.dt), self.gyro_vibration)


@dataclass(frozen=True, kw_only=True)
class GnssParams(Checked):
    """Two GNSS antennas: position of the primary one, and the baseline to the secondary one."""

    rate: float = 200.0
    """[Hz]; a whole division of the IMU's; the laboratory measures at every tick"""
    primary_antenna_B: Vector = (0.1013, -0.0004, 0.0472)
    """(3,) in B [m]; laboratory vehicle"""
    secondary_antenna_B: Vector = (-0.0887, -0.0004, 0.0472)
    """(3,) in B [m]; laboratory vehicle"""
    reference_antenna_G: Vector = (-742080.456, -5462030.875, 3198338.956)
    """(3,) origin of the east-north-up frame I, in ECEF [m]; laboratory"""
    position_sigma_I: Vector = (0.006, 0.006, 0.012)
    """(3,) standard deviation east, north, up [m]; laboratory (RTK)"""
    baseline_sigma: float = 0.05
    """standard deviation of the baseline's direction [rad]; laboratory"""
    heading_error_sigma: float = 0.0
    """standard deviation of an error that the baseline has in common with all others of its
    episode: a turn about the body z axis, as unequal antennas, their mounting, or a compass among
    iron cause it [rad]"""
    velocity_sigma: float | None = None
    """standard deviation of the velocity by Doppler shifts, per axis [m/s]; None: not measured, as
    in the laboratory"""
    phase: float | None = 0.0
    """when the first measurement after the start comes, as a share of the period in [0, 1), in
    whole ticks; None: at random in each episode"""
    drift_sigma_I: Vector = (0.0, 0.0, 0.0)
    """(3,) slow position error east, north, up, beside the white one: stationary standard deviation
    of a first-order Gauss-Markov process that is zero at the start of an episode, for positions are
    relative to the place of the start [m]"""
    drift_tau: float = 60.0
    """its correlation time [s]; the filter estimates the slow error, as three more states"""
    latency: float = 0.0
    """from when a measurement is taken to when it reaches the filter, with its time stamp, in whole
    ticks; at most MAX_UNDER_WAY periods [s]. Receivers take about 0.1 s: the autopilot PX4 assumes
    0.11 s (parameter EKF2_GPS_DELAY)"""

    def __post_init__(self) -> None:
        self._check(check.number, "latency", least=0.0)
        self._check(check.number, "heading_error_sigma", least=0.0, most=1.0)
        self._check(check.positive, "rate", "baseline_sigma", "drift_tau")
        self._check(check.phase, "phase")
        if self.velocity_sigma is not None:
            self._check(check.positive, "velocity_sigma")
        self._check(check.vector, "drift_sigma_I", length=3)
        if min(self.drift_sigma_I) < 0.0:
            raise ValueError(
                f"GnssParams.drift_sigma_I must be at least 0, got {self.drift_sigma_I}"
            )
        self._check(
            check.vector,
            "primary_antenna_B",
            "secondary_antenna_B",
            "reference_antenna_G",
            "position_sigma_I",
            length=3,
        )
        if min(self.position_sigma_I) <= 0.0:
            raise ValueError(
                f"GnssParams.position_sigma_I must be greater than 0, got {self.position_sigma_I}"
            )
        for name in ("primary_antenna_B", "secondary_antenna_B"):
            if np.abs(getattr(self, name)).max() > 100.0:
                raise ValueError(
                    f"GnssParams.{name} must be on the vehicle, within 100 m, got "
                    f"{getattr(self, name)}"
                )
        if np.linalg.norm(self.baseline_B) < 1e-3:
            raise ValueError("GnssParams.secondary_antenna_B must be apart from primary_antenna_B")
        if np.linalg.norm(self.reference_antenna_G) < 1e6:
            raise ValueError(
                "GnssParams.reference_antenna_G must be a place on the Earth in ECEF meters, "
                f"got {self.reference_antenna_G}"
            )

    @property
    def baseline_B(self) -> np.ndarray:
        """(3,) from the primary to the secondary antenna, in B [m]."""
        return np.array(self.secondary_antenna_B) - np.array(self.primary_antenna_B)

    @property
    def drifts(self) -> bool:
        """Whether positions have a slow error."""
        return any(self.drift_sigma_I)

    @property
    def first_baseline_sigma(self) -> float:
        """Standard deviation of the direction of one baseline [rad]."""
        return math.hypot(self.baseline_sigma, self.heading_error_sigma)

    @property
    def believed_baseline_sigma(self) -> float:
        """Standard deviation of the direction of a baseline that the filter takes for white [rad].

        Averages of white noise shrink, a constant error stays. It is counted so often as there are
        measurements in `HEADING_MEMORY`: the heading is then hardly better known after that time
        than after the first baseline, unless something else tells it.
        """
        count = max(self.rate * HEADING_MEMORY, 1.0)
        return math.hypot(self.baseline_sigma, math.sqrt(count) * self.heading_error_sigma)


HEADING_MEMORY = 60.0
"""For how long of a flight a filter takes the constant error of a baseline for new [s]."""


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
        if self.max_range != math.inf:
            self._check(check.positive, "max_range")
        self._check(check.phase, "phase")
        self._check(check.positive, "rate", "pixel_size", "focal_length", "pixel_sigma")
        self._check(check.vector, "position_B", "attitude", length=3)
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


@dataclass(frozen=True, kw_only=True)
class PlacementParams(Checked):
    """How well the place of the start is known where there is no GNSS to measure it.

    The vehicle is put down on a marked spot. The filter starts from the position of the spot and
    the heading of the vehicle, with these errors, and assumes that the vehicle is level. Where the
    baseline of GNSS lies within 12 degrees of the vertical, so that it hardly tells the heading,
    the heading is known from the mark, too.
    """

    position_sigma: float = 0.05
    """per axis [m]; a vehicle put on its mark by hand"""
    heading_sigma: float = 0.05
    """[rad]; a vehicle lined up by eye, some 3 degrees"""

    def __post_init__(self) -> None:
        self._check(check.positive, "position_sigma", "heading_sigma")


@dataclass(frozen=True, kw_only=True)
class NoisyObservationParams(Checked):
    """Standard deviations of `observation="noisy"`: the size of the converged filter's errors.

    The defaults are those of the laboratory's sensors; a suite of other sensors has its own.
    """

    position: float = 0.0018
    """per axis [m]; measured on the laboratory's circle"""
    velocity: float = 0.012
    """per axis [m/s]; measured on the laboratory's circle"""
    attitude: float = 0.006
    """per axis [rad]; measured on the laboratory's circle"""
    body_rates: float = 0.0123
    """per axis [rad/s]; the gyro's noise at 200 Hz"""

    def __post_init__(self) -> None:
        self._check(check.number, "position", "velocity", "attitude", "body_rates", least=0.0)


def delay_ticks(name: str, latency: float, rate: float, imu_rate: float) -> int:
    """How many ticks a latency [s] is.

    Raises:
        ValueError: If more than MAX_UNDER_WAY measurements would be in transit at a time.
    """
    ticks, longest = round(latency * imu_rate), MAX_UNDER_WAY * check.ticks(name, rate, imu_rate)
    if ticks > longest:
        raise ValueError(
            f"{name} must be at most {MAX_UNDER_WAY} periods of the sensor, {longest / imu_rate:g} "
            f"s, got {latency:g} s"
        )
    return ticks


@dataclass(frozen=True, kw_only=True)
class SensorSuite(Checked):
    """All sensors of a vehicle and the filter that fuses them."""

    imu: ImuParams = field(default_factory=ImuParams)
    gnss: GnssParams | None = field(default_factory=GnssParams)
    """None: no GNSS; the filter then starts from `placement`"""
    camera: CameraParams | None = field(default_factory=CameraParams)
    """None: no camera"""
    placement: PlacementParams = field(default_factory=PlacementParams)
    estimator: FilterParams = field(default_factory=FilterParams)
    noisy: NoisyObservationParams = field(default_factory=NoisyObservationParams)

    def __post_init__(self) -> None:
        for name, kind in (
            ("imu", ImuParams),
            ("placement", PlacementParams),
            ("estimator", FilterParams),
            ("noisy", NoisyObservationParams),
        ):
            check.instance(f"SensorSuite.{name}", getattr(self, name), kind)
        if self.gnss is not None:
            check.instance("SensorSuite.gnss", self.gnss, GnssParams)
            check.ticks("GnssParams.rate", self.gnss.rate, self.imu.rate)
            delay_ticks("GnssParams.latency", self.gnss.latency, self.gnss.rate, self.imu.rate)
        if self.camera is not None:
            check.instance("SensorSuite.camera", self.camera, CameraParams)
            check.ticks("CameraParams.rate", self.camera.rate, self.imu.rate)
            delay_ticks(
                "CameraParams.latency", self.camera.latency, self.camera.rate, self.imu.rate
            )

    @property
    def drifts(self) -> bool:
        """Whether GNSS positions have a slow error, so that a filter estimates it."""
        return self.gnss is not None and self.gnss.drifts

    def require_filter(self) -> None:
        """Refuse a suite whose filter mistakes the samples of the IMU, or would overflow.

        Raises:
            ValueError: If it takes means over a tick for the motion at its start, or divides by
                the square of hardly any noise.
        """
        if self.gnss is not None and min(self.gnss.position_sigma_I) < 1e-9:
            raise ValueError(
                "GnssParams.position_sigma_I must be at least 1e-9 m for a filter, got "
                f"{self.gnss.position_sigma_I}"
            )
        if self.imu.samples == "average" and self.estimator.integration == "euler":
            raise ValueError(
                "sensors must have FilterParams.integration='midpoint' with ImuParams.samples="
                "'average': 'euler' takes a sample for the motion at the start of its tick"
            )

    def require_like(self, true_sensors: "SensorSuite") -> None:
        """Refuse true sensors that a filter which believes in these cannot be flown with.

        Noise, biases, drift, latency, placement and mounting may differ, and where the features
        are. Which sensors there are, when and what they measure may not: both sides share a clock
        and the measurements that the filter expects.

        Raises:
            ValueError: If they tick otherwise, or others are missing.
        """
        if true_sensors.imu.rate != self.imu.rate:
            raise ValueError("true_sensors must have the IMU rate of sensors, as it is the tick")
        if true_sensors.imu.samples != self.imu.samples:
            raise ValueError(
                "true_sensors must have the IMU samples of sensors, as they order the tick: "
                f"{true_sensors.imu.samples!r} is not {self.imu.samples!r}"
            )
        for name in ("gnss", "camera"):
            if (getattr(true_sensors, name) is None) != (getattr(self, name) is None):
                raise ValueError(f"true_sensors must have a {name} if sensors has, and only then")
        for what, true, believed in self._schedule(true_sensors):
            if true != believed:
                raise ValueError(
                    f"true_sensors must have the {what} of sensors, {believed}, got {true}"
                )

    def _schedule(self, true: "SensorSuite") -> Iterator[tuple[str, object, object]]:
        """What measures when, in words: as it is in `true`, and as it is here."""
        if self.gnss is not None and true.gnss is not None:
            here, there = self.gnss, true.gnss
            yield "GNSS rate [Hz]", there.rate, here.rate
            yield "GNSS phase", there.phase, here.phase
            measured = [p.velocity_sigma is not None for p in (there, here)]
            yield "presence of GNSS velocities (velocity_sigma)", measured[0], measured[1]
        if self.camera is not None and true.camera is not None:
            image, expected = true.camera, self.camera
            yield "camera rate [Hz]", image.rate, expected.rate
            yield "camera phase", image.phase, expected.phase
            counts = [len(p.features_I) for p in (image, expected)]
            yield "number of camera features", counts[0], counts[1]

    def with_rates(
        self,
        *,
        imu: float | None = None,
        gnss: float | None = None,
        camera: float | None = None,
    ) -> "SensorSuite":
        """A copy whose sensors run at other rates [Hz]; None keeps a rate.

        A new IMU rate changes the tick: sensors that measured at every tick keep doing so.

        Raises:
            ValueError: If a rate is not positive or not a whole division of the IMU's, or there is
                no GNSS, or no camera, that could have the rate given for it.
        """
        imu_rate = self.imu.rate
        if imu is not None:
            imu_rate = check.positive("imu_rate", imu, least=1.0, most=1e6)

        def rate_of(name: str, wanted: float | None, current: float) -> float:
            follows = current == self.imu.rate or imu_rate < current
            rate = wanted if wanted is not None else (imu_rate if follows else current)
            check.ticks(name, rate, imu_rate)
            return rate

        gnss_params = self.gnss
        if gnss_params is not None:
            gnss_params = gnss_params.replace(rate=rate_of("gnss_rate", gnss, gnss_params.rate))
        elif gnss is not None:
            raise ValueError(f"gnss_rate must not be given without GNSS, got {gnss} Hz")
        camera_params = self.camera
        if camera_params is not None:
            camera_params = camera_params.replace(
                rate=rate_of("camera_rate", camera, camera_params.rate)
            )
        elif camera is not None:
            raise ValueError(f"camera_rate must not be given without a camera, got {camera} Hz")
        return self.replace(  # type: ignore[no-any-return]
            imu=self.imu.replace(rate=imu_rate), gnss=gnss_params, camera=camera_params
        )

    def simplified(self) -> "SensorSuite":
        """A copy whose measurements arrive at once, with white noise, bias and drift alone.

        To tell what latency, vibration, misalignment, constant heading errors, blur, range and
        ground do to a flight. White noise stays as it is.
        """
        gnss, camera = self.gnss, self.camera
        if gnss is not None:
            gnss = gnss.replace(latency=0.0, heading_error_sigma=0.0)
        if camera is not None:
            camera = camera.replace(
                latency=0.0, max_range=math.inf, exposure=0.0, ground_hides=False
            )
        imu = self.imu.replace(
            accel_scale_sigma=0.0,
            gyro_scale_sigma=0.0,
            accel_misalignment_sigma=0.0,
            gyro_misalignment_sigma=0.0,
            accel_vibration=0.0,
            gyro_vibration=0.0,
        )
        return self.replace(imu=imu, gnss=gnss, camera=camera)  # type: ignore[no-any-return]

    def scaled_noise(self, factor: float) -> "SensorSuite":
        """A copy whose white noise is `factor` times as large, as a filter of this suite knows."""
        check.positive("factor", factor)
        gnss, camera = self.gnss, self.camera
        if camera is not None:
            camera = camera.replace(pixel_sigma=factor * camera.pixel_sigma)
        if gnss is not None:
            gnss = gnss.replace(
                position_sigma_I=tuple(factor * s for s in gnss.position_sigma_I),
                baseline_sigma=factor * gnss.baseline_sigma,
                velocity_sigma=gnss.velocity_sigma and factor * gnss.velocity_sigma,
            )
        return self.replace(  # type: ignore[no-any-return]
            imu=self.imu.replace(
                accel_noise_density=factor * self.imu.accel_noise_density,
                gyro_noise_density=factor * self.imu.gyro_noise_density,
            ),
            gnss=gnss,
            camera=camera,
        )

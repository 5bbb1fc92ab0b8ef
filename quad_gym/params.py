"""What a flight is made of: vehicle, sensors, filter, gains, clocks; with their sources.

All classes are frozen, keyword-only and check themselves: a value that makes no sense raises a
ValueError that names it. Everything is SI (radians too); body frame B: x forward, z up along the
thrust.

The laboratory's numbers come from the Aerial Robotics course (ASE 479W, The University of Texas at
Austin) whose third laboratory report this package implements.
"""

import dataclasses
import math
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from quad_gym import validation as check

GRAVITY = 9.8
"""Standard gravity as the laboratory rounds it [m/s^2]."""

MAX_FEATURES = 16
"""The most features that a camera model can hold."""

MAX_GATES = 8
"""The most gates that a course can have."""

TASKS = ("hover", "circle", "lemniscate", "random_trajectory", "waypoints")
"""Kinds of task, in the order of `records.Task`."""

STARTS = ("ground", "hover")
"""How episodes begin, in the order of `records.Start`."""

Vector = tuple[float, ...]
Matrix = tuple[tuple[float, ...], ...]


class _Checked:
    """A frozen dataclass whose fields are replaced by their checked form on creation."""

    def _set(self, name: str, value: Any) -> None:
        object.__setattr__(self, name, value)

    def _check(self, rule: Any, *names: str, **options: Any) -> None:
        for name in names:
            label = f"{type(self).__name__}.{name}"
            self._set(name, rule(label, getattr(self, name), **options))

    def replace(self, **changes: Any) -> Any:
        """A copy with some fields changed, checked anew."""
        return dataclasses.replace(self, **changes)  # type: ignore[type-var]


@dataclass(frozen=True, kw_only=True)
class VehicleParams(_Checked):
    """A quadrotor: rigid body, four rotors with first-order speed response, drag of a flat disc."""

    mass: float = 0.78
    """[kg]; laboratory vehicle"""
    inertia: Matrix = ((1.7565e-3, 0.0, 0.0), (0.0, 3.5723e-3, 0.0), (0.0, 0.0, 4.7134e-3))
    """(3, 3) about the centre of mass, in B [kg m^2]; laboratory vehicle"""
    rotor_positions_B: Matrix = (
        (0.21, -0.21, 0.0),
        (0.21, 0.21, 0.0),
        (-0.21, 0.21, 0.0),
        (-0.21, -0.21, 0.0),
    )
    """(4, 3) rotor hubs relative to the centre of mass, in B [m]; laboratory vehicle"""
    rotor_spins: Vector = (1.0, -1.0, 1.0, -1.0)
    """(4,) sense of rotation about body z, opposite to the reaction torque; laboratory vehicle"""
    thrust_coefficient: float = 6.11e-8 / 0.104719755**2
    """F = kF W^2 [N/(rad/s)^2]; laboratory vehicle, given there per rpm^2"""
    torque_coefficient: float = 1.5e-9 / 0.104719755**2
    """N = kN W^2 [N m/(rad/s)^2]; laboratory vehicle, given there per rpm^2"""
    motor_time_constant: float = 0.05
    """lag of the rotor speed behind the voltage [s]; laboratory vehicle"""
    motor_speed_per_volt: float = 200.0
    """steady rotor speed per volt [rad/s/V]; laboratory vehicle"""
    max_voltage: float = 12.0
    """[V]; laboratory vehicle"""
    disc_area: float = 0.01
    """area of the drag disc [m^2]; laboratory vehicle"""
    drag_coefficient: float = 0.3
    """of the drag disc; laboratory vehicle"""
    air_density: float = 1.225
    """[kg/m^3]; standard atmosphere at sea level"""
    gravity: float = GRAVITY
    """[m/s^2]"""

    def __post_init__(self) -> None:
        self._check(
            check.positive,
            "mass",
            "thrust_coefficient",
            "torque_coefficient",
            "motor_time_constant",
            "motor_speed_per_volt",
            "max_voltage",
            "gravity",
        )
        self._check(check.number, "disc_area", "drag_coefficient", "air_density", least=0.0)
        self._check(check.matrix, "inertia", rows=3, columns=3)
        self._check(check.matrix, "rotor_positions_B", rows=4, columns=3)
        self._check(check.vector, "rotor_spins", length=4)
        inertia = np.array(self.inertia)
        if not np.allclose(inertia, inertia.T, rtol=1e-9, atol=0.0):
            raise ValueError("VehicleParams.inertia must be symmetric")
        smallest = np.linalg.eigvalsh(inertia)[0]
        if smallest <= 1e-9 * abs(inertia).max():
            raise ValueError(
                "VehicleParams.inertia must be positive definite, got a smallest eigenvalue of "
                f"{smallest:g}"
            )
        if self.hover_voltage >= self.max_voltage:
            raise ValueError(
                f"VehicleParams.mass must be light enough to hover, got {self.mass} kg: it takes "
                f"{self.hover_voltage:.1f} V of {self.max_voltage:g} V"
            )
        if any(abs(spin) != 1.0 for spin in self.rotor_spins):
            raise ValueError(f"VehicleParams.rotor_spins must be +1 or -1, got {self.rotor_spins}")
        if abs(np.linalg.det(self.effectiveness)) < 1e-12:
            raise ValueError(
                "VehicleParams.rotor_positions_B must let the rotors turn the body about every axis"
            )

    @property
    def max_rotor_force(self) -> float:
        """Thrust of one rotor at full voltage [N]."""
        return self.thrust_coefficient * (self.motor_speed_per_volt * self.max_voltage) ** 2

    @property
    def hover_voltage(self) -> float:
        """Voltage at which four rotors carry the weight [V]."""
        force = self.mass * self.gravity / 4
        return math.sqrt(force / self.thrust_coefficient) / self.motor_speed_per_volt

    @property
    def hover_torques(self) -> tuple[float, float, float]:
        """Torques about the body axes that the weight makes on the rotors' lever arms [N m]."""
        weight = self.mass * self.gravity
        x, y, _ = np.abs(np.array(self.rotor_positions_B)).mean(axis=0)
        return weight * y, weight * x, weight * self.torque_coefficient / self.thrust_coefficient

    @property
    def effectiveness(self) -> np.ndarray:
        """(4, 4): total thrust [N] and torque in B [N m] per unit of each rotor's thrust."""
        positions, spins = np.array(self.rotor_positions_B), np.array(self.rotor_spins)
        torque_per_thrust = self.torque_coefficient / self.thrust_coefficient
        return np.stack([np.ones(4), positions[:, 1], -positions[:, 0], -torque_per_thrust * spins])


@dataclass(frozen=True, kw_only=True)
class ImuParams(_Checked):
    """Accelerometer and gyro: white noise, Gauss-Markov biases (report equations 4, 6, 7)."""

    rate: float = 200.0
    """[Hz]; one sample is one tick of the simulation; report section 4"""
    lever_arm_B: Vector = (0.0, 0.0, 0.0)
    """(3,) position of the accelerometer in B [m]; report section 2.3"""
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

    def __post_init__(self) -> None:
        self._check(check.positive, "rate", "accel_bias_tau", "gyro_bias_tau")
        self._check(check.positive, "accel_noise_density", "gyro_noise_density")
        self._check(check.positive, "accel_bias_sigma", "gyro_bias_sigma")
        self._check(check.vector, "lever_arm_B", length=3)

    @property
    def dt(self) -> float:
        """The tick: time between two samples [s]."""
        return 1.0 / self.rate


@dataclass(frozen=True, kw_only=True)
class GnssParams(_Checked):
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

    def __post_init__(self) -> None:
        self._check(check.positive, "rate", "baseline_sigma")
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
        if np.linalg.norm(self.baseline_B) < 1e-3:
            raise ValueError("GnssParams.secondary_antenna_B must be apart from primary_antenna_B")
        if np.linalg.norm(self.reference_antenna_G) < 1e6:
            raise ValueError(
                "GnssParams.reference_antenna_G must be a place on the Earth in ECEF metres, "
                f"got {self.reference_antenna_G}"
            )

    @property
    def baseline_B(self) -> np.ndarray:
        """(3,) from the primary to the secondary antenna, in B [m]."""
        return np.array(self.secondary_antenna_B) - np.array(self.primary_antenna_B)


@dataclass(frozen=True, kw_only=True)
class CameraParams(_Checked):
    """A pinhole camera that sees known features."""

    rate: float = 200.0
    """[Hz]; a whole division of the IMU's; the laboratory measures at every tick"""
    position_B: Vector = (0.1159, -0.0004, -0.0435)
    """(3,) projection centre in B [m]; laboratory vehicle"""
    attitude: Vector = (math.radians(120.0), 0.0, math.radians(90.0))
    """(3,) Euler angles of R_CB, camera z along the optical axis [rad]; laboratory"""
    pixel_size: float = 2e-6
    """[m]; laboratory"""
    focal_length: float = 1657.72
    """[pixels]; laboratory"""
    image_size: Vector = (3840.0, 2160.0)
    """(2,) width and height, with the origin of coordinates at the centre [pixels]; laboratory"""
    pixel_sigma: float = 20.0
    """standard deviation per axis [pixels]; laboratory"""
    features_I: Matrix = ((0.0, 0.0, 0.0), (0.0, 0.0, 0.7))
    """(n, 3) known points in I, at most MAX_FEATURES [m]; laboratory"""

    def __post_init__(self) -> None:
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


@dataclass(frozen=True, kw_only=True)
class FilterParams(_Checked):
    """The unscented Kalman filter's own choices."""

    alpha: float = 1e-3
    """spread of the sigma points; laboratory"""
    beta: float = 2.0
    """weight of the central point's excess, 2 for Gaussians; laboratory"""
    kappa: float = 0.0
    """secondary scaling; laboratory"""
    direction_variance_floor: float = 1e-8
    """added to the diagonal of a direction's covariance, of rank 2 [-]; report section 3.1"""
    feature_noise_across: str = "measured"
    """how a feature's noise covariance of rank 2 lies: across its "measured" direction (report) or
    across the "predicted" one, as the baseline's does. The first takes the angle between the two,
    tens of milliradians in the first second, for information that it trusts to 0.1 mrad."""
    initial_velocity_variance: float = 1e-3
    """[m^2/s^2]; laboratory"""
    initial_scale: float = 2.0
    """factor on the first fix's covariance; laboratory"""
    gravity: float = GRAVITY
    """[m/s^2] that the filter subtracts"""

    def __post_init__(self) -> None:
        self._check(
            check.positive,
            "alpha",
            "direction_variance_floor",
            "initial_velocity_variance",
            "initial_scale",
            "gravity",
        )
        self._check(check.number, "beta", least=0.0)
        self._check(check.choice, "feature_noise_across", choices=("measured", "predicted"))
        self._check(check.number, "kappa", least=-14.0)


@dataclass(frozen=True, kw_only=True)
class NoisyObservationParams(_Checked):
    """Standard deviations of `observation="noisy"`: the size of the converged filter's errors."""

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


@dataclass(frozen=True, kw_only=True)
class SensorSuite(_Checked):
    """All sensors of a vehicle and the filter that fuses them."""

    imu: ImuParams = field(default_factory=ImuParams)
    gnss: GnssParams = field(default_factory=GnssParams)
    camera: CameraParams | None = field(default_factory=CameraParams)
    """None: no camera"""
    estimator: FilterParams = field(default_factory=FilterParams)
    noisy: NoisyObservationParams = field(default_factory=NoisyObservationParams)

    def __post_init__(self) -> None:
        for name, kind in (
            ("imu", ImuParams),
            ("gnss", GnssParams),
            ("estimator", FilterParams),
            ("noisy", NoisyObservationParams),
        ):
            check.instance(f"SensorSuite.{name}", getattr(self, name), kind)
        if self.camera is not None:
            check.instance("SensorSuite.camera", self.camera, CameraParams)
        check.ticks("GnssParams.rate", self.gnss.rate, self.imu.rate)
        if self.camera is not None:
            check.ticks("CameraParams.rate", self.camera.rate, self.imu.rate)

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
            ValueError: If a rate is not positive or not a whole division of the IMU's.
        """
        imu_rate = self.imu.rate if imu is None else check.positive("imu_rate", imu)

        def rate_of(name: str, wanted: float | None, current: float) -> float:
            follows = current == self.imu.rate or imu_rate < current
            rate = wanted if wanted is not None else (imu_rate if follows else current)
            check.ticks(name, rate, imu_rate)
            return rate

        gnss_params = self.gnss.replace(rate=rate_of("gnss_rate", gnss, self.gnss.rate))
        camera_params = self.camera
        if camera_params is not None:
            camera_params = camera_params.replace(
                rate=rate_of("camera_rate", camera, camera_params.rate)
            )
        return SensorSuite(
            imu=self.imu.replace(rate=imu_rate),
            gnss=gnss_params,
            camera=camera_params,
            estimator=self.estimator,
            noisy=self.noisy,
        )

    def scaled_noise(self, factor: float) -> "SensorSuite":
        """A copy whose white noise is `factor` times as large; the filter knows of it."""
        check.positive("factor", factor)
        camera = self.camera
        if camera is not None:
            camera = camera.replace(pixel_sigma=factor * camera.pixel_sigma)
        return self.replace(  # type: ignore[no-any-return]
            imu=self.imu.replace(
                accel_noise_density=factor * self.imu.accel_noise_density,
                gyro_noise_density=factor * self.imu.gyro_noise_density,
            ),
            gnss=self.gnss.replace(
                position_sigma_I=tuple(factor * s for s in self.gnss.position_sigma_I),
                baseline_sigma=factor * self.gnss.baseline_sigma,
            ),
            camera=camera,
        )


@dataclass(frozen=True, kw_only=True)
class PDGains(_Checked):
    """Gains of the PD controller of position and attitude."""

    position: float = 5.0
    """k [N/m]; laboratory"""
    velocity: float = 3.1
    """kd [N s/m]; laboratory"""
    attitude: Vector = (1.0, 0.95, 0.21)
    """(3,) diagonal of K [N m]; laboratory"""
    body_rates: Vector = (0.25, 0.25, 0.12)
    """(3,) diagonal of Kd [N m s]; laboratory"""

    def __post_init__(self) -> None:
        self._check(check.number, "position", "velocity", least=0.0)
        self._check(check.vector, "attitude", "body_rates", length=3)
        if min(self.attitude + self.body_rates) < 0.0:
            raise ValueError("PDGains.attitude and PDGains.body_rates must be at least 0")


@dataclass(frozen=True, kw_only=True)
class ActionParams(_Checked):
    """Scaling of actions and bandwidths of the inner loops that carry them out at every tick."""

    rate_scale: Vector = (6.0, 6.0, 3.0)
    """(3,) body rates at full action [rad/s]"""
    tilt_scale: float = math.radians(45.0)
    """roll and pitch at full action [rad]"""
    velocity_scale: float = 5.0
    """each component of the velocity at full action [m/s]"""
    rate_bandwidth: float = 14.0
    """k_w: torque J k_w (w* - w) + w x J w [1/s]"""
    attitude_bandwidth: float = 7.0
    """k_a: body rates k_a (e3 x z*) [1/s]"""
    velocity_bandwidth: float = 4.0
    """k_v: acceleration k_v (v* - v) [1/s]"""

    def __post_init__(self) -> None:
        self._check(
            check.positive,
            "tilt_scale",
            "velocity_scale",
            "rate_bandwidth",
            "attitude_bandwidth",
            "velocity_bandwidth",
        )
        self._check(check.vector, "rate_scale", length=3)
        if min(self.rate_scale) <= 0.0:
            raise ValueError(
                f"ActionParams.rate_scale must be greater than 0, got {self.rate_scale}"
            )
        if self.tilt_scale >= math.pi / 2:
            raise ValueError(
                f"ActionParams.tilt_scale must be less than pi/2, got {self.tilt_scale}"
            )


@dataclass(frozen=True, kw_only=True)
class Clocks(_Checked):
    """How often each part acts. A tick is an IMU sample; all periods are whole multiples of it."""

    imu_rate: float = 200.0
    """[Hz]"""
    control_rate: float = 200.0
    """[Hz] at which a new action is taken"""
    gnss_rate: float = 200.0
    """[Hz]"""
    camera_rate: float = 200.0
    """[Hz]"""
    substeps: int = 1
    """Runge-Kutta steps in a tick"""

    def __post_init__(self) -> None:
        self._check(check.positive, "imu_rate")
        for name in ("control_rate", "gnss_rate", "camera_rate"):
            check.ticks(name, getattr(self, name), self.imu_rate)
        self._check(check.whole, "substeps")

    @classmethod
    def of(cls, sensors: SensorSuite, control_rate: float, substeps: int = 1) -> "Clocks":
        """The clocks of a sensor suite, with a control rate [Hz]."""
        camera = sensors.camera
        return cls(
            imu_rate=sensors.imu.rate,
            control_rate=control_rate,
            gnss_rate=sensors.gnss.rate,
            camera_rate=camera.rate if camera is not None else sensors.imu.rate,
            substeps=substeps,
        )

    def ticks_between(self, name: str) -> int:
        """Ticks between two events of the clock `name`, such as "control"."""
        return check.ticks(f"{name}_rate", getattr(self, f"{name}_rate"), self.imu_rate)


@dataclass(frozen=True, kw_only=True)
class TaskParams(_Checked):
    """What the vehicle is to do, and when an episode is over."""

    kind: str = "circle"
    """one of TASKS"""
    radius: float = 4.0
    """size of the reference [m]; report section 4.2"""
    period: float = 10.0
    """of the reference [s]; report section 4.2"""
    height: float = 1.0
    """of the reference [m]; report section 4.2"""
    start: str = "ground"
    """"ground": at rest below the reference at height 0, rotors stopped (report section 4.2);
    "hover": hovering at rest within some decimetres of the reference"""
    randomize: bool = False
    """draw phase, radius, period and sense of the reference anew each episode"""
    duration: float = 10.0
    """time limit of an episode [s]; 0: none; report section 4.2"""
    out_of_bounds: float = 3.0
    """distance from the reference at which an episode ends [m]"""
    ground: float = -0.5
    """height at which an episode ends [m]; below 0, for flights sag while the rotors spin up"""
    max_tilt: float = math.radians(100.0)
    """angle between the body z axis and the vertical at which an episode ends [rad]"""
    max_speed: float = 2.5
    """bound of a random trajectory [m/s]"""
    max_acceleration: float = 3.0
    """bound of a random trajectory [m/s^2]"""
    gate_count: int = 5
    """gates of a course, at most MAX_GATES"""
    gate_radius: float = 0.3
    """distance at which a gate counts as passed [m]"""
    preview: Vector = (0.2, 0.4)
    """(2,) how far ahead an observation shows the reference [s]"""

    def __post_init__(self) -> None:
        self._check(check.choice, "kind", choices=TASKS)
        self._check(check.choice, "start", choices=STARTS)
        self._check(
            check.positive,
            "radius",
            "period",
            "height",
            "out_of_bounds",
            "max_speed",
            "max_acceleration",
            "gate_radius",
        )
        self._check(check.number, "duration", least=0.0)
        self._check(check.number, "ground")
        self._check(check.flag, "randomize")
        self._check(check.vector, "preview", length=2)
        self._check(check.whole, "gate_count")
        if self.gate_count > MAX_GATES:
            raise ValueError(
                f"TaskParams.gate_count must be at most {MAX_GATES}, got {self.gate_count}"
            )
        if not 0.0 < check.number("TaskParams.max_tilt", self.max_tilt) <= math.pi:
            raise ValueError(f"TaskParams.max_tilt must be in (0, pi], got {self.max_tilt}")
        if min(self.preview) < 0.0:
            raise ValueError(f"TaskParams.preview must be at least 0, got {self.preview}")


_SUITES = {"lab": SensorSuite()}
_VEHICLES = {"lab": VehicleParams()}
_GAINS = {
    "lab": PDGains(),
    # by random search for small errors on Hover, Circle, Lemniscate and RandomTrajectory, each
    # relative to that of the laboratory's gains, on the estimate at 50 Hz with thrust and rates
    "tuned": PDGains(
        position=10.6, velocity=3.44, attitude=(1.29, 1.29, 0.138), body_rates=(0.25, 0.25, 0.12)
    ),
}


def sensor_suite(name: str) -> SensorSuite:
    """The sensor suite called `name`: "lab", the report's."""
    return _SUITES[check.choice("sensors", name, tuple(_SUITES))]


def vehicle_params(name: str) -> VehicleParams:
    """The vehicle called `name`: "lab", the report's."""
    return _VEHICLES[check.choice("vehicle", name, tuple(_VEHICLES))]


def pd_gains(name: str) -> PDGains:
    """PD gains by name: "lab", the report's, or "tuned", for small errors on all tracking tasks."""
    return _GAINS[check.choice("gains", name, tuple(_GAINS))]

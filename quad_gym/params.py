"""What a flight is made of: vehicle, gains, actions, clocks, task; sensors are in `sensor_params`.

All classes are frozen, keyword-only and check themselves: an invalid value raises a ValueError that
names it. Everything is SI (radians too); body frame B: x forward, z up along the
thrust.

The laboratory's numbers come from the Aerial Robotics course (ASE 479W, The University of Texas at
Austin) whose third laboratory report this package implements.
"""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from quad_gym import validation as check
from quad_gym.frames import GRAVITY
from quad_gym.records import MAX_GATES, Start, Task
from quad_gym.sensor_params import SensorSuite
from quad_gym.validation import Checked, Matrix, Vector

TASKS = tuple(task.name.lower() for task in Task)
"""Kinds of task."""

STARTS = tuple(start.name.lower() for start in Start)
"""How episodes begin."""

FARTHEST = 1000.0
"""Positions of references are observed within this [m]."""

MIN_PERIOD = 0.01
"""No vehicle follows a faster reference [s]."""

LEAST_MOMENT = 1e-9
"""Of inertia, beyond which numbers are mistaken; a quadrotor of 10 g has 1e-6 [kg m^2]."""

MAX_LIFT = 1000.0
"""Thrust over weight beyond which numbers are mistaken; racing drones reach 15."""

MAX_TORQUE_ARM = 10.0
"""Torque over thrust of a rotor beyond which numbers are mistaken; of propellers it is 0.02 [m]."""

RK4_LIMIT = 2.78
"""Largest step of the classic Runge-Kutta method over the time constant of a decay, beyond which
its solution grows: the root of |1 - z + z^2/2 - z^3/6 + z^4/24| = 1 is 2.785."""


@dataclass(frozen=True, kw_only=True)
class VehicleParams(Checked):
    """A quadrotor: rigid body, four rotors with first-order speed response, drag of a flat disc."""

    mass: float = 0.78
    """[kg]; laboratory vehicle"""
    inertia: Matrix = ((1.7565e-3, 0.0, 0.0), (0.0, 3.5723e-3, 0.0), (0.0, 0.0, 4.7134e-3))
    """(3, 3) about the center of mass, in B [kg m^2]; laboratory vehicle"""
    rotor_positions_B: Matrix = (
        (0.21, -0.21, 0.0),
        (0.21, 0.21, 0.0),
        (-0.21, 0.21, 0.0),
        (-0.21, -0.21, 0.0),
    )
    """(4, 3) rotor hubs relative to the center of mass, in B [m]; laboratory vehicle"""
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
            "thrust_coefficient",
            "torque_coefficient",
            "motor_time_constant",
            "motor_speed_per_volt",
            "max_voltage",
            "gravity",
        )
        self._check(check.positive, "mass", least=1e-3)
        self._check(check.number, "disc_area", "drag_coefficient", "air_density", least=0.0)
        self._check(check.matrix, "inertia", rows=3, columns=3)
        self._check(check.matrix, "rotor_positions_B", rows=4, columns=3)
        self._check(check.vector, "rotor_spins", length=4)
        inertia = np.array(self.inertia)
        if not np.allclose(inertia, inertia.T, rtol=1e-9, atol=0.0):
            raise ValueError("VehicleParams.inertia must be symmetric")
        smallest = np.linalg.eigvalsh(inertia)[0]
        if 0.0 < smallest < LEAST_MOMENT:
            raise ValueError(
                f"VehicleParams.inertia must be at least {LEAST_MOMENT:g} kg m^2 about every "
                f"axis, got {smallest:g} kg m^2"
            )
        if smallest <= 1e-9 * abs(inertia).max():
            raise ValueError(
                "VehicleParams.inertia must be positive definite, got a smallest eigenvalue of "
                f"{smallest:g}"
            )
        check_moments("VehicleParams.inertia", np.linalg.eigvalsh(inertia))
        if self.hover_voltage >= self.max_voltage:
            raise ValueError(
                f"VehicleParams.mass must be light enough to hover, got {self.mass} kg: it takes "
                f"{self.hover_voltage:.3g} V of {self.max_voltage:g} V (by mass, gravity, "
                "thrust_coefficient, motor_speed_per_volt and max_voltage)"
            )
        if 4.0 * self.max_rotor_force > MAX_LIFT * self.mass * self.gravity:
            raise ValueError(
                f"VehicleParams.thrust_coefficient must lift at most {MAX_LIFT:g} times the weight "
                f"at full voltage, got {4.0 * self.max_rotor_force:g} N and "
                f"{self.mass * self.gravity:g} N (by mass, gravity, thrust_coefficient, "
                "motor_speed_per_volt and max_voltage)"
            )
        if self.torque_coefficient > MAX_TORQUE_ARM * self.thrust_coefficient:
            raise ValueError(
                f"VehicleParams.torque_coefficient must be at most {MAX_TORQUE_ARM:g} m times "
                f"thrust_coefficient, got {self.torque_coefficient:g}"
            )
        if any(abs(spin) != 1.0 for spin in self.rotor_spins):
            raise ValueError(f"VehicleParams.rotor_spins must be +1 or -1, got {self.rotor_spins}")
        if abs(np.linalg.det(self.effectiveness)) < 1e-12:
            raise ValueError(
                "VehicleParams.rotor_positions_B must let the rotors turn the body about all axes "
                "(and rotor_spins, with torque_coefficient over thrust_coefficient as their arm)"
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
class PDGains(Checked):
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
class ActionParams(Checked):
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
class Clocks(Checked):
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
        self._check(check.positive, "imu_rate", most=1e6)
        for name in ("control_rate", "gnss_rate", "camera_rate"):
            check.ticks(name, getattr(self, name), self.imu_rate)
        self._check(check.whole, "substeps", most=1000)

    @classmethod
    def of(cls, sensors: SensorSuite, control_rate: float, substeps: int = 1) -> "Clocks":
        """The clocks of a sensor suite, with a control rate [Hz]."""
        camera = sensors.camera
        return cls(
            imu_rate=sensors.imu.rate,
            control_rate=control_rate,
            gnss_rate=sensors.gnss.rate if sensors.gnss is not None else sensors.imu.rate,
            camera_rate=camera.rate if camera is not None else sensors.imu.rate,
            substeps=substeps,
        )

    def ticks_between(self, name: str) -> int:
        """Ticks between two events of the clock `name`, such as "control"."""
        return check.ticks(f"{name}_rate", getattr(self, f"{name}_rate"), self.imu_rate)


@dataclass(frozen=True, kw_only=True)
class TaskParams(Checked):
    """What the vehicle is to do, and when an episode is over."""

    kind: str = "circle"
    """one of TASKS"""
    radius: float = 4.0
    """size of the reference, at most 1000 [m]; report section 4.2"""
    period: float = 10.0
    """of the reference, at least 0.01 [s]; report section 4.2"""
    height: float = 1.0
    """of the reference, at most 1000 [m]; report section 4.2"""
    start: str = "ground"
    """"ground": at rest below the reference at height 0, rotors stopped (report section 4.2);
    "hover": hovering at rest within some decimeters of the reference; "mixed": either, with
    probability 0.5"""
    randomize: bool = False
    """draw the reference anew each episode: phase, radius, period and sense of circle and
    lemniscate, the heading of a random trajectory and of a course of gates"""
    duration: float = 10.0
    """time limit of an episode [s], at least half a control period; 0: none; report section 4.2"""
    out_of_bounds: float = 3.0
    """distance from the reference at which an episode ends [m]"""
    ground: float = -0.5
    """height at which an episode ends [m]; below 0, for flights sag while the rotors spin up"""
    end_when_lost: bool = False
    """whether an episode is truncated where the filter finds that it is lost"""
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
            "out_of_bounds",
            "max_speed",
            "max_acceleration",
            "gate_radius",
        )
        self._check(check.positive, "radius", "height", most=FARTHEST)
        self._check(check.number, "period", least=MIN_PERIOD)
        self._check(check.number, "duration", least=0.0, most=1e9)
        self._check(check.number, "ground")
        self._check(check.flag, "randomize")
        self._check(check.vector, "preview", length=2)
        self._check(check.whole, "gate_count")
        if self.gate_count > MAX_GATES:
            raise ValueError(
                f"TaskParams.gate_count must be at most {MAX_GATES}, got {self.gate_count}"
            )
        check.flag("TaskParams.end_when_lost", self.end_when_lost)
        if not 0.0 < check.number("TaskParams.max_tilt", self.max_tilt) <= math.pi:
            raise ValueError(f"TaskParams.max_tilt must be in (0, pi], got {self.max_tilt}")
        if min(self.preview) < 0.0:
            raise ValueError(f"TaskParams.preview must be at least 0, got {self.preview}")


def check_moments(name: str, moments: ArrayLike) -> None:
    """Refuse moments of inertia that no mass has: each is at most the sum of the other two.

    Args:
        name: What they belong to.
        moments: (3,) about the principal axes, or about any three orthogonal ones [kg m^2].

    Raises:
        ValueError: If one is larger, by more than rounding.
    """
    values = np.asarray(moments, np.float64)
    if 2.0 * values.max() > values.sum() * (1.0 + 1e-9):
        raise ValueError(
            f"{name} must be that of a body: no moment can be larger than the sum of the other "
            f"two, got {', '.join(f'{value:g}' for value in values)} kg m^2"
        )


def check_lag(name: str, time_constant: float, clocks: Clocks) -> None:
    """Refuse rotors that are too fast for the integration.

    Args:
        name: What the time constant belongs to.
        time_constant: Of the rotors' lag [s].
        clocks: Say how long a Runge-Kutta step is.

    Raises:
        ValueError: If the step is too long, so that the computed rotor speeds would diverge.
    """
    step = 1.0 / (clocks.imu_rate * clocks.substeps)
    if step > RK4_LIMIT * time_constant:
        raise ValueError(
            f"{name} must be at least {step / RK4_LIMIT:.3g} s at {clocks.imu_rate:g} Hz with "
            f"substeps={clocks.substeps}, where the integration is stable, got {time_constant:g} s"
        )


def check_limit(task: TaskParams, rate: float, name: str) -> None:
    """Refuse a time limit of less than a step, which would round to none.

    Args:
        task: Has the limit.
        rate: Of steps [Hz].
        name: Of that rate.

    Raises:
        ValueError: If it is.
    """
    if task.duration > 0.0 and round(task.duration * rate) == 0:
        raise ValueError(
            f"duration must be 0 (no limit) or at least one step, {1.0 / rate:g} s at {name}="
            f"{rate:g} Hz, got {task.duration:g} s"
        )


_VEHICLES = {"lab": VehicleParams()}
_GAINS = {
    "lab": PDGains(),
    # by random search for small errors on Hover, Circle, Lemniscate and RandomTrajectory, each
    # relative to that of the laboratory's gains, on the estimate at 50 Hz with thrust and rates
    "tuned": PDGains(
        position=10.6, velocity=3.44, attitude=(1.29, 1.29, 0.138), body_rates=(0.25, 0.25, 0.12)
    ),
}


def vehicle_params(name: str) -> VehicleParams:
    """The vehicle called `name`: "lab", the report's."""
    return _VEHICLES[check.choice("vehicle", name, tuple(_VEHICLES))]


def pd_gains(name: str) -> PDGains:
    """PD gains by name: "lab", the report's, or "tuned", for small errors on all tracking tasks."""
    return _GAINS[check.choice("gains", name, tuple(_GAINS))]

"""The vehicle and its control: rigid body, rotors, drag, rates, gains and scales of actions.

All quantities are in SI units, angles in radians; body frame B has x forward and z up along the
thrust. The laboratory's numbers come from the Aerial Robotics course (ASE 479W, The University of
Texas at Austin) whose third laboratory report this package implements.
"""

import math
from functools import partial
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from numpy.typing import ArrayLike

from quad_gym.params import checks as check
from quad_gym.params.checks import Checked, Vector
from quad_gym.params.files import Saved, is_params_file, read_params

# --------------------------------------------------------------------------------------------------
# Gravity.
# --------------------------------------------------------------------------------------------------

GRAVITY = 9.8  #: standard gravity as rounded in the laboratory report [m/s^2]


# --------------------------------------------------------------------------------------------------
# Clocks: the rates of simulation and control.
# --------------------------------------------------------------------------------------------------


class Clocks(Checked):
    """Rates of simulation and control; sensors have their own.

    A tick is one IMU sample, and every period is a whole number of ticks.
    """

    imu_rate: Annotated[float, partial(check.positive, most=1e6)] = 200.0
    """rate of IMU samples, which sets the tick [Hz]"""
    control_rate: float = 200.0
    """rate of new actions [Hz]"""
    substeps: Annotated[int, partial(check.whole, most=1000)] = 1
    """Runge-Kutta steps per tick"""

    def __post_init__(self) -> None:
        super().__post_init__()
        check.ticks("control_rate", self.control_rate, self.imu_rate)

    @property
    def step(self) -> float:
        """Duration of a Runge-Kutta step [s]."""
        return 1.0 / (self.imu_rate * self.substeps)

    @property
    def ticks_per_step(self) -> int:
        """Number of ticks in a control period."""
        return check.ticks("control_rate", self.control_rate, self.imu_rate)


# --------------------------------------------------------------------------------------------------
# The vehicle: rigid body, rotors and drag.
# --------------------------------------------------------------------------------------------------

MIN_MOMENT = 1e-9
"""Moment of inertia below which numbers are mistakes; a quadrotor of 10 g has 1e-6 [kg m^2]."""

MIN_GYRATION = 1.0 / 30.0
"""Radius of gyration over the distance of the rotors, below which numbers are mistaken: the rotors
would turn the vehicle faster than a tick resolves. Quadrotors have 0.2 to 0.8."""

MAX_GYRATION = 10.0
"""The same ratio, above which numbers are mistakes, such as moments in kg mm^2."""

SLOWEST_ROTORS = 1.0
"""Time constant of rotors above which numbers are mistakes, such as milliseconds [s]."""

MAX_LIFT = 1000.0
"""Thrust-to-weight ratio above which numbers are mistakes; racing drones reach 15."""

MAX_TORQUE_ARM = 10.0
"""Ratio of torque to thrust of a rotor above which numbers are mistakes; propellers have 0.02
[m]."""

RK4_LIMIT = 2.78
"""Largest step of the classic Runge-Kutta method over the time constant of a decay, beyond which
its solution grows: the root of |1 - z + z^2/2 - z^3/6 + z^4/24| = 1 is 2.785."""

_LIFTING = "thrust_coefficient, motor_speed_per_volt and max_voltage"


class VehicleParams(Checked, Saved):
    """A quadrotor: rigid body, four rotors with first-order speed response, disc drag."""

    mass: Annotated[float, partial(check.positive, least=1e-3)] = 0.78
    """mass [kg]; laboratory vehicle"""
    inertia: check.Matrix33 = ((1.7565e-3, 0.0, 0.0), (0.0, 3.5723e-3, 0.0), (0.0, 0.0, 4.7134e-3))
    """(3, 3) inertia about the center of mass, in B [kg m^2]; laboratory vehicle"""
    rotor_positions_B: check.Matrix43 = (
        (0.21, -0.21, 0.0),
        (0.21, 0.21, 0.0),
        (-0.21, 0.21, 0.0),
        (-0.21, -0.21, 0.0),
    )
    """(4, 3) positions of the rotor hubs relative to the center of mass, in B [m]; laboratory
    vehicle"""
    rotor_spins: Annotated[Vector, partial(check.vector, length=4)] = (1.0, -1.0, 1.0, -1.0)
    """(4,) sense of rotation of each rotor about body z, +1 or -1, opposite to its reaction torque;
    laboratory vehicle"""
    thrust_coefficient: check.Positive = 6.11e-8 / 0.104719755**2
    """kF in the thrust of a rotor, F = kF W^2 [N/(rad/s)^2]; laboratory vehicle, there per rpm^2"""
    torque_coefficient: check.Positive = 1.5e-9 / 0.104719755**2
    """kN in the reaction torque of a rotor, N = kN W^2 [N m/(rad/s)^2]; laboratory vehicle, there
    per rpm^2"""
    motor_time_constant: Annotated[float, partial(check.positive, most=SLOWEST_ROTORS)] = 0.05
    """time constant of the rotor speed's response to the voltage [s]; laboratory vehicle"""
    motor_speed_per_volt: check.Positive = 200.0
    """steady rotor speed per volt [rad/s/V]; laboratory vehicle"""
    max_voltage: check.Positive = 12.0
    """largest motor voltage [V]; laboratory vehicle"""
    disc_area: check.NonNegative = 0.01
    """area of the drag disc [m^2]; laboratory vehicle"""
    drag_coefficient: check.NonNegative = 0.3
    """drag coefficient of the drag disc [-]; laboratory vehicle"""
    air_density: check.NonNegative = 1.225
    """density of the air [kg/m^3]; standard atmosphere at sea level"""
    gravity: check.Positive = GRAVITY
    """gravitational acceleration [m/s^2]; laboratory"""

    def __post_init__(self) -> None:
        super().__post_init__()
        inertia = np.array(self.inertia)
        if not np.allclose(inertia, inertia.T, rtol=1e-9, atol=0.0):
            raise ValueError("VehicleParams.inertia must be symmetric")
        moments = np.linalg.eigvalsh(inertia)
        if moments[0] <= 1e-9 * abs(inertia).max():
            got = f"a smallest eigenvalue of {moments[0]:g}"
            self._refuse("inertia", "be positive definite", got)
        check_moments("VehicleParams.inertia", moments)
        if self.hover_voltage >= self.max_voltage:
            takes = f"that takes {self.hover_voltage:.3g} V of {self.max_voltage:g} V"
            got = f"{self.mass} kg: {takes} (by mass, gravity, {_LIFTING})"
            self._refuse("mass", "be light enough to hover", got)
        check_gyration("VehicleParams.inertia", moments, self.mass, self.rotor_positions_B)
        if 4.0 * self.max_rotor_force > MAX_LIFT * self.mass * self.gravity:
            must = f"lift at most {MAX_LIFT:g} times the weight at full voltage"
            got = f"{4.0 * self.max_rotor_force:g} N and {self.mass * self.gravity:g} N"
            self._refuse("thrust_coefficient", must, f"{got} (by mass, gravity, {_LIFTING})")
        if self.torque_coefficient > MAX_TORQUE_ARM * self.thrust_coefficient:
            must = f"be at most {MAX_TORQUE_ARM:g} m times thrust_coefficient"
            self._refuse("torque_coefficient", must)
        if any(abs(spin) != 1.0 for spin in self.rotor_spins):
            self._refuse("rotor_spins", "be +1 or -1")
        if abs(np.linalg.det(self.effectiveness)) < 1e-12:
            raise ValueError(
                "VehicleParams.rotor_positions_B must let the rotors turn the body about all axes "
                "(and rotor_spins, with torque_coefficient over thrust_coefficient as their arm)"
            )

    @property
    def max_rotor_force(self) -> float:
        """Thrust of one rotor at full voltage [N]."""
        speed = self.motor_speed_per_volt * self.max_voltage
        return self.thrust_coefficient * (speed * speed)

    @property
    def hover_voltage(self) -> float:
        """Voltage at which the four rotors carry the weight [V]."""
        force = self.mass * self.gravity / 4
        return math.sqrt(force / self.thrust_coefficient) / self.motor_speed_per_volt

    @property
    def hover_torques(self) -> tuple[float, float, float]:
        """Torques about the body axes that the weight exerts on the rotors' lever arms [N m]."""
        weight = self.mass * self.gravity
        x, y, _ = np.abs(np.array(self.rotor_positions_B)).mean(axis=0)
        return weight * y, weight * x, weight * self.torque_coefficient / self.thrust_coefficient

    @property
    def effectiveness(self) -> np.ndarray:
        """Matrix (4, 4): total thrust [N] and torque in B [N m] per unit thrust of each rotor."""
        positions, spins = np.array(self.rotor_positions_B), np.array(self.rotor_spins)
        torque_per_thrust = self.torque_coefficient / self.thrust_coefficient
        return np.stack([np.ones(4), positions[:, 1], -positions[:, 0], -torque_per_thrust * spins])


def check_moments(name: str, moments: ArrayLike) -> None:
    """Refuse moments of inertia (3,) that no body has: each is at most the sum of the other two."""
    values = np.asarray(moments, np.float64)
    if 2.0 * values.max() > values.sum() * (1.0 + 1e-9):
        raise ValueError(
            f"{name} must belong to a body: no moment can be larger than the sum of the other "
            f"two, got {', '.join(f'{value:g}' for value in values)} kg m^2"
        )


def check_gyration(name: str, moments: ArrayLike, mass: float, rotors: ArrayLike) -> None:
    """Refuse moments of inertia (3,) too small or too large for mass and rotor hubs (4, 3) [SI]."""
    reach = float(np.linalg.norm(rotors, axis=1).max())
    smallest = max(MIN_MOMENT, mass * (MIN_GYRATION * reach) ** 2)
    largest = mass * (MAX_GYRATION * reach) ** 2
    for limit, bound, found in (
        ("least", smallest, float(np.min(moments))),
        ("most", largest, float(np.max(moments))),
    ):
        if not smallest <= found <= largest:
            raise ValueError(
                f"{name} must be at {limit} {bound:.3g} kg m^2 about every axis, with a mass of "
                f"{mass:g} kg and rotor_positions_B {reach:.3g} m away, got {found:g} kg m^2"
            )


def check_lag(name: str, time_constant: float, clocks: Clocks) -> None:
    """Refuse rotors that are too fast for the integration, so that their speeds would diverge."""
    step = clocks.step
    if step > RK4_LIMIT * time_constant:
        raise ValueError(
            f"{name} must be at least {step / RK4_LIMIT:.3g} s at {clocks.imu_rate:g} Hz with "
            f"substeps={clocks.substeps}, where the integration is stable, got {time_constant:g} s"
        )


CRAZYFLIE = VehicleParams(
    # Bitcraze: Crazyflie 2.1, 27 g, and Flow deck v2, 1.6 g; 92 mm from motor to motor diagonally
    mass=0.0286,
    rotor_positions_B=(
        (0.0325, -0.0325, 0.0),
        (0.0325, 0.0325, 0.0),
        (-0.0325, 0.0325, 0.0),
        (-0.0325, -0.0325, 0.0),
    ),
    # the model cf2x of gym-pybullet-drones (J. Panerati and others, IROS 2021), after C. Luis and
    # J. Le Ny, arXiv 1608.05786, 2016: coefficients per rpm^2, thrust 2.25 times the weight of 27 g
    inertia=((1.4e-5, 0.0, 0.0), (0.0, 1.4e-5, 0.0), (0.0, 0.0, 2.17e-5)),
    thrust_coefficient=3.16e-10 / 0.104719755**2,
    torque_coefficient=7.94e-12 / 0.104719755**2,
    max_voltage=4.2,  # of a full cell
    motor_speed_per_volt=541.0,
    motor_time_constant=0.05,  # brushed motors; engineering judgment
    disc_area=0.0066,  # a disc of 92 mm; engineering judgment
)
"""A Crazyflie 2.1 with a Flow deck."""

_VEHICLES = {"lab": VehicleParams(), "crazyflie": CRAZYFLIE}


def vehicle_params(name: str | Path) -> VehicleParams:
    """A built-in vehicle, or the vehicle in a file.

    Args:
        name: "lab", of the laboratory report, or "crazyflie"; or a file that ends with ".toml", as
            `VehicleParams.save` writes it.

    Raises:
        ValueError: If there is no such vehicle, or a name or value in the file is invalid.
        OSError: If the file cannot be read.
    """
    if is_params_file(name):
        return read_params(Path(name), VehicleParams, _base)
    return _base(name, "vehicle")


def _base(name: Any, argument: str = "base") -> VehicleParams:
    return _VEHICLES[check.choice(argument, name, tuple(_VEHICLES))]


# --------------------------------------------------------------------------------------------------
# Control: gains of the PD controller, and scales and inner loops behind the actions.
# --------------------------------------------------------------------------------------------------


class PDGains(Checked):
    """Gains of the PD controller of position and attitude."""

    position: check.NonNegative = 5.0
    """proportional gain k of the position loop [N/m]; laboratory"""
    velocity: check.NonNegative = 3.1
    """derivative gain kd of the position loop [N s/m]; laboratory"""
    attitude: check.NonNegative3 = (1.0, 0.95, 0.21)
    """(3,) diagonal of the proportional gain K of the attitude loop [N m]; laboratory"""
    body_rates: check.NonNegative3 = (0.25, 0.25, 0.12)
    """(3,) diagonal of the derivative gain Kd of the attitude loop [N m s]; laboratory"""


class ActionParams(Checked):
    """Scales of the actions, and bandwidths of the inner loops that track them at every tick."""

    rate_scale: check.Positive3 = (6.0, 6.0, 3.0)
    """(3,) body rates at full action [rad/s]"""
    tilt_scale: check.AngleSize = math.radians(45.0)
    """roll and pitch angles at full action [rad]"""
    velocity_scale: check.Positive = 5.0
    """velocity along each axis at full action [m/s]"""
    rate_bandwidth: check.Positive = 14.0
    """bandwidth k_w of the body-rate loop [1/s]: torque J k_w (w* - w) + w x J w"""
    attitude_bandwidth: check.Positive = 7.0
    """bandwidth k_a of the attitude loop [1/s]: desired body rates k_a (e3 x z*)"""
    velocity_bandwidth: check.Positive = 4.0
    """bandwidth k_v of the velocity loop [1/s]: desired acceleration k_v (v* - v)"""

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.tilt_scale >= math.pi / 2:
            self._refuse("tilt_scale", "be less than pi/2")


_GAINS = {
    "lab": PDGains(),
    # random search for small errors on Hover, Circle, Lemniscate and RandomTrajectory, relative to
    # the errors with the laboratory's gains; on the estimate, at 50 Hz, with thrust and body rates
    "tuned": PDGains(
        position=10.6, velocity=3.44, attitude=(1.29, 1.29, 0.138), body_rates=(0.25, 0.25, 0.12)
    ),
}


_LAB = VehicleParams()


def pd_gains(name: str, vehicle: VehicleParams | None = None) -> PDGains:
    """Return PD gains: "lab", the report's, or "tuned", for small errors on all tracking tasks.

    Those for another vehicle than the laboratory's give the same accelerations: gains of the
    position loop grow with the mass, gains of the attitude loop with the moments of inertia.
    """
    gains = _GAINS[check.choice("gains", name, tuple(_GAINS))]
    if vehicle is None:
        return gains
    mass, turn = vehicle.mass / _LAB.mass, np.diag(vehicle.inertia) / np.diag(_LAB.inertia)
    return PDGains(
        position=mass * gains.position,
        velocity=mass * gains.velocity,
        attitude=tuple(turn * gains.attitude),
        body_rates=tuple(turn * gains.body_rates),
    )

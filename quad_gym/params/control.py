"""Control: gains of the PD controller, and scales and inner loops behind the actions."""

import math

import numpy as np

from quad_gym.params import checks as check
from quad_gym.params.checked import Checked
from quad_gym.params.vehicle import VehicleParams


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
    tilt_scale: check.Positive = math.radians(45.0)
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

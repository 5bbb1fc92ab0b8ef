"""The quadrotor's equations of motion, for one state."""

from collections.abc import Mapping

import numpy as np
from numpy.typing import ArrayLike, NDArray

from quad_gym.kernels import entries
from quad_gym.packing import params_record, world_settings
from quad_gym.params import checks as check
from quad_gym.params.suites import SensorSuite
from quad_gym.params.vehicle import VehicleParams
from quad_gym.params.world import WorldParams

State = Mapping[str, ArrayLike]
STATE_SHAPES: dict[str, tuple[int, ...]] = {
    "position": (3,),
    "velocity": (3,),
    "R_BI": (3, 3),
    "body_rates": (3,),
    "rotor_speeds": (4,),
}
"""Keys and shapes of a state: position [m] and velocity [m/s] in I, attitude, body rates in B
[rad/s], rotor speeds [rad/s]."""


def checked_state(state: State, name: str = "state") -> dict[str, NDArray[np.float64]]:
    """Return a copy of a state as float64 arrays; messages call it `name`."""
    if set(state) != set(STATE_SHAPES):
        raise ValueError(f"{name} must have the keys {sorted(STATE_SHAPES)}, got {sorted(state)}")
    return {
        key: check.array(f"{name}[{key!r}]", state[key], shape)
        for key, shape in STATE_SHAPES.items()
    }


def state_derivative(
    state: State,
    voltages: ArrayLike,
    disturbance_I: ArrayLike,
    params: VehicleParams,
    world: WorldParams | None = None,
) -> dict[str, NDArray[np.float64]]:
    """Return the time derivative of a quadrotor's state.

    `dr/dt = v`, `m dv/dt = -m g e3 + z_I sum(F_i) + d - 0.5 Cd Ad rho |z_I . v| v`, `dR_BI/dt = -[w
    x] R_BI`, `J dw/dt = N - w x J w`, `dW_i/dt = (cm ea_i - W_i) / taum`, with `F_i = kF W_i^2` and
    `N = sum(l_i x F_i e3 - s_i kN W_i^2 e3)`.

    Args:
        state: position (3,) [m] and velocity (3,) [m/s] in I, R_BI (3, 3), body_rates (3,) [rad/s]
            in B, rotor_speeds (4,) [rad/s]. R_BI is used as it is, as the stages of an integrator
            such as `scipy.integrate.solve_ivp` are no exact rotations.
        voltages: (4,) motor voltages [V], between 0 and the vehicle's largest.
        disturbance_I: (3,) external force in I [N].
        params: Parameters of the vehicle.
        world: World with steady wind, drag and ground effect: v is then relative to the air, and
            the forces of `quad_gym.WorldParams` are added. None: calm air.

    Returns:
        The derivative under the same keys, per second.

    Raises:
        ValueError: If an argument has another shape, is not finite, or a voltage is out of range.
    """
    s = checked_state(state)
    check.instance("params", params, VehicleParams)
    ea = check.array("voltages", voltages, (4,))
    d_I = check.array("disturbance_I", disturbance_I, (3,))
    if (ea < 0.0).any() or (ea > params.max_voltage).any():
        raise ValueError(f"voltages must be within [0, {params.max_voltage:g}] V, got {ea}")
    a_I, dw_B = np.empty(3), np.empty(3)
    motion = (s["R_BI"], s["velocity"], s["body_rates"], s["rotor_speeds"], d_I)
    record = params_record(params, SensorSuite(), world=world)
    if world is None:
        entries.body_accelerations(*motion, record, a_I, dw_B)
    else:
        settings = world_settings(world)
        entries.body_accelerations_in_air(s["position"], *motion, record, settings, a_I, dw_B)
    lag = params.motor_speed_per_volt * ea - s["rotor_speeds"]
    return {
        "position": s["velocity"],
        "velocity": a_I,
        "R_BI": -np.cross(s["body_rates"], s["R_BI"], axisb=0, axisc=0),
        "body_rates": dw_B,
        "rotor_speeds": lag / params.motor_time_constant,
    }

"""The quadrotor: rigid body, four lagging rotors, drag of a flat disc, and its integration.

A state is (r_I, v_I, q, w_B, rotor_speeds), a tuple of tuples; its derivative has the same form.
"""

from quad_gym.kernels.compiling import kernel, stage
from quad_gym.kernels.numbers.linalg import cross, dot, load3, load4, load33, load44, store
from quad_gym.kernels.numbers.rotation import (
    normalize_quaternion,
    quaternion_rate,
    quaternion_to_dcm,
)


@kernel
def accelerations(R_BI, v_I, w_B, rotor_speeds, d_I, p):
    """Acceleration of the center of mass in I and angular acceleration in B.

    `m dv/dt = -m g e3 + z_I sum(F_i) + d - 0.5 Cd Ad rho |z_I . v| v` with `F_i = kF W_i^2`, and
    `J dw/dt = N - w x J w` with `N = sum(l_i x F_i e3 - s_i kN W_i^2 e3)`; where the air moves, v
    is the velocity relative to it.
    """
    W, kF = rotor_speeds, p.thrust_coefficient
    forces = (kF * W[0] * W[0], kF * W[1] * W[1], kF * W[2] * W[2], kF * W[3] * W[3])
    thrust, torque_x, torque_y, torque_z = load44(p.effectiveness) @ forces
    z_I = R_BI[2]
    drag = p.half_drag * abs(dot(z_I, v_I))
    force_I = thrust * z_I - drag * v_I + d_I
    a_I = (1.0 / p.mass) * force_I - (0.0, 0.0, p.gravity)

    torque_B = (torque_x, torque_y, torque_z)
    dw_B = load33(p.inertia_inverse) @ (torque_B - cross(w_B, load33(p.inertia) @ w_B))
    return a_I, dw_B


@kernel
def rotor_lag(W, voltages, p):
    """dW_i/dt = (cm ea_i - W_i) / taum [rad/s^2]."""
    return -(1.0 / p.motor_time_constant) * (W - p.motor_speed_per_volt * voltages)


@kernel
def derivative(state, voltages, d_I, p):
    """The time derivative of a state under motor voltages [V] and a disturbance force [N]."""
    _, v_I, q, w_B, W = state
    a_I, dw_B = accelerations(quaternion_to_dcm(q), v_I, w_B, W, d_I, p)
    return v_I, a_I, quaternion_rate(q, w_B), dw_B, rotor_lag(W, voltages, p)


@kernel
def advance(state, h, rate):
    """State + h rate."""
    r, v, q, w, W = state
    dr, dv, dq, dw, dW = rate
    return r + h * dr, v + h * dv, q + h * dq, w + h * dw, W + h * dW


@kernel
def load_state(flight):
    """The true state of a flight."""
    r, v, q = load3(flight.r), load3(flight.v), load4(flight.q)
    return r, v, q, load3(flight.w), load4(flight.rotor_speeds)


@kernel
def load_start(work):
    """The true state at the start of the tick, from the workspace."""
    s = work.start
    return load3(s), load3(s[3:]), load4(s[6:]), load3(s[10:]), load4(s[13:])


@kernel
def store_state(flight, state):
    """Write the true state of a flight."""
    r, v, q, w, W = state
    store(flight.r, r)
    store(flight.v, v)
    store(flight.q, q)
    store(flight.w, w)
    store(flight.rotor_speeds, W)


@kernel
def integrate(flight, p, substeps):
    """Carry the true state over one tick by `substeps` classical Runge-Kutta steps of order four.

    The voltages and the disturbance are held; the quaternion is normalized after each step.
    """
    h = p.dt / substeps
    voltages, d_I = load4(flight.voltages), load3(flight.disturbance)
    for _ in range(substeps):
        state = load_state(flight)
        k1 = derivative(state, voltages, d_I, p)
        k2 = derivative(advance(state, 0.5 * h, k1), voltages, d_I, p)
        k3 = derivative(advance(state, 0.5 * h, k2), voltages, d_I, p)
        k4 = derivative(advance(state, h, k3), voltages, d_I, p)
        state = advance(state, h / 6.0, k1)
        state = advance(state, h / 3.0, k2)
        state = advance(state, h / 3.0, k3)
        r, v, q, w, W = advance(state, h / 6.0, k4)
        store_state(flight, (r, v, normalize_quaternion(q), w, W))


@kernel
def air_accelerations(flight, p, R_BI):
    """Acceleration in I and angular acceleration in B of a flight in the air, without contact."""
    v_air_I = load3(flight.v) - load3(flight.wind)
    d_I = load3(flight.disturbance) + load3(flight.air_force)
    W = load4(flight.rotor_speeds)
    a_I, dw_B = accelerations(R_BI, v_air_I, load3(flight.w), W, d_I, p)
    return a_I, dw_B + load33(p.inertia_inverse) @ load3(flight.air_torque)


@kernel
def body_point_velocity(R_BI, v_I, w_B, l_B):
    """Velocity of a body-fixed point in I: v_I + R^T (w x l)."""
    return v_I + R_BI.T @ cross(w_B, l_B)


@kernel
def imu_point_acceleration(R_BI, a_I, w_B, dw_B, l_B):
    """Acceleration of a body-fixed point in I: a_I + R^T (dw x l + w x (w x l)); report 2.3."""
    return a_I + R_BI.T @ (cross(dw_B, l_B) + cross(w_B, cross(w_B, l_B)))


@stage
def move_stage(flight, world, model, settings, work, stages, flag):
    """Carry the true state over a tick in calm air."""
    integrate(flight, world, settings.substeps)

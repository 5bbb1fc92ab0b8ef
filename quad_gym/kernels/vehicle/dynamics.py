"""The quadrotor: rigid body, four lagging rotors, drag of a flat disc, and its integration.

A state is (r_I, v_I, q, w_B, rotor_speeds), a tuple of tuples; its derivative has the same form.
"""

from quad_gym.kernels.compiling import kernel, stage
from quad_gym.kernels.maths.linalg import (
    add,
    add_scaled,
    apply,
    apply_transposed,
    cross,
    dot,
    load3,
    load4,
    load33,
    scale,
    store3,
    store4,
    sub,
)
from quad_gym.kernels.maths.rotation import normalize_quaternion, quaternion_rate, quaternion_to_dcm
from quad_gym.kernels.simd.blocks import lanes_of


@kernel
def combine(matrix, column):
    """A (4, 4) array times a tuple of four."""
    return (
        matrix[0, 0] * column[0]
        + matrix[0, 1] * column[1]
        + matrix[0, 2] * column[2]
        + matrix[0, 3] * column[3],
        matrix[1, 0] * column[0]
        + matrix[1, 1] * column[1]
        + matrix[1, 2] * column[2]
        + matrix[1, 3] * column[3],
        matrix[2, 0] * column[0]
        + matrix[2, 1] * column[1]
        + matrix[2, 2] * column[2]
        + matrix[2, 3] * column[3],
        matrix[3, 0] * column[0]
        + matrix[3, 1] * column[1]
        + matrix[3, 2] * column[2]
        + matrix[3, 3] * column[3],
    )


@kernel
def accelerations(R_BI, v_I, w_B, rotor_speeds, d_I, p):
    """Acceleration of the center of mass in I and angular acceleration in B.

    `m dv/dt = -m g e3 + z_I sum(F_i) + d - 0.5 Cd Ad rho |z_I . v| v` with `F_i = kF W_i^2`, and
    `J dw/dt = N - w x J w` with `N = sum(l_i x F_i e3 - s_i kN W_i^2 e3)`; where the air moves, v
    is the velocity relative to it.
    """
    W = rotor_speeds
    forces = (
        p.thrust_coefficient * W[0] * W[0],
        p.thrust_coefficient * W[1] * W[1],
        p.thrust_coefficient * W[2] * W[2],
        p.thrust_coefficient * W[3] * W[3],
    )
    thrust, torque_x, torque_y, torque_z = combine(p.effectiveness, forces)
    z_I = R_BI[2]
    drag = p.half_drag * abs(dot(z_I, v_I))
    force_I = add(add_scaled(scale(thrust, z_I), -drag, v_I), d_I)
    inverse_mass = 1.0 / p.mass
    a_I = scale(inverse_mass, force_I)
    a_I = (a_I[0], a_I[1], a_I[2] - p.gravity)

    J = load33(p.inertia)
    N_B = sub((torque_x, torque_y, torque_z), cross(w_B, apply(J, w_B)))
    return a_I, apply(load33(p.inertia_inverse), N_B)


@kernel
def rotor_lag(W, voltages, p):
    """dW_i/dt = (cm ea_i - W_i) / taum [rad/s^2]."""
    lag, gain = 1.0 / p.motor_time_constant, p.motor_speed_per_volt
    return (
        lag * (gain * voltages[0] - W[0]),
        lag * (gain * voltages[1] - W[1]),
        lag * (gain * voltages[2] - W[2]),
        lag * (gain * voltages[3] - W[3]),
    )


@kernel
def derivative(state, voltages, d_I, p):
    """The time derivative of a state under motor voltages [V] and a disturbance force [N]."""
    _, v_I, q, w_B, W = state
    a_I, dw_B = accelerations(quaternion_to_dcm(q), v_I, w_B, W, d_I, p)
    return v_I, a_I, quaternion_rate(q, w_B), dw_B, rotor_lag(W, voltages, p)


@kernel
def _advance4(x, h, k):
    return (x[0] + h * k[0], x[1] + h * k[1], x[2] + h * k[2], x[3] + h * k[3])


@kernel
def advance(state, h, rate):
    """State + h rate."""
    return (
        add_scaled(state[0], h, rate[0]),
        add_scaled(state[1], h, rate[1]),
        _advance4(state[2], h, rate[2]),
        add_scaled(state[3], h, rate[3]),
        _advance4(state[4], h, rate[4]),
    )


@kernel
def load_state(flight):
    """The true state of a flight."""
    return (
        load3(flight.r),
        load3(flight.v),
        load4(flight.q),
        load3(flight.w),
        load4(flight.rotor_speeds),
    )


@kernel
def load_start(work):
    """The true state at the start of the tick, as the workspace keeps it."""
    s = work.start
    return (
        (s[0], s[1], s[2]),
        (s[3], s[4], s[5]),
        (s[6], s[7], s[8], s[9]),
        (s[10], s[11], s[12]),
        (s[13], s[14], s[15], s[16]),
    )


@kernel
def store_state(flight, state):
    """Write the true state of a flight."""
    store3(flight.r, state[0])
    store3(flight.v, state[1])
    store4(flight.q, state[2])
    store3(flight.w, state[3])
    store4(flight.rotor_speeds, state[4])


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
def body_point_velocity(R_BI, v_I, w_B, l_B):
    """Velocity of a body-fixed point in I: v_I + R^T (w x l)."""
    return add(v_I, apply_transposed(R_BI, cross(w_B, l_B)))


@kernel
def imu_point_acceleration(R_BI, a_I, w_B, dw_B, l_B):
    """Acceleration of a body-fixed point in I: a_I + R^T (dw x l + w x (w x l)); report 2.3."""
    return add(a_I, apply_transposed(R_BI, add(cross(dw_B, l_B), cross(w_B, cross(w_B, l_B)))))


@stage
def move_stage(flight, world, model, settings, work, stages, flag):
    """Carry the true state over a tick in calm air."""
    integrate(lanes_of(flight), lanes_of(world), settings.substeps)

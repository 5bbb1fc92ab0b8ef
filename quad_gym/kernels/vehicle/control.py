"""From an action to motor voltages: delay, PD control, and inner loops of the actions.

Control uses the nominal parameters, never the true ones. The delay of an action is the true one.
"""

import math

from quad_gym.kernels.compiling import kernel, stage
from quad_gym.kernels.numbers.elementary import clip, maximum, minimum, sin_cos
from quad_gym.kernels.numbers.lanes import select, zero_like
from quad_gym.kernels.numbers.linalg import (
    cross,
    dot,
    keep,
    load3,
    load4,
    load33,
    load44,
    rounded,
    store,
    unit_or,
)
from quad_gym.kernels.task.reference import evaluate_reference
from quad_gym.records import Control

# --------------------------------------------------------------------------------------------------
# Actions that reach the vehicle some time after they are commanded.
#
# Transport from a computer to the inner loops takes time, in which the vehicle still carries out
# earlier commands. The inner loops themselves run on board, without delay.
# --------------------------------------------------------------------------------------------------


@kernel
def _forget_actions(flight, settings, mask):
    """Begin an episode as if zero, which is hover, had been commanded before it, where `mask`."""
    for k in range(settings.action_delays + 1):
        keep(flight.past_actions[k], mask, (0.0, 0.0, 0.0, 0.0))


@kernel
def _delay_action(flight, p, settings):
    """Set the action of the coming tick: the one commanded `p.action_delay` steps ago.

    The delay is in control steps, and is rounded to whole ticks: with T ticks per step, tick j of a
    step carries out the action of k steps ago, where k is `delay T - j` ticks in steps, rounded up.
    """
    T, past = settings.ticks_per_step, flight.past_actions
    since = flight.tick - T * flight.step
    for k in range(settings.action_delays, 0, -1):
        keep(past[k], since == 0.0, load4(past[k - 1]))
    chosen = load4(flight.action)
    store(past[0], chosen)
    for k in range(settings.action_delays):
        late = p.action_delay * T - 0.5 >= since + 1.0 * k * T
        chosen = select(late, load4(past[k + 1]), chosen)
    store(flight.delayed_action, chosen)


@stage
def delay_action_stage(flight, world, model, settings, work, stages, flag):
    """Set the action of the coming tick; `flag`: 1 where an episode begins instead."""
    if flag > 0:
        _forget_actions(flight, settings, work.mask > 0.0)
    else:
        _delay_action(flight, world, settings)


# --------------------------------------------------------------------------------------------------
# From the observed state to motor voltages: PD control, and inner loops of the actions.
# --------------------------------------------------------------------------------------------------


@kernel
def allocate(thrust, torque, p):
    """Motor voltages for a total thrust [N] and a torque in B [N m].

    The thrust is limited to 0.9 of the rotors' sum, 3.6 Fmax. The torque is multiplied by the
    largest alpha <= 1 that keeps every rotor force at most Fmax: with the forces f + alpha t, alpha
    is the least (Fmax - f_i) / t_i over the rotors with t_i > 0. Negative forces are set to zero,
    and a rotor that the thrust alone overloads, as unequal arms allow, is limited to Fmax.
    """
    limit = p.max_rotor_force
    zero = zero_like(thrust)
    base = load44(p.allocation) @ (minimum(thrust, 3.6 * limit), zero, zero, zero)
    turn = load44(p.allocation) @ (zero, torque[0], torque[1], torque[2])
    alpha = zero + 1.0
    for i in range(4):
        loaded = turn[i] > 0.0
        share = (limit - base[i]) / select(loaded, turn[i], 1.0)
        alpha = select(loaded, minimum(alpha, share), alpha)
    alpha = maximum(alpha, 0.0)
    f = base + alpha * turn
    return (_voltage(f[0], p), _voltage(f[1], p), _voltage(f[2], p), _voltage(f[3], p))


@kernel
def _voltage(force, p):
    force = clip(force, 0.0, p.max_rotor_force)
    return math.sqrt(force / p.thrust_coefficient) / p.motor_speed_per_volt


@kernel
def pd_wrench(r, v, R_BI, w_B, reference, p):
    """Thrust and torque of the report's PD controller.

    `F_I = k (r* - r) + kd (v* - v) + m (a* + g e3)`, `z* = F_I / |F_I|`, thrust `F_I . z_I`; with
    `b = unit(z* x x*)`, `R*_BI = [b x z*, b, z*]^T`, `R_E = R* R_BI^T` and `[e x] = R_E^T - R_E`,
    so that e is twice the vector of an antisymmetric part, `N = K e - Kd w + w x J w`.
    `reference` is (r*, v*, a*, x*) in I.
    """
    r_ref, v_ref, a_ref, x_ref = reference
    F_I = (
        p.gain_position * (r_ref - r)
        + rounded(p.gain_velocity * (v_ref - v))
        + rounded(p.mass * (a_ref[0], a_ref[1], a_ref[2] + p.gravity))
    )
    z_I = R_BI[2]
    z_ref = unit_or(F_I, z_I)
    b = unit_or(cross(z_ref, x_ref), R_BI[1])
    R_ref = (cross(b, z_ref), b, z_ref)
    R_E = R_ref @ R_BI.T
    e = (R_E[1][2] - R_E[2][1], R_E[2][0] - R_E[0][2], R_E[0][1] - R_E[1][0])
    K, Kd = p.gain_attitude, p.gain_body_rates
    gyroscopic = cross(w_B, load33(p.inertia) @ w_B)
    torque = (
        K[0] * e[0] - Kd[0] * w_B[0] + gyroscopic[0],
        K[1] * e[1] - Kd[1] * w_B[1] + gyroscopic[1],
        K[2] * e[2] - Kd[2] * w_B[2] + gyroscopic[2],
    )
    return dot(F_I, z_I), torque


@kernel
def rate_torque(w_desired, w_B, p):
    """Torque of the inner rate loop: J k_w (w* - w) + w x J w."""
    J = load33(p.inertia)
    return J @ (p.rate_bandwidth * (w_desired - w_B)) + cross(w_B, J @ w_B)


@kernel
def level_axes(R_BI):
    """The axes of the level frame in I: x ahead along the body's heading, y to its left, z up."""
    x_B_I = R_BI[0]
    zero = zero_like(x_B_I[0])
    ahead = unit_or((x_B_I[0], x_B_I[1], zero), (1.0, 0.0, 0.0))
    return (ahead, (-ahead[1], ahead[0], zero), (zero, zero, zero + 1.0))


@kernel
def tilt_rates(z_desired_I, R_BI, yaw_rate, p):
    """Body rates that turn the thrust axis toward a direction: k_a (e3 x R z*), and a yaw rate."""
    z_desired_B = R_BI @ z_desired_I
    k = p.attitude_bandwidth
    return (-k * z_desired_B[1], k * z_desired_B[0], yaw_rate)


@kernel
def act(flight, a, p, mode, reference):
    """Set the motor voltages of the coming tick, from the observed state.

    Args:
        flight: Record.
        a: Action (4,), in [-1, 1]; with `Control.PD` not used.
        p: Nominal parameters.
        mode: Meaning of the action, a `Control`.
        reference: (r*, v*, a*, x*) in I, which only `Control.PD` uses.
    """
    R_BI, w_B = load33(flight.R_seen), load3(flight.w_seen)
    weight = p.mass * p.gravity
    thrust = weight * (1.0 + a[0])
    if mode == Control.MOTOR:
        hover, limit = p.hover_voltage, p.max_voltage
        for i in range(4):
            flight.voltages[i] = minimum(hover * (1.0 + a[i]), limit)
    else:
        torque = (zero_like(thrust), zero_like(thrust), zero_like(thrust))
        if mode == Control.WRENCH:
            scales = p.torque_scale
            torque = (scales[0] * a[1], scales[1] * a[2], scales[2] * a[3])
        elif mode == Control.CTBR:
            rates = p.rate_scale
            w_desired = (rates[0] * a[1], rates[1] * a[2], rates[2] * a[3])
            torque = rate_torque(w_desired, w_B, p)
        elif mode == Control.ATTITUDE:
            s_roll, c_roll = sin_cos(p.tilt_scale * a[1])
            s_pitch, c_pitch = sin_cos(p.tilt_scale * a[2])
            z_I = level_axes(R_BI).T @ (s_pitch, -c_pitch * s_roll, c_pitch * c_roll)
            w_desired = tilt_rates(z_I, R_BI, p.rate_scale[2] * a[3], p)
            torque = rate_torque(w_desired, w_B, p)
        elif mode == Control.VELOCITY:
            level = level_axes(R_BI)
            v_level = level @ load3(flight.v_seen)
            s = p.velocity_scale
            k = p.mass * p.velocity_bandwidth
            F_level = (
                clip(k * (s * a[0] - v_level[0]), -weight, weight),
                clip(k * (s * a[1] - v_level[1]), -weight, weight),
                weight + clip(k * (s * a[2] - v_level[2]), -0.5 * weight, weight),
            )
            F_I = level.T @ F_level
            thrust = dot(F_I, R_BI[2])
            w_desired = tilt_rates(unit_or(F_I, R_BI[2]), R_BI, p.rate_scale[2] * a[3], p)
            torque = rate_torque(w_desired, w_B, p)
        else:
            r, v = load3(flight.r_seen), load3(flight.v_seen)
            thrust, torque = pd_wrench(r, v, R_BI, w_B, reference, p)
        store(flight.voltages, allocate(thrust, torque, p))


@stage
def control_stage(flight, world, model, settings, work, stages, flag):
    """Set the motor voltages of a tick."""
    nothing = load3(flight.disturbance)
    reference = (nothing, nothing, nothing, nothing)
    if settings.control == Control.PD:
        reference = evaluate_reference(flight, flight.tick * model.dt, settings.harmonics)
    action = load4(flight.action)
    if settings.action_delays > 0:
        action = load4(flight.delayed_action)
    act(flight, action, model, settings.control, reference)

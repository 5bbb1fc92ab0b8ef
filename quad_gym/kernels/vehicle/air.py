"""Moving air with gusts, rotor drag, ground effect and battery, in worlds with any of these.

The air's velocity is held over a tick, as the motor voltages are.
"""

import math

from quad_gym.kernels.compiling import kernel, stage
from quad_gym.kernels.numbers.elementary import TINY, approached, clip, exp, log, maximum, minimum
from quad_gym.kernels.numbers.lanes import logical_not, no_lane, select, zero_like
from quad_gym.kernels.numbers.linalg import dot, keep, load3, load4, load33, norm
from quad_gym.kernels.numbers.random import normal_pair, stream_of
from quad_gym.kernels.numbers.rotation import (
    normalize_quaternion,
    quaternion_rate,
    quaternion_to_dcm,
)
from quad_gym.kernels.vehicle.dynamics import (
    accelerations,
    advance,
    load_state,
    rotor_lag,
    store_state,
)
from quad_gym.records import DRAW_GUST, Supply

# --------------------------------------------------------------------------------------------------
# Dryden gusts in the low-altitude form of MIL-F-8785C (3.7.3.4), discretized exactly.
#
# Along the mean wind, the gust u is white noise through a first-order filter; across (v) and upward
# (w), it is white noise through `(1 + sqrt(3) T s) / (1 + T s)^2` with T = L / V. In the time h = V
# t / L all three are stationary at any airspeed V and length L, so V and L may change from tick to
# tick: the states below have fixed variances, and only the intensities are multiplied in.
# --------------------------------------------------------------------------------------------------

MIN_AIRSPEED = 1.0
"""Least airspeed with which gusts change [m/s]: turbulence that is frozen in the air (Taylor's
hypothesis) would be constant for a vehicle that drifts with the wind."""
_FOOT = 0.3048
_LOWEST, _HIGHEST = 10.0, 1000.0  #: feet: where the low-altitude form holds
_ROOT3, _ROOT_HALF, _ROOT_EIGHTH = math.sqrt(3.0), math.sqrt(0.5), math.sqrt(0.125)


@kernel
def gust_scales(height, wind_speed):
    """(sigma_u, sigma_w) [m/s] and (L_u, L_w) [m]; sigma_v = sigma_u and L_v = L_u.

    `sigma_w = 0.1 W20`, `sigma_u = sigma_w / k^0.4`, `L_w = h`, `L_u = h / k^1.2` with `k = 0.177 +
    0.000823 h` and h in feet.
    `height` above ground [m] counts as between 10 and 1,000 feet; `wind_speed` is W20, 20 feet
    above ground [m/s].
    """
    h = clip(height / _FOOT, _LOWEST, _HIGHEST)
    log_k = log(0.177 + 0.000823 * h)
    sigma_w = 0.1 * wind_speed
    return sigma_w * exp(-0.4 * log_k), sigma_w, _FOOT * h * exp(-1.2 * log_k), _FOOT * h


@kernel
def sinh_less_argument(h):
    """Sinh h - h for h >= 0, without cancellation."""
    z = h * h
    tail = 1.0 + z / 156.0 * (1.0 + z / 210.0 * (1.0 + z / 272.0))
    tail = 1.0 + z / 42.0 * (1.0 + z / 72.0 * (1.0 + z / 110.0 * tail))
    series = z * h / 6.0 * (1.0 + z / 20.0 * tail)
    return select(h < 1.0, series, 0.5 * (exp(h) - exp(-h)) - h)


@kernel
def first_order(x, h, n):
    """Carry `x' = -x + white noise` of unit variance over the time h, with a standard normal n."""
    return exp(-h) * x + math.sqrt(approached(2.0 * h)) * n


@kernel
def second_order(x, y, h, n, m):
    """Carry `x' = -x + noise`, `y' = -y + x` of unit noise density over the time h.

    With e = exp(-h), the added noise has the covariance [[e sinh h, c], [c, d]], where c = e (sinh
    h - h e) / 2, and d gives it the determinant e^2 (sinh^2 h - h^2) / 4.
    h is in units of the filter's time constant, n and m are standard normals, and the stationary
    covariance of (x, y) is [[1/2, 1/4], [1/4, 1/4]].
    """
    e, excess = exp(-h), sinh_less_argument(h)
    sinh = h + excess
    variance = e * sinh
    deviation = math.sqrt(variance)
    shared = 0.5 * e * (excess + h * approached(h)) / select(h > 0.0, deviation, 1.0)
    rest = 0.25 * e * excess * (sinh + h) / select(h > 0.0, sinh, 1.0)
    return e * x + deviation * n, e * (y + h * x) + shared * n + math.sqrt(rest) * m


@kernel
def draw_gust(flight, stream, mask):
    """Draw the stationary gust at the start of an episode, where `mask`."""
    n_u, n_v = normal_pair(stream, DRAW_GUST)
    m_v, n_w = normal_pair(stream, DRAW_GUST + 1)
    m_w, _ = normal_pair(stream, DRAW_GUST + 2)
    start = (
        n_u,
        _ROOT_HALF * n_v,
        _ROOT_EIGHTH * (n_v + m_v),
        _ROOT_HALF * n_w,
        _ROOT_EIGHTH * (n_w + m_w),
    )
    for i in range(5):
        flight.gust[i] = select(mask, start[i], flight.gust[i])


@kernel
def carry_gust(flight, p):
    """Carry the gust over a tick, at the vehicle's present height and airspeed."""
    _, _, L_u, L_w = gust_scales(flight.r[2] - p.ground_height, p.gust_wind_speed)
    airspeed = norm(load3(flight.v) - load3(p.wind_I))
    way = p.dt * maximum(airspeed, MIN_AIRSPEED)
    stream = stream_of(flight)
    n_u, n_v = normal_pair(stream, DRAW_GUST)
    m_v, n_w = normal_pair(stream, DRAW_GUST + 1)
    m_w, _ = normal_pair(stream, DRAW_GUST + 2)
    gust = flight.gust
    gust[0] = first_order(gust[0], way / L_u, n_u)
    gust[1], gust[2] = second_order(gust[1], gust[2], way / L_u, n_v, m_v)
    gust[3], gust[4] = second_order(gust[3], gust[4], way / L_w, n_w, m_w)


@kernel
def gust_velocity(flight, p):
    """Velocity of the gust in I [m/s]; u lies along the horizontal mean wind (or east), w is up."""
    sigma_u, sigma_w, _, _ = gust_scales(flight.r[2] - p.ground_height, p.gust_wind_speed)
    gust = flight.gust
    u = sigma_u * gust[0]
    v = sigma_u * (_ROOT3 * gust[1] + (1.0 - _ROOT3) * gust[2])
    w = sigma_w * (_ROOT3 * gust[3] + (1.0 - _ROOT3) * gust[4])
    x, y = p.wind_I[0], p.wind_I[1]
    speed = math.sqrt(x * x + y * y)
    blows = speed > 0.0
    along = select(blows, speed, 1.0)
    c, s = select(blows, x, 1.0) / along, y / along
    return (c * u - s * v, s * u + c * v, w)


# --------------------------------------------------------------------------------------------------
# Moving air, rotor drag, ground effect and battery. These stages run only in worlds with any.
# --------------------------------------------------------------------------------------------------


@kernel
def ground_gain(height, radius):
    """Relative gain of thrust near the ground: 1 / (1 - (R / 4z)^2) - 1.

    I. C. Cheeseman and W. E. Bennett, 1955, for hover. Heights below R/2 count as R/2.
    """
    ratio = 0.25 * radius / maximum(height, 0.5 * radius)
    square = ratio * ratio
    return square / (1.0 - square)


@kernel
def air_wrench(r_I, R_BI, v_air_I, rotor_speeds, p, settings):
    """Force in I [N] and torque in B [N m] that the air adds to thrust and disc drag.

    Linear drag `-(D + D_W sum W_i) v_air` along the body axes (Faessler et al. 2018; Svacha et al.
    2017), and each rotor's gain of thrust near the ground.

    `v_air_I` is the velocity relative to the air [m/s].
    """
    W = rotor_speeds
    zero = zero_like(r_I[0])
    force_I, torque_B = (zero, zero, zero), (zero, zero, zero)
    if settings.linear_drag:
        v_B = R_BI @ v_air_I
        D = load3(p.linear_drag_B) + (W[0] + W[1] + W[2] + W[3]) * load3(p.rotor_drag_B)
        force_I = force_I - R_BI.T @ (D[0] * v_B[0], D[1] * v_B[1], D[2] * v_B[2])
    if settings.ground_effect:
        up_B = R_BI.T[2]
        level = maximum(up_B[2], 0.0)
        thrust, torque_x, torque_y = zero, zero, zero
        for i in range(4):
            height = r_I[2] - p.ground_height + dot(up_B, load3(p.rotor_positions_B[i]))
            force = p.thrust_coefficient * W[i] * W[i]
            gained = level * ground_gain(height, p.rotor_radius) * force
            thrust = thrust + p.effectiveness[0, i] * gained
            torque_x = torque_x + p.effectiveness[1, i] * gained
            torque_y = torque_y + p.effectiveness[2, i] * gained
        force_I = thrust * R_BI[2] + force_I
        torque_B = (torque_x, torque_y, zero)
    return force_I, torque_B


@kernel
def accelerations_in_air(r_I, R_BI, v_I, w_B, rotor_speeds, d_I, wind_I, p, settings):
    """As `dynamics.accelerations`, in air that moves with the velocity wind_I."""
    v_air_I = v_I - wind_I
    force_I, torque_B = air_wrench(r_I, R_BI, v_air_I, rotor_speeds, p, settings)
    a_I, dw_B = accelerations(R_BI, v_air_I, w_B, rotor_speeds, d_I + force_I, p)
    return a_I, dw_B + load33(p.inertia_inverse) @ torque_B


@kernel
def _derivative(state, voltages, d_I, wind_I, p, settings):
    r_I, v_I, q, w_B, W = state
    R_BI = quaternion_to_dcm(q)
    a_I, dw_B = accelerations_in_air(r_I, R_BI, v_I, w_B, W, d_I, wind_I, p, settings)
    return v_I, a_I, quaternion_rate(q, w_B), dw_B, rotor_lag(W, voltages, p)


@kernel
def integrate_in_air(flight, p, settings):
    """As `dynamics.integrate`, in moving air."""
    h = p.dt / settings.substeps
    voltages, d_I, wind_I = load4(flight.voltages), load3(flight.disturbance), load3(flight.wind)
    for _ in range(settings.substeps):
        start = load_state(flight)
        k = _derivative(start, voltages, d_I, wind_I, p, settings)
        end = advance(start, h / 6.0, k)
        for part in range(3):  # a loop, as four copies of the derivative take long to compile
            last = part == 2
            state = advance(start, h if last else 0.5 * h, k)
            k = _derivative(state, voltages, d_I, wind_I, p, settings)
            end = advance(end, h / 6.0 if last else h / 3.0, k)
        r, v, q, w, W = end
        store_state(flight, (r, v, normalize_quaternion(q), w, W))


@kernel
def set_air(flight, p, settings, mask):
    """Set the air's velocity, force and torque at the present instant, where `mask`.

    The accelerometer measures their effect.
    """
    wind_I = load3(p.wind_I)
    if settings.gusts:
        wind_I = wind_I + gust_velocity(flight, p)
    r_I, v_I, q, _, W = load_state(flight)
    force_I, torque_B = air_wrench(r_I, quaternion_to_dcm(q), v_I - wind_I, W, p, settings)
    keep(flight.wind, mask, wind_I)
    keep(flight.air_force, mask, force_I)
    keep(flight.air_torque, mask, torque_B)


@kernel
def battery_voltage(charge, power, current, p):
    """Largest voltage of the motors, and the power that the battery delivers.

    U = U0 - R P / U, and at most the V with V I = U0^2 / (4 R), the most that the battery can
    deliver. P is the electrical power of the rotors at their present speeds [W], I the power over
    voltage of rotors at steady speeds [A]. An empty battery cuts off.
    """
    U0 = p.max_voltage * (p.battery_empty_voltage + (1.0 - p.battery_empty_voltage) * charge)
    R = p.battery_resistance
    loaded = 0.5 * (U0 + math.sqrt(maximum(U0 * U0 - 4.0 * R * power, 0.0)))
    loaded = minimum(loaded, 0.25 * U0 * U0 / maximum(R * current, TINY))
    delivered = minimum(power, 0.25 * U0 * U0 / maximum(R, TINY))
    return select(charge > 0.0, loaded, 0.0), delivered


@stage
def begin_in_air_stage(flight, world, model, settings, work, stages, flag):
    """Draw the gust and set the air at the start of an episode."""
    if settings.gusts:
        draw_gust(flight, stream_of(flight), work.mask > 0.0)
    set_air(flight, world, settings, work.mask > 0.0)


@stage
def move_in_air_stage(flight, world, model, settings, work, stages, flag):
    """Carry the true state and the gust over a tick, and set the air at its end."""
    integrate_in_air(flight, world, settings)
    if settings.gusts:
        carry_gust(flight, world)
    set_air(flight, world, settings, logical_not(no_lane(flight.tick)))


@stage
def supply_stage(flight, world, model, settings, work, stages, flag):
    """Limit the motor voltages, and take a tick's energy from the battery."""
    p, limit = world, world.max_voltage
    if settings.supply == Supply.BATTERY:
        W = load4(flight.rotor_speeds)
        power, current = zero_like(W[0]), zero_like(W[0])
        for i in range(4):
            torque = p.effectiveness[0, i] * p.torque_coefficient * W[i] * W[i]
            power = power + torque * W[i]
            current = current + torque * p.motor_speed_per_volt
        power, current = power / p.battery_motor_efficiency, current / p.battery_motor_efficiency
        limit, delivered = battery_voltage(flight.charge, power, current, p)
        flight.charge = maximum(flight.charge - p.dt * delivered / p.battery_energy, 0.0)
    for i in range(4):
        flight.voltages[i] = minimum(flight.voltages[i], limit)

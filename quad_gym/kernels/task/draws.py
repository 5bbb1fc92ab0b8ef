"""Domain randomization: a flight's own parameters, drawn when an episode begins.

`flight.drawn` holds the drawn numbers, in the columns of `quad_gym.params.randomization`; the
parameters that follow from them are computed anew whenever flights are stepped, so that a
flight is nothing but its record.
"""

import math

import numpy as np

from quad_gym.kernels.compiling import kernel, stage
from quad_gym.kernels.maths.elementary import clip, exp, log, minimum, sin_cos
from quad_gym.kernels.maths.linalg import load33, multiply, norm, store33
from quad_gym.kernels.maths.random import stream_of, uniform_pair
from quad_gym.kernels.maths.rotation import euler_to_dcm
from quad_gym.kernels.simd.blocks import lanes_of
from quad_gym.kernels.simd.lanes import select
from quad_gym.records import COLUMNS, DRAW_PARAMETERS, DRAWN_SIZE, FIXED, LOG_UNIFORM, NORMAL

_FIRST = np.uint64(DRAW_PARAMETERS)
_HALF_STEP = 2.0**-53  # moves a number on [0, 1) into (0, 1)

_MASS, _INERTIA = COLUMNS["mass"].start, COLUMNS["inertia"].start
_CENTER, _EFFICIENCY = COLUMNS["center_of_mass_B"].start, COLUMNS["rotor_efficiency"].start
_KF, _KN = COLUMNS["thrust_coefficient"].start, COLUMNS["torque_coefficient"].start
_TAU, _GAIN = COLUMNS["motor_time_constant"].start, COLUMNS["motor_speed_per_volt"].start
_VOLTAGE, _DRAG = COLUMNS["max_voltage"].start, COLUMNS["drag_coefficient"].start
_WIND, _WIND_SPEED = COLUMNS["wind_east"].start, COLUMNS["wind_speed"].start
_WIND_DIRECTION, _GUST = COLUMNS["wind_direction"].start, COLUMNS["gust_wind_speed"].start
_LINEAR_DRAG, _ROTOR_DRAG = COLUMNS["linear_drag_B"].start, COLUMNS["rotor_drag_B"].start
_CHARGE, _RESISTANCE = COLUMNS["battery_charge"].start, COLUMNS["battery_resistance"].start
_ACCEL_NOISE, _GYRO_NOISE = (
    COLUMNS["accel_noise_density"].start,
    COLUMNS["gyro_noise_density"].start,
)
_ACCEL_BIAS, _GYRO_BIAS = COLUMNS["accel_bias_sigma"].start, COLUMNS["gyro_bias_sigma"].start
_ACCEL_TAU, _GYRO_TAU = COLUMNS["accel_bias_tau"].start, COLUMNS["gyro_bias_tau"].start
_POSITION_SIGMA, _BASELINE_SIGMA = (
    COLUMNS["position_sigma_I"].start,
    COLUMNS["baseline_sigma"].start,
)
_PIXEL_SIGMA, _LEVER_ARM = COLUMNS["pixel_sigma"].start, COLUMNS["lever_arm_B"].start
_PRIMARY, _SECONDARY = COLUMNS["primary_antenna_B"].start, COLUMNS["secondary_antenna_B"].start
_CAMERA, _CAMERA_ROTATION = COLUMNS["camera_position_B"].start, COLUMNS["camera_rotation"].start
_FOCAL_LENGTH = COLUMNS["focal_length"].start
_ACTION_DELAY = COLUMNS["action_delay"].start


@kernel
def normal_quantile(p):
    """The x with Phi(x) = p, for p in (0, 1), to 16 digits.

    M. J. Wichura, "Algorithm AS 241: The percentage points of the normal distribution", Applied
    Statistics 37, 1988 (PPND16).
    """
    q = p - 0.5
    r = 0.180625 - q * q
    # fmt: off
    middle = q * (((((((r * 2509.0809287301226727 + 33430.575583588128105) * r
        + 67265.770927008700853) * r + 45921.953931549871457) * r
        + 13731.693765509461125) * r + 1971.5909503065514427) * r
        + 133.14166789178437745) * r + 3.387132872796366608) / (((((((r * 5226.495278852545925
        + 28729.085735721942674) * r + 39307.89580009271061) * r + 21213.794301586595867) * r
        + 5394.1960214247511077) * r + 687.1870074920579083) * r + 42.313330701600911252) * r + 1.0)
    s = math.sqrt(-log(minimum(p, 1.0 - p)))
    t = s - 1.6
    near = (((((((t * 7.7454501427834140764e-4 + 0.0227238449892691845833) * t
        + 0.24178072517745061177) * t + 1.27045825245236838258) * t
        + 3.64784832476320460504) * t + 5.7694972214606914055) * t + 4.6303378461565452959) * t
        + 1.42343711074968357734) / (((((((t * 1.05075007164441684324e-9
        + 5.475938084995344946e-4) * t + 0.0151986665636164571966) * t
        + 0.14810397642748007459) * t + 0.68976733498510000455) * t + 1.6763848301838038494) * t
        + 2.05319162663775882187) * t + 1.0)
    t = s - 5.0
    far = (((((((t * 2.01033439929228813265e-7 + 2.71155556874348757815e-5) * t
        + 0.0012426609473880784386) * t + 0.026532189526576123093) * t
        + 0.29656057182850489123) * t + 1.7848265399172913358) * t + 5.4637849111641143699) * t
        + 6.6579046435011037772) / (((((((t * 2.04426310338993978564e-15
        + 1.4215117583164458887e-7) * t + 1.8463183175100546818e-5) * t
        + 7.868691311456132591e-4) * t + 0.0148753612908506148525) * t
        + 0.13692988092273580531) * t + 0.59983220655588793769) * t + 1.0)
    # fmt: on
    tail = select(s <= 5.0, near, far)
    return select(abs(q) <= 0.425, middle, select(q < 0.0, -tail, tail))


@kernel
def draw_parameters(flight, settings, stream, mask):
    """Draw the parameters of a new episode, where `mask`.

    Each column has a draw of its own, so that a parameter does not depend on which others are
    drawn.
    """
    for k in range(DRAWN_SIZE):
        kind = settings.draw_kind[k]
        if kind != FIXED:
            u, _ = uniform_pair(stream, _FIRST + np.uint64(k))
            u = u + _HALF_STEP
            a, b = settings.draw_a[k], settings.draw_b[k]
            if kind == NORMAL:
                value = a + b * normal_quantile(settings.draw_c[k] + settings.draw_d[k] * u)
            elif kind == LOG_UNIFORM:
                value = a * exp(b * u)
            else:
                value = a + b * u
            # the bounds hold to the last bit
            value = clip(value, settings.draw_low[k], settings.draw_high[k])
            flight.drawn[k] = select(mask, value, flight.drawn[k])


@kernel
def _value(flight, settings, k, nominal):
    """Column k where it is drawn, else the nominal value."""
    value = nominal
    if settings.draw_kind[k] != FIXED:
        value = flight.drawn[k]
    return value


@kernel
def _impose_body(flight, nominal, own, settings):
    """Mass, inertia, and the rotors with the effectiveness and allocation that follow."""
    own.mass = _value(flight, settings, _MASS, nominal.mass)
    for i in range(3):
        for j in range(3):
            # J' = S J S with S diagonal is positive definite as J is
            J_i, J_j = nominal.inertia[i, i], nominal.inertia[j, j]
            f_i = _value(flight, settings, _INERTIA + i, J_i) / J_i
            f_j = _value(flight, settings, _INERTIA + j, J_j) / J_j
            scale = math.sqrt(f_i * f_j)
            own.inertia[i, j] = scale * nominal.inertia[i, j]
            own.inertia_inverse[i, j] = nominal.inertia_inverse[i, j] / scale

    kF = _value(flight, settings, _KF, nominal.thrust_coefficient)
    kN = _value(flight, settings, _KN, nominal.torque_coefficient)
    turn = (kN / kF) / (nominal.torque_coefficient / nominal.thrust_coefficient)
    zero = 0.0 * kF
    x = _value(flight, settings, _CENTER, zero)
    y = _value(flight, settings, _CENTER + 1, zero)
    z = _value(flight, settings, _CENTER + 2, zero)
    for i in range(4):
        # E' = M E D and so A' = D^-1 A M^-1: D scales the rotors, M moves the center of mass
        e = _value(flight, settings, _EFFICIENCY + i, zero + 1.0)
        E, A = nominal.effectiveness, nominal.allocation
        own.effectiveness[0, i] = e * E[0, i]
        own.effectiveness[1, i] = e * (E[1, i] - y * E[0, i])
        own.effectiveness[2, i] = e * (E[2, i] + x * E[0, i])
        own.effectiveness[3, i] = e * turn * E[3, i]
        own.allocation[i, 0] = (A[i, 0] + y * A[i, 1] - x * A[i, 2]) / e
        own.allocation[i, 1] = A[i, 1] / e
        own.allocation[i, 2] = A[i, 2] / e
        own.allocation[i, 3] = A[i, 3] / (turn * e)
        own.rotor_positions_B[i, 0] = nominal.rotor_positions_B[i, 0] - x
        own.rotor_positions_B[i, 1] = nominal.rotor_positions_B[i, 1] - y
        own.rotor_positions_B[i, 2] = nominal.rotor_positions_B[i, 2] - z
        if settings.grounded:
            own.feet_B[i, 0] = nominal.feet_B[i, 0] - x
            own.feet_B[i, 1] = nominal.feet_B[i, 1] - y
            own.feet_B[i, 2] = nominal.feet_B[i, 2] - z

    own.thrust_coefficient, own.torque_coefficient = kF, kN
    own.action_delay = _value(flight, settings, _ACTION_DELAY, nominal.action_delay)
    own.motor_time_constant = _value(flight, settings, _TAU, nominal.motor_time_constant)
    gain = _value(flight, settings, _GAIN, nominal.motor_speed_per_volt)
    full = _value(flight, settings, _VOLTAGE, nominal.max_voltage)
    own.motor_speed_per_volt, own.max_voltage = gain, full
    own.max_rotor_force = kF * (gain * full) * (gain * full)
    own.hover_voltage = math.sqrt(0.25 * own.mass * nominal.gravity / kF) / gain
    weight = own.mass / nominal.mass
    own.torque_scale[0] = weight * nominal.torque_scale[0]
    own.torque_scale[1] = weight * nominal.torque_scale[1]
    own.torque_scale[2] = weight * turn * nominal.torque_scale[2]


@kernel
def _impose_world(flight, nominal, own, settings):
    """Drag, wind, gusts and battery."""
    if settings.draw_kind[_DRAG] != FIXED:
        own.half_drag = flight.drawn[_DRAG] * nominal.half_disc
    for i in range(3):
        own.wind_I[i] = _value(flight, settings, _WIND + i, nominal.wind_I[i])
        own.linear_drag_B[i] = _value(flight, settings, _LINEAR_DRAG + i, nominal.linear_drag_B[i])
        own.rotor_drag_B[i] = _value(flight, settings, _ROTOR_DRAG + i, nominal.rotor_drag_B[i])
    if settings.draw_kind[_WIND_SPEED] != FIXED or settings.draw_kind[_WIND_DIRECTION] != FIXED:
        speed = _value(flight, settings, _WIND_SPEED, nominal.wind_speed)
        s, c = sin_cos(_value(flight, settings, _WIND_DIRECTION, nominal.wind_direction))
        own.wind_I[0], own.wind_I[1] = speed * c, speed * s
    own.gust_wind_speed = _value(flight, settings, _GUST, nominal.gust_wind_speed)
    own.battery_charge = _value(flight, settings, _CHARGE, nominal.battery_charge)
    own.battery_resistance = _value(flight, settings, _RESISTANCE, nominal.battery_resistance)


@kernel
def _all_noise(drawn, white, all_of_it):
    """A drawn white noise with what the filter takes for white, too."""
    return math.sqrt(drawn * drawn + (all_of_it - white) * (all_of_it + white))


@kernel
def _impose_noise(flight, nominal, own, settings):
    """White noise, and biases with the decay and drive that follow."""
    root = math.sqrt(nominal.dt)
    if settings.draw_kind[_ACCEL_NOISE] != FIXED:
        own.accel_sigma = flight.drawn[_ACCEL_NOISE] / root
        own.accel_noise = _all_noise(own.accel_sigma, nominal.accel_sigma, nominal.accel_noise)
    if settings.draw_kind[_GYRO_NOISE] != FIXED:
        own.gyro_sigma = flight.drawn[_GYRO_NOISE] / root
        own.gyro_noise = _all_noise(own.gyro_sigma, nominal.gyro_sigma, nominal.gyro_noise)
    own.accel_bias_sigma = _value(flight, settings, _ACCEL_BIAS, nominal.accel_bias_sigma)
    own.gyro_bias_sigma = _value(flight, settings, _GYRO_BIAS, nominal.gyro_bias_sigma)
    if settings.draw_kind[_ACCEL_TAU] != FIXED:
        own.accel_bias_decay = exp(-nominal.dt / flight.drawn[_ACCEL_TAU])
    if settings.draw_kind[_GYRO_TAU] != FIXED:
        own.gyro_bias_decay = exp(-nominal.dt / flight.drawn[_GYRO_TAU])
    if settings.draw_kind[_ACCEL_BIAS] != FIXED or settings.draw_kind[_ACCEL_TAU] != FIXED:
        a = own.accel_bias_decay
        own.accel_bias_drive = own.accel_bias_sigma * math.sqrt((1.0 - a) * (1.0 + a))
    if settings.draw_kind[_GYRO_BIAS] != FIXED or settings.draw_kind[_GYRO_TAU] != FIXED:
        g = own.gyro_bias_decay
        own.gyro_bias_drive = own.gyro_bias_sigma * math.sqrt((1.0 - g) * (1.0 + g))
    for i in range(3):
        if settings.draw_kind[_POSITION_SIGMA + i] != FIXED:
            own.gnss_sigma[i] = flight.drawn[_POSITION_SIGMA + i]
    if settings.draw_kind[_BASELINE_SIGMA] != FIXED:
        white, own.baseline_sigma = nominal.baseline_sigma, flight.drawn[_BASELINE_SIGMA]
        own.baseline_noise = _all_noise(own.baseline_sigma, white, nominal.baseline_noise)
        own.first_baseline_sigma = _all_noise(
            own.baseline_sigma, white, nominal.first_baseline_sigma
        )
    own.pixel_sigma = _value(flight, settings, _PIXEL_SIGMA, nominal.pixel_sigma)


@kernel
def _impose_mounting(flight, nominal, own, settings):
    """Where the sensors are, seen from the true center of mass."""
    for i in range(3):
        center = _value(flight, settings, _CENTER + i, 0.0 * nominal.mass)
        antenna, baseline = nominal.antenna[i], nominal.baseline[i]
        primary = _value(flight, settings, _PRIMARY + i, antenna) - antenna
        secondary = _value(flight, settings, _SECONDARY + i, antenna + baseline)
        secondary = secondary - (antenna + baseline)
        own.antenna[i] = antenna + (primary - center)
        own.baseline[i] = baseline + (secondary - primary)
        lever_arm = _value(flight, settings, _LEVER_ARM + i, nominal.imu_lever_arm[i])
        own.imu_lever_arm[i] = lever_arm - center
        own.camera[i] = _value(flight, settings, _CAMERA + i, nominal.camera[i]) - center
    own.baseline_length = norm((own.baseline[0], own.baseline[1], own.baseline[2]))
    if (
        settings.draw_kind[_CAMERA_ROTATION] != FIXED
        or settings.draw_kind[_CAMERA_ROTATION + 1] != FIXED
        or settings.draw_kind[_CAMERA_ROTATION + 2] != FIXED
    ):
        k = _CAMERA_ROTATION
        e = (flight.drawn[k], flight.drawn[k + 1], flight.drawn[k + 2])
        store33(own.R_CB, multiply(euler_to_dcm(e), load33(nominal.R_CB)))
    own.focal_length = _value(flight, settings, _FOCAL_LENGTH, nominal.focal_length)
    if settings.draw_kind[_FOCAL_LENGTH] != FIXED:
        own.blur = nominal.blur * (own.focal_length / nominal.focal_length)


@kernel
def impose(flight, nominal, own, settings):
    """Put together a flight's own parameters from what it has drawn.

    Args:
        flight: Record, with its draws.
        nominal: Parameters without draws.
        own: Parameters that were a copy of `nominal` at first; those that draws touch are written.
        settings: Says what is drawn.
    """
    _impose_body(flight, nominal, own, settings)
    _impose_world(flight, nominal, own, settings)
    _impose_noise(flight, nominal, own, settings)
    _impose_mounting(flight, nominal, own, settings)


@stage
def draw_stage(flight, world, model, settings, work, stages, flag):
    """Draw the parameters of a new episode."""
    flying = lanes_of(flight)
    draw_parameters(flying, settings, stream_of(flying), lanes_of(work).mask > 0.0)


@stage
def impose_stage(flight, world, model, settings, work, stages, flag):
    """Put the parameters of the flights at hand together in `world`; `model`: the nominal ones."""
    impose(lanes_of(flight), lanes_of(model), lanes_of(world), settings)

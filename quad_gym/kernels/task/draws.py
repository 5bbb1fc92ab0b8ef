"""Domain randomization: draws of an episode, and parameters that follow from them.

`flight.drawn` holds the drawn numbers in the order of `DRAWABLES`, which is also the order of the
first fields of a record of parameters. The other parameters are derived from them whenever flights
are stepped, so that the record alone defines a flight.
"""

import math

import numpy as np

from quad_gym.kernels.compiling import kernel, stage
from quad_gym.kernels.numbers.blocks import numbers_of
from quad_gym.kernels.numbers.elementary import approached, clip, exp, log, minimum, sin_cos
from quad_gym.kernels.numbers.lanes import select
from quad_gym.kernels.numbers.linalg import keep, load3, load33, norm, store, vector
from quad_gym.kernels.numbers.random import stream_of, uniform_pair
from quad_gym.kernels.numbers.rotation import euler_to_dcm
from quad_gym.records import (
    BASELINE_BLOCK,
    COLUMNS,
    DRAW_PARAMETERS,
    DRAWN_SIZE,
    FIXED,
    LOG_UNIFORM,
    NORMAL,
    PARAMETERS_DRAWN,
)

# --------------------------------------------------------------------------------------------------
# Derivation of parameters from drawn ones.
#
# Formulas scale or shift the nominal values, which `quad_gym.packing` computes, so that these stay
# unchanged if nothing is drawn. Formulas that would round differently are skipped in this case.
# --------------------------------------------------------------------------------------------------

_DRAG, _WIND_SPEED, _WIND_DIRECTION, _CAMERA_ROTATION, _FOCAL_LENGTH, _BASELINE_SIGMA = (
    COLUMNS[name].start
    for name in (
        "drag_coefficient",
        "wind_speed",
        "wind_direction",
        "camera_rotation",
        "focal_length",
        "baseline_sigma",
    )
)
_ACCEL_NOISE, _ACCEL_BIAS, _ACCEL_TAU, _GYRO_NOISE, _GYRO_BIAS, _GYRO_TAU = (
    COLUMNS[f"{sensor}_{name}"].start
    for sensor in ("accel", "gyro")
    for name in ("noise_density", "bias_sigma", "bias_tau")
)


@kernel
def _derive_body(own, nominal, settings):
    """Derive the inertia, rotors with effectiveness and allocation, and scales of actions."""
    for i in range(3):
        for j in range(3):
            # J' = S J S with S diagonal is positive definite as J is
            f_i = own.moments[i] / nominal.moments[i]
            f_j = own.moments[j] / nominal.moments[j]
            scale = math.sqrt(f_i * f_j)
            own.inertia[i, j] = scale * nominal.inertia[i, j]
            own.inertia_inverse[i, j] = nominal.inertia_inverse[i, j] / scale

    kF, kN = own.thrust_coefficient, own.torque_coefficient
    turn = (kN / kF) / (nominal.torque_coefficient / nominal.thrust_coefficient)
    center = load3(own.center_of_mass_B)
    x, y, _ = center
    for i in range(4):
        # E' = M E D and so A' = D^-1 A M^-1: D scales the rotors, M moves the center of mass
        e, E, A = own.rotor_efficiency[i], nominal.effectiveness, nominal.allocation
        own.effectiveness[0, i] = e * E[0, i]
        own.effectiveness[1, i] = e * (E[1, i] - y * E[0, i])
        own.effectiveness[2, i] = e * (E[2, i] + x * E[0, i])
        own.effectiveness[3, i] = e * turn * E[3, i]
        own.allocation[i, 0] = (A[i, 0] + y * A[i, 1] - x * A[i, 2]) / e
        own.allocation[i, 1] = A[i, 1] / e
        own.allocation[i, 2] = A[i, 2] / e
        own.allocation[i, 3] = A[i, 3] / (turn * e)
        store(own.rotor_positions_B[i], load3(nominal.rotor_positions_B[i]) - center)
        if settings.grounded:
            store(own.feet_B[i], load3(nominal.feet_B[i]) - center)

    gain, full = own.motor_speed_per_volt, own.max_voltage
    own.max_rotor_force = kF * (gain * full) * (gain * full)
    own.hover_voltage = math.sqrt(0.25 * own.mass * nominal.gravity / kF) / gain
    weight = own.mass / nominal.mass
    own.torque_scale[0] = weight * nominal.torque_scale[0]
    own.torque_scale[1] = weight * nominal.torque_scale[1]
    own.torque_scale[2] = weight * turn * nominal.torque_scale[2]


@kernel
def _derive_air(own, nominal, settings):
    """Derive the drag of the disc and the wind."""
    if settings.draw_kind[_DRAG] != FIXED:
        own.half_drag = own.drag_coefficient * nominal.half_disc
    own.wind_I[0], own.wind_I[1], own.wind_I[2] = own.wind_east, own.wind_north, own.wind_up
    if settings.draw_kind[_WIND_SPEED] != FIXED or settings.draw_kind[_WIND_DIRECTION] != FIXED:
        s, c = sin_cos(own.wind_direction)
        own.wind_I[0], own.wind_I[1] = own.wind_speed * c, own.wind_speed * s


@kernel
def _all_noise(drawn, white, all_of_it):
    """Return a drawn white noise plus all other noise that the filter assumes to be white."""
    return math.sqrt(drawn * drawn + (all_of_it - white) * (all_of_it + white))


@kernel
def _derive_noise(own, nominal, settings):
    """Derive white noise, and decay and driving noise of biases."""
    kinds, root = settings.draw_kind, math.sqrt(nominal.dt)
    if kinds[_ACCEL_NOISE] != FIXED:
        own.accel_sigma = own.accel_noise_density / root
        own.accel_noise = _all_noise(own.accel_sigma, nominal.accel_sigma, nominal.accel_noise)
    if kinds[_GYRO_NOISE] != FIXED:
        own.gyro_sigma = own.gyro_noise_density / root
        own.gyro_noise = _all_noise(own.gyro_sigma, nominal.gyro_sigma, nominal.gyro_noise)
    if kinds[_ACCEL_TAU] != FIXED:
        own.accel_bias_decay = exp(-nominal.dt / own.accel_bias_tau)
    if kinds[_GYRO_TAU] != FIXED:
        own.gyro_bias_decay = exp(-nominal.dt / own.gyro_bias_tau)
    if kinds[_ACCEL_BIAS] != FIXED or kinds[_ACCEL_TAU] != FIXED:
        gained = approached(2.0 * nominal.dt / own.accel_bias_tau)
        own.accel_bias_drive = own.accel_bias_sigma * math.sqrt(gained)
    if kinds[_GYRO_BIAS] != FIXED or kinds[_GYRO_TAU] != FIXED:
        gained = approached(2.0 * nominal.dt / own.gyro_bias_tau)
        own.gyro_bias_drive = own.gyro_bias_sigma * math.sqrt(gained)
    if kinds[_BASELINE_SIGMA] != FIXED:
        drawn, white = own.baseline_sigma, nominal.baseline_sigma
        own.baseline_noise = _all_noise(drawn, white, nominal.baseline_noise)
        own.first_baseline_sigma = _all_noise(drawn, white, nominal.first_baseline_sigma)


@kernel
def _derive_sensors(own, nominal, settings):
    """Derive sensor positions relative to the true center of mass, and the camera's attitude."""
    for i in range(3):
        center, antenna = own.center_of_mass_B[i], nominal.antenna[i]
        primary = own.primary_antenna_B[i] - antenna
        secondary = own.secondary_antenna_B[i] - nominal.secondary_antenna_B[i]
        own.antenna[i] = antenna + (primary - center)
        own.baseline[i] = nominal.baseline[i] + (secondary - primary)
        own.imu_lever_arm[i] = own.lever_arm_B[i] - center
        own.camera[i] = own.camera_position_B[i] - center
    own.baseline_length = norm(load3(own.baseline))
    own.raw_scale[BASELINE_BLOCK] = own.baseline_length  # the group has the number of its block
    k, kinds = _CAMERA_ROTATION, settings.draw_kind
    if kinds[k] != FIXED or kinds[k + 1] != FIXED or kinds[k + 2] != FIXED:
        store(own.R_CB, euler_to_dcm(load3(own.camera_rotation)) @ load33(nominal.R_CB))
    if kinds[_FOCAL_LENGTH] != FIXED:
        own.blur = nominal.blur * (own.focal_length / nominal.focal_length)


@kernel
def derive(own, nominal, settings):
    """Derive the parameters of flights from the drawn ones.

    `own` begins with the drawn ones; the others are initially equal to the ones in `nominal`.
    """
    _derive_body(own, nominal, settings)
    _derive_air(own, nominal, settings)
    _derive_noise(own, nominal, settings)
    _derive_sensors(own, nominal, settings)


# --------------------------------------------------------------------------------------------------
# Domain randomization: parameters of a flight, drawn when an episode begins.
# --------------------------------------------------------------------------------------------------

_FIRST = np.uint64(DRAW_PARAMETERS)
_HALF_STEP = 2.0**-53  #: moves a number on [0, 1) into (0, 1)


@kernel
def normal_quantile(p):
    """Return the x with Phi(x) = p, for p in (0, 1), to 16 digits.

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


@stage
def draw_stage(flight, world, model, settings, work, stages, flag):
    """Draw the parameters of a new episode.

    Each column has its own draw, so that a parameter does not depend on the other drawn ones.
    """
    stream, mask = stream_of(flight), work.mask > 0.0
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
            # the bounds hold exactly
            value = clip(value, settings.draw_low[k], settings.draw_high[k])
            flight.drawn[k] = select(mask, value, flight.drawn[k])


@stage
def impose_stage(flight, world, model, settings, work, stages, flag):
    """Write the parameters of the current flights to `world`; `model`: the nominal ones."""
    own, nominal = numbers_of(world), numbers_of(model)
    for k in range(PARAMETERS_DRAWN):
        own[k] = flight.drawn[k] if settings.draw_kind[k] != FIXED else nominal[k]
    derive(world, model, settings)


# --------------------------------------------------------------------------------------------------
# Features of a camera whose positions differ between episodes, and are known to the filter.
#
# Feature i, nominally at X_i, is at `R_z(yaw) (X_i + offset_i) + shift`: each feature has its own
# offset; all are rotated about the vertical through the origin and shifted together.
# --------------------------------------------------------------------------------------------------

_YAW, _SHIFT = COLUMNS["features_yaw"].start, COLUMNS["features_shift_I"].start
_OFFSETS = COLUMNS["feature_offsets_I"].start


@kernel
def _place(flight, X_I, i):
    """Position in I of feature i in this episode, nominally at X_I [m]."""
    drawn, k = flight.drawn, _OFFSETS + 3 * i
    s, c = sin_cos(drawn[_YAW])
    x, y, z = X_I[0] + drawn[k], X_I[1] + drawn[k + 1], X_I[2] + drawn[k + 2]
    return vector(c * x - s * y, s * x + c * y, z) + load3(drawn[_SHIFT:])


@stage
def place_features_stage(flight, world, model, settings, work, stages, flag):
    """Set the positions of the current flights' features, both true and assumed by the filter.

    `flag`: 1 if episodes begin, whose positions are then stored in the flights.
    """
    for i in range(settings.feature_count):
        place = _place(flight, load3(settings.feature_places[1, i]), i)
        store(model.features[i], place)
        store(world.features[i], _place(flight, load3(settings.feature_places[0, i]), i))
        if flag:
            keep(flight.feature_place[i], work.mask > 0.0, place)

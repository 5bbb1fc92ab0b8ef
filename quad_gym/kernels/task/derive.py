"""Derivation of parameters from drawn ones.

Formulas scale or shift the nominal values, which `quad_gym.packing` computes, so that these stay
unchanged if nothing is drawn. Formulas that would round differently are skipped in this case.
"""

import math

from quad_gym.kernels.compiling import kernel
from quad_gym.kernels.maths.elementary import exp, sin_cos
from quad_gym.kernels.maths.linalg import load3, load33, norm, store
from quad_gym.kernels.maths.rotation import euler_to_dcm
from quad_gym.records import COLUMNS, FIXED

_DRAG, _WIND_SPEED, _WIND_DIRECTION, _CAMERA_ROTATION, _FOCAL_LENGTH, _BASELINE_SIGMA = (
    COLUMNS[name].start
    for name in (
        *("drag_coefficient", "wind_speed", "wind_direction"),
        *("camera_rotation", "focal_length", "baseline_sigma"),
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
        a = own.accel_bias_decay
        own.accel_bias_drive = own.accel_bias_sigma * math.sqrt((1.0 - a) * (1.0 + a))
    if kinds[_GYRO_BIAS] != FIXED or kinds[_GYRO_TAU] != FIXED:
        g = own.gyro_bias_decay
        own.gyro_bias_drive = own.gyro_bias_sigma * math.sqrt((1.0 - g) * (1.0 + g))
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

"""Imperfections of real sensors besides noise and bias: constant errors, vibration, blur.

Each acts on a measurement that has just been taken and has its own draws, so that it changes
nothing else.
"""

import math

from quad_gym.kernels.compiling import kernel, stage
from quad_gym.kernels.numbers.elementary import sin_cos
from quad_gym.kernels.numbers.lanes import any_of, logical_not, select
from quad_gym.kernels.numbers.linalg import (
    cross,
    dot,
    keep,
    load3,
    load4,
    load33,
    norm,
    rounded,
)
from quad_gym.kernels.numbers.random import normal_pair, six_normals, stream_of, uniform_pair
from quad_gym.kernels.numbers.rotation import quaternion_to_dcm
from quad_gym.records import (
    BASELINE_BLOCK,
    DRAW_BLUR,
    DRAW_HEADING,
    DRAW_IMU_ERRORS,
    DRAW_VIBRATION,
    FEATURE_BLOCKS,
)

HIDDEN_BELOW = 1e-3
"""Depth below the ground at which a feature is hidden [m]: one on the ground is visible."""


@kernel
def _errors(on, off, n, m, k):
    """Error matrix D of a sensor: scale errors on the diagonal, alignment errors off it."""
    return (
        (on * n[0], off * n[1], off * n[2]),
        (off * m[0], on * m[1], off * m[2]),
        (off * k[0], off * k[1], on * k[2]),
    )


@kernel
def draw_imu_errors(flight, p, mask):
    """Draw the errors of scale and alignment of an episode, where `mask`."""
    stream = stream_of(flight)
    a, b = six_normals(stream, DRAW_IMU_ERRORS)
    c, d = six_normals(stream, DRAW_IMU_ERRORS + 3)
    e, f = six_normals(stream, DRAW_IMU_ERRORS + 6)
    accel = _errors(p.accel_scale_sigma, p.accel_misalignment_sigma, a, b, c)
    gyro = _errors(p.gyro_scale_sigma, p.gyro_misalignment_sigma, d, e, f)
    keep(flight.accel_error, mask, accel)
    keep(flight.gyro_error, mask, gyro)


@kernel
def err_imu(flight, p, mask):
    """Add D (f - g e3) and D w to the IMU's sample, where `mask`."""
    D_a, D_g = load33(flight.accel_error), load33(flight.gyro_error)
    f, w, w_now = load3(flight.accel), load3(flight.gyro), load3(flight.w_meas)
    keep(flight.accel, mask, f + D_a @ (f[0], f[1], f[2] - p.gravity))
    keep(flight.gyro, mask, w + D_g @ w)
    keep(flight.w_meas, mask, w_now + D_g @ w_now)


@kernel
def vibrate_imu(flight, p, mask):
    """Add the rotors' vibration to the IMU's sample, where `mask`.

    Each rotor's imbalance shakes with a force that grows with the square of its speed, and the four
    are independent: a standard deviation of `c sqrt(sum W_i^4 / 4)`.
    """
    W = load4(flight.rotor_speeds)
    a, b, c, d = W[0] * W[0], W[1] * W[1], W[2] * W[2], W[3] * W[3]
    size = 0.5 * math.sqrt(a * a + b * b + c * c + d * d)
    n_a, n_g = six_normals(stream_of(flight), DRAW_VIBRATION)
    n_a, n_g = p.accel_vibration * size * n_a, p.gyro_vibration * size * n_g
    keep(flight.accel, mask, n_a + load3(flight.accel))
    keep(flight.gyro, mask, n_g + load3(flight.gyro))
    keep(flight.w_meas, mask, n_g + load3(flight.w_meas))


@kernel
def draw_heading_error(flight, p, mask):
    """Draw the constant error of an episode's baselines, where `mask`."""
    n, _ = normal_pair(stream_of(flight), DRAW_HEADING)
    flight.heading_error = select(mask, p.heading_error_sigma * n, flight.heading_error)


@kernel
def turn_baseline(flight, p, mask):
    """Turn a measured baseline about the body z axis by its constant error, where `mask`."""
    z_G = load33(p.R_IG).T @ quaternion_to_dcm(load4(flight.q))[2]
    s, c = sin_cos(flight.heading_error)
    b = load3(flight.measurement[BASELINE_BLOCK])
    turned = c * b + rounded(s * cross(z_G, b))
    keep(flight.measurement[BASELINE_BLOCK], mask, (1.0 - c) * dot(z_G, b) * z_G + turned)


@kernel
def limit_camera(flight, p, blurs, ground_hides, feature_count, mask):
    """Blur the image just taken; drop features too far or behind the ground, where `mask`."""
    stream, r_I = stream_of(flight), load3(flight.r)
    camera_I = r_I + quaternion_to_dcm(load4(flight.q)).T @ load3(p.camera)
    # uniform over the smear in both directions: sqrt(3) standard deviations
    reach = 1.7320508075688772 * p.blur * norm(load3(flight.w))
    for i in range(feature_count):
        X_I, valid = load3(p.features[i]), flight.block_valid[FEATURE_BLOCKS + i]
        lost = norm(X_I - camera_I) > p.max_range
        if ground_hides:
            below = logical_not(camera_I[2] >= p.ground_height)
            lost = lost | below | (X_I[2] < p.ground_height - HIDDEN_BELOW)
        kept = select(lost, 0.0, valid)
        flight.block_valid[FEATURE_BLOCKS + i] = select(mask, kept, valid)
        seen = mask & (kept > 0.0)
        if blurs and any_of(seen):
            u, v = uniform_pair(stream, DRAW_BLUR + i)
            for axis in range(2):
                shift = reach * (2.0 * (u if axis == 0 else v) - 1.0)
                pixel = flight.measurement[FEATURE_BLOCKS + i, axis]
                flight.measurement[FEATURE_BLOCKS + i, axis] = select(seen, pixel + shift, pixel)


@stage
def begin_imperfect_stage(flight, world, model, settings, work, stages, flag):
    """Draw the errors that last an episode."""
    if settings.imu_errs:
        draw_imu_errors(flight, world, work.mask > 0.0)
    if settings.heading_errs:
        draw_heading_error(flight, world, work.mask > 0.0)


@stage
def disturb_imu_stage(flight, world, model, settings, work, stages, flag):
    """Add the IMU's constant errors and vibration to its sample."""
    if settings.imu_errs:
        err_imu(flight, world, work.mask > 0.0)
    if settings.imu_vibrates:
        vibrate_imu(flight, world, work.mask > 0.0)


@stage
def turn_baseline_stage(flight, world, model, settings, work, stages, flag):
    """Apply the constant error to the baseline just measured."""
    turn_baseline(flight, world, work.mask > 0.0)


@stage
def limit_camera_stage(flight, world, model, settings, work, stages, flag):
    """Blur the image just taken; drop features too far or behind the ground."""
    count, mask = settings.feature_count, work.mask > 0.0
    limit_camera(flight, world, settings.camera_blurs, settings.ground_hides, count, mask)

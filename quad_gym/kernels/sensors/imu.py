"""The IMU: its measurements, and the drift of its biases.

Every draw has a fixed number within its instant, so that a measurement does not depend on other
measurements.
"""

import math

from quad_gym.kernels.compiling import Stage, call_stage, kernel, stage
from quad_gym.kernels.numbers.elementary import clip
from quad_gym.kernels.numbers.lanes import select
from quad_gym.kernels.numbers.linalg import keep, load3, load4, load33, store
from quad_gym.kernels.numbers.random import six_normals, stream_of
from quad_gym.kernels.numbers.rotation import (
    mean_quaternion,
    quaternion_to_dcm,
    rotation_between,
)
from quad_gym.kernels.vehicle.dynamics import (
    air_accelerations,
    body_point_velocity,
    imu_point_acceleration,
    load_start,
)
from quad_gym.records import DRAW_BIAS, DRAW_IMU, DRAW_IMU_ERRORS, DRAW_VIBRATION, FaultKind


@kernel
def specific_force(flight, p, R_BI):
    """f_B = R (a_I + g e3) at the accelerometer, without bias and noise (report equation 4)."""
    a_I, dw_B = air_accelerations(flight, p, R_BI)
    rest, on_pad = (0.0, 0.0, 0.0), flight.on_pad > 0.0
    a_I, dw_B = select(on_pad, rest, a_I), select(on_pad, rest, dw_B)
    a_I = imu_point_acceleration(R_BI, a_I, load3(flight.w), dw_B, load3(p.imu_lever_arm))
    return R_BI @ (a_I[0], a_I[1], a_I[2] + p.gravity)


@kernel
def _sample_imu(flight, p, w_B, f_B, mask):
    """Sample the IMU with biases and white noise, where `mask`.

    The filter's sample is of the true body rates `w_B` and specific force `f_B`. Inner loops read
    the gyro at the present instant, `w_meas`, with the same bias and noise.
    """
    n_a, n_g = six_normals(stream_of(flight), DRAW_IMU)
    b_a, b_g = load3(flight.b_a), load3(flight.b_g)
    keep(flight.accel, mask, p.accel_sigma * n_a + (f_B + b_a))
    keep(flight.gyro, mask, p.gyro_sigma * n_g + (w_B + b_g))
    keep(flight.w_before, mask, load3(flight.w_meas))
    keep(flight.w_meas, mask, p.gyro_sigma * n_g + (load3(flight.w) + b_g))


@kernel
def _measure_now(flight, p, mask):
    """Sample accelerometer and gyro at this instant, where `mask`."""
    R_BI = quaternion_to_dcm(load4(flight.q))
    _sample_imu(flight, p, load3(flight.w), specific_force(flight, p, R_BI), mask)


@kernel
def _measure_average(flight, p, start, mask):
    """Sample the means of body rates and specific force over the tick that ends now, where `mask`.

    Model of an IMU that integrates faster than it reports: the mean rate is the rotation vector
    from the initial to the final body frame over dt (coning corrected), and the mean specific force
    is R_mid (dv_I + g dt e3) / dt with the change of the accelerometer's velocity and the attitude
    halfway (sculling corrected; P. G. Savage, J. Guidance, Control, and Dynamics 21, 1998). Density
    over sqrt(dt) is the standard deviation of white noise in a mean over dt. `start` is the true
    state at the tick's start; biases are the ones at its start.
    """
    _, v_start, q_start, w_start, _ = start
    q_end, rate, lever = load4(flight.q), 1.0 / p.dt, load3(p.imu_lever_arm)
    v_before = body_point_velocity(quaternion_to_dcm(q_start), v_start, w_start, lever)
    v_after = body_point_velocity(quaternion_to_dcm(q_end), load3(flight.v), load3(flight.w), lever)
    a_I = rate * (v_after - v_before)
    R_mid = quaternion_to_dcm(mean_quaternion(q_start, q_end))
    f_B = R_mid @ (a_I[0], a_I[1], a_I[2] + p.gravity)
    _sample_imu(flight, p, rate * rotation_between(q_start, q_end), f_B, mask)


@stage
def sample_stage(flight, world, model, settings, work, stages, flag):
    """Sample the IMU at the present instant; `flag`: 1 at the start of an episode."""
    if flag == 0 and settings.imu_averages:  # at the start, no tick to average over
        return
    mask = work.mask > 0.0
    _measure_now(flight, world, mask)
    call_stage(stages, Stage.FEEL_GROUND, flight, world, world, settings, work, 0)
    call_stage(stages, Stage.DISTURB_IMU, flight, world, world, settings, work, 0)
    if flag > 0:
        keep(flight.w_before, mask, load3(flight.w_meas))
    call_stage(stages, Stage.SATURATE_IMU, flight, world, world, settings, work, 0)


@stage
def drift_biases_stage(flight, world, model, settings, work, stages, flag):
    """Step the Gauss-Markov biases by one tick: b+ = alpha b + v_2 (report equations 6 and 7)."""
    n_a, n_g = six_normals(stream_of(flight), DRAW_BIAS)
    for i in range(3):
        flight.b_a[i] = world.accel_bias_decay * flight.b_a[i] + world.accel_bias_drive * n_a[i]
        flight.b_g[i] = world.gyro_bias_decay * flight.b_g[i] + world.gyro_bias_drive * n_g[i]


@stage
def average_imu_stage(flight, world, model, settings, work, stages, flag):
    """Sample the means of the IMU over the tick that ends now."""
    _measure_average(flight, world, load_start(work), work.mask > 0.0)
    call_stage(stages, Stage.DISTURB_IMU, flight, world, model, settings, work, 0)
    call_stage(stages, Stage.SATURATE_IMU, flight, world, model, settings, work, 0)


@stage
def sum_imu_stage(flight, world, model, settings, work, stages, flag):
    """Add the newest IMU sample to the sum since the last step."""
    store(flight.gyro_sum, load3(flight.gyro_sum) + load3(flight.gyro))
    store(flight.accel_sum, load3(flight.accel_sum) + load3(flight.accel))


# --------------------------------------------------------------------------------------------------
# Imperfections besides noise and bias: constant errors, vibration, and limited ranges.
#
# Each acts on a sample that has just been taken and has its own draws, so that it changes nothing
# else.
# --------------------------------------------------------------------------------------------------


@kernel
def _errors(on, off, n, m, k):
    """Error matrix D of a sensor: scale errors on the diagonal, alignment errors off it."""
    return (
        (on * n[0], off * n[1], off * n[2]),
        (off * m[0], on * m[1], off * m[2]),
        (off * k[0], off * k[1], on * k[2]),
    )


@kernel
def _err(flight, p, mask):
    """Add D (f - g e3) and D w to the IMU's sample, where `mask`."""
    D_a, D_g = load33(flight.accel_error), load33(flight.gyro_error)
    f, w, w_now = load3(flight.accel), load3(flight.gyro), load3(flight.w_meas)
    keep(flight.accel, mask, f + D_a @ (f[0], f[1], f[2] - p.gravity))
    keep(flight.gyro, mask, w + D_g @ w)
    keep(flight.w_meas, mask, w_now + D_g @ w_now)


@kernel
def _vibrate(flight, p, mask):
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


@stage
def begin_imperfect_stage(flight, world, model, settings, work, stages, flag):
    """Draw the errors of scale and alignment of an episode."""
    p, mask, stream = world, work.mask > 0.0, stream_of(flight)
    a, b = six_normals(stream, DRAW_IMU_ERRORS)
    c, d = six_normals(stream, DRAW_IMU_ERRORS + 3)
    e, f = six_normals(stream, DRAW_IMU_ERRORS + 6)
    accel = _errors(p.accel_scale_sigma, p.accel_misalignment_sigma, a, b, c)
    gyro = _errors(p.gyro_scale_sigma, p.gyro_misalignment_sigma, d, e, f)
    keep(flight.accel_error, mask, accel)
    keep(flight.gyro_error, mask, gyro)


@stage
def disturb_imu_stage(flight, world, model, settings, work, stages, flag):
    """Add the IMU's constant errors and vibration to its sample."""
    if settings.imu_errs:
        _err(flight, world, work.mask > 0.0)
    if settings.imu_vibrates:
        _vibrate(flight, world, work.mask > 0.0)


@stage
def saturate_imu_stage(flight, world, model, settings, work, stages, flag):
    """Limit the IMU's samples to its ranges, where the fault is active."""
    if settings.fault_on[FaultKind.IMU_SATURATION]:
        full = (work.mask > 0.0) & (flight.fault_active[FaultKind.IMU_SATURATION] > 0.0)
        a, w = settings.imu_range[0], settings.imu_range[1]
        for i in range(3):
            flight.accel[i] = select(full, clip(flight.accel[i], -a, a), flight.accel[i])
            flight.gyro[i] = select(full, clip(flight.gyro[i], -w, w), flight.gyro[i])
            flight.w_meas[i] = select(full, clip(flight.w_meas[i], -w, w), flight.w_meas[i])

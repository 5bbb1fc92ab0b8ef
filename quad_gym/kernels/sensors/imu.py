"""The IMU: its measurements, and the drift of its biases.

Every draw has a fixed number within its instant, so that a measurement does not depend on other
measurements.
"""

from quad_gym.kernels.compiling import Stage, call_stage, kernel, stage
from quad_gym.kernels.numbers.lanes import select
from quad_gym.kernels.numbers.linalg import keep, load3, load4, store
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
from quad_gym.records import DRAW_BIAS, DRAW_IMU


@kernel
def drift_biases(flight, p):
    """Step the Gauss-Markov biases by one tick: b+ = alpha b + v_2 (report equations 6 and 7)."""
    n_a, n_g = six_normals(stream_of(flight), DRAW_BIAS)
    for i in range(3):
        flight.b_a[i] = p.accel_bias_decay * flight.b_a[i] + p.accel_bias_drive * n_a[i]
        flight.b_g[i] = p.gyro_bias_decay * flight.b_g[i] + p.gyro_bias_drive * n_g[i]


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
    """Add biases and white noise to the filter's body rates and specific force, where `mask`.

    Inner loops read the gyro at the present instant, with the same bias and noise.
    """
    n_a, n_g = six_normals(stream_of(flight), DRAW_IMU)
    b_a, b_g = load3(flight.b_a), load3(flight.b_g)
    keep(flight.accel, mask, p.accel_sigma * n_a + (f_B + b_a))
    keep(flight.gyro, mask, p.gyro_sigma * n_g + (w_B + b_g))
    keep(flight.w_before, mask, load3(flight.w_meas))
    keep(flight.w_meas, mask, p.gyro_sigma * n_g + (load3(flight.w) + b_g))


@kernel
def measure_imu(flight, p, mask):
    """Sample accelerometer and gyro at this instant, where `mask`."""
    R_BI = quaternion_to_dcm(load4(flight.q))
    _sample_imu(flight, p, load3(flight.w), specific_force(flight, p, R_BI), mask)


@kernel
def measure_imu_average(flight, p, start, mask):
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
    measure_imu(flight, world, mask)
    call_stage(stages, Stage.FEEL_GROUND, flight, world, world, settings, work, 0)
    call_stage(stages, Stage.DISTURB_IMU, flight, world, world, settings, work, 0)
    if flag > 0:
        keep(flight.w_before, mask, load3(flight.w_meas))
    call_stage(stages, Stage.SATURATE_IMU, flight, world, world, settings, work, 0)


@stage
def drift_biases_stage(flight, world, model, settings, work, stages, flag):
    """Let the true IMU biases drift over a tick."""
    drift_biases(flight, world)


@stage
def average_imu_stage(flight, world, model, settings, work, stages, flag):
    """Sample the means of the IMU over the tick that ends now."""
    measure_imu_average(flight, world, load_start(work), work.mask > 0.0)
    call_stage(stages, Stage.DISTURB_IMU, flight, world, model, settings, work, 0)
    call_stage(stages, Stage.SATURATE_IMU, flight, world, model, settings, work, 0)


@stage
def sum_imu_stage(flight, world, model, settings, work, stages, flag):
    """Add the newest IMU sample to the sum since the last step."""
    store(flight.gyro_sum, load3(flight.gyro_sum) + load3(flight.gyro))
    store(flight.accel_sum, load3(flight.accel_sum) + load3(flight.accel))

"""The IMU: its measurements, and the drift of its biases.

Every draw has a fixed number within its instant, so that a measurement does not depend on other
measurements.
"""

from quad_gym.kernels.compiling import Stage, call_stage, kernel, stage
from quad_gym.kernels.maths.linalg import (
    add,
    apply,
    keep3,
    load3,
    load4,
    load33,
    scale,
    select3,
    store3,
    sub,
)
from quad_gym.kernels.maths.random import six_normals, stream_of
from quad_gym.kernels.maths.rotation import mean_quaternion, quaternion_to_dcm, rotation_between
from quad_gym.kernels.simd.blocks import lanes_of
from quad_gym.kernels.vehicle.dynamics import (
    accelerations,
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
    w_B = load3(flight.w)
    v_air_I = sub(load3(flight.v), load3(flight.wind))
    d_I = add(load3(flight.disturbance), load3(flight.air_force))
    a_I, dw_B = accelerations(R_BI, v_air_I, w_B, load4(flight.rotor_speeds), d_I, p)
    dw_B = add(dw_B, apply(load33(p.inertia_inverse), load3(flight.air_torque)))
    rest, on_pad = (0.0, 0.0, 0.0), flight.on_pad > 0.0
    a_I, dw_B = select3(on_pad, rest, a_I), select3(on_pad, rest, dw_B)
    a_I = imu_point_acceleration(R_BI, a_I, w_B, dw_B, load3(p.imu_lever_arm))
    return apply(R_BI, (a_I[0], a_I[1], a_I[2] + p.gravity))


@kernel
def _sample_imu(flight, p, w_B, f_B, mask):
    """Add biases and white noise to the filter's body rates and specific force, where `mask`.

    Inner loops read the gyro at the present instant, with the same bias and noise.
    """
    n_a, n_g = six_normals(stream_of(flight), DRAW_IMU)
    noise_g, b_g = scale(p.gyro_sigma, n_g), load3(flight.b_g)
    f_B = add(f_B, load3(flight.b_a))
    keep3(flight.accel, mask, add(f_B, scale(p.accel_sigma, n_a)))
    keep3(flight.gyro, mask, add(add(w_B, b_g), noise_g))
    keep3(flight.w_before, mask, load3(flight.w_meas))
    keep3(flight.w_meas, mask, add(add(load3(flight.w), b_g), noise_g))


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
    over sqrt(dt) is the standard deviation of white noise in a mean over dt.

    Args:
        flight: Record, with the true state at the tick's end and the biases at its start.
        p: True parameters.
        start: True state at the tick's start, from `load_state`.
        mask: Lanes to work on.
    """
    _, v_start, q_start, w_start, _ = start
    q_end, rate, lever = load4(flight.q), 1.0 / p.dt, load3(p.imu_lever_arm)
    v_before = body_point_velocity(quaternion_to_dcm(q_start), v_start, w_start, lever)
    v_after = body_point_velocity(quaternion_to_dcm(q_end), load3(flight.v), load3(flight.w), lever)
    a_I = scale(rate, sub(v_after, v_before))
    R_mid = quaternion_to_dcm(mean_quaternion(q_start, q_end))
    f_B = apply(R_mid, (a_I[0], a_I[1], a_I[2] + p.gravity))
    _sample_imu(flight, p, scale(rate, rotation_between(q_start, q_end)), f_B, mask)


# ---- stages ----------------------------------------------------------------------------------


@stage
def sample_stage(flight, world, model, settings, work, stages, flag):
    """Sample the IMU at the present instant; `flag`: 1 at the start of an episode."""
    if flag == 0 and settings.imu_averages:  # at the start, no tick to average over
        return
    flying, scratch = lanes_of(flight), lanes_of(work)
    mask = scratch.mask > 0.0
    measure_imu(flying, lanes_of(world), mask)
    call_stage(stages, Stage.FEEL_GROUND, flight, world, world, settings, work, 0)
    call_stage(stages, Stage.DISTURB_IMU, flight, world, world, settings, work, 0)
    if flag > 0:
        keep3(flying.w_before, mask, load3(flying.w_meas))
    call_stage(stages, Stage.SATURATE_IMU, flight, world, world, settings, work, 0)


@stage
def drift_biases_stage(flight, world, model, settings, work, stages, flag):
    """Let the true IMU biases drift over a tick."""
    drift_biases(lanes_of(flight), lanes_of(world))


@stage
def average_imu_stage(flight, world, model, settings, work, stages, flag):
    """Sample the means of the IMU over the tick that ends now."""
    flying, scratch = lanes_of(flight), lanes_of(work)
    measure_imu_average(flying, lanes_of(world), load_start(scratch), scratch.mask > 0.0)
    call_stage(stages, Stage.DISTURB_IMU, flight, world, model, settings, work, 0)
    call_stage(stages, Stage.SATURATE_IMU, flight, world, model, settings, work, 0)


@stage
def sum_imu_stage(flight, world, model, settings, work, stages, flag):
    """Add the newest IMU sample to the sum since the last step."""
    here = lanes_of(flight)
    store3(here.gyro_sum, add(load3(here.gyro_sum), load3(here.gyro)))
    store3(here.accel_sum, add(load3(here.accel_sum), load3(here.accel)))

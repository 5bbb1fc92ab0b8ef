"""What the IMU has measured between two instants, and an estimate taken from one to the other.

Over a tick in which the body turns by exp(-[w dt x]) the filter adds R^T f dt to the velocity. Such
increments of many ticks are summed up without the estimate, in the frame in which the episode
began: the turn C, the velocity V = sum C^T f dt, the position X, and the gain of the biases B = sum
C^T dt. Between instants s and k they leave, in the body frame of s,

    dR = C_k C_s^T,  dv = C_s (V_k - V_s),  dr = C_s (X_k - X_s - V_s T),  B_s = C_s (B_k - B_s)

from which the biases are taken to first order:

    dR <- dR exp([B_s b_g x]),  dv <- dv - B_s b_a - (B_s b_g) x dv / 2,
    dr <- dr - T (B_s b_a + T b_a / 2) / 3 - T (B_s b_g) x dv / 6

where the last is right to the first order in the turn, so that, with g = (0, 0, gravity),

    R_k = dR R_s,  v_k = v_s - g T + R_s^T dv,  r_k = r_s + v_s T - g T^2 / 2 + R_s^T dr

and the errors follow likewise. Reading these from the left to the right takes an estimate back.

Sources: T. Lupton and S. Sukkarieh, IEEE Trans. Robotics 28(1), 2012; C. Forster, L. Carlone, F.
Dellaert and D. Scaramuzza, IEEE Trans. Robotics 33(1), 2017.
"""

import math

from quad_gym.kernels.compiling import kernel, stage
from quad_gym.kernels.filter.error_state import BA, BG, E, R, V
from quad_gym.kernels.filter.lever_arm import LEVER_ARM, lever_force
from quad_gym.kernels.maths.elementary import maximum
from quad_gym.kernels.maths.linalg import (
    add,
    add33,
    apply,
    apply_transposed,
    cross,
    dot,
    keep3,
    keep33,
    load3,
    load33,
    load_column3,
    multiply,
    scale,
    scale33,
    store3,
    store33,
    sub,
    transpose,
)
from quad_gym.kernels.maths.rotation import euler_to_dcm, vector_to_dcm
from quad_gym.kernels.simd.blocks import lanes_of
from quad_gym.kernels.simd.lanes import select
from quad_gym.records import FilterForm

_MIDPOINT = int(FilterForm.MIDPOINT)
NOISE = 15
"""First of the six columns of white noise beside the fifteen of the covariance's factor."""


@kernel
def begin_increments(flight, mask):
    """Begin to sum up, where `mask`."""
    nothing = (0.0, 0.0, 0.0)
    keep33(flight.imu_turn, mask, ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0)))
    keep3(flight.imu_velocity, mask, nothing)
    keep3(flight.imu_position, mask, nothing)
    keep33(flight.imu_bias_gain, mask, (nothing, nothing, nothing))


@kernel
def add_increment(flight, p, form):
    """Add the tick's IMU sample, in the form in which the filter predicts with it."""
    dt, C = p.dt, load33(flight.imu_turn)
    turn, half = scale(dt, load3(flight.gyro)), C
    force = load3(flight.accel)
    if (form & _MIDPOINT) != 0:
        half = vector_to_dcm(scale(0.5, turn))
    if (form & LEVER_ARM) != 0:
        force = sub(force, lever_force(flight, p, form, half))
    if (form & _MIDPOINT) != 0:
        C = multiply(half, C)
        store33(flight.imu_turn, multiply(half, C))
    else:
        store33(flight.imu_turn, multiply(euler_to_dcm(turn), C))
    dv, v = scale(dt, apply_transposed(C, force)), load3(flight.imu_velocity)
    store3(flight.imu_velocity, add(v, dv))
    moved = add(scale(dt, v), scale(0.5 * dt, dv))
    store3(flight.imu_position, add(load3(flight.imu_position), moved))
    gain = add33(load33(flight.imu_bias_gain), scale33(dt, transpose(C)))
    store33(flight.imu_bias_gain, gain)


@kernel
def _moved_by(b_a, alpha, T):
    """T (B_s b_a + T b_a / 2) / 3, with alpha = B_s b_a."""
    return scale(T / 3.0, add(alpha, scale(0.5 * T, b_a)))


@kernel
def increments(flight, work):
    """(dR, dv, dr) since the instant that work.since_* has kept, less the estimated biases."""
    C_s, T, B = load33(work.since_turn), work.since_time, load33(work.since_bias_gain)
    dR = multiply(load33(flight.imu_turn), transpose(C_s))
    v_s = load3(work.since_velocity)
    dv = apply(C_s, sub(load3(flight.imu_velocity), v_s))
    moved = sub(load3(flight.imu_position), load3(work.since_position))
    dr = apply(C_s, sub(moved, scale(T, v_s)))
    b_a = load3(flight.b_a_hat)
    alpha, beta = apply(B, b_a), apply(B, load3(flight.b_g_hat))
    turned = cross(beta, dv)
    dr = sub(sub(dr, _moved_by(b_a, alpha, T)), scale(T / 6.0, turned))
    dv = sub(sub(dv, alpha), scale(0.5, turned))
    return multiply(dR, vector_to_dcm(scale(-1.0, beta))), dv, dr


@kernel
def take_mean(flight, p, work, back):
    """Take the mean over the time since the kept instant, back to it or on from it.

    Returns:
        R_s, dR, dv, dr.
    """
    dR, dv, dr = increments(flight, work)
    T, fall = work.since_time, p.gravity * work.since_time
    r, v, R_BI = load3(flight.r_hat), load3(flight.v_hat), load33(flight.R_hat)
    R_s, R_end = R_BI, multiply(dR, R_BI)
    if back:
        R_s = multiply(transpose(dR), R_BI)
        R_end = R_s
    gained, moved = apply_transposed(R_s, dv), apply_transposed(R_s, dr)
    gained = (gained[0], gained[1], gained[2] - fall)
    moved = (moved[0], moved[1], moved[2] - 0.5 * T * fall)
    if back:
        v = sub(v, gained)
        r = sub(sub(r, scale(T, v)), moved)
    else:
        r = add(add(r, scale(T, v)), moved)
        v = add(v, gained)
    store33(flight.R_hat, R_end)
    store3(flight.r_hat, r)
    store3(flight.v_hat, v)
    return R_s, dR, dv, dr


@kernel
def accel_variance(p, f_B):
    """What the filter takes for white in a sample of the accelerometer, per axis [m^2/s^4]."""
    d = (f_B[0], f_B[1], f_B[2] - p.gravity)
    variance = _with_thrust(p, p.accel_noise, p.accel_thrust_noise, f_B)
    return variance + p.accel_error_noise * p.accel_error_noise * dot(d, d)


@kernel
def gyro_sigma(p, f_B):
    """Likewise the standard deviation of a sample of the gyro [rad/s]."""
    return math.sqrt(_with_thrust(p, p.gyro_noise, p.gyro_thrust_noise, f_B))


@kernel
def _with_thrust(p, hovering, thrust_noise, f_B):
    """A variance as of hovering with what rotors add that lift f_B, not g.

    Vibration grows with the square of the rotor speeds, as the thrust does.
    """
    more = dot(f_B, f_B) - p.gravity * p.gravity
    return maximum(hovering * hovering + thrust_noise * thrust_noise * more, 0.0)


@kernel
def put_noise(p, work, R_s, dR, dv):
    """Fill the columns of work.columns with the IMU's white noise since the kept instant.

    As of the last instant, and as if all had come halfway: the variances of a noise that comes
    evenly are matched to a third of the small terms.
    """
    M, T = work.columns, work.since_time
    root = math.sqrt(p.dt * T)
    force = scale(select(T > 0.0, 1.0 / T, 0.0), dv)  # its mean
    a, g = root * math.sqrt(accel_variance(p, force)), root * gyro_sigma(p, force)
    zero = 0.0 * T
    for k in range(6):
        for i in range(15):
            M[i, NOISE + k] = zero
    for k in range(3):
        M[V + k, NOISE + k] = a
        M[R + k, NOISE + k] = 0.5 * T * a
    axes = ((g, zero, zero), (zero, g, zero), (zero, zero, g))
    for k in range(3):
        force = apply_transposed(R_s, cross(axes[k], dv))
        angle = apply(dR, axes[k])
        for i in range(3):
            M[R + i, NOISE + 3 + k] = -T / 6.0 * force[i]
            M[V + i, NOISE + 3 + k] = -0.5 * force[i]
            M[E + i, NOISE + 3 + k] = -angle[i]


@kernel
def take_columns(work, R_s, dR, dv, dr, back):
    """Take the columns of work.columns, errors of the state, back or on; noise only back."""
    M, T, B = work.columns, work.since_time, load33(work.since_bias_gain)
    for j in range(NOISE + 6 if back else NOISE):
        alpha, beta = apply(B, load_column3(M, BA, j)), apply(B, load_column3(M, BG, j))
        r, v, e = load_column3(M, R, j), load_column3(M, V, j), load_column3(M, E, j)
        if back:
            e = add(apply_transposed(dR, e), beta)
        turned = cross(beta, dv)
        gained = sub(sub(cross(e, dv), alpha), scale(0.5, turned))
        moved = sub(cross(e, dr), _moved_by(load_column3(M, BA, j), alpha, T))
        moved = sub(moved, scale(T / 6.0, turned))
        gained, moved = apply_transposed(R_s, gained), apply_transposed(R_s, moved)
        if back:
            v = sub(v, gained)
            r = sub(sub(r, scale(T, v)), moved)
        else:
            r = add(add(r, scale(T, v)), moved)
            v = add(v, gained)
            e = apply(dR, sub(e, beta))
        for i in range(3):
            M[R + i, j] = r[i]
            M[V + i, j] = v[i]
            M[E + i, j] = e[i]


# ---- stages ----------------------------------------------------------------------------------


@stage
def begin_late_stage(flight, world, model, settings, work, stages, flag):
    """Reset the sums of the IMU at the start of an episode."""
    begin_increments(lanes_of(flight), lanes_of(work).mask > 0.0)


@stage
def increment_stage(flight, world, model, settings, work, stages, flag):
    """Add the tick's IMU sample to the sums with which delayed measurements are retrodicted."""
    add_increment(lanes_of(flight), lanes_of(model), settings.form)

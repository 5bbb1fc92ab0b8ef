"""Preintegrated IMU samples, which propagate an estimate from one instant to another and back.

Over a tick in which the body rotates by exp(-[w dt x]) the filter adds R^T f dt to the velocity.
Such increments are summed over many ticks independently of the estimate, in the body frame of an
instant 0 that they count from: the rotation C, the velocity V = sum C^T f dt, the position X, and
the gain of the biases B = sum C^T dt. Between instants s and k they give, in the body frame of s,

    dR = C_k C_s^T,  dv = C_s (V_k - V_s),  dr = C_s (X_k - X_s - V_s T),  B_s = C_s (B_k - B_s)

from which the biases are removed to first order:

    dR <- dR exp([B_s b_g x]),  dv <- dv - B_s b_a - (B_s b_g) x dv / 2,
    dr <- dr - T (B_s b_a + T b_a / 2) / 3 - T (B_s b_g) x dv / 6

where the last is accurate to first order in the rotation, so that, with g = (0, 0, gravity),

    R_k = dR R_s,  v_k = v_s - g T + R_s^T dv,  r_k = r_s + v_s T - g T^2 / 2 + R_s^T dr

and the errors are propagated in the same way. Solved for the state at s, these go back in time.

The sums grow: within minutes V and X are kilometers per second and kilometers, of which the
differences above would be small remainders. From time to time, the present instant k becomes
instant 0. The stamps of measurements in transit, which hold the sums of instants s, then change to

    C_s C_k^T,  C_k (V_s - V_k),  C_k (X_s - X_k - V_k (t_s - t_k)),  C_k (B_s - B_k)

and the sums to I, 0, 0 and 0. Exact arithmetic would leave dR, dv, dr and B_s as they are.

Sources: T. Lupton and S. Sukkarieh, IEEE Trans. Robotics 28(1), 2012; C. Forster, L. Carlone, F.
Dellaert and D. Scaramuzza, IEEE Trans. Robotics 33(1), 2017.
"""

import math

from quad_gym.kernels.compiling import kernel, stage
from quad_gym.kernels.filter.error_state import BA, BG, D, E, R, V
from quad_gym.kernels.numbers.blocks import reset
from quad_gym.kernels.numbers.elementary import maximum
from quad_gym.kernels.numbers.lanes import any_of, round_to_even, select, zero_like
from quad_gym.kernels.numbers.linalg import (
    cross,
    diagonal,
    dot,
    keep,
    load3,
    load33,
    load_column3,
    rounded,
    store,
    store_column3,
)
from quad_gym.kernels.numbers.rotation import euler_to_dcm, orthonormal, vector_to_dcm
from quad_gym.records import MAX_SLOW, SENSORS, FilterForm

# --------------------------------------------------------------------------------------------------
# The specific force at the center of mass, from an accelerometer that is mounted elsewhere.
#
# The accelerometer at l_B measures the acceleration of that point (report section 2.3),
#
#     a_l = a + d/dt [R^T (w x l)],
#
# so that the filter subtracts R d/dt [R^T (w x l)] = dw x l + w x (w x l) from each sample. The
# gyro measures w at the instants, and its differences give dw. Their noise is the noise of R^T (w x
# l) at the two ends of a tick and does not add up over ticks: it leaves |l| sigma_gyro in the
# velocity, which is far below the accuracy of GNSS and cameras, and is not modeled.
# --------------------------------------------------------------------------------------------------

LEVER_ARM = int(FilterForm.LEVER_AVERAGES | FilterForm.LEVER_SAMPLES)
"""Bits of a `FilterForm` with which there is a lever arm."""


@kernel
def lever_force(flight, p, form, half):
    """Specific force that the lever arm adds to the tick's sample, in B.

    A sample that is the mean over the tick contains the change of R^T (w x l), in the body frame
    halfway: `half` rotates from the attitude at the tick's start to it. For a sample of the tick's
    start, dw comes from the sample before.
    """
    l_B, b_g, rate = load3(p.imu_lever_arm), load3(flight.b_g_hat), 1.0 / p.dt
    w, w_before = load3(flight.w_meas) - b_g, load3(flight.w_before) - b_g
    if (form & FilterForm.LEVER_AVERAGES.value) != 0:
        return rate * (half.T @ cross(w, l_B) - half @ cross(w_before, l_B))
    dw = rate * (w - w_before)
    return cross(dw, l_B) + cross(w, cross(w, l_B))


# --------------------------------------------------------------------------------------------------
# Preintegrated IMU samples, which propagate an estimate from one instant to another and back.
# --------------------------------------------------------------------------------------------------

NOISE = D + MAX_SLOW


"""First of the six columns of white noise, after those of the covariance with states and slow
errors."""


_TICKS_OF_SUMS = 32.0
"""Ticks after which the sums count from the present instant on: few enough that V remains below
some meters per second, and so many that the change of the stamps costs next to nothing."""


@kernel
def _begin_sums(flight, mask):
    """Count the sums from the present instant on, where `mask`."""
    keep(flight.imu_turn, mask, ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0)))
    reset(flight, mask, 0.0, "imu_velocity imu_position imu_bias_gain")


@stage
def begin_late_stage(flight, world, model, settings, work, stages, flag):
    """Reset the sums of the IMU at the start of an episode."""
    _begin_sums(flight, work.mask > 0.0)


@kernel
def _three(row, k):
    return (row[k], row[k + 1], row[k + 2])


@kernel
def _keep_three(row, k, mask, values):
    for i in range(3):
        row[k + i] = select(mask, values[i], row[k + i])


@kernel
def _rebase(flight, p, settings, now, mask):
    """Make the instant `now` [ticks] the one that sums and stamps count from, where `mask`."""
    C, V = load33(flight.imu_turn), load3(flight.imu_velocity)
    X, B = load3(flight.imu_position), load33(flight.imu_bias_gain)
    for sensor in range(SENSORS):
        if settings.sensor_delay[sensor] > 0:
            for slot in range(settings.under_way[sensor] + 1):
                row = flight.stamps[sensor, slot]
                since = p.dt * (row[0] - now)
                turn = (_three(row, 1), _three(row, 4), _three(row, 7)) @ C.T
                v = C @ (_three(row, 10) - V)
                x = C @ (_three(row, 13) - X - rounded(since * V))
                gain = C @ ((_three(row, 16), _three(row, 19), _three(row, 22)) - B)
                for i in range(3):
                    _keep_three(row, 1 + 3 * i, mask, turn[i])
                    _keep_three(row, 16 + 3 * i, mask, gain[i])
                _keep_three(row, 10, mask, v)
                _keep_three(row, 13, mask, x)
    _begin_sums(flight, mask)


@stage
def increment_stage(flight, world, model, settings, work, stages, flag):
    """Add the tick's IMU sample to the sums, in the form that the prediction uses."""
    p, form = model, settings.form
    dt, C = p.dt, load33(flight.imu_turn)
    turn, half = dt * load3(flight.gyro), C
    force = load3(flight.accel)
    if (form & FilterForm.MIDPOINT.value) != 0:
        half = vector_to_dcm(0.5 * turn)
    if (form & LEVER_ARM) != 0:
        force = force - lever_force(flight, p, form, half)
    if (form & FilterForm.MIDPOINT.value) != 0:
        C = half @ C
        store(flight.imu_turn, orthonormal(half @ C))
    else:
        store(flight.imu_turn, orthonormal(euler_to_dcm(turn) @ C))
    dv, v = rounded(dt * (C.T @ force)), load3(flight.imu_velocity)
    store(flight.imu_velocity, v + dv)
    moved = dt * v + rounded(0.5 * dt * dv)
    store(flight.imu_position, load3(flight.imu_position) + moved)
    store(flight.imu_bias_gain, dt * C.T + load33(flight.imu_bias_gain))
    now = flight.tick + 1.0  # `tick` advances after this stage
    grown = now == _TICKS_OF_SUMS * round_to_even(now / _TICKS_OF_SUMS)
    if any_of(grown):
        _rebase(flight, p, settings, now, grown)


@kernel
def _moved_by(b_a, alpha, T):
    """T (B_s b_a + T b_a / 2) / 3, with alpha = B_s b_a."""
    return T / 3.0 * (0.5 * T * b_a + alpha)


@kernel
def increments(flight, work):
    """(dR, dv, dr) since the instant saved in work.since_*, without the estimated biases."""
    C_s, T, B = load33(work.since_turn), work.since_time, load33(work.since_bias_gain)
    dR, v_s = load33(flight.imu_turn) @ C_s.T, load3(work.since_velocity)
    dv = C_s @ (load3(flight.imu_velocity) - v_s)
    moved = load3(flight.imu_position) - load3(work.since_position)
    dr = C_s @ (moved - rounded(T * v_s))
    b_a = load3(flight.b_a_hat)
    alpha, beta = B @ b_a, B @ load3(flight.b_g_hat)
    turned = cross(beta, dv)
    dr = dr - _moved_by(b_a, alpha, T) - rounded(T / 6.0 * turned)
    dv = dv - alpha - rounded(0.5 * turned)
    return dR @ vector_to_dcm(-beta), dv, dr


@kernel
def take_mean(flight, p, work, back):
    """Propagate the mean over the time since the saved instant; return (R_s, dR, dv, dr)."""
    dR, dv, dr = increments(flight, work)
    T = work.since_time
    fall = (0.0, 0.0, p.gravity * T)
    r, v, R_BI = load3(flight.r_hat), load3(flight.v_hat), load33(flight.R_hat)
    R_s, R_end = R_BI, dR @ R_BI
    if back:
        R_s = dR.T @ R_BI
        R_end = R_s
    gained = R_s.T @ dv - fall
    moved = R_s.T @ dr - 0.5 * T * fall
    if back:
        v = v - gained
        r = r - rounded(T * v) - moved
    else:
        r = T * v + r + moved
        v = v + gained
    store(flight.R_hat, R_end)
    store(flight.r_hat, r)
    store(flight.v_hat, v)
    return R_s, dR, dv, dr


@kernel
def accel_variance(p, f_B):
    """Variance that the filter assumes for an accelerometer sample, per axis [m^2/s^4]."""
    d = f_B - (0.0, 0.0, p.gravity)
    variance = _with_thrust(p, p.accel_noise, p.accel_thrust_noise, f_B)
    return variance + p.accel_error_noise * p.accel_error_noise * dot(d, d)


@kernel
def gyro_sigma(p, f_B):
    """Standard deviation that the filter assumes for a gyro sample, per axis [rad/s]."""
    return math.sqrt(_with_thrust(p, p.gyro_noise, p.gyro_thrust_noise, f_B))


@kernel
def _with_thrust(p, hovering, thrust_noise, f_B):
    """Variance in hover, changed by the vibration at a thrust of f_B instead of g.

    Vibration grows with the square of the rotor speeds, as the thrust does.
    """
    more = dot(f_B, f_B) - p.gravity * p.gravity
    return maximum(hovering * hovering + thrust_noise * thrust_noise * more, 0.0)


@kernel
def put_noise(p, work, R_s, dR, dv):
    """Fill the columns of work.columns with the IMU's white noise since the saved instant.

    The noise refers to the last instant and acts at half time: compared with noise that is spread
    evenly, the variances match except for a third of their small terms.
    """
    M, T = work.columns, work.since_time
    root = math.sqrt(p.dt * T)
    force = select(T > 0.0, 1.0 / T, 0.0) * dv  # its mean
    a, g = root * math.sqrt(accel_variance(p, force)), root * gyro_sigma(p, force)
    zero = zero_like(T)
    for k in range(6):
        for i in range(15):
            M[i, NOISE + k] = zero
    for k in range(3):
        M[V + k, NOISE + k] = a
        M[R + k, NOISE + k] = 0.5 * T * a
    axes = diagonal((g, g, g))
    for k in range(3):
        force = R_s.T @ cross(axes[k], dv)
        store_column3(M, R, NOISE + 3 + k, -T / 6.0 * force)
        store_column3(M, V, NOISE + 3 + k, -0.5 * force)
        store_column3(M, E, NOISE + 3 + k, -(dR @ axes[k]))


@kernel
def take_columns(work, columns, R_s, dR, dv, dr, back):
    """Propagate the first columns of work.columns, errors of the state, back or forward.

    The noise of the samples refers to the last instant and is propagated back only.
    """
    M, T, B = work.columns, work.since_time, load33(work.since_bias_gain)
    for j in range(columns if back else min(columns, NOISE)):
        alpha, beta = B @ load_column3(M, BA, j), B @ load_column3(M, BG, j)
        r, v, e = load_column3(M, R, j), load_column3(M, V, j), load_column3(M, E, j)
        if back:
            e = dR.T @ e + beta
        turned = cross(beta, dv)
        gained = cross(e, dv) - alpha - rounded(0.5 * turned)
        moved = cross(e, dr) - _moved_by(load_column3(M, BA, j), alpha, T)
        moved = moved - rounded(T / 6.0 * turned)
        gained, moved = R_s.T @ gained, R_s.T @ moved
        if back:
            v = v - gained
            r = r - rounded(T * v) - moved
        else:
            r = T * v + r + moved
            v = v + gained
            e = dR @ (e - beta)
        store_column3(M, R, j, r)
        store_column3(M, V, j, v)
        store_column3(M, E, j, e)

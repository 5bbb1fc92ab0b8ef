"""The unscented Kalman filter of the report, with its structure exploited, its result unchanged.

State (r_I, v_I, e, b_a, b_g) with the error Euler angles e about R_hat, as R_BI = R(e) R_hat. The
filter stores the lower Cholesky factor L of its covariance P = L L^T. The sigma points are the same
as in the augmented filter (27 columns in the prediction, 15 + n_z in the update), but

* the augmented factor is block diagonal, so that noise which enters linearly contributes in closed
  form, and so do the columns for states on which a model does not depend: 9 pairs of points remain;
* a pair f(x0 + c l), f(x0 - c l) is evaluated as its half-difference a and s, its half-sum minus
  f(x0), since the rotation is split into parts even and odd in e. With c^2 = n + lambda the moments
  are
      mean = f(x0) + mu,  mu = sum s / c^2
      cov  = sum (a a^T + s s^T) / c^2 + (beta - alpha^2) mu mu^T + noise
  in which nothing cancels, unlike in the usual weights near -1e6;
* the update never forms P_zz. With A and E the columns a / c and s / c of the measurement, and Rz =
  E E^T + (beta - alpha^2) mu mu^T + R its noise, so that P_zz = A A^T + Rz, the matrix inversion
  lemma gives  P+ = L (I + C C^T)^-1 L^T  with  C = A^T Rz^-T/2  over the nine columns that matter.
  The new factor is L times the factor of that inverse, lower triangular again, and stays accurate
  when a measurement is 10^8 times as good as the prediction.

The extended Kalman filter (EKF) shares everything with the UKF: state, error angles, models, noise,
and the factor L of the covariance. Where the UKF puts the half-differences of a pair of sigma
points into a column, the EKF puts the derivative of the model times the column of L; the half-sums
minus the center, which carry the second order, are zero. With `R(e) = I - [e x] + ...`:

* `a = R_hat^T R(e)^T (f - b_a) - g e3`:  da = R_hat^T (de x f - db_a)
* `e+ = e + dt S(e) (w - b_g)`:  de+ = de + dt ((de_th w_z, -de_phi w_z, -de_th w_x) - db_g)

The derivatives of measurements are in the files of these, in `kernels/sensors/`.

Sources: report section 3.4; S. J. Julier and J. K. Uhlmann, Proc. IEEE 92(3), 2004.
"""

import math

import numpy as np

from quad_gym.kernels.compiling import Stage, call_stage, kernel
from quad_gym.kernels.filter.error_state import (
    BA,
    BG,
    E,
    R,
    V,
    keep_arc,
    reset_matrix,
    turn_covariance,
    velocity_error,
)
from quad_gym.kernels.filter.motion import turn_level
from quad_gym.kernels.filter.preintegration import (
    LEVER_ARM,
    accel_variance,
    gyro_sigma,
    lever_force,
)
from quad_gym.kernels.filter.slow import (
    decay_slow,
    keep_factor,
    predict_slow,
    stages_of,
    turn_slow,
)
from quad_gym.kernels.numbers.elementary import is_finite
from quad_gym.kernels.numbers.factors import cholesky
from quad_gym.kernels.numbers.lanes import any_of, select, zero_like
from quad_gym.kernels.numbers.linalg import (
    add_to_diagonal,
    cross,
    diagonal,
    keep,
    load3,
    load33,
    load_block,
    load_column3,
    outer,
    store_block,
    store_column3,
    sum_of_outers,
    sum_of_squares,
)
from quad_gym.kernels.numbers.rotation import (
    euler_to_dcm,
    split_rotation,
    split_turn,
    turn_pair_back,
    vector_to_dcm,
)
from quad_gym.records import FilterForm, FilterStatus


@kernel
def _euler_rate_parts(parts, w_B, dg):
    """The odd and even parts, in the sigma offset, of S(e) (w_B - dg) - w_B.

    S(e) maps body rates to rates of the error Euler angles; e and dg change sign together.
    """
    s_phi, m_phi, s_th, m_th = parts
    c_phi, c_th = 1.0 + m_phi, 1.0 + m_th
    per_c_phi = 1.0 / c_phi
    t_phi = s_phi * per_c_phi
    odd = (
        s_th * w_B[2] - c_th * dg[0],
        -dg[1] - t_phi * (s_th * dg[0] + c_th * w_B[2]),
        (-s_th * w_B[0] - c_th * dg[2]) * per_c_phi,
    )
    even = (
        m_th * w_B[0] - s_th * dg[2],
        t_phi * (s_th * w_B[0] + c_th * dg[2]),
        (s_th * dg[0] + (m_th - m_phi) * w_B[2]) * per_c_phi,
    )
    return odd, even


@kernel
def _acceleration_column(L, j, R_BI, f_B, df_B):
    """Derivative of the acceleration in I along column j, whose share of biases in f is df_B."""
    return R_BI.T @ (cross(load_column3(L, E, j), f_B) - df_B)


@kernel
def _angle_column(L, j, w_B, dt):
    """Derivative of the Euler step e + dt S(e) (w - b_g) along column j."""
    d, dg = load_column3(L, E, j), load_column3(L, BG, j)
    rate = (d[1] * w_B[2] - dg[0], -d[0] * w_B[2] - dg[1], -d[1] * w_B[0] - dg[2])
    return d + dt * rate


@kernel
def _force_offset(L, j, c, f_B, half, half_dt, midpoint):
    """Offset of the measured force along c times column j of L, in B at the tick's start.

    Halfway through the tick, an offset of the gyro's bias has rotated the force by half its angle.
    """
    df = c * load_column3(L, BA, j)
    if midpoint:
        dg = c * load_column3(L, BG, j)
        df = half.T @ (df + half_dt * cross(dg, f_B))
    return df


@kernel
def _propagate_columns(flight, p, work, f_B, w_B, half, form, augmented):
    """Fill work.F and work.S with the propagated pairs; return the means minus the center's.

    Position and velocity share the half-sums of the acceleration: S and the means have these and
    the half-sums of the error angles.
    """
    L, F, S = flight.L, work.F, work.S
    R_BI = load33(flight.R_hat)
    dt = p.dt
    half_dt, half_dt2 = 0.5 * dt, 0.5 * dt * dt
    midpoint, extended = (form & FilterForm.MIDPOINT.value) != 0, (form & FilterForm.EKF.value) != 0
    first = (form & FilterForm.FIRST_ESTIMATES.value) != 0
    c = p.sigma_spread * math.sqrt(p.sigma_kappa + augmented)
    inverse_c = 1.0 / c
    zero = zero_like(c)
    nothing = (zero, zero, zero)
    mean_a, mean_e = nothing, nothing
    f_start, full = f_B, half
    if midpoint:
        f_start, full = half.T @ f_B, half @ half

    for j in range(9):
        if extended:
            df = _force_offset(L, j, 1.0, f_B, half, half_dt, midpoint)
            a_odd, a_even = _acceleration_column(L, j, R_BI, f_start, df), nothing
            e_odd, e_even = _angle_column(L, j, w_B, dt), nothing
        else:
            d, dg = c * load_column3(L, E, j), c * load_column3(L, BG, j)
            df = _force_offset(L, j, c, f_B, half, half_dt, midpoint)
            even, odd, parts = split_rotation(d)
            # a_I = R^T R(e)^T (f - b_a) - g: parts odd and even in the offset, minus the center
            odd_B, even_B = turn_pair_back(even, odd, f_start, df)
            if first:
                even, odd = split_turn(d)
                odd_B = odd.T @ f_start - df - even.T @ df
                even_B = even.T @ f_start - odd.T @ df
            a_odd = inverse_c * (R_BI.T @ odd_B)
            a_even = inverse_c * (R_BI.T @ even_B)
            e_odd, e_even = nothing, nothing
            if not midpoint:
                rate_odd, rate_even = _euler_rate_parts(parts, w_B, dg)
                e_odd = inverse_c * (d + dt * rate_odd)
                e_even = dt * inverse_c * rate_even
        if midpoint:
            # about the new R_hat: R_half (R_half e - dt b_g)
            e_odd = full @ load_column3(L, E, j) - dt * (half @ load_column3(L, BG, j))

        v_j = load_column3(L, V, j)
        if first:
            v_j = velocity_error(v_j, load_column3(L, E, j), R_BI, load3(flight.v_corrected))
        store_column3(F, R, j, load_column3(L, R, j) + dt * v_j + half_dt2 * a_odd)
        store_column3(F, V, j, v_j + dt * a_odd)
        store_column3(F, E, j, e_odd)
        store_column3(S, 0, j, a_even)
        store_column3(S, 3, j, e_even)
        mean_a, mean_e = mean_a + a_even, mean_e + e_even

    for j in range(9, 15):  # offsets of the biases alone: linear
        df = _force_offset(L, j, -1.0, f_B, half, half_dt, midpoint)
        a_odd, e_odd = R_BI.T @ df, -dt * load_column3(L, BG, j)
        if midpoint:
            e_odd = half @ e_odd
        store_column3(F, R, j, half_dt2 * a_odd)
        store_column3(F, V, j, dt * a_odd)
        store_column3(F, E, j, e_odd)

    return inverse_c * mean_a, inverse_c * mean_e


@kernel
def _add_gyro_noise(P, p, R_BI, f_B, half):
    """Add the gyro's white noise to P; half of its angle error rotates the force."""
    dt, sigma = p.dt, gyro_sigma(p, f_B)
    for axis in diagonal((sigma, sigma, sigma)):
        dv = 0.5 * dt * dt * (R_BI.T @ (half.T @ cross(f_B, axis)))
        dr, de = 0.5 * dt * dv, -dt * (half @ axis)
        store_block(P, R, R, load_block(P, R, R) + outer(dr, dr))
        store_block(P, V, R, load_block(P, V, R) + outer(dv, dr))
        store_block(P, V, V, load_block(P, V, V) + outer(dv, dv))
        store_block(P, E, R, load_block(P, E, R) + outer(de, dr))
        store_block(P, E, V, load_block(P, E, V) + outer(de, dv))
        store_block(P, E, E, load_block(P, E, E) + outer(de, de))


@kernel
def _add_second_order(work, p, mean_a, mean_e, midpoint):
    """Add the half-sums of acceleration and error angles to work.P.

    With MIDPOINT, the error angles have none.
    """
    S, P = work.S, work.P
    dt = p.dt
    half_dt2 = 0.5 * dt * dt
    excess = p.sigma_beta - p.sigma_spread * p.sigma_spread
    aa = sum_of_squares(S, 0, 9) + outer(excess * mean_a, mean_a)
    store_block(P, R, R, load_block(P, R, R) + half_dt2 * half_dt2 * aa)
    store_block(P, V, R, load_block(P, V, R) + dt * half_dt2 * aa)
    store_block(P, V, V, load_block(P, V, V) + dt * dt * aa)
    if not midpoint:
        ea = sum_of_outers(S, 3, S, 0, 9) + outer(excess * mean_e, mean_a)
        ee = sum_of_squares(S, 3, 9) + outer(excess * mean_e, mean_e)
        store_block(P, E, R, load_block(P, E, R) + half_dt2 * ea)
        store_block(P, E, V, load_block(P, E, V) + dt * ea)
        store_block(P, E, E, load_block(P, E, E) + ee)


@kernel
def _sum_moments(flight, p, work, mean_a, mean_e, f_B, form):
    """Fill the lower triangle of work.P from the propagated pairs and the process noise.

    The gyro's noise is added here only if the sample counts as of the tick's start.
    """
    L, F, P = flight.L, work.F, work.P
    dt = p.dt
    half_dt2 = 0.5 * dt * dt
    decay_a, decay_g = p.accel_bias_decay, p.gyro_bias_decay
    variance = accel_variance(p, f_B)
    extended, midpoint = (form & FilterForm.EKF.value) != 0, (form & FilterForm.MIDPOINT.value) != 0
    angle = zero_like(dt) if midpoint else dt * gyro_sigma(p, f_B)
    gyro_variance = angle * angle

    for i in range(0, 9, 3):
        store_block(P, i, i, sum_of_squares(F, i, 15))
        for j in range(0, i, 3):
            store_block(P, i, j, sum_of_outers(F, i, F, j, 15))
    if not extended:
        _add_second_order(work, p, mean_a, mean_e, midpoint)
    for i in range(3):
        P[R + i, R + i] += half_dt2 * half_dt2 * variance
        P[V + i, R + i] += half_dt2 * dt * variance
        P[V + i, V + i] += dt * dt * variance
        P[E + i, E + i] += gyro_variance

    # the biases are linear: their propagated rows are the rows of L times the decay
    for j in range(0, 9, 3):
        store_block(P, BA, j, decay_a * sum_of_outers(L, BA, F, j, 12))
        store_block(P, BG, j, decay_g * sum_of_outers(L, BG, F, j, 15))
    aa, gg = sum_of_squares(L, BA, 12), sum_of_squares(L, BG, 15)
    drive_a, drive_g = p.accel_bias_drive, p.gyro_bias_drive
    store_block(P, BA, BA, add_to_diagonal(decay_a * decay_a * aa, drive_a * drive_a))
    store_block(P, BG, BA, decay_g * decay_a * sum_of_outers(L, BG, L, BA, 12))
    store_block(P, BG, BG, add_to_diagonal(decay_g * decay_g * gg, drive_g * drive_g))


@kernel
def predict(flight, p, work, settings, stages, slow):
    """Predict over one tick with its IMU sample.

    In the report's form, the sample is taken at the tick's start:
    `a = R^T (f_meas - b_a - v_a) - g e3`, `r+ = r + v dt + a dt^2/2`, `v+ = v + a dt`,
    `e+ = e + dt S(e) (w_meas - b_g - v_g)`, `b+ = alpha b + v_2`, and R_hat+ = R(mean e+) R_hat.

    With MIDPOINT, the sample applies to the whole tick: R_hat+ = exp(-[dt w x]) R_hat, and R in `a`
    is the attitude halfway. The error angles refer to the new R_hat at once: with R_half =
    exp(-[dt w x] / 2), `e+ = R_half (R_half e - dt (b_g + v_g))`, and the gyro's error rotates the
    force by half the angle by which it rotates the attitude.

    With TURN, the covariance is transformed with the reset of e, see `error_state.py`; with EKF,
    derivatives replace sigma points.

    A lane whose predicted covariance is not positive definite keeps its state, sets
    PREDICTION_FAILED, and counts the failure. `slow`: the settings if sensors have slow errors
    (`slow.py`), else None.
    """
    dt, form = p.dt, settings.form
    midpoint = (form & FilterForm.MIDPOINT.value) != 0
    if settings.by_motion:
        if any_of(flight.level_fresh > 0.0):
            call_stage(stages, Stage.HEADING, flight, p, p, settings, work, 0)
    w_B = load3(flight.gyro) - load3(flight.b_g_hat)
    f_B = load3(flight.accel) - load3(flight.b_a_hat)
    R_BI = load33(flight.R_hat)
    half = R_BI  # read with MIDPOINT only
    if midpoint:
        half = vector_to_dcm(0.5 * dt * w_B)
    if (form & LEVER_ARM) != 0:
        f_B = f_B - lever_force(flight, p, form, half)
    if settings.by_motion:
        halfway = half if midpoint else vector_to_dcm(0.5 * dt * w_B)
        turn_level(flight, p, f_B + load3(flight.b_a_hat), halfway)
    states, augmented = 15, 27.0  # the latter with the noise
    if slow is not None:
        states, augmented = 15 + slow.slow_states, 27.0 + 2.0 * slow.slow_errors
    mean_a, mean_e = _propagate_columns(flight, p, work, f_B, w_B, half, form, augmented)
    _sum_moments(flight, p, work, mean_a, mean_e, f_B, form)
    if slow is not None:
        predict_slow(flight, slow, p, work)
    turn = mean_e + dt * w_B
    if midpoint:
        _add_gyro_noise(work.P, p, R_BI, f_B, half)
        R_pred, f_B = half @ (half @ R_BI), half.T @ f_B
    else:
        R_pred = euler_to_dcm(turn) @ R_BI
        if (form & FilterForm.TURN.value) != 0:
            turn_covariance(work.P, reset_matrix(turn))
            if slow is not None:
                turn_slow(slow, work.P, reset_matrix(turn))
    ok = cholesky(work.P, states, work.inverse_diagonal) > 0.0

    a_I = R_BI.T @ f_B - (0.0, 0.0, p.gravity) + mean_a
    r, v = load3(flight.r_hat), load3(flight.v_hat)
    r_pred = r + dt * v + 0.5 * dt * dt * a_I
    v_pred = v + dt * a_I
    ok = ok & is_finite(r_pred[0] + r_pred[1] + r_pred[2] + v_pred[0] + v_pred[1] + v_pred[2])

    keep(flight.r_hat, ok, r_pred)
    keep(flight.v_hat, ok, v_pred)
    if (form & FilterForm.FIRST_ESTIMATES.value) != 0:
        keep(flight.v_corrected, ok, dt * mean_a)
    keep(flight.R_hat, ok, R_pred)
    keep(flight.b_a_hat, ok, p.accel_bias_decay * load3(flight.b_a_hat))
    keep(flight.b_g_hat, ok, p.gyro_bias_decay * load3(flight.b_g_hat))
    keep_factor(flight, slow, work, ok)
    if (form & FilterForm.FIRST_ESTIMATES.value) != 0:
        keep_arc(flight, ok)
    if slow is not None:
        decay_slow(flight, slow, p, ok)
    status, failure = flight.filter_status, np.uint64(FilterStatus.PREDICTION_FAILED.value)
    flight.filter_status = select(ok, status, status | failure)
    flight.prediction_failures = flight.prediction_failures + select(ok, 0.0, 1.0)


predict_stage, predict_with_slow_stage = stages_of("predict", predict)

"""The prediction of the filter: of the unscented Kalman filter of the report, its result unchanged.

State (e, r_I, v_I, b_a, b_g) with the error Euler angles e about R_hat, as R_BI = R(e) R_hat. The
sigma points are the same as in the augmented filter (27 columns of a root of the covariance here,
15 + n_z in the update), but

* the augmented root is block diagonal, so that noise which enters linearly contributes in closed
  form, and so do the columns for states on which a model does not depend;
* with e first, only three columns of the lower factor change the attitude. The model is linear
  in all other ones, which so contribute as in a linear filter: A P A^T, without any factor;
* a pair f(x0 + c l), f(x0 - c l) is evaluated as its half-difference a and s, its half-sum minus
  f(x0), since the rotation is split into parts even and odd in e. With c^2 = n + lambda the moments
  are
      mean = f(x0) + mu,  mu = sum s / c^2
      cov  = sum (a a^T + s s^T) / c^2 + (beta - alpha^2) mu mu^T + noise
  in which nothing cancels, unlike in the usual weights near -1e6. Of the three columns, a / c is
  A l plus a remainder q of third order, so that the sum of a a^T / c^2 over all columns is A P A^T
  + sum (A l q^T + q l^T A^T + q q^T) over these;
* the update never forms P_zz, see `update.py`.

The filter carries its covariance from tick to tick. Its factor is computed where a measurement is.

The extended Kalman filter (EKF) shares everything with the UKF: state, error angles, models and
noise. Its derivatives are the matrices A, and q and s are zero. With `R(e) = I - [e x] + ...`:

* `a = R_hat^T R(e)^T (f - b_a) - g e3`:  da = R_hat^T (de x f - db_a)
* `e+ = e + dt S(e) (w - b_g)`:  de+ = de + dt ((de_th w_z, -de_phi w_z, -de_th w_x) - db_g)

The derivatives of measurements are in the files of these, in `kernels/sensors/`.

Sources: report section 3.4; S. J. Julier and J. K. Uhlmann, Proc. IEEE 92(3), 2004; M. Morelande
and B. Moran, "An Unscented Transformation for Conditionally Linear Models", ICASSP 2007.
"""

import math

import numpy as np

from quad_gym.kernels.compiling import kernel
from quad_gym.kernels.filter.error_state import (
    BA,
    BG,
    E,
    R,
    V,
    crossed,
    keep_arc,
    reset_matrix,
    take_up_corrections,
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
    predict_slow,
    stages_of,
)
from quad_gym.kernels.numbers.elementary import is_finite, minimum
from quad_gym.kernels.numbers.factors import KNOWN, cholesky33, lower33, solve_right33
from quad_gym.kernels.numbers.lanes import select, zero_like
from quad_gym.kernels.numbers.linalg import (
    add_to_diagonal,
    cross,
    diagonal,
    keep,
    keep_block,
    keep_lower,
    load3,
    load33,
    load_block,
    load_symmetric,
    outer,
)
from quad_gym.kernels.numbers.rotation import (
    euler_to_dcm,
    orthonormal,
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
def _column(form, c, d, da, dg, f_B, f_start, w_B, R_BI, half, dt):
    """Odd and even parts of acceleration and error angles along a column of the factor, over c.

    Args:
        form: Options of the filter.
        c: Spread of the sigma points.
        d, da, dg: Offsets of the error angles and of both biases, times c.
        f_B: Specific force halfway through the tick, in B.
        f_start: The same in B at the tick's start.
        w_B: Angular rate.
        R_BI: Attitude at the tick's start.
        half: Rotation over half a tick, with MIDPOINT.
        dt: Tick.
    """
    midpoint, inverse_c = (form & FilterForm.MIDPOINT.value) != 0, 1.0 / c
    even, odd, parts = split_rotation(d)
    df = da
    if midpoint:  # halfway, an offset of the gyro's bias has rotated the force by half its angle
        df = half.T @ (da + 0.5 * dt * cross(dg, f_B))
    # a_I = R^T R(e)^T (f - b_a) - g: parts odd and even in the offset, minus the center
    odd_B, even_B = turn_pair_back(even, odd, f_start, df)
    if (form & FilterForm.FIRST_ESTIMATES.value) != 0:
        even, odd = split_turn(d)
        odd_B = odd.T @ f_start - df - even.T @ df
        even_B = even.T @ f_start - odd.T @ df
    zero = zero_like(c)
    e_odd, e_even = (zero, zero, zero), (zero, zero, zero)
    if not midpoint:
        rate_odd, rate_even = _euler_rate_parts(parts, w_B, dg)
        e_odd = inverse_c * (d + dt * rate_odd)
        e_even = dt * inverse_c * rate_even
    return inverse_c * (R_BI.T @ odd_B), inverse_c * (R_BI.T @ even_B), e_odd, e_even


@kernel
def _maps(form, f_B, f_start, w_B, R_BI, half, dt):
    """Matrices A of the prediction, (full, B, K, G, H).

    e+ = full e + B b_g, and v+ = v + K e + G b_a + H b_g.
    """
    zero = zero_like(dt)
    one = 1.0 + zero
    eye = diagonal((one, one, one))
    K = dt * (R_BI.T @ crossed(f_start))
    if (form & FilterForm.MIDPOINT.value) != 0:
        # about the new R_hat: R_half (R_half e - dt b_g)
        full, B, G = half @ half, -dt * half, -dt * (half @ R_BI).T
        H = 0.5 * dt * (G @ crossed(f_B))
    else:
        rate = ((zero, w_B[2], zero), (-w_B[2], zero, zero), (zero, -w_B[0], zero))
        full, B, G = eye + dt * rate, -dt * eye, -dt * R_BI.T
        H = diagonal((zero, zero, zero))
    return full, B, K, G, H


@kernel
def _load_covariance(P):
    """Blocks of the covariance: of e, r and v, of the biases, and of the biases with the former."""
    motion = (
        load_symmetric(P, E),
        load_symmetric(P, R),
        load_symmetric(P, V),
        load_block(P, R, E),
        load_block(P, V, E),
        load_block(P, V, R),
    )
    biases = load_symmetric(P, BA), load_symmetric(P, BG), load_block(P, BG, BA)
    accel = load_block(P, BA, E), load_block(P, BA, R), load_block(P, BA, V)
    gyro = load_block(P, BG, E), load_block(P, BG, R), load_block(P, BG, V)
    return motion, biases, accel, gyro


@kernel
def _keep_covariance(P, ok, motion, biases, accel, gyro):
    """Store blocks of the covariance, in the order of `_load_covariance`, in the lanes `ok`."""
    ee, rr, vv, re, ve, vr = motion
    aa, gg, ga = biases
    ae, ar, av = accel
    ge, gr, gv = gyro
    keep_lower(P, E, ok, ee)
    keep_block(P, R, E, ok, re)
    keep_lower(P, R, ok, rr)
    keep_block(P, V, E, ok, ve)
    keep_block(P, V, R, ok, vr)
    keep_lower(P, V, ok, vv)
    keep_block(P, BA, E, ok, ae)
    keep_block(P, BA, R, ok, ar)
    keep_block(P, BA, V, ok, av)
    keep_lower(P, BA, ok, aa)
    keep_block(P, BG, E, ok, ge)
    keep_block(P, BG, R, ok, gr)
    keep_block(P, BG, V, ok, gv)
    keep_block(P, BG, BA, ok, ga)
    keep_lower(P, BG, ok, gg)


@kernel
def _with_states_before(maps, motion, biases, accel, gyro):
    """Covariances of v+ with the states before, (e, r, v, b_a, b_g), and of e+ with (e, b_a, b_g).

    They lack the remainders of the sigma points, as in a linear filter.
    """
    full, B, K, G, H = maps
    ee, _, vv, re, ve, vr = motion
    (aa, gg, ga), (ae, ar, av), (ge, gr, gv) = biases, accel, gyro
    Ve = ve + K @ ee + G @ ae + H @ ge
    Vr = vr + K @ re.T + G @ ar + H @ gr
    Vv = vv + K @ ve.T + G @ av + H @ gv
    Va = av.T + K @ ae.T + G @ aa + H @ ga
    Vg = gv.T + K @ ge.T + G @ ga.T + H @ gg
    Ee, Ea, Eg = full @ ee + B @ ge, full @ ae.T + B @ ga, full @ ge.T + B @ gg
    return Ve, Vr, Vv, Va, Vg, Ee, Ea, Eg


@kernel
def _columns(form, c, rows, f_B, f_start, w_B, R_BI, half, dt):
    """Odd and even parts of acceleration and error angles along the columns that turn, over c.

    Args:
        form: Options of the filter.
        c: Spread of the sigma points.
        rows: Rows of the factor for the error angles and for both biases, (3, 3) each.
        f_B, f_start, w_B, R_BI, half, dt: As in `_column`.

    Returns:
        Four tuples of three vectors, one for each column: odd and even parts of the acceleration,
        odd and even parts of the error angles.
    """
    l_e, l_a, l_g = rows
    e_0, e_1, e_2 = c * l_e.T
    a_0, a_1, a_2 = c * l_a.T
    g_0, g_1, g_2 = c * l_g.T
    odd_0, s_0, turn_0, t_0 = _column(form, c, e_0, a_0, g_0, f_B, f_start, w_B, R_BI, half, dt)
    odd_1, s_1, turn_1, t_1 = _column(form, c, e_1, a_1, g_1, f_B, f_start, w_B, R_BI, half, dt)
    odd_2, s_2, turn_2, t_2 = _column(form, c, e_2, a_2, g_2, f_B, f_start, w_B, R_BI, half, dt)
    return (odd_0, odd_1, odd_2), (s_0, s_1, s_2), (turn_0, turn_1, turn_2), (t_0, t_1, t_2)


@kernel
def _even_moments(p, c, dt, s, t, midpoint):
    """Moments of the even parts s of the acceleration and t of the error angles.

    Returns:
        Means of acceleration and error angles; their shares of the covariance of v, of v with e,
        and of e.
    """
    zero = zero_like(dt)
    nothing = (zero, zero, zero)
    mean_e, S_ve, S_e = nothing, (nothing, nothing, nothing), (nothing, nothing, nothing)
    inverse_c, excess = 1.0 / c, p.sigma_beta - p.sigma_spread * p.sigma_spread
    s_0, s_1, s_2 = s
    mean_a = inverse_c * (s_0 + s_1 + s_2)
    S_v = outer(s_0, s_0) + outer(s_1, s_1) + outer(s_2, s_2) + outer(excess * mean_a, mean_a)
    S_v = dt * dt * S_v
    if not midpoint:
        t_0, t_1, t_2 = t
        mean_e = inverse_c * (t_0 + t_1 + t_2)
        S_ve = outer(s_0, t_0) + outer(s_1, t_1) + outer(s_2, t_2)
        S_ve = dt * (S_ve + outer(excess * mean_a, mean_e))
        S_e = outer(t_0, t_0) + outer(t_1, t_1) + outer(t_2, t_2)
        S_e = S_e + outer(excess * mean_e, mean_e)
    return mean_a, mean_e, S_v, S_ve, S_e


@kernel
def _spread(p, slow):
    """Spread c of the sigma points, from the number of states with the noise."""
    augmented = 27.0
    if slow is not None:
        augmented = 27.0 + 2.0 * slow.slow_errors
    return p.sigma_spread * math.sqrt(p.sigma_kappa + augmented)


@kernel
def _remainders(p, form, c, maps, factor, diagonal_e, blocks, f_B, f_start, w_B, R_BI, half):
    """Differences of the sigma points that turn from a linear filter.

    Args:
        p: Parameters of the filter.
        form: Options of the filter.
        c: Spread of the sigma points.
        maps: Matrices of the prediction.
        factor, diagonal_e: Factor of the covariance of e.
        blocks: Blocks of the covariance: of e, r and v, and of both biases with these.
        f_B, f_start, w_B, R_BI, half: As in `_column`.

    Returns:
        Rows of the factor, of e, b_a, b_g, v and r; means of acceleration and error angles;
        remainders q of v+ and q_e of e+, a row for each column of the factor; products of v+ with q
        and q_e, of r+ with q_e, and of e+ with q_e; sums of even parts, see `_even_moments`.
    """
    dt, midpoint = p.dt, (form & FilterForm.MIDPOINT.value) != 0
    full, B, K, G, H = maps
    (_, _, _, re, ve, _), (ae, _, _), (ge, _, _) = blocks
    half_dt = 0.5 * dt
    l_e, l_a = lower33(factor, diagonal_e), solve_right33(ae, factor)
    l_g, l_v, l_r = (
        solve_right33(ge, factor),
        solve_right33(ve, factor),
        solve_right33(re, factor),
    )
    rows = (l_e, l_a, l_g)
    odd, s, turned, t = _columns(form, c, rows, f_B, f_start, w_B, R_BI, half, dt)
    mean_a, mean_e, S_v, S_ve, S_e = _even_moments(p, c, dt, s, t, midpoint)
    odd = (dt * odd[0], dt * odd[1], dt * odd[2])
    q = odd - (K @ l_e + G @ l_a + H @ l_g).T
    f_v = l_v + odd.T
    v_q = f_v @ q
    zero = zero_like(dt)
    nothing = (zero, zero, zero)
    none = (nothing, nothing, nothing)
    q_e, v_qe, r_qe, e_qe = none, none, none, none
    if not midpoint:
        q_e = turned - (full @ l_e + B @ l_g).T
        v_qe, r_qe = f_v @ q_e, (l_r + half_dt * (l_v + f_v)) @ q_e
        e_qe = turned.T @ q_e
    rows = (l_e, l_a, l_g, l_v, l_r)
    return rows, (mean_a, mean_e), (q, q_e), (v_q, v_qe, r_qe, e_qe), (S_v, S_ve, S_e)


@kernel
def _predict_covariance(flight, p, settings, slow, f_B, w_B, R_BI, half, sound):
    """Predict the covariance, in the lanes `sound` where it stays one.

    Returns:
        Mean of the acceleration minus the center's, mean of the error angles, and the lanes.

    With v+ = v + K e + G b_a + H b_g + q, and r+ = r + dt (v + v+) / 2, covariances of v+, r+ and
    e+ with the states before follow first, then those with the states after. Two letters name the
    covariance of two states, a capital one the state after: Ve is the covariance of v+ with e.
    """
    P, dt, form = flight.P, p.dt, settings.form
    midpoint, extended = (form & FilterForm.MIDPOINT.value) != 0, (form & FilterForm.EKF.value) != 0
    half_dt = 0.5 * dt
    f_start = f_B
    if midpoint:
        f_start = half.T @ f_B
    maps = _maps(form, f_B, f_start, w_B, R_BI, half, dt)
    full, B, K, G, H = maps
    motion, biases, with_accel, with_gyro = _load_covariance(P)
    ee, rr, vv, re, ve, vr = motion
    (aa, gg, ga), (_, ar, av), (_, gr, gv) = biases, with_accel, with_gyro

    Ve, Vr, Vv, Va, Vg, Ee, Ea, Eg = _with_states_before(
        maps, motion, biases, with_accel, with_gyro
    )
    factor, diagonal_e, pivot = cholesky33(add_to_diagonal(ee, KNOWN))
    zero = zero_like(dt)
    nothing = (zero, zero, zero)
    none = (nothing, nothing, nothing)
    mean_a, mean_e, q, q_e = nothing, nothing, none, none
    (v_q, v_qe, r_qe, e_qe), (S_v, S_ve, S_e) = (none, none, none, none), (none, none, none)
    if not extended:
        blocks = (motion, with_accel, with_gyro)
        c = _spread(p, slow)
        rows, means, remainders, products, even = _remainders(
            p, form, c, maps, factor, diagonal_e, blocks, f_B, f_start, w_B, R_BI, half
        )
        (mean_a, mean_e), (q, q_e), (l_e, l_a, l_g, l_v, l_r) = means, remainders, rows
        (v_q, v_qe, r_qe, e_qe), (S_v, S_ve, S_e) = products, even
        Ve, Vr, Vv = Ve + q.T @ l_e.T, Vr + q.T @ l_r.T, Vv + q.T @ l_v.T
        Va, Vg = Va + q.T @ l_a.T, Vg + q.T @ l_g.T
        if not midpoint:
            Ee, Ea, Eg = Ee + q_e.T @ l_e.T, Ea + q_e.T @ l_a.T, Eg + q_e.T @ l_g.T
    # of r+ with the states before
    Re, Rr, Rv = re + half_dt * (ve + Ve), rr + half_dt * (vr + Vr), vr.T + half_dt * (vv + Vv)
    Ra, Rg = ar.T + half_dt * (av.T + Va), gr.T + half_dt * (gv.T + Vg)
    # the gyro's noise acts as an error of its bias does
    sigma, accel = gyro_sigma(p, f_B), accel_variance(p, f_B)
    noise = sigma * sigma
    Vn, Rn, En = Vg + noise * H, Rg + (half_dt * noise) * H, Eg + noise * B
    # after
    new_vv = Vv + Ve @ K.T + Va @ G.T + Vn @ H.T + (v_q + S_v)
    new_vv = add_to_diagonal(new_vv, dt * dt * accel)
    new_rv = Vr.T + half_dt * (Vv.T + new_vv)
    new_rr = Rr + half_dt * (Rv + new_rv)
    new_re, new_ve = Re @ full.T + Rn @ B.T, Ve @ full.T + Vn @ B.T
    new_ee = Ee @ full.T + En @ B.T
    if not (midpoint or extended):
        new_re, new_ve = new_re + r_qe + half_dt * S_ve, new_ve + v_qe + S_ve
        new_ee = new_ee + e_qe + S_e
    turn = mean_e + dt * w_B
    turns = not midpoint and (form & FilterForm.TURN.value) != 0
    if turns:
        T = reset_matrix(turn)
        new_ee, new_re, new_ve = T @ new_ee @ T.T, new_re @ T.T, new_ve @ T.T
        Ea, Eg = T @ Ea, T @ Eg
    a, g = p.accel_bias_decay, p.gyro_bias_decay
    new_aa = add_to_diagonal(a * a * aa, p.accel_bias_drive * p.accel_bias_drive)
    new_gg = add_to_diagonal(g * g * gg, p.gyro_bias_drive * p.gyro_bias_drive)

    ok = sound & (pivot > 0.0) & _are_variances(new_ee, new_rr, new_vv, new_aa, new_gg)
    motion = (new_ee, new_rr, new_vv, new_re, new_ve, new_rv.T)
    biases = (new_aa, new_gg, (g * a) * ga)
    accel_with, gyro_with = (a * Ea.T, a * Ra.T, a * Va.T), (g * Eg.T, g * Rg.T, g * Vg.T)
    _keep_covariance(P, ok, motion, biases, accel_with, gyro_with)
    if slow is not None:
        predict_slow(flight, slow, p, (full, B, K, G, H, q, q_e), factor, turn, turns, midpoint, ok)
    return mean_a, turn, ok


@kernel
def _are_variances(*blocks):
    """Lanes in which no number on the diagonals is negative, and all are finite."""
    least, total = blocks[0][0][0], blocks[0][0][0]
    for m in blocks:
        least = minimum(minimum(least, m[0][0]), minimum(m[1][1], m[2][2]))
        total = total + m[0][0] + m[1][1] + m[2][2]
    return (least >= 0.0) & is_finite(total)


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

    A lane whose covariance of e is not positive definite, or whose predicted estimate or variances
    are not finite, keeps its state, sets PREDICTION_FAILED, and counts the failure. `slow`: the
    settings if sensors have slow errors (`slow.py`), else None.
    """
    dt, form = p.dt, settings.form
    midpoint = (form & FilterForm.MIDPOINT.value) != 0
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
    if (form & FilterForm.FIRST_ESTIMATES.value) != 0:
        take_up_corrections(flight, slow, R_BI, flight.tick == flight.tick)
    f_start = f_B
    if midpoint:
        f_start = half.T @ f_B
    a_I = R_BI.T @ f_start - (0.0, 0.0, p.gravity)
    r, v = load3(flight.r_hat), load3(flight.v_hat)
    moved = r + v + a_I
    sound = is_finite(moved[0] + moved[1] + moved[2])
    mean_a, turn, ok = _predict_covariance(flight, p, settings, slow, f_B, w_B, R_BI, half, sound)
    if midpoint:
        R_pred = half @ (half @ R_BI)
    else:
        R_pred = euler_to_dcm(turn) @ R_BI
    a_I = a_I + mean_a

    keep(flight.r_hat, ok, r + dt * v + 0.5 * dt * dt * a_I)
    keep(flight.v_hat, ok, v + dt * a_I)
    if (form & FilterForm.FIRST_ESTIMATES.value) != 0:
        keep(flight.v_corrected, ok, dt * mean_a)
    keep(flight.R_hat, ok, orthonormal(R_pred))
    keep(flight.b_a_hat, ok, p.accel_bias_decay * load3(flight.b_a_hat))
    keep(flight.b_g_hat, ok, p.gyro_bias_decay * load3(flight.b_g_hat))
    if (form & FilterForm.FIRST_ESTIMATES.value) != 0:
        keep_arc(flight, ok)
    if slow is not None:
        decay_slow(flight, slow, p, ok)
    status, failure = flight.filter_status, np.uint64(FilterStatus.PREDICTION_FAILED.value)
    flight.filter_status = select(ok, status, status | failure)
    flight.prediction_failures = flight.prediction_failures + select(ok, 0.0, 1.0)


predict_stage, predict_with_slow_stage = stages_of("predict", predict)

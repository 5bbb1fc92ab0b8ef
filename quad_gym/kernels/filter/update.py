"""The filter's update: antenna position, baseline direction and feature directions at once.

See `ukf.py` for the form of the unscented transform and of the update. The stacked measurement is
made of triples, all in I or B: r + R^T l_p, unit(R^T l_b), v + R^T (w x l_p), and for each feature
unit(R (X - r) - l_c), for a direction in the camera frame differs from one in B by a fixed rotation
only. A triple that a lane lacks is masked: its deviations and innovation are zero and its noise is
one, which gives exactly the update without it. Triples that every lane lacks are left out.
"""

import math

import numpy as np

from quad_gym.kernels.compiling import kernel, stage
from quad_gym.kernels.filter.directions import direction_noise, direction_pair
from quad_gym.kernels.filter.ekf import measure_columns
from quad_gym.kernels.filter.error_state import BA, BG, E, R, V, reset_matrix, turn_factor
from quad_gym.kernels.filter.innovations import judge_innovations, mark_failed
from quad_gym.kernels.filter.recovery import raise_doubts
from quad_gym.kernels.maths.elementary import is_finite
from quad_gym.kernels.maths.linalg import (
    add,
    add_outer,
    add_to_diagonal,
    apply,
    apply_transposed,
    cholesky,
    cross,
    dot,
    keep3,
    keep33,
    load3,
    load33,
    load_block,
    load_column3,
    multiply,
    norm,
    scale,
    scale33,
    select3,
    solve_left_vector,
    solve_right,
    store3,
    store_block,
    sub,
    sum_of_outers,
    sum_of_outers_of_rows,
    sum_of_squares,
)
from quad_gym.kernels.maths.rotation import euler_to_dcm, split_rotation
from quad_gym.kernels.simd.blocks import lanes_of
from quad_gym.kernels.simd.lanes import any_of, logical_not, select
from quad_gym.records import FilterForm, FilterStatus

_EKF, _TURN = int(FilterForm.EKF), int(FilterForm.TURN)
_GATE, _WATCH = int(FilterForm.GATE), int(FilterForm.GATE | FilterForm.INNOVATIONS)
_GRADUAL = int(FilterForm.GRADUAL)
_UPDATE_FAILED = np.uint64(FilterStatus.UPDATE_FAILED)


@kernel
def _set_triple(row, k, has, values):
    """Write three numbers of the stacked measurement, zero where a lane lacks it."""
    for i in range(3):
        row[k + i] = select(has, values[i], 0.0)


@kernel
def _set_noise(Rz, k, has, block):
    """Write a diagonal block of the measurement noise, the identity where a lane lacks it."""
    for i in range(3):
        for j in range(3):
            Rz[k + i, k + j] = select(has, block[i][j], 1.0 if i == j else 0.0)


@kernel
def _has_feature(flight, k):
    return flight.feature_valid[k] > 0.0


@kernel
def _compare_centre(flight, p, work, feature_count, use_position, use_baseline, use_velocity):
    """Fill work.h (center), work.z (measured) and work.Rz's diagonal blocks; return n_z."""
    h, z, Rz = work.h, work.z, work.Rz
    R_IG, R_BI, R_CB = load33(p.R_IG), load33(flight.R_hat), load33(p.R_CB)
    r = load3(flight.r_hat)
    k = 0
    if use_position:
        has = flight.position_valid > 0.0
        _set_triple(h, k, has, add(r, apply_transposed(R_BI, load3(p.antenna))))
        _set_triple(z, k, has, apply(R_IG, load3(flight.gnss_position)))
        s = load3(p.position_sigma)
        zero = 0.0 * s[0]
        noise = ((s[0] * s[0], zero, zero), (zero, s[1] * s[1], zero), (zero, zero, s[2] * s[2]))
        _set_noise(Rz, k, has, noise)
        k += 3
    if use_baseline:
        has = flight.baseline_valid > 0.0
        u_I = apply_transposed(R_BI, scale(1.0 / p.baseline_length, load3(p.baseline)))
        _set_triple(h, k, has, u_I)
        measured = apply(R_IG, load3(flight.gnss_baseline))
        _set_triple(z, k, has, scale(1.0 / norm(measured), measured))
        variance = p.baseline_noise * p.baseline_noise
        _set_noise(Rz, k, has, direction_noise(u_I, variance, p.direction_floor))
        k += 3
    if use_velocity:
        has = flight.velocity_valid > 0.0
        w_B = sub(load3(flight.w_meas), load3(flight.b_g_hat))
        lever_B = cross(w_B, load3(p.antenna))
        _set_triple(h, k, has, add(load3(flight.v_hat), apply_transposed(R_BI, lever_B)))
        _set_triple(z, k, has, apply(R_IG, load3(flight.gnss_velocity)))
        variance = p.velocity_sigma * p.velocity_sigma
        zero = 0.0 * variance
        nothing = (zero, zero, zero)
        noise = add_to_diagonal((nothing, nothing, nothing), variance)
        _set_noise(Rz, k, has, noise)
        k += 3
    w_B = sub(load3(flight.w_meas), load3(flight.b_g_hat))
    pixel_sigma = math.sqrt(p.pixel_sigma * p.pixel_sigma + p.blur * p.blur * dot(w_B, w_B))
    for i in range(feature_count):
        has = _has_feature(flight, i)
        if any_of(has):
            X_B = apply(R_BI, sub(load3(p.features[i]), r))
            to_feature = sub(X_B, load3(p.camera))
            store3(work.X_B[i], X_B)
            work.inverse_distance[i] = 1.0 / norm(to_feature)
            _set_triple(h, k, has, scale(work.inverse_distance[i], to_feature))
            pixel = p.pixel_size
            ray_C = (
                pixel * flight.pixels[i, 0],
                pixel * flight.pixels[i, 1],
                pixel * p.focal_length,
            )
            length = norm(ray_C)
            u_B = apply_transposed(R_CB, scale(1.0 / length, ray_C))
            _set_triple(z, k, has, u_B)
            sigma = pixel_sigma * pixel / length
            predicted = scale(work.inverse_distance[i], to_feature)
            u_B = select3(p.noise_at_prediction > 0.0, predicted, u_B)
            noise = direction_noise(u_B, sigma * sigma, p.direction_floor)
            # a pixel does not move along the optical axis c: less c c^T, across u
            across = sub(R_CB[2], scale(dot(R_CB[2], u_B), u_B))
            less = scale(-p.noise_projected * sigma * sigma, across)
            _set_noise(Rz, k, has, add_outer(noise, less, across))
            k += 3
    return k


@kernel
def _measure_sigma_points(
    flight, p, work, feature_count, use_position, use_baseline, use_velocity, c
):
    """Fill work.A and work.E with the measured pairs; column j of L is their row 8 - j."""
    L = flight.L
    R_BI = load33(flight.R_hat)
    camera = load3(p.camera)
    antenna, unit_baseline = load3(p.antenna), scale(1.0 / p.baseline_length, load3(p.baseline))
    inverse_c = 1.0 / c
    for j in range(9):
        A, S = work.A[8 - j], work.E[8 - j]
        dr = load_column3(L, R, j)
        even, odd, _ = split_rotation(scale(c, load_column3(L, E, j)))
        k = 0
        if use_position:
            has = flight.position_valid > 0.0
            lever_odd = scale(inverse_c, apply_transposed(odd, antenna))
            lever_even = scale(inverse_c, apply_transposed(even, antenna))
            _set_triple(A, k, has, add(dr, apply_transposed(R_BI, lever_odd)))
            _set_triple(S, k, has, apply_transposed(R_BI, lever_even))
            k += 3
        if use_baseline:
            has = flight.baseline_valid > 0.0
            baseline_odd = scale(inverse_c, apply_transposed(odd, unit_baseline))
            baseline_even = scale(inverse_c, apply_transposed(even, unit_baseline))
            _set_triple(A, k, has, apply_transposed(R_BI, baseline_odd))
            _set_triple(S, k, has, apply_transposed(R_BI, baseline_even))
            k += 3
        if use_velocity:  # that the lever arm's share turns with e is neglected
            has = flight.velocity_valid > 0.0
            dv = load_column3(L, V, j)
            _set_triple(A, k, has, dv)
            _set_triple(S, k, has, scale(0.0, dv))
            k += 3
        dr_B = apply(R_BI, scale(c, dr))
        for i in range(feature_count):
            has = _has_feature(flight, i)
            if any_of(has):
                X_B = load3(work.X_B[i])
                # (I + even +- odd) (X_B -+ dr_B) - l_c
                v_odd = sub(sub(apply(odd, X_B), dr_B), apply(even, dr_B))
                v_even = sub(apply(even, X_B), apply(odd, dr_B))
                v = sub(X_B, camera)
                a, s = direction_pair(v, work.inverse_distance[i], v_even, v_odd)
                _set_triple(A, k, has, scale(inverse_c, a))
                _set_triple(S, k, has, scale(inverse_c, s))
                k += 3


@kernel
def _innovate(work, n, c):
    """Turn work.z into the innovation: what was measured less what the sigma points expect."""
    S, mu = work.E, work.mu
    for k in range(n):
        total = S[0, k]
        for j in range(1, 9):
            total = total + S[j, k]
        mu[k] = total / c
        work.z[k] = work.z[k] - work.h[k] - mu[k]


@kernel
def _sum_noise(p, work, n, doubt):
    """Multiply the measurement noise in work.Rz by `doubt` and add the even parts' share."""
    S, mu = work.E, work.mu
    excess = p.sigma_beta - p.sigma_spread * p.sigma_spread
    for i in range(0, n, 3):
        mu_i = scale(excess, (mu[i], mu[i + 1], mu[i + 2]))
        for j in range(0, i + 3, 3):
            block = sum_of_outers_of_rows(S, S, i, j, 9)
            block = add_outer(block, mu_i, (mu[j], mu[j + 1], mu[j + 2]))
            if i == j:
                noise = scale33(doubt, load_block(work.Rz, i, i))
                block = (add(block[0], noise[0]), add(block[1], noise[1]), add(block[2], noise[2]))
            store_block(work.Rz, i, j, block)


_DOUBTS = (100.0, 100.0 / 9.0, 100.0 / 90.0)
"""Factors on the noise of the steps of a measurement; the sum of their inverses is one."""


@kernel
def update(flight, p, work, feature_count, mask, form=0):
    """Condition the estimate on the valid measurements of the present instant, where `mask`.

    A lane whose result is not finite keeps its state bit for bit, sets UPDATE_FAILED and counts it.
    The gate masks after the spread c of the sigma points was chosen for all measurements; c enters
    the moments in their fourth order only.

    With GRADUAL, lanes whose attitude is uncertain process images in steps: three updates by the
    same measurements with more noise, each about the estimate that the one before has left. Their
    information adds up to that of the measurements, so that a linear model would see no difference;
    the derivatives of this one are taken where they matter. (R. Zanetti, "Recursive Update
    Filtering for Nonlinear Estimation", IEEE Trans. Automatic Control 57(6), 2012, on the idea.)

    Args:
        flight: Record; reads the measurements and their validity, changes the estimate.
        p: Parameters as the filter believes them.
        work: Workspace.
        feature_count: Features in use.
        mask: Which lanes.
        form: A `FilterForm`.
    """
    loose, first = mask & (p.sigma_spread < 0.0), 2  # nobody
    if (form & _GRADUAL) != 0 and feature_count > 0:
        loose = mask & _is_loose(flight, p, feature_count)
        if any_of(loose):
            first = 0
    failures = flight.update_failures
    for part in range(first, 3):
        doubt = select(loose, _DOUBTS[part], 1.0)
        well = flight.update_failures == failures  # a step that fails is the last
        taking, again = mask & well & (loose | (part == 2)), loose & (part > 0)
        _update_by(flight, p, work, feature_count, taking, form, doubt, again)
    if (form & _GRADUAL) != 0:
        flight.nis = select(loose, np.nan, flight.nis)


@kernel
def _is_loose(flight, p, feature_count):
    """Where the camera sees a feature and the attitude deviates by more than `gradual_above`."""
    seen = flight.feature_valid[0]
    for i in range(1, feature_count):
        seen = seen + flight.feature_valid[i]
    P_ee = sum_of_squares(flight.L, E, 9)
    variance = P_ee[0][0] + P_ee[1][1] + P_ee[2][2]
    return (seen > 0.0) & (variance > p.gradual_above * p.gradual_above)


@kernel
def _update_by(flight, p, work, feature_count, mask, form, doubt, again):
    """Condition the estimate on the measurements with `doubt` times their noise, where `mask`.

    `again`: where these measurements were met before, with another doubt.
    """
    use_position = any_of(flight.position_valid > 0.0)
    use_baseline = any_of(flight.baseline_valid > 0.0)
    use_velocity = any_of(flight.velocity_valid > 0.0)
    n = _compare_centre(flight, p, work, feature_count, use_position, use_baseline, use_velocity)
    if n == 0:
        return
    measured = 3.0 * (flight.position_valid + flight.baseline_valid + flight.velocity_valid)
    for i in range(feature_count):
        measured = measured + 3.0 * flight.feature_valid[i]
    c = p.sigma_spread * math.sqrt(p.sigma_kappa + 15.0 + measured)
    if (form & _EKF) != 0:
        measure_columns(flight, p, work, n, feature_count, use_position, use_baseline, use_velocity)
    else:
        _measure_sigma_points(
            flight, p, work, feature_count, use_position, use_baseline, use_velocity, c
        )
    _innovate(work, n, c)
    if (form & _WATCH) != 0:
        left_out = judge_innovations(
            flight,
            p,
            work,
            feature_count,
            use_position,
            use_baseline,
            use_velocity,
            form,
            mask,
            again,
        )
        measured = measured - left_out
    _sum_noise(p, work, n, doubt)

    # C = A^T Rz^(-T/2), kept as rows of work.A; y = Rz^(-1/2) innovation
    A, z, N, t, L9 = work.A, work.z, work.N, work.t, work.L9
    pivot = cholesky(work.Rz, n, work.inverse_diagonal)
    solve_right(A, 9, work.Rz, n, work.inverse_diagonal, 0)
    solve_left_vector(work.Rz, z, n, work.inverse_diagonal)
    nis = z[0] * z[0]
    for k in range(1, n):
        nis = nis + z[k] * z[k]

    # N = I + C C^T = K K^T, t = K^-1 C y
    for j in range(9):
        total = A[j, 0] * z[0]
        for k in range(1, n):
            total = total + A[j, k] * z[k]
        t[j] = total
    for i in range(0, 9, 3):
        for j in range(0, i + 3, 3):
            if i == j:
                store_block(N, i, i, add_to_diagonal(sum_of_squares(A, i, n), 1.0))
            else:
                store_block(N, i, j, sum_of_outers(A, i, A, j, n))
    cholesky(N, 9, work.inverse_diagonal)
    solve_left_vector(N, t, 9, work.inverse_diagonal)
    for j in range(9):
        nis = nis - t[j] * t[j]

    # L9 K^-T: with the columns last first it is the updated factor's, last first again
    L = flight.L
    for i in range(15):
        for j in range(9):
            L9[i, 8 - j] = L[i, j]
    solve_right(L9, 15, N, 9, work.inverse_diagonal, 6)

    dx = work.h  # no longer needed
    total = 0.0 * nis
    for i in range(15):
        shift = L9[i, 0] * t[0]
        for j in range(1, 9):
            shift = shift + L9[i, j] * t[j]
        dx[i] = shift
        total = total + shift
    if (form & _TURN) != 0:
        turn_factor(L9, reset_matrix((dx[E], dx[E + 1], dx[E + 2])))
    wanted = mask & (measured > 0.0)
    ok = wanted & (pivot > 0.0) & is_finite(total)
    keep3(flight.r_hat, ok, add(load3(flight.r_hat), (dx[R], dx[R + 1], dx[R + 2])))
    keep3(flight.v_hat, ok, add(load3(flight.v_hat), (dx[V], dx[V + 1], dx[V + 2])))
    R_BI = multiply(euler_to_dcm((dx[E], dx[E + 1], dx[E + 2])), load33(flight.R_hat))
    keep33(flight.R_hat, ok, R_BI)
    keep3(flight.b_a_hat, ok, add(load3(flight.b_a_hat), (dx[BA], dx[BA + 1], dx[BA + 2])))
    keep3(flight.b_g_hat, ok, add(load3(flight.b_g_hat), (dx[BG], dx[BG + 1], dx[BG + 2])))
    for i in range(15):
        for j in range(min(i + 1, 9)):
            L[i, j] = select(ok, L9[i, 8 - j], L[i, j])
    flight.nis = select(ok, nis, flight.nis)
    flight.nis_dimension = select(ok, measured, flight.nis_dimension)
    failed = wanted & logical_not(ok)
    flight.filter_status = select(
        failed, flight.filter_status | _UPDATE_FAILED, flight.filter_status
    )
    flight.update_failures = flight.update_failures + select(failed, 1.0, 0.0)
    if (form & _WATCH) != 0 and any_of(failed):
        mark_failed(flight, feature_count, failed)
    if (form & _GATE) != 0:
        raise_doubts(flight, p, work, feature_count, mask & logical_not(failed))


@stage
def update_stage(flight, world, model, settings, work, stages, flag):
    """Update the estimate with the valid measurements; `flag`: how many features are in use."""
    scratch = lanes_of(work)
    update(lanes_of(flight), lanes_of(model), scratch, flag, scratch.mask > 0.0, settings.form)

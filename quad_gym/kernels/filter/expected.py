"""What the filter expects to be measured: center, sigma points and noise of the stacked triples.

See `update.py` for the triples, and `predict.py` for the form of the unscented transform.
"""

import math

from quad_gym.kernels.compiling import kernel
from quad_gym.kernels.filter.directions import direction_noise, direction_pair
from quad_gym.kernels.filter.error_state import E, R, V
from quad_gym.kernels.maths.linalg import (
    add,
    add_outer,
    add_to_diagonal,
    apply,
    apply_transposed,
    cross,
    dot,
    load3,
    load33,
    load_column3,
    norm,
    scale,
    select3,
    store3,
    sub,
)
from quad_gym.kernels.maths.rotation import split_rotation
from quad_gym.kernels.simd.lanes import any_of, select


@kernel
def set_triple(row, k, has, values):
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
def compare_center(flight, p, work, feature_count, use_position, use_baseline, use_velocity, slow):
    """Fill work.h (center), work.z (measured) and work.Rz's diagonal blocks; return n_z."""
    h, z, Rz = work.h, work.z, work.Rz
    R_IG, R_BI, R_CB = load33(p.R_IG), load33(flight.R_hat), load33(p.R_CB)
    r = load3(flight.r_hat)
    k = 0
    if use_position:
        has = flight.position_valid > 0.0
        antenna_I = add(r, apply_transposed(R_BI, load3(p.antenna)))
        if slow is not None:
            if slow.estimates_drift:
                antenna_I = add(antenna_I, load3(flight.slow_hat))
        set_triple(h, k, has, antenna_I)
        set_triple(z, k, has, apply(R_IG, load3(flight.gnss_position)))
        s = load3(p.gnss_sigma)
        zero = 0.0 * s[0]
        noise = ((s[0] * s[0], zero, zero), (zero, s[1] * s[1], zero), (zero, zero, s[2] * s[2]))
        _set_noise(Rz, k, has, noise)
        k += 3
    if use_baseline:
        has = flight.baseline_valid > 0.0
        u_I = apply_transposed(R_BI, scale(1.0 / p.baseline_length, load3(p.baseline)))
        set_triple(h, k, has, u_I)
        measured = apply(R_IG, load3(flight.gnss_baseline))
        set_triple(z, k, has, scale(1.0 / norm(measured), measured))
        variance = p.baseline_noise * p.baseline_noise
        _set_noise(Rz, k, has, direction_noise(u_I, variance, p.direction_floor))
        k += 3
    if use_velocity:
        has = flight.velocity_valid > 0.0
        w_B = sub(load3(flight.w_meas), load3(flight.b_g_hat))
        lever_B = cross(w_B, load3(p.antenna))
        set_triple(h, k, has, add(load3(flight.v_hat), apply_transposed(R_BI, lever_B)))
        set_triple(z, k, has, apply(R_IG, load3(flight.gnss_velocity)))
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
            set_triple(h, k, has, scale(work.inverse_distance[i], to_feature))
            pixel = p.pixel_size
            ray_C = (
                pixel * flight.pixels[i, 0],
                pixel * flight.pixels[i, 1],
                pixel * p.focal_length,
            )
            length = norm(ray_C)
            u_B = apply_transposed(R_CB, scale(1.0 / length, ray_C))
            set_triple(z, k, has, u_B)
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
def measure_sigma_points(
    flight, p, work, feature_count, use_position, use_baseline, use_velocity, c, last
):
    """Fill work.A and work.E with the measured pairs.

    Column j of L is row `last - j` of work.A, where `last` is the last column that matters, and row
    8 - j of work.E.
    """
    L = flight.L
    R_BI = load33(flight.R_hat)
    camera = load3(p.camera)
    antenna, unit_baseline = load3(p.antenna), scale(1.0 / p.baseline_length, load3(p.baseline))
    inverse_c = 1.0 / c
    for j in range(9):
        A, S = work.A[last - j], work.E[8 - j]
        dr = load_column3(L, R, j)
        even, odd, _ = split_rotation(scale(c, load_column3(L, E, j)))
        k = 0
        if use_position:
            has = flight.position_valid > 0.0
            lever_odd = scale(inverse_c, apply_transposed(odd, antenna))
            lever_even = scale(inverse_c, apply_transposed(even, antenna))
            set_triple(A, k, has, add(dr, apply_transposed(R_BI, lever_odd)))
            set_triple(S, k, has, apply_transposed(R_BI, lever_even))
            k += 3
        if use_baseline:
            has = flight.baseline_valid > 0.0
            baseline_odd = scale(inverse_c, apply_transposed(odd, unit_baseline))
            baseline_even = scale(inverse_c, apply_transposed(even, unit_baseline))
            set_triple(A, k, has, apply_transposed(R_BI, baseline_odd))
            set_triple(S, k, has, apply_transposed(R_BI, baseline_even))
            k += 3
        if use_velocity:  # that the lever arm's share turns with e is neglected
            has = flight.velocity_valid > 0.0
            dv = load_column3(L, V, j)
            set_triple(A, k, has, dv)
            set_triple(S, k, has, scale(0.0, dv))
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
                set_triple(A, k, has, scale(inverse_c, a))
                set_triple(S, k, has, scale(inverse_c, s))
                k += 3

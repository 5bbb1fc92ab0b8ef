"""Features of a camera: the directions of known points.

Each measures `z = unit(R (X - r) - l_c)` in B with the noise of its pixel, for a direction in the
camera frame differs from one in B by a fixed rotation only. With a pair of sigma points, R(+-e)
R_hat = (I + even +- odd) R_hat, the vector before it is made a unit one is odd and even by

    odd:   odd X_B -+ (I + even) dr_B,   even:   even X_B - odd dr_B,

X_B = R_hat (X - r_hat), dr_B = R_hat dr; the derivative along an offset of a feature seen at
distance s along u is (I - u u^T) (X_B x de - dr_B) / s.

Each feature is a block of its own; an image is one group of the gate.
"""

import math

from quad_gym.kernels.compiling import kernel
from quad_gym.kernels.filter.directions import direction_noise, direction_pair
from quad_gym.kernels.filter.error_state import E, R
from quad_gym.kernels.filter.recovery import (
    FITTING_FEATURES,
    LARGEST,
    MOST_ANGLE,
    doubt_rate,
    follow_drift,
    raise_diagonal,
    suspect_group,
    time_of,
)
from quad_gym.kernels.maths.elementary import clip, maximum, minimum
from quad_gym.kernels.maths.linalg import (
    add_outer,
    add_scaled,
    apply,
    apply_transposed,
    cross,
    dot,
    load3,
    load4,
    load33,
    load_column3,
    norm,
    scale,
    select3,
    store3,
    sub,
)
from quad_gym.kernels.maths.random import normal_pair, stream_of
from quad_gym.kernels.maths.rotation import quaternion_to_dcm, turn_pair
from quad_gym.kernels.measurements.gate import (
    accept_group,
    count_in_row,
    judge_direction,
    mark_block,
    mask_block,
)
from quad_gym.kernels.measurements.rows import (
    clear_slow_columns,
    columns_of,
    put_noise,
    put_three,
)
from quad_gym.kernels.simd.lanes import any_of, logical_not, select
from quad_gym.records import DELAY_SLOTS, DRAW_FEATURE, FEATURE_BLOCKS, FilterForm, Sensor

SENSOR = Sensor.CAMERA
_CAMERA, _EKF, _GATE = int(SENSOR), int(FilterForm.EKF), int(FilterForm.GATE)

_PIXEL = 2e-6  # [m]; it cancels, and no parameter has it: the report writes rays in meters

# ---- simulation ------------------------------------------------------------------------------


@kernel
def project(X_I, r_I, R_BI, p):
    """Pixel of a point, and whether it is in front of the camera and inside the image."""
    v_C = apply(load33(p.R_CB), sub(apply(R_BI, sub(X_I, r_I)), load3(p.camera)))
    in_front = v_C[2] > 1e-9
    per_depth = p.focal_length / select(in_front, v_C[2], 1.0)
    x, y = per_depth * v_C[0], per_depth * v_C[1]
    seen = in_front & (abs(x) <= p.half_image[0]) & (abs(y) <= p.half_image[1])
    return x, y, seen


@kernel
def measure(flight, p, feature_count, mask):
    """Project the features and mark those that the camera sees, where `mask`."""
    stream = stream_of(flight)
    R_BI, r_I = quaternion_to_dcm(load4(flight.q)), load3(flight.r)
    for i in range(feature_count):
        x, y, seen = project(load3(p.features[i]), r_I, R_BI, p)
        n_x, n_y = normal_pair(stream, DRAW_FEATURE + i)
        seen = seen & mask
        flight.pixels[i, 0] = select(seen, x + p.pixel_sigma * n_x, flight.pixels[i, 0])
        flight.pixels[i, 1] = select(seen, y + p.pixel_sigma * n_y, flight.pixels[i, 1])
        flight.feature_valid[i] = select(mask, select(seen, 1.0, 0.0), flight.feature_valid[i])


# ---- update ----------------------------------------------------------------------------------


@kernel
def count(flight, p, work, settings, slow, k):
    """Count what is measured; return the row behind it."""
    for i in range(settings.feature_count):
        if any_of(flight.feature_valid[i] > 0.0):
            work.measured = work.measured + 3.0 * flight.feature_valid[i]
            k += 3
    return k


@kernel
def _center(flight, p, work, settings, k):
    """Fill the rows of what is expected, of what was measured, and of the noise."""
    R_BI, R_CB, r = load33(flight.R_hat), load33(p.R_CB), load3(flight.r_hat)
    w_B = sub(load3(flight.w_meas), load3(flight.b_g_hat))
    pixel_sigma = math.sqrt(p.pixel_sigma * p.pixel_sigma + p.blur * p.blur * dot(w_B, w_B))
    for i in range(settings.feature_count):
        has = flight.feature_valid[i] > 0.0
        if any_of(has):
            X_B = apply(R_BI, sub(load3(p.features[i]), r))
            to_feature = sub(X_B, load3(p.camera))
            store3(work.X_B[i], X_B)
            work.inverse_distance[i] = 1.0 / norm(to_feature)
            put_three(work.h, k, has, scale(work.inverse_distance[i], to_feature))
            ray_C = (
                _PIXEL * flight.pixels[i, 0],
                _PIXEL * flight.pixels[i, 1],
                _PIXEL * p.focal_length,
            )
            length = norm(ray_C)
            u_B = apply_transposed(R_CB, scale(1.0 / length, ray_C))
            put_three(work.z, k, has, u_B)
            sigma = pixel_sigma * _PIXEL / length
            predicted = scale(work.inverse_distance[i], to_feature)
            u_B = select3(p.noise_at_prediction > 0.0, predicted, u_B)
            noise = direction_noise(u_B, sigma * sigma, p.direction_floor)
            # a pixel does not move along the optical axis c: less c c^T, across u
            across = add_scaled(R_CB[2], -dot(R_CB[2], u_B), u_B)
            less = scale(-p.noise_pinhole * sigma * sigma, across)
            put_noise(work, k, has, add_outer(noise, less, across))
            k += 3


@kernel
def _column(flight, p, work, settings, k, j, A, S, R_BI):
    """Fill the rows of all features in column j, with a derivative or a pair of sigma points."""
    L, c, camera = flight.L, work.spread, load3(p.camera)
    inverse_c, d, dr = work.inverse_spread, load_column3(L, E, j), load_column3(L, R, j)
    by_derivative = (settings.form & _EKF) != 0
    dr_B = apply(R_BI, dr) if by_derivative else apply(R_BI, scale(c, dr))
    odd, even = load33(work.odd[j]), load33(work.even[j])
    for i in range(settings.feature_count):
        has = flight.feature_valid[i] > 0.0
        if any_of(has):
            X_B = load3(work.X_B[i])
            if by_derivative:
                u_B = load3(work.h[k : k + 3])
                v = scale(work.inverse_distance[i], sub(cross(X_B, d), dr_B))
                put_three(A, k, has, add_scaled(v, -dot(u_B, v), u_B))
                put_three(S, k, has, scale(0.0, dr))
            else:
                # (I + even +- odd) (X_B -+ dr_B) - l_c
                v_odd, v_even = turn_pair(even, odd, X_B, dr_B)
                v = sub(X_B, camera)
                a, s = direction_pair(v, work.inverse_distance[i], v_even, v_odd)
                put_three(A, k, has, scale(inverse_c, a))
                put_three(S, k, has, scale(inverse_c, s))
            k += 3
    return k


@kernel
def expect(flight, p, work, settings, slow, k):
    """Fill the rows from k on, three for each feature that any lane sees; return the row behind."""
    if settings.feature_count == 0:
        return k
    R_BI, last, end = load33(flight.R_hat), columns_of(slow) - 1, k
    _center(flight, p, work, settings, k)
    for j in range(9):
        end = _column(flight, p, work, settings, k, j, work.A[last - j], work.E[8 - j], R_BI)
    for first in range(k, end, 3):
        clear_slow_columns(work, first, slow)
    return end


@kernel
def judge(flight, p, work, settings, slow, k):
    """Keep the innovations in the rows from k on, and mask those beyond the gate.

    A feature whose predicted direction is too uncertain for a linear model is left out, too: as a
    direction's error is bounded it would pass any gate, and its update would be wrong and sure of
    itself.
    """
    if settings.feature_count == 0:
        return k
    gating, columns, again = (settings.form & _GATE) != 0, columns_of(slow), work.again > 0.0
    zero = 0.0 * p.sigma_beta
    seen, refused, fresh, side, up = zero, zero, zero, zero, zero
    for i in range(settings.feature_count):
        if any_of(flight.feature_valid[i] > 0.0):
            has = (work.taking > 0.0) & (flight.feature_valid[i] > 0.0)
            block = FEATURE_BLOCKS + i
            rejected, unsure, scaled, nis = judge_direction(
                flight, p, work, settings, k, block, has, columns, p.gate_uncertainty
            )
            work.judged_nis = work.judged_nis + nis
            counts = select(has & logical_not(unsure), 1.0, 0.0)
            work.judged_freedoms = work.judged_freedoms + 2.0 * counts
            counts = select(again, 0.0, counts)
            fresh = fresh + counts
            side = side + counts * clip(scaled[0], -LARGEST, LARGEST)
            up = up + counts * clip(scaled[1], -LARGEST, LARGEST)
            if gating:
                out = rejected | unsure
                mask_block(work, k, out, columns)
                work.left_out = work.left_out + select(out, 3.0, 0.0)
                seen = seen + select(has & logical_not(unsure), 1.0, 0.0)
                refused = refused + select(rejected, 1.0, 0.0)
            k += 3
    root = math.sqrt(maximum(fresh, 1.0))
    follow_drift(flight, FEATURE_BLOCKS, fresh > 0.0, side / root, up / root, zero)
    if gating:
        count_in_row(flight, FEATURE_BLOCKS, seen > 0.0, refused >= seen, again)
        fits = (seen - refused >= FITTING_FEATURES) & (2.0 * refused < seen) & logical_not(again)
        flight.fit_tick = select(fits, flight.tick, flight.fit_tick)
    else:
        accept_group(flight, FEATURE_BLOCKS, fresh > 0.0)
    return k


@kernel
def mark_failed(flight, p, work, settings, slow, k):
    """Say that the update failed that they were part of, where `work.taking`."""
    failed = work.taking > 0.0
    for i in range(settings.feature_count):
        mark_block(flight, FEATURE_BLOCKS + i, failed & (flight.feature_valid[i] > 0.0))
    return k


# ---- doubts ----------------------------------------------------------------------------------


@kernel
def suspect(flight, p, work, settings, slow, k):
    """Note whether images make the filter doubt itself."""
    suspect_group(flight, p, work, FEATURE_BLOCKS, work.taking > 0.0)
    return k


@kernel
def doubt(flight, p, work, settings, slow, k):
    """Raise the variances of what may be wrong, where whole images are doubted.

    That is the attitude by the largest innovation, or the position by what that is at the feature's
    distance; the gyro may have led there.
    """
    angle, offset, P = 0.0 * flight.tick, 0.0 * flight.tick, work.P
    doubted, nu = work.doubted[FEATURE_BLOCKS], flight.innovation
    for i in range(settings.feature_count):
        s = FEATURE_BLOCKS + i
        seen = (doubted > 0.0) & (flight.feature_valid[i] > 0.0)
        square = select(seen, nu[s, 0] * nu[s, 0] + nu[s, 1] * nu[s, 1], 0.0)
        distance = norm(sub(load3(p.features[i]), load3(flight.r_hat)))
        angle = maximum(angle, square)
        offset = maximum(offset, square * distance * distance)
    raise_diagonal(P, E, minimum(angle, MOST_ANGLE * MOST_ANGLE))
    raise_diagonal(P, R, offset)
    doubt_rate(P, math.sqrt(angle) / time_of(flight, p, FEATURE_BLOCKS), doubted)
    return k


# ---- late measurements -----------------------------------------------------------------------


@kernel
def set_aside(flight, p, work, settings, slow, k):
    """Keep what has arrived so far, before something new is measured."""
    for i in range(settings.feature_count):
        work.kept_pixels[i, 0], work.kept_pixels[i, 1] = flight.pixels[i, 0], flight.pixels[i, 1]
    return k


@kernel
def _move_on(pixels, seen, slot, mask, new_pixels, new_seen, features):
    for i in range(features):
        for axis in range(2):
            pixels[slot, i, axis] = select(mask, new_pixels[i, axis], pixels[slot, i, axis])
        seen[slot, i] = select(mask, new_seen[i], seen[slot, i])


@kernel
def exchange(flight, p, work, settings, slow, starting):
    """Let the image of now wait, and the one that waited arrive."""
    pixels, seen, features = flight.late_pixels, flight.late_seen, settings.feature_count
    arrived, mask, taken = work.kept_seen, work.mask > 0.0, work.taken > 0.0
    for i in range(features):
        arrived[i] = 0.0 * flight.tick
    for slot in range(DELAY_SLOTS):
        here = work.here[slot] > 0.0
        if any_of(here):
            for i in range(features):
                arrived[i] = select(here, seen[slot, i], arrived[i])
                for axis in range(2):
                    kept = work.kept_pixels[i, axis]
                    work.kept_pixels[i, axis] = select(here, pixels[slot, i, axis], kept)
    if any_of(taken):
        for slot in range(DELAY_SLOTS - 1, 0, -1):
            _move_on(pixels, seen, slot, taken, pixels[slot - 1], seen[slot - 1], features)
        _move_on(pixels, seen, 0, taken, flight.pixels, flight.feature_valid, features)
    for i in range(features):
        flight.feature_valid[i] = select(mask, arrived[i], flight.feature_valid[i])
        fresh = mask & (arrived[i] > 0.0)
        flight.feature_fresh[i] = select(fresh, 1.0, flight.feature_fresh[i])
        for axis in range(2):
            flight.pixels[i, axis] = select(mask, work.kept_pixels[i, axis], flight.pixels[i, axis])
    return starting


@kernel
def keep_valid(flight, p, work, settings, slow, k):
    """Keep what is seen, for the turns of late measurements."""
    for i in range(settings.feature_count):
        work.kept_valid[FEATURE_BLOCKS + i] = flight.feature_valid[i]
    return k


@kernel
def choose(flight, p, work, settings, slow, k):
    """Let features be seen only where their sensor has its turn."""
    for i in range(settings.feature_count):
        flight.feature_valid[i] = work.turn[_CAMERA] * work.kept_valid[FEATURE_BLOCKS + i]
    return k

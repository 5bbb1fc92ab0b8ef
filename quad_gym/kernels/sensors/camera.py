"""Features of a camera: the directions of known points.

Each measures `z = unit(R (X - r) - l_c)` in B with the noise of its pixel, as a direction in the
camera frame differs from one in B by a fixed rotation only. With a pair of sigma points, R(+-e)
R_hat = (I + even +- odd) R_hat, the vector before normalization is odd and even by

    odd:   odd X_B -+ (I + even) dr_B,   even:   even X_B - odd dr_B,

X_B = R_hat (X - r_hat), dr_B = R_hat dr; the derivative along an offset of a feature seen at
distance s along u is (I - u u^T) (X_B x de - dr_B) / s.

Each feature is a separate block; an image is one group of the gate. A feature whose predicted
direction is too uncertain for a linear model is masked, too: the error of a direction is bounded,
so it would pass any gate, and its update would be wrong and overconfident.
"""

import math

from quad_gym.kernels.compiling import Stage, call_stage, kernel, stage
from quad_gym.kernels.filter.columns import columns_of
from quad_gym.kernels.filter.error_state import MAX_ANGLE, E, R, reset_variances
from quad_gym.kernels.filter.measurements import (
    by_derivative,
    direction_noise,
    direction_pair,
    direction_shift,
    put_block,
    put_three,
    with_pairs,
)
from quad_gym.kernels.filter.recovery import reset_drifted_velocity
from quad_gym.kernels.numbers.elementary import maximum, minimum
from quad_gym.kernels.numbers.lanes import any_of, logical_not, select, zero_like
from quad_gym.kernels.numbers.linalg import (
    cross,
    dot,
    load3,
    load4,
    load33,
    load_column3,
    norm,
    outer,
)
from quad_gym.kernels.numbers.random import normal_pair, stream_of, uniform_pair
from quad_gym.kernels.numbers.rotation import quaternion_to_dcm, turn_pair
from quad_gym.kernels.sensors.common import (
    ReadingModel,
    begin_clock,
    sample_of,
    sensor_stage,
    tick_clock,
)
from quad_gym.kernels.sensors.faults import draw_of
from quad_gym.records import (
    DRAW_BLUR,
    DRAW_FEATURE,
    DRAW_PHASE,
    FEATURE_BLOCKS,
    FaultKind,
    Sensor,
)

_CAMERA = int(Sensor["CAMERA"])
_PIXEL = 2e-6  #: [m]; it cancels, so it is no parameter: the report writes rays in meters


@kernel
def project(X_I, r_I, R_BI, p):
    """Pixel of a point, and the lanes in which it is in front of the camera and in the image."""
    v_C = load33(p.R_CB) @ (R_BI @ (X_I - r_I) - load3(p.camera))
    in_front = v_C[2] > 1e-9
    per_depth = p.focal_length / select(in_front, v_C[2], 1.0)
    x, y = per_depth * v_C[0], per_depth * v_C[1]
    seen = in_front & (abs(x) <= p.half_image[0]) & (abs(y) <= p.half_image[1])
    return x, y, seen


@kernel
def _measure(flight, p, i):
    """The projection of feature i, and the lanes in which it is visible."""
    R_BI, r_I = quaternion_to_dcm(load4(flight.q)), load3(flight.r)
    x, y, seen = project(load3(p.features[i]), r_I, R_BI, p)
    if any_of(seen):
        n_x, n_y = normal_pair(stream_of(flight), DRAW_FEATURE + i)
        x, y = x + p.pixel_sigma * n_x, y + p.pixel_sigma * n_y
    return (x, y, 0.0), seen


@kernel
def _begin(flight, p, settings, mask):
    _, share = uniform_pair(stream_of(flight), DRAW_PHASE)
    begin_clock(flight, settings, _CAMERA, share, mask)


@kernel
def _when(flight, p, settings, mask, starting):
    return tick_clock(flight, settings, _CAMERA, mask)


@kernel
def _change(flight, p, settings, work, stages, due):
    """Apply limits of range, blur, ground, obstacles, and faults to the image just taken."""
    work.mask = select(due, 1.0, 0.0)
    call_stage(stages, Stage.LIMIT_CAMERA, flight, p, p, settings, work, 0)
    call_stage(stages, Stage.HIDE_FEATURES, flight, p, p, settings, work, 0)
    call_stage(stages, Stage.CORRUPT_FEATURES, flight, p, p, settings, work, 0)


@kernel
def _expect(flight, p, work, settings, i, k, valid):
    """Fill rows k to k + 2: the direction of feature i."""
    R_BI, w_B = load33(flight.R_hat), load3(flight.w_meas) - load3(flight.b_g_hat)
    pixel_sigma = math.sqrt(p.pixel_sigma * p.pixel_sigma + p.blur * p.blur * dot(w_B, w_B))
    X_B = R_BI @ (load3(p.features[i]) - load3(flight.r_hat))
    to_feature = X_B - load3(p.camera)
    per_distance = 1.0 / norm(to_feature)
    z_hat = per_distance * to_feature
    _center(flight, p, work, settings, i, k, valid, z_hat, pixel_sigma)
    last = columns_of(settings) - 1
    for j in range(settings.motion_columns):
        a, s = _column(p, work, settings, j, R_BI, X_B, per_distance, z_hat)
        put_three(work.A[last - j], k, valid, a)
        put_three(work.E[j], k, valid, s)


@kernel
def _center(flight, p, work, settings, i, k, valid, z_hat, pixel_sigma):
    """Fill the rows of measurement, prediction and noise of feature i."""
    R_CB, pixel = load33(p.R_CB), flight.measurement[FEATURE_BLOCKS + i]
    x, y = pixel[0], pixel[1]
    ray_C = (_PIXEL * x, _PIXEL * y, _PIXEL * p.focal_length)
    length = norm(ray_C)
    z = R_CB.T @ ((1.0 / length) * ray_C)
    sigma = pixel_sigma * _PIXEL / length
    u_B = select(p.noise_at_prediction > 0.0, z_hat, z)
    noise = direction_noise(u_B, sigma * sigma, p.direction_floor)
    # a pixel does not move along the optical axis c: minus c c^T, across u
    across = R_CB[2] + -dot(R_CB[2], u_B) * u_B
    noise = noise + outer(-p.noise_pinhole * sigma * sigma * across, across)
    put_block(work, settings, k, valid, z, z_hat, noise)


@kernel
def _column(p, work, settings, j, R_BI, X_B, per_distance, u_B):
    """Half-difference and half-sum of a feature in column j, or its derivative and zero.

    Columns from the fourth on do not change the attitude.
    """
    L, c, inverse_c, camera = work.L, work.spread, work.inverse_spread, load3(p.camera)
    d, dr_B = load_column3(L, E, j), load_column3(L, R, j)
    dr_B = R_BI @ dr_B if by_derivative(settings) else R_BI @ (c * dr_B)
    odd, even = load33(work.odd[min(j, 2)]), load33(work.even[min(j, 2)])
    a, s = zero_like(X_B), zero_like(X_B)
    if with_pairs(settings):
        # (I + even +- odd) (X_B -+ dr_B) - l_c
        shift = c * dr_B if by_derivative(settings) else dr_B
        if j >= 3:
            a, s = direction_shift(X_B - camera, per_distance, -shift)
        else:
            v_odd, v_even = turn_pair(even, odd, X_B, shift)
            a, s = direction_pair(X_B - camera, per_distance, v_even, v_odd)
        a, s = inverse_c * a, inverse_c * s
    if by_derivative(settings):
        v = per_distance * (cross(X_B, d) - dr_B)
        a = v + -dot(u_B, v) * u_B
    return a, s


@kernel
def _reset(flight, p, work, settings, states, lanes, alone, nu):
    """Reset attitude and position.

    The variance of the attitude is the square of the largest innovation, the variance of the
    position that of the corresponding offset at the feature's distance.
    """
    angle, offset, P = zero_like(flight.tick), zero_like(flight.tick), work.P
    for i in range(settings.feature_count):
        innovation = flight.innovation[FEATURE_BLOCKS + i]
        seen = lanes & (flight.block_valid[FEATURE_BLOCKS + i] > 0.0)
        square = select(seen, innovation[0] * innovation[0] + innovation[1] * innovation[1], 0.0)
        distance = minimum(norm(load3(p.features[i]) - load3(flight.r_hat)), p.max_range)
        angle = maximum(angle, square)
        offset = maximum(offset, square * distance * distance)
    reset_drifted_velocity(flight, p, work, states, FEATURE_BLOCKS, lanes, offset)
    reset_variances(P, R, states, lanes, (offset, offset, offset))
    angle = minimum(angle, MAX_ANGLE * MAX_ANGLE)
    reset_variances(P, E, states, lanes, (angle, angle, angle))


camera_stage = sensor_stage(
    Sensor["CAMERA"],
    _begin,
    sample_of(Sensor["CAMERA"], _measure, _when, change=_change),
    ReadingModel(_expect, _reset),
)


# --------------------------------------------------------------------------------------------------
# Limits of images, and their faults.
# --------------------------------------------------------------------------------------------------

HIDDEN_BELOW = 1e-3
"""Depth below the ground at which a feature is hidden [m]: one on the ground is visible."""


@stage
def limit_camera_stage(flight, world, model, settings, work, stages, flag):
    """Blur the image just taken; drop features too far or behind the ground."""
    p, mask, stream, r_I = world, work.mask > 0.0, stream_of(flight), load3(flight.r)
    camera_I = r_I + quaternion_to_dcm(load4(flight.q)).T @ load3(p.camera)
    # uniform over the smear in both directions: sqrt(3) standard deviations
    reach = 1.7320508075688772 * p.blur * norm(load3(flight.w))
    for i in range(settings.feature_count):
        X_I, valid = load3(p.features[i]), flight.block_valid[FEATURE_BLOCKS + i]
        lost = norm(X_I - camera_I) > p.max_range
        if settings.ground_hides:
            below = logical_not(camera_I[2] >= p.ground_height)
            lost = lost | below | (X_I[2] < p.ground_height - HIDDEN_BELOW)
        kept = select(lost, 0.0, valid)
        flight.block_valid[FEATURE_BLOCKS + i] = select(mask, kept, valid)
        seen = mask & (kept > 0.0)
        if settings.camera_blurs and any_of(seen):
            u, v = uniform_pair(stream, DRAW_BLUR + i)
            for axis in range(2):
                shift = reach * (2.0 * (u if axis == 0 else v) - 1.0)
                pixel = flight.measurement[FEATURE_BLOCKS + i, axis]
                flight.measurement[FEATURE_BLOCKS + i, axis] = select(seen, pixel + shift, pixel)


@kernel
def _nth(count, share, total):
    """The whole number below `total` at a share of it, at most `count` - 1."""
    place, number = total * share, zero_like(share)
    for i in range(1, count):
        number = select(place >= 1.0 * i, 1.0 * i, number)
    return number


@kernel
def _mistake_features(flight, settings, mask):
    """Confuse two visible features in the image just taken, at random in the lanes `mask`.

    The two are the `first`-th and the `second`-th visible ones, counted from zero.
    """
    k, stream, count = FaultKind.WRONG_ASSOCIATIONS, stream_of(flight), settings.feature_count
    zero = zero_like(flight.tick)
    seen = zero
    for i in range(count):
        seen = seen + flight.block_valid[FEATURE_BLOCKS + i]
    chance, u = uniform_pair(stream, draw_of(k, 4))
    w, _ = uniform_pair(stream, draw_of(k, 5))
    struck = mask & (flight.fault_active[k] > 0.0) & (chance < settings.fault_share[k])
    struck = struck & (seen > 1.0)
    first, second = _nth(count, u, seen), _nth(count, w, seen - 1.0)
    second = select(second >= first, second + 1.0, second)

    rank, x_first, y_first, x_second, y_second = zero, zero, zero, zero, zero
    for i in range(count):
        valid = flight.block_valid[FEATURE_BLOCKS + i] > 0.0
        here, there = valid & (rank == first), valid & (rank == second)
        x, y = flight.measurement[FEATURE_BLOCKS + i, 0], flight.measurement[FEATURE_BLOCKS + i, 1]
        x_first, y_first = select(here, x, x_first), select(here, y, y_first)
        x_second, y_second = select(there, x, x_second), select(there, y, y_second)
        rank = rank + flight.block_valid[FEATURE_BLOCKS + i]

    swaps = settings.fault_swaps > 0
    rank = zero
    for i in range(count):
        valid = struck & (flight.block_valid[FEATURE_BLOCKS + i] > 0.0)
        here, there = valid & (rank == first) & swaps, valid & (rank == second)
        x, y = flight.measurement[FEATURE_BLOCKS + i, 0], flight.measurement[FEATURE_BLOCKS + i, 1]
        x, y = select(here, x_second, x), select(here, y_second, y)
        flight.measurement[FEATURE_BLOCKS + i, 0] = select(there, x_first, x)
        flight.measurement[FEATURE_BLOCKS + i, 1] = select(there, y_first, y)
        mistaken = select(here | there, 1.0, 0.0)
        flight.feature_mistaken[i] = select(mask, mistaken, flight.feature_mistaken[i])
        rank = rank + flight.block_valid[FEATURE_BLOCKS + i]


@stage
def corrupt_features_stage(flight, world, model, settings, work, stages, flag):
    """Hide features of the image just taken and confuse some with others.

    A feature hidden now counts as not visible in the whole step.
    """
    mask = work.mask > 0.0
    if settings.fault_on[FaultKind.CAMERA_OCCLUSION]:
        covered = mask & (flight.fault_active[FaultKind.CAMERA_OCCLUSION] > 0.0)
        for i in range(settings.feature_count):
            hidden, block = covered & (flight.feature_hidden[i] > 0.0), FEATURE_BLOCKS + i
            flight.block_valid[block] = select(hidden, 0.0, flight.block_valid[block])
            flight.block_fresh[block] = select(hidden, 0.0, flight.block_fresh[block])
    if settings.fault_on[FaultKind.WRONG_ASSOCIATIONS]:
        _mistake_features(flight, settings, mask)

"""Alignment: initialization of the filter from its first fix.

Source: report section 3.4.2; heading of the mark and level starts are ours.
"""

import math

import numpy as np

from quad_gym.kernels.compiling import Stage, call_stage, kernel, stage
from quad_gym.kernels.filter.error_state import BA, BG, E, R, V
from quad_gym.kernels.filter.gate import forget_innovations
from quad_gym.kernels.filter.recovery import begin_recovery
from quad_gym.kernels.filter.slow import begin_slow
from quad_gym.kernels.filter.wahba import wahba
from quad_gym.kernels.maths.elementary import maximum, minimum, sin_cos
from quad_gym.kernels.maths.factors import cholesky33, lower33, solve_right33
from quad_gym.kernels.maths.linalg import dot, keep, load3, load4, load33, outer, rounded, unit_or
from quad_gym.kernels.maths.matrices import load_block
from quad_gym.kernels.maths.random import normal_pair, stream_of
from quad_gym.kernels.maths.rotation import level_attitude, quaternion_to_dcm
from quad_gym.kernels.simd.blocks import reset
from quad_gym.kernels.simd.lanes import select, zero_like
from quad_gym.records import DRAW_MARK

_NOTHING = (0.0, 0.0, 0.0)
_NO_HEADING = math.pi / math.sqrt(3.0)  #: standard deviation of an unknown angle
_STEEP = 0.2  #: level share of a baseline 12 degrees from the vertical: too small for a heading


@kernel
def lever_of_attitude(R_BI, l_B):
    """J = R_hat^T [l x]: with R = R(e) R_hat, the error of r = antenna - R^T l grows by J e."""
    zero = zero_like(l_B[0])
    x, y, z = l_B
    return R_BI.T @ ((zero, -z, y), (z, zero, -x), (-y, x, zero))


@kernel
def _tie_position_to_attitude(L, R_BI, l_B, mask):
    """Add to L the dependence of the start's position on its attitude, in the lanes `mask`."""
    root_r, root_e = load_block(L, R, R), load_block(L, E, E)  # diagonal
    tied = lever_of_attitude(R_BI, l_B) @ root_e
    factor, diagonal_r, _ = cholesky33(root_r @ root_r + tied @ tied.T)
    L_er = solve_right33(root_e @ tied.T, factor)
    keep(L[R : R + 3, R : R + 3], mask, lower33(factor, diagonal_r))
    keep(L[E : E + 3, R : R + 3], mask, L_er)
    factor, diagonal_e, _ = cholesky33(root_e @ root_e - L_er @ L_er.T)
    keep(L[E : E + 3, E : E + 3], mask, lower33(factor, diagonal_e))


@kernel
def initialize(flight, p, mask, x_I, v_I=_NOTHING, v_variance=_NOTHING, tilt_variance=_NOTHING):
    """Start the filter from the first fix, in the lanes `mask`.

    Attitude by Wahba's problem from the measured baseline and the body z axis taken as vertical,
    with equal weights, or level with the baseline's heading (a single antenna counts as a vertical
    baseline); position from the antenna; velocity and biases zero. For a level start, the
    covariance includes the dependence of the position on the attitude. The steeper the baseline,
    the less certain the heading. Where the baseline is too steep for a heading, the body x axis is
    added to Wahba's problem, or gives the heading alone; where it is unknown, too, so is the
    heading.

    Args:
        flight, p, mask: Record, parameters assumed by the filter, lanes to work on.
        x_I: Level direction in I of the body x axis, if the place of the start determines it; else
            zero.
        v_I: Known velocity of the start, in I [m/s].
        v_variance: Variance per axis, added to the variance of a start at rest [m^2/s^2].
        tilt_variance: Variances added for roll and pitch [rad^2]; the third element is not used.
    """
    inflation = math.sqrt(p.initial_covariance_scale)
    attitude = inflation * p.first_baseline_sigma
    baseline_B = (1.0 / p.baseline_length) * load3(p.baseline)
    level_share = math.sqrt(baseline_B[0] * baseline_B[0] + baseline_B[1] * baseline_B[1])
    heading = minimum(attitude / maximum(level_share, 1e-9), _NO_HEADING)
    placed = (level_share < _STEEP) & (dot(x_I, x_I) > 0.0)
    heading = select(placed, inflation * p.heading_sigma, heading)

    R_IG = load33(p.R_IG)
    baseline_I = unit_or(R_IG @ load3(flight.gnss_baseline), (0.0, 0.0, 1.0))
    nothing = zero_like(x_I)
    x_B = (nothing[0] + 1.0, nothing[1], nothing[2])
    ahead = outer(x_B, select(placed, x_I, nothing))
    profile = outer(baseline_B, baseline_I) + rounded(ahead)
    profile = (profile[0], profile[1], (profile[2][0], profile[2][1], profile[2][2] + 1.0))
    R_BI, _ = wahba(profile)
    level = p.initial_tilt_sigma > 0.0
    ahead_B, ahead_I = select(placed, x_B, baseline_B), select(placed, x_I, baseline_I)
    R_BI = select(level, level_attitude(ahead_B, ahead_I), R_BI)
    antenna_I = R_IG @ load3(flight.gnss_position)
    keep(flight.R_hat, mask, R_BI)
    keep(flight.r_hat, mask, antenna_I - R_BI.T @ load3(p.antenna))
    keep(flight.v_hat, mask, v_I)
    flight.filter_status = select(mask, np.uint64(0), flight.filter_status)
    reset(flight, mask, 0.0, "b_a_hat b_g_hat prediction_failures update_failures")
    reset(flight, mask, 0.0, "nis nis_dimension v_corrected arc")
    begin_recovery(flight, mask)

    L = flight.L
    for i in range(15):
        for j in range(i + 1):
            L[i, j] = select(mask, 0.0, L[i, j])
    for i in range(3):
        L[R + i, R + i] = select(mask, inflation * p.position_sigma_I[i], L[R + i, R + i])
        speed = math.sqrt(p.initial_velocity_variance + v_variance[i])
        L[V + i, V + i] = select(mask, speed, L[V + i, V + i])
        tilt = select(level, p.initial_tilt_sigma, attitude)
        angle = heading if i == 2 else math.sqrt(tilt * tilt + tilt_variance[i])
        L[E + i, E + i] = select(mask, angle, L[E + i, E + i])
        L[BA + i, BA + i] = select(mask, p.accel_bias_sigma, L[BA + i, BA + i])
        L[BG + i, BG + i] = select(mask, p.gyro_bias_sigma, L[BG + i, BG + i])
    _tie_position_to_attitude(L, R_BI, load3(p.antenna), mask & level)


@kernel
def known_velocity(flight, settings):
    """Velocity of the start in I that the filter receives, and the variance of its random part.

    A velocity given by the caller of a reset is known; its variance is zero.
    """
    known, zero = load3(flight.start_given[3:]), zero_like(flight.tick)
    drawn = load3(settings.start_velocity_variance)
    return (
        (_or(known[0], zero), _or(known[1], zero), _or(known[2], zero)),
        (
            select(known[0] == known[0], zero, drawn[0]),
            select(known[1] == known[1], zero, drawn[1]),
            select(known[2] == known[2], zero, drawn[2]),
        ),
    )


@kernel
def _or(given, other):
    """A number, or another where it is NaN."""
    return select(given == given, given, other)


@kernel
def look_along_mark(flight, p):
    """Level direction in I of the body x axis, as accurate as the place of the start gives it."""
    R_BI = quaternion_to_dcm(load4(flight.q))
    zero = zero_like(p.dt)
    x_I = unit_or((R_BI[0][0], R_BI[0][1], zero), (zero + 1.0, zero, zero))
    n, _ = normal_pair(stream_of(flight), DRAW_MARK)
    s, c = sin_cos(p.heading_sigma * n)
    return (c * x_I[0] - s * x_I[1], s * x_I[0] + c * x_I[1], zero)


@stage
def align_stage(flight, world, model, settings, work, stages, flag):
    """Start the filter from its first fix."""
    mask = work.mask > 0.0
    if settings.slow_states > 0:
        begin_slow(flight, model, settings, mask)
    call_stage(stages, Stage.FORGET_INNOVATIONS, flight, world, model, settings, work, 0)
    v_I, v_variance = known_velocity(flight, settings)
    tilt_variance = load3(settings.start_tilt_variance)
    x_I = look_along_mark(flight, world)
    initialize(flight, model, mask, x_I, v_I, v_variance, tilt_variance)


@stage
def forget_innovations_stage(flight, world, model, settings, work, stages, flag):
    """Forget the innovations of the previous episode."""
    forget_innovations(flight, work.mask > 0.0)

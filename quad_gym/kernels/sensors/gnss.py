"""The GNSS receiver: position, baseline and velocity, with one clock and latency."""

import math

from quad_gym.kernels.compiling import Stage, call_stage, kernel, stage
from quad_gym.kernels.filter.columns import columns_of
from quad_gym.kernels.filter.error_state import D, R, V, reset_heading, reset_variances
from quad_gym.kernels.filter.measurements import (
    direction_noise,
    lever_column,
    put_block,
    put_column,
)
from quad_gym.kernels.filter.recovery import reset_drifted_heading, reset_drifted_velocity
from quad_gym.kernels.filter.slow import stationary
from quad_gym.kernels.numbers.elementary import approached, exp, minimum, sin_cos
from quad_gym.kernels.numbers.lanes import any_of, logical_not, select, zero_like
from quad_gym.kernels.numbers.linalg import (
    cross,
    diagonal,
    dot,
    keep,
    load3,
    load4,
    load33,
    load_column3,
    norm,
    outer,
    rounded,
    unit_or,
    vector,
)
from quad_gym.kernels.numbers.random import normal_pair, six_normals, stream_of, uniform_pair
from quad_gym.kernels.numbers.rotation import quaternion_to_dcm
from quad_gym.kernels.sensors.common import (
    ReadingModel,
    begin_clock,
    begin_sample,
    deliver_arrived,
    exchange,
    find_arrivals,
    sensor_stage,
    stamp,
    tick_clock,
)
from quad_gym.kernels.sensors.faults import any_direction, draw_of
from quad_gym.records import (
    BASELINE_BLOCK,
    DRAW_DRIFT,
    DRAW_GNSS,
    DRAW_HEADING,
    DRAW_PHASE,
    DRAW_VELOCITY,
    FIRST_GROUP,
    POSITION_BLOCK,
    VELOCITY_BLOCK,
    FaultKind,
    Sensor,
)

# --------------------------------------------------------------------------------------------------
# GNSS position: of the primary antenna.
#
# It measures `z = r + R^T l_p + d + v` in I, with white noise v and, where positions drift, a slow
# error d, which may be a state of the filter (`filter/slow.py`). With a pair of sigma points,
# R(+-e) R_hat = (I + even +- odd) R_hat, that is
#
#     odd:   dr + R_hat^T odd^T l_p + dd,   even:   R_hat^T even^T l_p,
#
# and the derivative along an offset is dr + R_hat^T (de x l_p) + dd.
# --------------------------------------------------------------------------------------------------


@kernel
def measure_position(flight, p, R_BI, normals, mask):
    """Measure the antenna's position in G, in the lanes `mask`."""
    s = load3(p.position_sigma_I)
    antenna_I = load3(flight.r) + R_BI.T @ load3(p.antenna)
    noise_I = vector(s[0] * normals[0], s[1] * normals[1], s[2] * normals[2])
    noise_I = noise_I + load3(flight.drift)
    keep(flight.measurement[POSITION_BLOCK], mask, load33(p.R_IG).T @ (antenna_I + noise_I))


@kernel
def _drift(flight, p, mask, share):
    """Advance the slow error of GNSS positions to the next measurement, in the lanes `mask`.

    The first measurement comes a `share` of the period after the start.
    """
    n, _ = six_normals(stream_of(flight), DRAW_DRIFT)
    d, s, x = load3(flight.drift), load3(p.drift_drive), p.drift_step
    decay = exp(-share * x)
    root = math.sqrt(approached(2.0 * share * x) / approached(2.0 * x))
    drive = vector(root * s[0] * n[0], root * s[1] * n[1], root * s[2] * n[2])
    keep(flight.drift, mask, decay * d + rounded(drive))


@kernel
def expect_position(flight, p, work, settings, i, k, valid):
    """Fill rows k to k + 2."""
    R_BI, l_B, s = load33(flight.R_hat), load3(p.antenna), load3(p.position_sigma_I)
    antenna_I = load3(flight.r_hat) + R_BI.T @ l_B
    if settings.estimates_drift:
        antenna_I = antenna_I + load3(flight.slow_hat)
    z = load33(p.R_IG) @ load3(flight.measurement[POSITION_BLOCK])
    noise = diagonal((s[0] * s[0], s[1] * s[1], s[2] * s[2]))
    put_block(work, settings, k, valid, z, antenna_I, noise)
    for j in range(settings.motion_columns):
        a, s = lever_column(work, settings, j, R_BI, l_B)
        put_column(work, settings, k, j, valid, load_column3(work.L, R, j) + a, s)
    if settings.estimates_drift:
        last, first = columns_of(settings) - 1, settings.motion_columns
        for j in range(last + 1):
            row = work.A[last - j]
            for i in range(3):
                row[k + i] = row[k + i] + select(valid, work.L[first + i, j], 0.0)


@kernel
def reset_position(flight, p, work, settings, states, lanes, alone, nu):
    """Reset the position, and its slow error to the stationary one.

    Where the estimate has drifted off, the velocity is reset, too.
    """
    square = dot(nu, nu)
    reset_drifted_velocity(flight, p, work, states, POSITION_BLOCK, lanes, square)
    zero = zero_like(square)
    drift = (zero, zero, zero)
    if settings.estimates_drift:
        drift = (stationary(p, 0), stationary(p, 1), stationary(p, 2))
        reset_variances(work.P, D, states, lanes, drift)
    squares = (square + drift[0], square + drift[1], square + drift[2])
    reset_variances(work.P, R, states, lanes, squares)


# --------------------------------------------------------------------------------------------------
# GNSS baseline: the direction from the primary to the secondary antenna.
#
# It measures `z = unit(R^T l_b)` in I with noise across that direction. With a pair of sigma
# points, R(+-e) R_hat = (I + even +- odd) R_hat, that is R_hat^T odd^T u and R_hat^T even^T u, u =
# unit(l_b); the derivative along an offset is R_hat^T (de x u).
#
# Noise n across a unit vector shortens its part along the direction by n^2 / 2, whose mean square
# is 2 sigma^4 for two axes of standard deviation sigma. It is added along the direction if sigma
# exceeds `_COARSE`: the sigma points of an uncertain attitude are shortened, too, so that the
# filter would attribute an innovation along the direction to the attitude.
#
# A heading alone is a level baseline of which only the horizontal component across it was measured.
# A sigma above pi says so: it adds this noise along the other two axes.
# --------------------------------------------------------------------------------------------------

_COARSE = 0.05
"""Noise up to which this term is left out [rad], as in the laboratory: it makes no difference."""


@kernel
def noisy_baseline(r_b, normals, sigma_b, floor, length):
    """Measured baseline of known length, covariance |r_b|^2 sigma_b^2 (I - u u^T) + floor I.

    The symmetric root of that covariance is a (I - u u^T) + b u u^T (report equation 1, section
    3.1).
    """
    size = norm(r_b)
    u = (1.0 / size) * r_b
    b = math.sqrt(floor)
    a = math.sqrt((size * sigma_b) * (size * sigma_b) + floor)
    noisy = a * normals + r_b + rounded((b - a) * dot(u, normals) * u)
    return (length / norm(noisy)) * noisy


@kernel
def measure_baseline(flight, p, R_BI, normals, mask):
    """Measure the baseline in G, in the lanes `mask`."""
    r_b = load33(p.R_IG).T @ (R_BI.T @ load3(p.baseline))
    sigma, floor, length = p.baseline_sigma, p.direction_floor, p.baseline_length
    found = noisy_baseline(r_b, normals, sigma, floor, length)
    keep(flight.measurement[BASELINE_BLOCK], mask, found)


@kernel
def expect_baseline(flight, p, work, settings, i, k, valid):
    """Fill rows k to k + 2."""
    R_BI, u_B = load33(flight.R_hat), (1.0 / p.baseline_length) * load3(p.baseline)
    u_I, z = R_BI.T @ u_B, load33(p.R_IG) @ load3(flight.measurement[BASELINE_BLOCK])
    noise = direction_noise(u_I, p.baseline_noise * p.baseline_noise, p.direction_floor)
    white = p.baseline_sigma * p.baseline_sigma
    along = select(p.baseline_sigma > _COARSE, 2.0 * white * white, 0.0)
    noise = noise + outer(along * u_I, u_I)
    alone = p.baseline_sigma > math.pi
    if any_of(alone):
        side = unit_or((-u_I[1], u_I[0], zero_like(u_I[0])), (1.0, 0.0, 0.0))
        up = cross(u_I, side)
        noise = noise + outer(select(alone, along, 0.0) * up, up)
    put_block(work, settings, k, valid, (1.0 / norm(z)) * z, u_I, noise)
    for j in range(settings.motion_columns):
        a, s = lever_column(work, settings, j, R_BI, u_B)
        put_column(work, settings, k, j, valid, a, s)


@kernel
def reset_baseline(flight, p, work, settings, states, lanes, alone, nu):
    """Reset the heading to the sideward innovation."""
    square = nu[0] * nu[0] + nu[1] * nu[1]
    reset_heading(work.P, load33(flight.R_hat), states, lanes, square)
    reset_drifted_heading(flight, p, work, BASELINE_BLOCK, lanes & (work.drifted > 0.0), square)


# --------------------------------------------------------------------------------------------------
# GNSS velocity: of the primary antenna.
#
# It measures `z = v + R^T (w x l_p) + v_noise` in I, with body rates w from the gyro. The lever
# arm's share depends on the attitude. Filters with slow errors take this into account
# (`filter/slow.py`): where a magnetometer gives the heading, it is off by a few degrees, and the
# share at 6 rad/s by 0.02 m/s. Where two antennas give the heading to half a degree, this is
# neglected, so that the model is linear: dz = dv.
# --------------------------------------------------------------------------------------------------


@kernel
def measure_velocity(flight, p, mask):
    """Measure the antenna's velocity in G, in the lanes `mask`."""
    R_BI, R_IG = quaternion_to_dcm(load4(flight.q)), load33(p.R_IG)
    n, _ = six_normals(stream_of(flight), DRAW_VELOCITY)
    v_I = load3(flight.v) + R_BI.T @ cross(load3(flight.w), load3(p.antenna))
    keep(flight.measurement[VELOCITY_BLOCK], mask, R_IG.T @ (p.velocity_sigma * n + v_I))


@kernel
def expect_velocity(flight, p, work, settings, i, k, valid):
    """Fill rows k to k + 2."""
    R_BI, variance = load33(flight.R_hat), p.velocity_sigma * p.velocity_sigma
    lever_B = cross(load3(flight.w_meas) - load3(flight.b_g_hat), load3(p.antenna))
    z = load33(p.R_IG) @ load3(flight.measurement[VELOCITY_BLOCK])
    z_hat = load3(flight.v_hat) + R_BI.T @ lever_B
    put_block(work, settings, k, valid, z, z_hat, diagonal((variance, variance, variance)))
    for j in range(settings.motion_columns):
        dv = load_column3(work.L, V, j)
        s = zero_like(dv)
        if settings.slow_states > 0:
            a, s = lever_column(work, settings, j, R_BI, lever_B)
            dv = dv + a
        put_column(work, settings, k, j, valid, dv, s)


@kernel
def reset_velocity(flight, p, work, settings, states, lanes, alone, nu):
    """Reset the velocity."""
    squares = (nu[0] * nu[0], nu[1] * nu[1], nu[2] * nu[2])
    reset_variances(work.P, V, states, lanes, squares)


# --------------------------------------------------------------------------------------------------
# Errors besides noise: constant errors of the heading that baselines show, and faults.
# --------------------------------------------------------------------------------------------------


@kernel
def _draw_heading_error(flight, p, mask):
    """Draw the constant error of an episode's baselines, where `mask`."""
    n, _ = normal_pair(stream_of(flight), DRAW_HEADING)
    flight.heading_error = select(mask, p.heading_error_sigma * n, flight.heading_error)


@stage
def turn_baseline_stage(flight, world, model, settings, work, stages, flag):
    """Turn the baseline just measured about the body z axis by its constant error."""
    z_G = load33(world.R_IG).T @ quaternion_to_dcm(load4(flight.q))[2]
    s, c = sin_cos(flight.heading_error)
    b = load3(flight.measurement[BASELINE_BLOCK])
    turned = c * b + rounded(s * cross(z_G, b))
    turned = (1.0 - c) * dot(z_G, b) * z_G + turned
    keep(flight.measurement[BASELINE_BLOCK], work.mask > 0.0, turned)


@kernel
def _heard(flight, settings, due):
    """Lanes in which GNSS has a position, and lanes in which it has a baseline, among those due."""
    heard = due
    if settings.fault_on[FaultKind.GNSS_OUTAGE]:
        heard = heard & (flight.fault_active[FaultKind.GNSS_OUTAGE] <= 0.0)
    paired = heard
    if settings.fault_on[FaultKind.BASELINE_LOSS]:
        paired = paired & (flight.fault_active[FaultKind.BASELINE_LOSS] <= 0.0)
    return heard, paired


@kernel
def _draw_outlier(flight, p, settings, mask):
    """Offset of an outlier in I; zero where this fix is not an outlier.

    Its size is measured in standard deviations of a fix. These include the slow error, which has
    the variance drive^2 / (1 - decay^2).
    """
    k, stream = FaultKind.GNSS_OUTLIERS, stream_of(flight)
    chance, u = uniform_pair(stream, draw_of(k, 4))
    struck = mask & (flight.fault_active[k] > 0.0) & (chance < settings.fault_share[k])
    size = settings.fault_size[k, 0] + settings.fault_size[k, 1] * u
    size, direction = select(struck, size, 0.0), any_direction(stream, draw_of(k, 5))
    white, drive = load3(p.position_sigma_I), load3(p.drift_drive)
    gained = approached(2.0 * p.drift_step)
    flight.outlier = select(mask, select(struck, 1.0, 0.0), flight.outlier)
    return (
        size * math.sqrt(white[0] * white[0] + drive[0] * drive[0] / gained) * direction[0],
        size * math.sqrt(white[1] * white[1] + drive[1] * drive[1] / gained) * direction[1],
        size * math.sqrt(white[2] * white[2] + drive[2] * drive[2] / gained) * direction[2],
    )


@stage
def corrupt_gnss_stage(flight, world, model, settings, work, stages, flag):
    """Add ramp, jump and outliers to the GNSS position that has just been measured."""
    active, mask = flight.fault_active, work.mask > 0.0
    zero = zero_like(flight.tick)
    offset_I = (zero, zero, zero)
    if settings.fault_on[FaultKind.GNSS_RAMP]:
        seconds = (flight.tick - flight.fault_from[FaultKind.GNSS_RAMP]) * world.dt
        seconds = select(active[FaultKind.GNSS_RAMP] > 0.0, seconds, 0.0)
        offset_I = seconds * load3(flight.fault_vector[FaultKind.GNSS_RAMP]) + offset_I
    if settings.fault_on[FaultKind.GNSS_JUMP]:
        jump_I = load3(flight.fault_vector[FaultKind.GNSS_JUMP])
        offset_I = active[FaultKind.GNSS_JUMP] * jump_I + offset_I
    if settings.fault_on[FaultKind.GNSS_OUTLIERS]:
        offset_I = offset_I + _draw_outlier(flight, world, settings, mask)
    offset_G = load33(world.R_IG).T @ offset_I
    position = flight.measurement[POSITION_BLOCK]
    keep(position, mask, load3(position) + offset_G)


# --------------------------------------------------------------------------------------------------
# The GNSS receiver: one clock and latency for position, baseline and velocity.
# --------------------------------------------------------------------------------------------------

_GNSS = int(Sensor["GNSS"])
_BLOCKS = (POSITION_BLOCK, BASELINE_BLOCK, VELOCITY_BLOCK)
_BASELINE, _VELOCITY = FIRST_GROUP[_GNSS] + 1, FIRST_GROUP[_GNSS] + 2  #: groups of these readings


@kernel
def _begin(flight, p, settings, mask):
    share, _ = uniform_pair(stream_of(flight), DRAW_PHASE)
    begin_clock(flight, settings, _GNSS, share, mask)
    keep(flight.drift, mask, (0.0, 0.0, 0.0))
    if settings.heading_errs:
        _draw_heading_error(flight, p, mask)


@kernel
def _measure(flight, p, settings, work, stages, mask, corrupted):
    """Measure, with constant heading error and, if `corrupted`, faults, in the lanes `mask`."""
    R_BI = quaternion_to_dcm(load4(flight.q))
    n_p, n_b = six_normals(stream_of(flight), DRAW_GNSS)
    measure_position(flight, p, R_BI, n_p, mask)
    if settings.reading_blocks[_BASELINE] > 0:
        measure_baseline(flight, p, R_BI, n_b, mask)
    work.mask = select(mask, 1.0, 0.0)
    call_stage(stages, Stage.TURN_BASELINE, flight, p, p, settings, work, 0)
    if corrupted:
        call_stage(stages, Stage.CORRUPT_GNSS, flight, p, p, settings, work, 0)
    if settings.reading_blocks[_VELOCITY] > 0:
        measure_velocity(flight, p, mask)


@kernel
def _flag(flags, mask, position, baseline, settings):
    """Set the flags of the three blocks, in the lanes `mask`."""
    flags[POSITION_BLOCK] = select(mask, position, flags[POSITION_BLOCK])
    flags[BASELINE_BLOCK] = select(mask, baseline, flags[BASELINE_BLOCK])
    if settings.reading_blocks[_VELOCITY] > 0:
        flags[VELOCITY_BLOCK] = select(mask, position, flags[VELOCITY_BLOCK])


@kernel
def _sample(flight, p, settings, work, stages, mask, starting):
    """Measure when due, and at the start for the initialization of the filter."""
    due = tick_clock(flight, settings, _GNSS, mask)
    delayed, period = settings.sensor_delay[_GNSS] > 0, settings.sensor_ticks[_GNSS]
    begin_sample(flight, work, settings, _GNSS, mask)
    arrives = find_arrivals(flight, work, settings, _GNSS, mask)
    if not starting and not any_of(due | arrives):
        return
    if settings.drifts > 0 and not starting and any_of(due):
        share = minimum(flight.tick / period, 1.0)
        _drift(flight, p, due, share)
    measured = mask if starting else due
    paired = measured
    initializes = starting and not settings.warm  # this fix has no faults
    if settings.faults and not initializes:
        measured, paired = _heard(flight, settings, due)
    if any_of(measured):
        _measure(flight, p, settings, work, stages, measured, not initializes)
    if settings.reading_blocks[_BASELINE] == 0:
        paired = paired & logical_not(measured)
    unpaired = measured & logical_not(paired)
    if starting or not delayed:
        fresh = measured & (period > 0)
        one = 1.0 + zero_like(flight.tick)
        _flag(flight.block_fresh, fresh, one, select(unpaired, 0.0, one), settings)
    if starting and settings.reuse_first_fix == 0 and not settings.warm:
        due = due & (period < 0)  # none
    valid = select(due & measured, 1.0, 0.0)
    _flag(flight.block_valid, mask, valid, select(unpaired, 0.0, valid), settings)
    if delayed:
        taken, n = stamp(flight, settings, _GNSS, mask), settings.under_way[_GNSS]
        for block in _BLOCKS:
            exchange(flight, work, block, n, mask, taken)
            if not starting:  # there, it stays in the record, for the initialization of the filter
                deliver_arrived(flight, work, block, mask)


gnss_stage = sensor_stage(
    Sensor["GNSS"],
    _begin,
    _sample,
    ReadingModel(expect_position, reset_position),
    ReadingModel(expect_baseline, reset_baseline),
    ReadingModel(expect_velocity, reset_velocity),
)

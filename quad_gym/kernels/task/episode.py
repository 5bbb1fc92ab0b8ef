"""Start of an episode: its reference, gates, counters and true state."""

import math

from quad_gym.kernels.compiling import Stage, call_stage, kernel, stage
from quad_gym.kernels.numbers.blocks import reset
from quad_gym.kernels.numbers.elementary import atan2, clip, maximum, minimum, sin_cos
from quad_gym.kernels.numbers.lanes import select, zero_like
from quad_gym.kernels.numbers.linalg import dot, keep, load3, vector
from quad_gym.kernels.numbers.random import normal_pair, six_normals, stream_of, uniform_pair
from quad_gym.kernels.numbers.rotation import dcm_to_quaternion, euler_to_dcm
from quad_gym.kernels.task.reference import draw_path, evaluate_reference
from quad_gym.records import (
    COLUMNS,
    DRAW_COURSE,
    DRAW_FIRST_BIASES,
    DRAW_GATES,
    DRAW_GROUND,
    DRAW_MOTION,
    DRAW_SERIES,
    DRAW_START,
    HEADING_ALONG,
    HEADING_TOWARD,
    HEADING_VELOCITY,
    MAX_GATES,
    MAX_HARMONICS,
    MAX_START_RATE,
    MAX_START_VELOCITY,
    Start,
    TaskKind,
)
from quad_gym.records.streams import GATE_SPREAD, LOWEST_GATE, RANDOM_RISE

# --------------------------------------------------------------------------------------------------
# True state at the start of an episode, drawn around the start of the reference.
# --------------------------------------------------------------------------------------------------

START_POSITION_SIGMA, START_YAW_SIGMA, START_TILT_SIGMA, START_VELOCITY_SIGMA = 0.3, 0.2, 0.03, 0.03
"""Standard deviations of a hovering start: [m], [rad], [rad], [m/s]."""
GROUND_SHARE = 0.5  #: share of mixed starts that are on the ground
_POSITION, _VELOCITY = COLUMNS["start_position_I"].start, COLUMNS["start_velocity_I"].start
_RATES, _YAW = COLUMNS["start_body_rates"].start, COLUMNS["start_yaw"].start
_ROLL, _PITCH = COLUMNS["start_roll"].start, COLUMNS["start_pitch"].start


@kernel
def _signed_pair(stream, draw):
    """Return two independent numbers, uniform on [-1, 1)."""
    a, b = uniform_pair(stream, draw)
    return 2.0 * a - 1.0, 2.0 * b - 1.0


@kernel
def _given_or(given, drawn):
    """Return a start value from the caller, or the drawn one where that is NaN."""
    return select(given == given, given, drawn)


@kernel
def draw_start(flight, p, model, settings, work, stream, mask):
    """Set the true state at the start of an episode, where `mask`; mark lanes on the ground."""
    (x, y, z), _, _, x_ref = evaluate_reference(flight, zero_like(flight.tick), settings.harmonics)
    yaw = atan2(x_ref[1], x_ref[0])
    zero = zero_like(yaw)
    v_I = (zero, zero, zero)
    roll, pitch, rotor_speed = zero, zero, zero
    on_ground = mask
    if settings.start != Start.GROUND:
        n_r, n_v = six_normals(stream, DRAW_START)
        n_roll, n_pitch = normal_pair(stream, DRAW_START + 3)
        n_yaw, _ = normal_pair(stream, DRAW_START + 4)
        u_ground, _ = uniform_pair(stream, DRAW_GROUND)
        share = GROUND_SHARE if settings.start == Start.MIXED else 0.0
        on_ground = u_ground < share
        if settings.task == TaskKind.WAYPOINTS:
            x, y, z = load3(flight.gates[0])
            x, y, z = 0.25 * x, 0.25 * y, zero + settings.height
        r_I = (
            x + START_POSITION_SIGMA * clip(n_r[0], -3.0, 3.0),
            y + START_POSITION_SIGMA * clip(n_r[1], -3.0, 3.0),
            maximum(z + START_POSITION_SIGMA * clip(n_r[2], -3.0, 3.0), 0.1),
        )
        x, y = select(on_ground, x, r_I[0]), select(on_ground, y, r_I[1])
        z = r_I[2]
        hovering = select(on_ground, 0.0, 1.0)
        v_I = hovering * START_VELOCITY_SIGMA * n_v
        roll = hovering * START_TILT_SIGMA * n_roll
        pitch = hovering * START_TILT_SIGMA * n_pitch
        yaw = yaw + hovering * START_YAW_SIGMA * n_yaw
        rotor_speed = hovering * model.motor_speed_per_volt * model.hover_voltage
    w_B = (zero, zero, zero)
    if settings.start == Start.MOVING:
        a, b = _signed_pair(stream, DRAW_MOTION)
        c, d = _signed_pair(stream, DRAW_MOTION + 1)
        e, f = _signed_pair(stream, DRAW_MOTION + 2)
        v_I = MAX_START_VELOCITY * (a, b, c) + v_I
        w_B = MAX_START_RATE * (d, e, f)
    z = select(on_ground, 0.0, z)
    if settings.randomized:
        drawn = flight.drawn
        x, y, z = vector(x, y, z) + load3(drawn[_POSITION:])
        v_I, w_B = v_I + load3(drawn[_VELOCITY:]), w_B + load3(drawn[_RATES:])
        roll, pitch, yaw = roll + drawn[_ROLL], pitch + drawn[_PITCH], yaw + drawn[_YAW]
    given = flight.start_given
    x, y, z = _given_or(given[0], x), _given_or(given[1], y), _given_or(given[2], z)
    v_I = (_given_or(given[3], v_I[0]), _given_or(given[4], v_I[1]), _given_or(given[5], v_I[2]))
    yaw = _given_or(given[6], yaw)
    still = dot(v_I, v_I) + dot(w_B, w_B) <= 0.0
    work.on_ground = select(on_ground, 1.0, 0.0)
    on_pad = select(on_ground & still, 1.0 * settings.pad, 0.0)
    flight.on_pad = select(mask, on_pad, flight.on_pad)
    keep(flight.r, mask, (x, y, z))
    keep(flight.v, mask, v_I)
    keep(flight.w, mask, w_B)
    R_BI = euler_to_dcm((roll, pitch, zero)) @ euler_to_dcm((zero, zero, yaw))
    keep(flight.q, mask, dcm_to_quaternion(R_BI))
    keep(flight.rotor_speeds, mask, (rotor_speed, rotor_speed, rotor_speed, rotor_speed))
    reset(flight, mask, 0.0, "disturbance voltages action last_action")

    n_a, n_g = six_normals(stream, DRAW_FIRST_BIASES)
    keep(flight.b_a, mask, p.accel_bias_sigma * n_a)
    keep(flight.b_g, mask, p.gyro_bias_sigma * n_g)


# --------------------------------------------------------------------------------------------------
# Start of an episode: its reference, gates and counters.
# --------------------------------------------------------------------------------------------------


@kernel
def _clear_reference(flight, mask, center, omega, rule, point):
    keep(flight.ref_center, mask, center)
    keep(flight.ref_heading_point, mask, point)
    flight.ref_omega = select(mask, omega, flight.ref_omega)
    flight.ref_heading_rule = select(mask, rule, flight.ref_heading_rule)
    reset(flight, mask, 0.0, "ref_cos ref_sin")


@kernel
def _draw_series(flight, settings, stream, mask):
    """Draw a random trajectory: normal coefficients, decreasing as 1/k^2, scaled to the bounds.

    |r'| <= sum k w |c_k| and |r''| <= sum (k w)^2 |c_k|, so the bounds hold at all times.
    """
    omega = 2.0 * math.pi / settings.period
    zero = zero_like(flight.tick)
    speed, acceleration, extent = zero, zero, zero
    for k in range(MAX_HARMONICS):
        n_a, n_b = six_normals(stream, DRAW_SERIES + 3 * k)
        fall = 1.0 / ((k + 1.0) * (k + 1.0))
        rate = (k + 1.0) * omega
        a = (fall * n_a[0], fall * n_a[1], RANDOM_RISE * fall * n_a[2])
        b = (fall * n_b[0], fall * n_b[1], RANDOM_RISE * fall * n_b[2])
        keep(flight.ref_cos[k], mask, a)
        keep(flight.ref_sin[k], mask, b)
        size = math.sqrt(
            a[0] * a[0] + a[1] * a[1] + a[2] * a[2] + b[0] * b[0] + b[1] * b[1] + b[2] * b[2]
        )
        speed = speed + rate * size
        acceleration = acceleration + rate * rate * size
        extent = extent + size
    shrink = minimum(settings.max_speed / speed, settings.max_acceleration / acceleration)
    shrink = minimum(shrink, settings.radius / extent)
    for k in range(MAX_HARMONICS):
        keep(flight.ref_cos[k], mask, shrink * load3(flight.ref_cos[k]))
        keep(flight.ref_sin[k], mask, shrink * load3(flight.ref_sin[k]))


@kernel
def _draw_gates(flight, settings, stream, mask):
    """Draw gates around the origin; azimuths of successive gates differ by at least 60 degrees."""
    azimuth, _ = uniform_pair(stream, DRAW_GATES)
    azimuth = 2.0 * math.pi * azimuth
    x, y, z = load3(flight.ref_center)
    for k in range(MAX_GATES):
        turn, where = uniform_pair(stream, DRAW_GATES + 1 + 2 * k)
        up, side = uniform_pair(stream, DRAW_GATES + 2 + 2 * k)
        distance = settings.radius * (0.4 + 0.6 * where)
        height = settings.height * (LOWEST_GATE + GATE_SPREAD * up)
        used = k < settings.gate_count
        s, c = sin_cos(azimuth)
        # entries after the last gate repeat it, so that the preview ends there
        x, y, z = (distance * c, distance * s, height) if used else (x, y, z)
        keep(flight.gates[k], mask, (x, y, z))
        step = (1.0 / 3.0 + 2.0 / 3.0 * turn) * math.pi
        azimuth = azimuth + select(side < 0.5, -step, step)
    keep(flight.ref_center, mask, load3(flight.gates[0]))
    flight.gate_next = select(mask, 0.0, flight.gate_next)


@kernel
def draw_reference(flight, settings, stream, mask):
    """Set the reference of a new episode, where `mask`; at random if the settings require it."""
    u_phase, u_radius = uniform_pair(stream, DRAW_COURSE)
    u_period, u_sense = uniform_pair(stream, DRAW_COURSE + 1)
    zero = zero_like(u_phase)
    radius, period, phase, sense = zero + settings.radius, zero + settings.period, zero, zero + 1.0
    if settings.randomize_reference:
        phase = 2.0 * math.pi * u_phase
        radius = radius * (0.5 + 0.75 * u_radius)
        period = period * (0.8 + 0.7 * u_period)
        sense = select(u_sense < 0.5, -1.0, 1.0)
    s, c = sin_cos(phase)
    omega = 2.0 * math.pi / period
    over_origin = (zero, zero, zero + settings.height)
    origin, ahead = (zero, zero, zero), (c, s, zero)

    if settings.task == TaskKind.HOVER:
        place = (radius * c, radius * s, zero + settings.height)
        _clear_reference(flight, mask, place, zero, HEADING_TOWARD, origin)
    elif settings.task == TaskKind.CIRCLE:
        _clear_reference(flight, mask, over_origin, omega, HEADING_TOWARD, origin)
        keep(flight.ref_cos[0], mask, (radius * c, radius * s, zero))
        keep(flight.ref_sin[0], mask, (-sense * radius * s, sense * radius * c, zero))
    elif settings.task == TaskKind.LEMNISCATE:
        # r(t) = radius (sin wt, sin(2wt)/2) rotated by the phase
        _clear_reference(flight, mask, over_origin, omega, HEADING_VELOCITY, origin)
        half = 0.5 * sense * radius
        keep(flight.ref_sin[0], mask, (radius * c, radius * s, zero))
        keep(flight.ref_sin[1], mask, (-half * s, half * c, zero))
    elif settings.task == TaskKind.RANDOM_TRAJECTORY:
        _clear_reference(flight, mask, over_origin, omega, HEADING_ALONG, ahead)
        flight.ref_omega = select(mask, 2.0 * math.pi / settings.period, flight.ref_omega)
        _draw_series(flight, settings, stream, mask)
    elif settings.task == TaskKind.TRAJECTORY:
        _clear_reference(flight, mask, over_origin, zero, HEADING_TOWARD, origin)
        draw_path(flight, settings, stream, mask)
    else:
        # a fixed heading: one that follows the gates would jump from gate to gate
        _clear_reference(flight, mask, over_origin, zero, HEADING_ALONG, ahead)
        _draw_gates(flight, settings, stream, mask)


@stage
def begin_stage(flight, world, model, settings, work, stages, flag):
    """Set the reference, true state and counters at the start of an episode."""
    stream, mask = stream_of(flight), work.mask > 0.0
    draw_reference(flight, settings, stream, mask)
    call_stage(stages, Stage.FOLLOW, flight, world, model, settings, work, 0)
    draw_start(flight, world, model, settings, work, stream, mask)
    flight.charge = select(mask, world.battery_charge, flight.charge)
    flight.episode = select(mask, flight.episode + 1.0, flight.episode)
    reset(flight, mask, 0.0, "step gate_next needs_reset reward terminated truncated ending")
    reset(flight, mask, 0.0, "episode_return episode_error")

"""Start of an episode: its reference, gates and counters."""

import math

from quad_gym.kernels.compiling import Stage, call_stage, kernel, stage
from quad_gym.kernels.maths.elementary import minimum, sin_cos
from quad_gym.kernels.maths.linalg import keep, load3
from quad_gym.kernels.maths.random import six_normals, stream_of, uniform_pair
from quad_gym.kernels.simd.blocks import reset
from quad_gym.kernels.simd.lanes import select, zero_like
from quad_gym.kernels.task.follow import draw_path
from quad_gym.kernels.task.heights import GATE_SPREAD, LOWEST_GATE, RANDOM_RISE
from quad_gym.kernels.task.start import draw_start
from quad_gym.records import (
    DRAW_COURSE,
    DRAW_GATES,
    DRAW_SERIES,
    HEADING_ALONG,
    HEADING_TOWARD,
    HEADING_VELOCITY,
    MAX_GATES,
    MAX_HARMONICS,
    TaskKind,
)


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

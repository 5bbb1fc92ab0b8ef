"""References: a finite Fourier series or a user's trajectory, and a rule for the heading.

`r*(t) = c + sum_k a_k cos(k w t) + b_k sin(k w t)`: hover has no terms, a circle one, a lemniscate
two, a random trajectory several. One kernel evaluates them all, with exact derivatives. A user's
trajectory is looked up by the stage FOLLOW.
"""

import math

from quad_gym.kernels.compiling import entry, kernel
from quad_gym.kernels.compiling.decorators import SIGNATURE
from quad_gym.kernels.numbers.blocks import lanes_of, record_at
from quad_gym.kernels.numbers.elementary import sin_cos
from quad_gym.kernels.numbers.lanes import select, zero_like
from quad_gym.kernels.numbers.linalg import load3, store, unit_or
from quad_gym.kernels.numbers.random import uniform_pair
from quad_gym.records import (
    DRAW_PATH,
    FOLLOWED,
    HEADING_ALONG,
    HEADING_GIVEN,
    HEADING_VELOCITY,
    MAX_HARMONICS,
    PATH,
    PIECE,
    REGISTER,
    TERMS,
    Control,
)

# --------------------------------------------------------------------------------------------------
# References: a finite Fourier series per axis and a rule for the heading.
# --------------------------------------------------------------------------------------------------


@kernel
def position_on_reference(flight, t, harmonics=MAX_HARMONICS):
    """Return r*(t) in I [m]."""
    x, y, z = load3(flight.ref_center)
    s1, c1 = zero_like(x), zero_like(x)
    if harmonics > 0:
        s1, c1 = sin_cos(flight.ref_omega * t)
    s, c = s1, c1
    for k in range(harmonics):
        a, b = flight.ref_cos[k], flight.ref_sin[k]
        x, y, z = x + a[0] * c + b[0] * s, y + a[1] * c + b[1] * s, z + a[2] * c + b[2] * s
        s, c = s * c1 + c * s1, c * c1 - s * s1
    return (x, y, z)


@kernel
def direction_of(v, zero):
    """Return the horizontal unit vector along v, east if v is vertical; `zero`: its z component."""
    return unit_or((v[0], v[1], zero), (zero + 1.0, zero, zero))


@kernel
def heading(flight, r_ref, v_ref):
    """Return x*, the desired direction of the body x axis: a horizontal unit vector in I."""
    point = load3(flight.ref_heading_point)
    rule = flight.ref_heading_rule
    along = select(rule == HEADING_VELOCITY, v_ref, point - r_ref)
    direction = select(rule == HEADING_ALONG, point, along)
    return direction_of(direction, zero_like(r_ref[0]))


@kernel
def _followed(flight):
    """Return (r*, v*, a*, x*) of a user's trajectory at the present instant."""
    r, v = load3(flight.path_r), load3(flight.path_v)
    return r, v, load3(flight.path_a), load3(flight.path_x)


@kernel
def evaluate_reference(flight, t, harmonics=MAX_HARMONICS):
    """Return (r*, v*, a*, x*) in I at the time t of the episode [s].

    `harmonics`: number of nonzero terms of the series; FOLLOWED: the reference is a trajectory, and
    t the present instant, for which the stage FOLLOW has looked it up.
    """
    if harmonics == FOLLOWED:
        return _followed(flight)
    return _evaluate_series(flight, t, harmonics)


@kernel
def _evaluate_series(flight, t, harmonics):
    omega = flight.ref_omega
    x, y, z = load3(flight.ref_center)
    zero = zero_like(x)
    s1, c1 = zero, zero
    if harmonics > 0:
        s1, c1 = sin_cos(omega * t)
    s, c = s1, c1
    vx, vy, vz, ax, ay, az = zero, zero, zero, zero, zero, zero
    rate = omega
    for k in range(harmonics):
        a, b = flight.ref_cos[k], flight.ref_sin[k]
        ex, ey, ez = a[0] * c + b[0] * s, a[1] * c + b[1] * s, a[2] * c + b[2] * s
        x, y, z = x + ex, y + ey, z + ez
        vx = vx + rate * (b[0] * c - a[0] * s)
        vy = vy + rate * (b[1] * c - a[1] * s)
        vz = vz + rate * (b[2] * c - a[2] * s)
        square = rate * rate
        ax, ay, az = ax - square * ex, ay - square * ey, az - square * ez
        s, c = s * c1 + c * s1, c * c1 - s * s1
        rate = rate + omega
    r_ref, v_ref = (x, y, z), (vx, vy, vz)
    return r_ref, v_ref, (ax, ay, az), heading(flight, r_ref, v_ref)


# --------------------------------------------------------------------------------------------------
# Users' trajectories: piecewise polynomials, looked up flight by flight.
#
# The stage stores the reference of the present instant in the flight's record, where `reference.py`
# reads it. Each lane searches for its segment and copies the coefficients to the workspace; all
# later steps compute the lanes together.
# --------------------------------------------------------------------------------------------------

_path_at, _piece_at = record_at(PATH), record_at(PIECE)
_PATH_SIZE, _PIECE_SIZE = PATH.itemsize, PIECE.itemsize


@kernel
def draw_path(flight, settings, stream, mask):
    """Draw the trajectory of a new episode, where `mask`; also its phase and rotation, if set."""
    u_path, u_share = uniform_pair(stream, DRAW_PATH)
    u_turn, _ = uniform_pair(stream, DRAW_PATH + 1)
    zero = zero_like(u_path)
    chosen, share, turn = zero, zero, zero
    for k in range(1, settings.path_count):
        chosen = select(u_path * settings.path_count >= 1.0 * k, 1.0 * k, chosen)
    if settings.randomize_reference:
        share, turn = u_share, 2.0 * math.pi * u_turn
    s, c = sin_cos(turn)
    flight.path = select(mask, chosen, flight.path)
    flight.path_share = select(mask, share, flight.path_share)
    flight.path_turn[0] = select(mask, c, flight.path_turn[0])
    flight.path_turn[1] = select(mask, s, flight.path_turn[1])


@kernel
def _piece_of(table, path, time):
    """Return the last segment that begins at or before a time; else the first one."""
    low, high = path.first, path.first + path.pieces - 1
    while low < high:
        middle = (low + high + 1) // 2
        if _piece_at(table.pieces + middle * _PIECE_SIZE).begin <= time:
            low = middle
        else:
            high = middle - 1
    return low


@kernel
def _look_up(flight, work, table):
    """Copy the segment of each lane's trajectory at `path_time` to the workspace."""
    for lane in range(REGISTER):
        path = _path_at(table.paths + int(flight.path[lane]) * _PATH_SIZE)
        time, span = work.path_time[lane], path.duration
        before, beyond = 0.0, 0.0
        if path.closed > 0:
            time = time + flight.path_share[lane] * span
            time = time - math.floor(time / span) * span
        else:
            before = 1.0 if time <= 0.0 else 0.0
            beyond = 1.0 if time >= span else 0.0
        work.path_still[lane] = 1.0 if path.closed == 0 and (time < 0.0 or time > span) else 0.0
        time = min(max(time, 0.0), span)
        piece = _piece_at(table.pieces + _piece_of(table, path, time) * _PIECE_SIZE)
        work.path_time[lane] = time - piece.begin
        for k in range(TERMS):
            for i in range(4):
                work.path_terms[k, i, lane] = piece.terms[k, i]
        work.path_heading[lane] = path.heading
        work.path_held[lane] = before + beyond
        for i in range(2):
            work.path_point[i, lane] = path.point[i]
            work.path_end[i, lane] = path.end_heading[i] if beyond > 0.0 else path.begin_heading[i]


@kernel
def _value(work, i):
    """Return a polynomial and its first two derivatives, by Horner's rule."""
    t = work.path_time
    value = work.path_terms[0, i]
    rate, bend = zero_like(t), zero_like(t)
    for k in range(1, TERMS):
        bend = bend * t + rate
        rate = rate * t + value
        value = value * t + work.path_terms[k, i]
    return value, rate, 2.0 * bend


@kernel
def _turned(flight, x, y, z):
    """Return a vector, rotated about the vertical like the flight's trajectory."""
    c, s = flight.path_turn[0], flight.path_turn[1]
    return (c * x - s * y, s * x + c * y, z)


@kernel
def _heading(flight, work, r, v):
    """Return the desired direction of body x, rotated like the trajectory."""
    zero = zero_like(r[0])
    rule = work.path_heading
    yaw, _, _ = _value(work, 3)
    s, c = sin_cos(yaw)
    toward = (work.path_point[0] - r[0], work.path_point[1] - r[1], zero)
    along = select(work.path_held > 0.0, (work.path_end[0], work.path_end[1], zero), v)
    direction = select(rule == HEADING_VELOCITY, along, toward)
    x, y, _ = direction_of(select(rule == HEADING_GIVEN, (c, s, zero), direction), zero)
    return _turned(flight, x, y, zero)


@entry(signature=SIGNATURE)
def follow_stage(flight, world, model, settings, work, stages, flag):
    """Set the reference of the present instant, and its preview.

    `flag`: 1 if the instant is within a control period, where only PD control reads them.
    """
    if flag and settings.control != Control.PD:
        return
    flying, room = lanes_of(flight), lanes_of(work)
    time = flying.tick * lanes_of(model).dt
    for i in range(2):
        room.path_time = time + settings.preview[i]
        _look_up(flight, work, stages)
        (x, _, _), (y, _, _), (z, _, _) = _value(room, 0), _value(room, 1), _value(room, 2)
        store(flying.path_ahead[i], _turned(flying, x, y, z))
    room.path_time = time
    _look_up(flight, work, stages)
    (x, vx, ax), (y, vy, ay), (z, vz, az) = _value(room, 0), _value(room, 1), _value(room, 2)
    still, none = room.path_still > 0.0, (zero_like(x), zero_like(x), zero_like(x))
    v = select(still, none, (vx, vy, vz))
    store(flying.path_r, _turned(flying, x, y, z))
    store(flying.path_v, _turned(flying, v[0], v[1], v[2]))
    ax, ay, az = select(still, none, (ax, ay, az))
    store(flying.path_a, _turned(flying, ax, ay, az))
    store(flying.path_x, _heading(flying, room, (x, y, z), v))

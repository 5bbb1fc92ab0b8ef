"""The ground as a level plane that carries a vehicle, and the launch pad.

Each tick is flown freely first. Where a point would be below the plane at its end, impulses act at
all points: with the gap g_i, velocity u_i and impulse j_i of point i, and the tick h,

    u_iz >= -g_i / h,   j_iz >= 0,   |(j_ix, j_iy)| <= friction j_iz,

found by Gauss-Seidel sweeps; then r+ = r + h v+ and q+ = q exp(h w+). Impulses that satisfy this do
no positive work at the resulting velocities, u_i . j_i <= 0, so contact adds no energy. The number
of sweeps is fixed, however: sweeps that have not converged, as in an impact of several points at
once, may add energy, which a final scaling of all impulses removes (`_share_without_gain`). As r+
and q+ follow from velocities, points of a vehicle that rotates fast may end a tick below the plane;
they go no deeper, and nothing pushes them out, which would add energy. A vehicle at rest that
normal forces and static friction can hold keeps its exact state.
"""

import math

from quad_gym.kernels.compiling import kernel, stage
from quad_gym.kernels.numbers.elementary import TINY, clip, maximum, minimum, sin_cos
from quad_gym.kernels.numbers.lanes import any_of, logical_not, select, zero_like
from quad_gym.kernels.numbers.linalg import cross, dot, keep, load3, load4, load33, rounded, store
from quad_gym.kernels.numbers.rotation import normalize_quaternion, quaternion_to_dcm
from quad_gym.kernels.vehicle.dynamics import (
    accelerations,
    air_accelerations,
    load_start,
    load_state,
)
from quad_gym.records import Ending

# --------------------------------------------------------------------------------------------------
# The ground as a level plane that carries a vehicle: contact of its feet and rotor hubs.
# --------------------------------------------------------------------------------------------------

SWEEPS = 24  #: Gauss-Seidel sweeps over all points in a tick
STILL_SPEED, STILL_RATE, STILL_GAP = 5e-3, 0.05, 2e-4
"""Speed [m/s], body rate [rad/s] and gap of the feet [m] below which a vehicle can come to rest.

Feet that an impact has left below the plane count as standing on it.
"""
_FEET, _POINTS = 4, 8


@kernel
def _point(p, i):
    """Foot or rotor hub i, relative to the center of mass in B [m]."""
    return load3(p.feet_B[i]) if i < _FEET else load3(p.rotor_positions_B[i - _FEET])


@kernel
def _effective_mass(arm, along, inverse_inertia_I, inverse_mass):
    """Effective mass of a point along a direction: impulse per change of its velocity [kg]."""
    turn = cross(arm, along)
    return 1.0 / (inverse_mass + dot(turn, inverse_inertia_I @ turn))


@kernel
def _prepare(work, p, R_BI, inverse_inertia_I, height):
    """Set arms in I, effective masses and gaps of all points, and zero impulses."""
    zero, inverse_mass = zero_like(height), 1.0 / p.mass
    one = zero + 1.0
    for i in range(_POINTS):
        arm = R_BI.T @ _point(p, i)
        x = _effective_mass(arm, (one, zero, zero), inverse_inertia_I, inverse_mass)
        y = _effective_mass(arm, (zero, one, zero), inverse_inertia_I, inverse_mass)
        z = _effective_mass(arm, (zero, zero, one), inverse_inertia_I, inverse_mass)
        store(work.ground_arm[i], arm)
        # one for all level directions, so that friction opposes the sliding
        store(work.ground_mass[i], (minimum(x, y), minimum(x, y), z))
        store(work.ground_impulse[i], (zero, zero, zero))
        work.ground_gap[i] = height + arm[2]


@kernel
def _pushed(v_I, w_I, arm, j_I, inverse_inertia_I, inverse_mass):
    """Velocity and body rates in I after an impulse at the end of an arm."""
    return inverse_mass * j_I + v_I, w_I + inverse_inertia_I @ cross(arm, j_I)


@kernel
def _sweep(work, v_I, w_I, inverse_inertia_I, inverse_mass, friction, rate):
    """One sweep over all points; returns velocity and body rates in I after it."""
    zero = zero_like(v_I[0])
    for i in range(_POINTS):
        arm, mass = load3(work.ground_arm[i]), load3(work.ground_mass[i])
        old = load3(work.ground_impulse[i])
        floor = -maximum(work.ground_gap[i], zero) * rate
        u = v_I + cross(w_I, arm)
        up = maximum(old[2] + mass[2] * (floor - u[2]), zero)
        upward = (zero, zero, up - old[2])
        v_I, w_I = _pushed(v_I, w_I, arm, upward, inverse_inertia_I, inverse_mass)
        u = v_I + cross(w_I, arm)
        x, y = old[0] - mass[0] * u[0], old[1] - mass[1] * u[1]
        size, most = math.sqrt(x * x + y * y), friction * up
        share = select(size > most, most / select(size > most, size, 1.0), 1.0)
        x, y = share * x, share * y
        aside = (x - old[0], y - old[1], zero)
        v_I, w_I = _pushed(v_I, w_I, arm, aside, inverse_inertia_I, inverse_mass)
        store(work.ground_impulse[i], (x, y, up))
    return v_I, w_I


@kernel
def _share_without_gain(start, before, after, ahead, p):
    """Share of the impulses with which a vehicle has no more energy than in free flight.

    The mean forces of free flight over the tick do work along the path: their acceleration is
    a = (v_free - v_start) / h. Kinetic energy minus that work, at the end of the tick, exceeds its
    value in free flight by `A s^2 / 2 + B s + C` with a share s of the impulses, where

        A = m |dv|^2 + dw . J dw,   B = m (v_free - h a) . dv + w_free . J dw,   C = -m a . ahead.

    It is never positive at s = 1 once the sweeps have converged. With gravity alone in place of all
    forces, standing still under thrust would count as an energy gain.

    Args:
        start: Velocity (I) at the tick's start.
        before, after: Velocity (I) and body rates (B) at its end without and with impulses.
        ahead: Displacement in a tick at the final velocity, minus the displacement in free flight,
            in I [m].
        p: True parameters.
    """
    J = load33(p.inertia)
    dv, dw = after[0] - before[0], after[1] - before[1]
    a = p.mass * dot(dv, dv) + dot(dw, J @ dw)
    b = p.mass * dot(start, dv) + dot(before[1], J @ dw)  # v_free - h a = v_start
    c = -p.mass * dot(before[0] - start, ahead) / p.dt
    changes = a > TINY
    root = math.sqrt(maximum(b * b - 2.0 * a * c, 0.0))
    return clip((root - b) / select(changes, a, 1.0), 0.0, 1.0)


@kernel
def _can_hold(work, F, T, friction):
    """Check that the feet can give an impulse F and an angular impulse T, both in I.

    Normal forces are the least-squares solution among the four; static friction is evaluated for
    the whole vehicle, as if the feet shared the load.
    """
    zero = zero_like(F[0])
    c_x, c_y, c_z = zero, zero, zero
    n, y, x, yy, xx, xy = zero, zero, zero, zero, zero, zero
    for i in range(_FEET):
        arm = load3(work.ground_arm[i])
        c_x, c_y, c_z = c_x + 0.25 * arm[0], c_y + 0.25 * arm[1], c_z + 0.25 * arm[2]
        n, y, x = n + 1.0, y + arm[1], x - arm[0]
        yy, xx, xy = yy + arm[1] * arm[1], xx + arm[0] * arm[0], xy - arm[0] * arm[1]
    # sum g_i g_i^T m = b with g_i = (1, y_i, -x_i), and the normal impulses are g_i . m
    first, second, third = (n, y, x), (y, yy, xy), (x, xy, xx)
    b = (F[2], T[0] + c_z * F[1], T[1] - c_z * F[0])
    across = cross(second, third)
    m = b[0] * across + rounded(b[1] * cross(third, first)) + rounded(b[2] * cross(first, second))
    m = (1.0 / dot(first, across)) * m
    least, reach = zero + math.inf, zero + math.inf
    for i in range(_FEET):
        arm = load3(work.ground_arm[i])
        least = minimum(least, m[0] + arm[1] * m[1] - arm[0] * m[2])
        dx, dy = arm[0] - c_x, arm[1] - c_y
        reach = minimum(reach, dx * dx + dy * dy)
    turn = abs(T[2] - (c_x * F[1] - c_y * F[0])) / math.sqrt(maximum(reach, 1e-12))
    aside = math.sqrt(F[0] * F[0] + F[1] * F[1])
    return (F[2] > 0.0) & (least >= 0.0) & (aside + turn <= friction * F[2])


@kernel
def carry(p, settings, work, pose, rates, free, ahead):
    """Apply the ground's impulses over one tick.

    Args:
        p, settings, work: As for a stage.
        pose: Position in I and attitude quaternion at the tick's start.
        rates, free: Velocity in I and body rates in B at its start, and at its end without ground.
        ahead: See `_share_without_gain`.

    Returns:
        Velocity in I and body rates in B at its end; masks of the lanes in contact, at rest, and
        crashed; number of feet that carry load.
    """
    (r_I, q), (v_start, w_start), (v_free, w_free) = pose, rates, free
    R_BI, rate, J = quaternion_to_dcm(q), 1.0 / p.dt, load33(p.inertia)
    friction = settings.friction
    inverse_inertia_I = R_BI.T @ (load33(p.inertia_inverse) @ R_BI)
    inverse_mass, zero = 1.0 / p.mass, zero_like(r_I[0])
    w_I = R_BI.T @ w_free
    _prepare(work, p, R_BI, inverse_inertia_I, r_I[2] - p.ground_height)
    meets, hard, still = zero > 1.0, zero > 1.0, zero < 1.0
    for i in range(_POINTS):
        down = v_free[2] + cross(w_I, load3(work.ground_arm[i]))[2]
        low = work.ground_gap[i] + p.dt * down < 0.0
        meets = meets | low
        if i < _FEET:
            still = still & (work.ground_gap[i] <= STILL_GAP)
        else:
            hard = hard | low
    hard = hard | (R_BI[2][2] < settings.hard_up) | (v_start[2] < -settings.hard_speed)
    v, w, feet = v_free, w_free, zero
    stays = meets & still & (dot(v_start, v_start) <= STILL_SPEED * STILL_SPEED)
    stays = stays & (dot(w_start, w_start) <= STILL_RATE * STILL_RATE)
    T_I = R_BI.T @ -(J @ w_free)
    stays = stays & _can_hold(work, -p.mass * v_free, T_I, friction)
    if any_of(meets & logical_not(stays)):
        v_I = v_free
        for _ in range(SWEEPS):
            v_I, w_I = _sweep(work, v_I, w_I, inverse_inertia_I, inverse_mass, friction, rate)
        w_B = R_BI @ w_I
        share = _share_without_gain(v_start, free, (v_I, w_B), ahead, p)
        v = share * (v_I - v_free) + v_free
        w = share * (w_B - w_free) + w_free
        for i in range(_FEET):
            feet = feet + select(work.ground_impulse[i, 2] > 0.0, 1.0, 0.0)
    nothing = (zero, zero, zero)
    v, w = select(stays, nothing, v), select(stays, nothing, w)
    feet = select(meets, select(stays, 4.0, feet), 0.0)
    return v, w, meets, stays, meets & hard, feet


@kernel
def _feel(flight, p, R_BI, gained, mask):
    """Set the specific force that the ground adds at the accelerometer, in contact where `mask`.

    `gained`: mean acceleration in I and angular acceleration in B over the tick.
    """
    a_I, dw_B = air_accelerations(flight, p, R_BI)
    push = R_BI @ (gained[0] - a_I) + cross(gained[1] - dw_B, load3(p.imu_lever_arm))
    zero = zero_like(p.dt)
    store(flight.ground_push, select(mask, push, (zero, zero, zero)))


@kernel
def _turned(q, w_B, dt):
    """The attitude q exp(w dt), a quaternion."""
    half = 0.5 * dt * math.sqrt(dot(w_B, w_B))
    sine, cosine = sin_cos(half)
    turns = half > TINY
    per = select(turns, 0.5 * dt * sine / select(turns, half, 1.0), 0.5 * dt)
    (a, x, y, z), d = q, per * w_B
    return normalize_quaternion(
        (
            a * cosine - x * d[0] - y * d[1] - z * d[2],
            x * cosine + a * d[0] + y * d[2] - z * d[1],
            y * cosine + a * d[1] + z * d[0] - x * d[2],
            z * cosine + a * d[2] + x * d[1] - y * d[0],
        )
    )


@stage
def stand_stage(flight, world, model, settings, work, stages, flag):
    """Apply the ground's contact forces to the tick that has just been flown freely."""
    p = world
    r_I, v_I, q, w_B, _ = load_start(work)
    free = load3(flight.v), load3(flight.w)
    ahead = p.dt * free[0] + r_I - load3(flight.r)
    pose = (r_I, q)
    v, w, meets, stays, crashes, feet = carry(p, settings, work, pose, (v_I, w_B), free, ahead)
    flight.footing = feet
    flight.crashed = select(crashes, 1.0, flight.crashed)
    if any_of(meets):
        keep(flight.r, meets, select(stays, r_I, p.dt * v + r_I))
        keep(flight.v, meets, v)
        keep(flight.w, meets, w)
        keep(flight.q, meets, select(stays, q, _turned(q, w, p.dt)))
        rate = 1.0 / p.dt
        gained = rate * (v - v_I), rate * (w - w_B)
        _feel(flight, p, quaternion_to_dcm(load4(flight.q)), gained, meets)
    else:
        zero = zero_like(p.dt)
        store(flight.ground_push, (zero, zero, zero))


@stage
def begin_ground_stage(flight, world, model, settings, work, stages, flag):
    """Place a vehicle that starts on the ground, and lift one that is below it."""
    p, mask = world, work.mask > 0.0
    R_BI, height = quaternion_to_dcm(load4(flight.q)), flight.r[2] - p.ground_height
    lowest = height + math.inf
    for i in range(_POINTS):
        lowest = minimum(lowest, height + (R_BI.T @ _point(p, i))[2])
    given = flight.start_given[2]
    placed = (work.on_ground > 0.0) & logical_not(given == given)
    z = flight.r[2]
    # z is 0 on the ground, and the drawn height is on top of it
    above = select(placed, maximum(z, 0.0), 0.0)
    moved = mask & (placed | (lowest < 0.0))
    flight.r[2] = select(moved, z - lowest + above, z)
    flight.on_pad = select(mask, 0.0, flight.on_pad)
    flight.crashed = select(mask, 0.0, flight.crashed)
    v_I, w_B, h = load3(flight.v), load3(flight.w), p.dt
    a_I, dw_B = air_accelerations(flight, p, R_BI)
    free = h * a_I + v_I, h * dw_B + w_B
    pose = load3(flight.r), load4(flight.q)
    ahead = 0.5 * h * (free[0] - v_I)
    v, w, meets, _, _, feet = carry(p, settings, work, pose, (v_I, w_B), free, ahead)
    before = load3(flight.ground_push)
    gained = (1.0 / h) * (v - v_I), (1.0 / h) * (w - w_B)
    _feel(flight, p, R_BI, gained, meets)
    keep(flight.ground_push, logical_not(mask), before)
    flight.footing = select(mask, feet, flight.footing)


@stage
def feel_ground_stage(flight, world, model, settings, work, stages, flag):
    """Add the ground's contact force to the accelerometer's sample."""
    push = load3(flight.ground_push)
    keep(flight.accel, work.mask > 0.0, load3(flight.accel) + push)


@stage
def judge_landing_stage(flight, world, model, settings, work, stages, flag):
    """Terminate the episodes of vehicles that have crashed into the ground."""
    over, flying = (work.mask > 0.0) & (flight.crashed > 0.0), flight.terminated <= 0.0
    flight.ending = select(over & flying, Ending.BELOW_MIN_HEIGHT, flight.ending)
    flight.terminated = select(over, 1.0, flight.terminated)


# --------------------------------------------------------------------------------------------------
# The launch pad: it carries a vehicle that starts on the ground until its thrust lifts it.
# --------------------------------------------------------------------------------------------------


@stage
def keep_start_stage(flight, world, model, settings, work, stages, flag):
    """Keep the true state at the start of a tick, for contact and for IMU samples that average."""
    if settings.grounded or settings.imu_averages or any_of(flight.on_pad > 0.0):
        r, v, q, w, W = load_state(flight)
        store(work.start, r)
        store(work.start[3:], v)
        store(work.start[6:], q)
        store(work.start[10:], w)
        store(work.start[13:], W)


@stage
def rest_on_pad_stage(flight, world, model, settings, work, stages, flag):
    """Undo the tick's motion of vehicles on the pad, and release those that lift off.

    On the pad only the rotors move: its normal force balances weight less thrust, and friction
    holds position and attitude. It can push, not pull: a vehicle that the other forces accelerate
    upward has lifted off. The pad does no work, as nothing moves on it.
    """
    on_pad = flight.on_pad > 0.0
    if any_of(on_pad):
        r, v, q, w, _ = load_start(work)
        keep(flight.r, on_pad, r)
        keep(flight.v, on_pad, v)
        keep(flight.w, on_pad, w)
        keep(flight.q, on_pad, q)
        d_I = load3(flight.disturbance) + load3(flight.air_force)
        W, v_air_I = load4(flight.rotor_speeds), v - load3(flight.wind)
        a_I, _ = accelerations(quaternion_to_dcm(q), v_air_I, w, W, d_I, world)
        flight.on_pad = select(on_pad & (a_I[2] <= 0.0), 1.0, 0.0)

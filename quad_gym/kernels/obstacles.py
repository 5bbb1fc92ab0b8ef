"""Obstacles: shapes, contact with them, and lines of sight."""

import math

from quad_gym.kernels.compiling import kernel, stage
from quad_gym.kernels.numbers.blocks import reset
from quad_gym.kernels.numbers.elementary import clip, maximum, minimum
from quad_gym.kernels.numbers.lanes import logical_not, no_lane, select, zero_like
from quad_gym.kernels.numbers.linalg import keep, load3, load4, norm
from quad_gym.kernels.numbers.random import stream_of, uniform_pair
from quad_gym.kernels.numbers.rotation import quaternion_to_dcm
from quad_gym.records import DRAW_OBSTACLES, FEATURE_BLOCKS, Ending, Shape

# --------------------------------------------------------------------------------------------------
# Walls and cylinders: the distance of a point, and intersection with a line.
#
# Both are upright. A wall is a box that is turned about the vertical; `half` has its half length,
# half thickness and half height. For a cylinder, `half` has radius, radius and half height.
# --------------------------------------------------------------------------------------------------

AT_THE_END = 1e-3
"""Length before a line's end in which an obstacle does not count, as a marker may hang on a wall
[m]."""
_FAR, _PARALLEL = 1e30, 1e-12


@kernel
def to_obstacle(v_I, settings, k):
    """A vector in the axes of obstacle k: along its length, its thickness, and up."""
    c, s = settings.obstacle_axis[k, 0], settings.obstacle_axis[k, 1]
    return (c * v_I[0] + s * v_I[1], c * v_I[1] - s * v_I[0], v_I[2])


@kernel
def from_obstacle(v, settings, k):
    """A vector in the axes of obstacle k turned back to I."""
    c, s = settings.obstacle_axis[k, 0], settings.obstacle_axis[k, 1]
    return (c * v[0] - s * v[1], s * v[0] + c * v[1], v[2])


@kernel
def _outward(p, inside):
    """`inside` (a depth, at least 0) in the direction of p's sign."""
    return select(p < 0.0, -inside, inside)


@kernel
def _from_wall(p, half):
    """(distance, vector to the nearest point of the surface) of a point in a wall's axes."""
    zero = zero_like(p[0])
    q = (abs(p[0]) - half[0], abs(p[1]) - half[1], abs(p[2]) - half[2])
    deepest = maximum(maximum(q[0], q[1]), q[2])
    outside = (
        clip(p[0], -half[0], half[0]) - p[0],
        clip(p[1], -half[1], half[1]) - p[1],
        clip(p[2], -half[2], half[2]) - p[2],
    )
    by_length, by_thickness = q[0] >= deepest, q[1] >= deepest
    upward = (zero, zero, _outward(p[2], -q[2]))
    inside = select(by_thickness, (zero, _outward(p[1], -q[1]), zero), upward)
    inside = select(by_length, (_outward(p[0], -q[0]), zero, zero), inside)
    is_outside = deepest > 0.0
    return select(is_outside, norm(outside), deepest), select(is_outside, outside, inside)


@kernel
def _from_cylinder(p, half):
    """(distance, vector to the nearest point of the surface) of a point in a cylinder's axes."""
    zero = zero_like(p[0])
    rho = math.sqrt(p[0] * p[0] + p[1] * p[1])
    aside = rho > _PARALLEL
    per_rho = 1.0 / select(aside, rho, 1.0)
    x, y = select(aside, p[0] * per_rho, 1.0), p[1] * per_rho  # on the axis: to its east
    q_r, q_z = rho - half[0], abs(p[2]) - half[2]
    deepest = maximum(q_r, q_z)
    back = -maximum(q_r, zero)
    outside = (back * x, back * y, clip(p[2], -half[2], half[2]) - p[2])
    inside = select(q_r >= q_z, (-q_r * x, -q_r * y, zero), (zero, zero, _outward(p[2], -q_z)))
    is_outside = deepest > 0.0
    return select(is_outside, norm(outside), deepest), select(is_outside, outside, inside)


@kernel
def distance_from(r_I, center_I, settings, k):
    """Distance of a point from the surface of obstacle k, negative inside, and the vector to it."""
    p, half = to_obstacle(r_I - center_I, settings, k), load3(settings.obstacle_half[k])
    if settings.obstacle_shape[k] == Shape.CYLINDER:
        distance, vector = _from_cylinder(p, half)
    else:
        distance, vector = _from_wall(p, half)
    return distance, from_obstacle(vector, settings, k)


@kernel
def _slab(start, along, half):
    """Fractions of a line at which it enters and leaves the slab [-half, half]."""
    across = abs(along) > _PARALLEL
    per = 1.0 / select(across, along, 1.0)
    a, b = (-half - start) * per, (half - start) * per
    within = abs(start) < half
    enters = select(across, minimum(a, b), select(within, -_FAR, _FAR))
    leaves = select(across, maximum(a, b), select(within, _FAR, -_FAR))
    return enters, leaves


@kernel
def _disc(start, along, radius):
    """Fractions of a line at which it enters and leaves an infinite vertical cylinder."""
    a = along[0] * along[0] + along[1] * along[1]
    across = a > _PARALLEL * _PARALLEL
    b = start[0] * along[0] + start[1] * along[1]
    c = start[0] * start[0] + start[1] * start[1] - radius * radius
    root = b * b - a * c
    meets, per = root > 0.0, 1.0 / select(across, a, 1.0)
    reach = math.sqrt(select(meets, root, 0.0)) * per
    within = c < 0.0
    enters = select(across & meets, -b * per - reach, _FAR)
    leaves = select(across & meets, -b * per + reach, -_FAR)
    enters = select(across, enters, select(within, -_FAR, _FAR))
    leaves = select(across, leaves, select(within, _FAR, -_FAR))
    return enters, leaves


@kernel
def crosses(start_I, end_I, center_I, settings, k):
    """Check if the line from one point to another crosses obstacle k, before AT_THE_END.

    It does if it has entered all slabs before it leaves the first.
    """
    along_I = end_I - start_I
    length = norm(along_I)
    start = to_obstacle(start_I - center_I, settings, k)
    along, half = to_obstacle(along_I, settings, k), load3(settings.obstacle_half[k])
    enters, leaves = _slab(start[2], along[2], half[2])
    if settings.obstacle_shape[k] == Shape.CYLINDER:
        into, out = _disc(start, along, half[0])
    else:
        into, out = _slab(start[0], along[0], half[0])
        by_thickness, out_of_it = _slab(start[1], along[1], half[1])
        into, out = maximum(into, by_thickness), minimum(out, out_of_it)
    enters, leaves = maximum(enters, into), minimum(leaves, out)
    end = 1.0 - AT_THE_END / maximum(length, AT_THE_END)
    return maximum(enters, 0.0) < minimum(leaves, end)


# --------------------------------------------------------------------------------------------------
# Positions of obstacles in an episode, contact with them, and the geofence.
# --------------------------------------------------------------------------------------------------


@kernel
def _place_obstacles(flight, settings, mask):
    """Draw the positions of obstacles in a new episode, where `mask`."""
    stream = stream_of(flight)
    for k in range(settings.obstacle_count):
        u, v = uniform_pair(stream, DRAW_OBSTACLES + 2 * k)
        w, _ = uniform_pair(stream, DRAW_OBSTACLES + 2 * k + 1)
        reach, center = load3(settings.obstacle_shift[k]), load3(settings.obstacle_center[k])
        u, v, w = 2.0 * u - 1.0, 2.0 * v - 1.0, 2.0 * w - 1.0
        shift = (reach[0] * u, reach[1] * v, reach[2] * w)
        other = settings.obstacle_follows[k]
        if other >= 0:
            nominal = load3(settings.obstacle_center[other])
            shift = shift + (load3(flight.obstacle_center[other]) - nominal)
        keep(flight.obstacle_center[k], mask, shift + center)
    reset(flight, mask, 0.0, "collided left_fence")


@kernel
def _touch(flight, settings, mask):
    """Find the nearest obstacle, contact with it, and departure from the fence, where `mask`."""
    r_I = load3(flight.r)
    zero = zero_like(flight.tick)
    nearest, vector = zero + math.inf, (zero, zero, zero)
    for k in range(settings.obstacle_count):
        distance, there = distance_from(r_I, load3(flight.obstacle_center[k]), settings, k)
        closer = distance < nearest
        nearest, vector = select(closer, distance, nearest), select(closer, there, vector)
    flight.obstacle_distance = select(mask, nearest, flight.obstacle_distance)
    keep(flight.obstacle_vector, mask, vector)
    touches = mask & (nearest <= settings.vehicle_radius)
    flight.collided = select(touches, 1.0, flight.collided)
    if settings.fenced:
        low, high = load3(settings.fence[0]), load3(settings.fence[1])
        within = (r_I[0] >= low[0]) & (r_I[0] <= high[0])
        within = within & (r_I[1] >= low[1]) & (r_I[1] <= high[1])
        within = within & (r_I[2] >= low[2]) & (r_I[2] <= high[2])
        flight.left_fence = select(mask & logical_not(within), 1.0, flight.left_fence)


@stage
def begin_contacts_stage(flight, world, model, settings, work, stages, flag):
    """Place the obstacles of a new episode."""
    _place_obstacles(flight, settings, work.mask > 0.0)
    _touch(flight, settings, work.mask > 0.0)


@stage
def touch_stage(flight, world, model, settings, work, stages, flag):
    """Find vehicles that touch an obstacle or are outside the geofence at the present instant."""
    _touch(flight, settings, work.mask > 0.0)


@stage
def judge_contacts_stage(flight, world, model, settings, work, stages, flag):
    """Terminate episodes whose vehicle touched an obstacle or left the geofence.

    A collision has priority over any other ending in the same step, except the last gate.
    """
    active, flying = work.mask > 0.0, flight.terminated <= 0.0
    hit, left = active & (flight.collided > 0.0), active & (flight.left_fence > 0.0)
    short_of_goal = flying | logical_not(flight.ending == Ending.LAST_GATE)
    flight.ending = select(left & flying, Ending.LEFT_GEOFENCE, flight.ending)
    flight.ending = select(hit & short_of_goal, Ending.COLLISION, flight.ending)
    flight.terminated = select(hit | left, 1.0, flight.terminated)


# --------------------------------------------------------------------------------------------------
# Features that an obstacle hides from the camera.
# --------------------------------------------------------------------------------------------------


@stage
def hide_features_stage(flight, world, model, settings, work, stages, flag):
    """Remove features behind an obstacle from the image just taken."""
    camera_I = load3(flight.r) + quaternion_to_dcm(load4(flight.q)).T @ load3(world.camera)
    for i in range(settings.feature_count):
        X_I, hidden = load3(world.features[i]), no_lane(flight.tick)
        for k in range(settings.obstacle_count):
            center_I = load3(flight.obstacle_center[k])
            hidden = hidden | crosses(camera_I, X_I, center_I, settings, k)
        valid = flight.block_valid[FEATURE_BLOCKS + i]
        hidden = (work.mask > 0.0) & hidden
        flight.block_valid[FEATURE_BLOCKS + i] = select(hidden, 0.0, valid)

"""Positions of obstacles in an episode, contact with them, and the geofence."""

import math

from quad_gym.kernels.compiling import kernel, stage
from quad_gym.kernels.maths.linalg import keep, load3
from quad_gym.kernels.maths.random import stream_of, uniform_pair
from quad_gym.kernels.obstacles.shapes import distance_from
from quad_gym.kernels.simd.blocks import reset
from quad_gym.kernels.simd.lanes import logical_not, select, zero_like
from quad_gym.records import DRAW_OBSTACLES, Ending


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

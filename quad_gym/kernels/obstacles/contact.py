"""Positions of obstacles in an episode, contact with them, and the geofence."""

import math

from quad_gym.kernels.compiling import kernel, stage
from quad_gym.kernels.maths.linalg import keep3, load3, select3
from quad_gym.kernels.maths.random import stream_of, uniform_pair
from quad_gym.kernels.obstacles.shapes import distance_from
from quad_gym.kernels.simd.blocks import lanes_of
from quad_gym.kernels.simd.lanes import logical_not, select
from quad_gym.records import DRAW_OBSTACLES, Ending

_COLLISION, _LEFT_GEOFENCE = float(Ending.COLLISION), float(Ending.LEFT_GEOFENCE)
_LAST_GATE = float(Ending.LAST_GATE)


@kernel
def place_obstacles(flight, settings, mask):
    """Draw the positions of obstacles in a new episode, where `mask`."""
    stream = stream_of(flight)
    for k in range(settings.obstacle_count):
        u, v = uniform_pair(stream, DRAW_OBSTACLES + 2 * k)
        w, _ = uniform_pair(stream, DRAW_OBSTACLES + 2 * k + 1)
        reach, center = load3(settings.obstacle_shift[k]), load3(settings.obstacle_center[k])
        shift = (
            reach[0] * (2.0 * u - 1.0),
            reach[1] * (2.0 * v - 1.0),
            reach[2] * (2.0 * w - 1.0),
        )
        other = settings.obstacle_follows[k]
        if other >= 0:
            nominal = load3(settings.obstacle_center[other])
            shift = shift + (load3(flight.obstacle_center[other]) - nominal)
        keep3(flight.obstacle_center[k], mask, shift + center)
    flight.collided = select(mask, 0.0, flight.collided)
    flight.left_fence = select(mask, 0.0, flight.left_fence)


@kernel
def touch(flight, settings, mask):
    """Find the nearest obstacle, contact with it, and departure from the fence, where `mask`."""
    r_I = load3(flight.r)
    zero = 0.0 * flight.tick
    nearest, vector = zero + math.inf, (zero, zero, zero)
    for k in range(settings.obstacle_count):
        distance, there = distance_from(r_I, load3(flight.obstacle_center[k]), settings, k)
        closer = distance < nearest
        nearest, vector = select(closer, distance, nearest), select3(closer, there, vector)
    flight.obstacle_distance = select(mask, nearest, flight.obstacle_distance)
    keep3(flight.obstacle_vector, mask, vector)
    touches = mask & (nearest <= settings.vehicle_radius)
    flight.collided = select(touches, 1.0, flight.collided)
    if settings.fenced:
        low, high = load3(settings.fence[0]), load3(settings.fence[1])
        within = (r_I[0] >= low[0]) & (r_I[0] <= high[0])
        within = within & (r_I[1] >= low[1]) & (r_I[1] <= high[1])
        within = within & (r_I[2] >= low[2]) & (r_I[2] <= high[2])
        flight.left_fence = select(mask & logical_not(within), 1.0, flight.left_fence)


@kernel
def judge_contacts(flight, active):
    """Terminate episodes whose vehicle touched an obstacle or left the geofence, where `active`.

    A collision has priority over any other ending in the same step, except the last gate.
    """
    hit, left = active & (flight.collided > 0.0), active & (flight.left_fence > 0.0)
    over, flying = hit | left, logical_not(flight.terminated > 0.0)
    short_of_goal = flying | logical_not(flight.ending == _LAST_GATE)
    flight.ending = select(left & flying, _LEFT_GEOFENCE, flight.ending)
    flight.ending = select(hit & short_of_goal, _COLLISION, flight.ending)
    flight.terminated = select(over, 1.0, flight.terminated)


@stage
def begin_contacts_stage(flight, world, model, settings, work, stages, flag):
    """Place the obstacles of a new episode."""
    flying, mask = lanes_of(flight), lanes_of(work).mask > 0.0
    place_obstacles(flying, settings, mask)
    touch(flying, settings, mask)


@stage
def touch_stage(flight, world, model, settings, work, stages, flag):
    """Find vehicles that touch an obstacle or are outside the geofence at the present instant."""
    touch(lanes_of(flight), settings, lanes_of(work).mask > 0.0)


@stage
def judge_contacts_stage(flight, world, model, settings, work, stages, flag):
    """Terminate episodes whose vehicle touched an obstacle or left the geofence."""
    judge_contacts(lanes_of(flight), lanes_of(work).mask > 0.0)

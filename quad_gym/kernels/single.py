"""Entries for the classes of one vehicle: scalar instances of the kernels of the vehicle.

Filters and sensors instead run the stages of flights on their own blocks, as scalar instances of
these would take even longer to compile.

Python calls them through `entries.py`, which has their arguments.
"""

from quad_gym.kernels import entries
from quad_gym.kernels.compiling import call_stage, entry, kernel
from quad_gym.kernels.compiling.signatures import signature_of
from quad_gym.kernels.filter.gate import forget_innovations
from quad_gym.kernels.filter.slow import begin_slow
from quad_gym.kernels.filter.starts import initialize, set_heading, start_still, wahba
from quad_gym.kernels.numbers.blocks import lanes_at, lanes_of
from quad_gym.kernels.numbers.linalg import diagonal, load3, load4, load33, outer, store
from quad_gym.kernels.obstacles import crosses, distance_from
from quad_gym.kernels.vehicle.air import accelerations_in_air
from quad_gym.kernels.vehicle.dynamics import accelerations, integrate
from quad_gym.records import FLIGHT_BLOCK

_flight_at = lanes_at(FLIGHT_BLOCK)


def _entry(function):
    return entry(function, signature_of(getattr(entries, function.__name__)))


@kernel
def begin_filter(block, params, settings, work, x_I):
    """Start the filters of a block, see `start_filter`."""
    flight, mask = lanes_of(block), lanes_of(work).mask > 0.0
    forget_innovations(flight, mask)
    initialize(flight, lanes_of(params), mask, x_I)
    begin_slow(flight, lanes_of(params), settings, mask)


@_entry
def start_filter(blocks, params, settings, work, x_I):
    """Start the filters of blocks[0] from their first fixes, where `work.mask`.

    x_I: (3,) known direction of body x in I, or zeros if unknown.
    """
    begin_filter(blocks[0], params[0], settings[0], work[0], load3(x_I))


@_entry
def first_heading(starts, fixes):
    """Set the heading of starts[0] from fixes[0], see `set_heading`."""
    fixes[0].outcome = set_heading(starts[0], fixes[0])


@_entry
def start_level(starts):
    """Compute the first estimate of a vehicle of known tilt, from starts[0]."""
    start_still(starts[0])


@_entry
def run_stage(address, pitch, count, number, world, model, settings, work, table, flag):
    """Run a stage of the table, its number, once for every block, where `work.mask`.

    The first block is at `address`; each next one is `pitch` bytes further.
    """
    true, believed = lanes_of(world[0]), lanes_of(model[0])
    scratch = lanes_of(work[0])
    mask = scratch.mask
    for index in range(count):
        flight = _flight_at(address + index * pitch)
        scratch.mask = mask
        call_stage(table[0], number, flight, true, believed, settings[0], scratch, flag)


@_entry
def integrate_flight(flights, params, substeps):
    """Integrate the true state of flights[0] over one tick."""
    integrate(flights[0], params[0], substeps)


@_entry
def body_accelerations(R_BI, v_I, w_B, rotor_speeds, d_I, params, a_I, dw_B):
    """Write the acceleration in I and the angular acceleration in B."""
    R, W = load33(R_BI), load4(rotor_speeds)
    a, dw = accelerations(R, load3(v_I), load3(w_B), W, load3(d_I), params[0])
    store(a_I, a)
    store(dw_B, dw)


@_entry
def body_accelerations_in_air(r_I, R_BI, v_I, w_B, rotor_speeds, d_I, params, settings, a_I, dw_B):
    """Write the acceleration in I and the angular acceleration in B in moving air."""
    r, R, v, w, W = load3(r_I), load33(R_BI), load3(v_I), load3(w_B), load4(rotor_speeds)
    p, d, wind = params[0], load3(d_I), load3(params[0].wind_I)
    a, dw = accelerations_in_air(r, R, v, w, W, d, wind, p, settings[0])
    store(a_I, a)
    store(dw_B, dw)


@_entry
def nearest_obstacles(points, centers, settings, distances, vectors):
    """Write distances (n,) of points (n, 3) from obstacles at (n, k, 3), and vectors to them."""
    for i in range(len(points)):
        for k in range(centers.shape[1]):
            distance, vector = distance_from(load3(points[i]), load3(centers[i, k]), settings[0], k)
            if distance < distances[i]:
                distances[i] = distance
                store(vectors[i], vector)


@_entry
def hide_points(eyes, points, centers, settings, hidden):
    """Write which points (n, m, 3) are behind an obstacle, as seen from eyes (n, 3)."""
    for i in range(len(eyes)):
        for j in range(points.shape[1]):
            for k in range(centers.shape[1]):
                line = (load3(eyes[i]), load3(points[i, j]), load3(centers[i, k]))
                hidden[i, j] |= crosses(*line, settings[0], k)


@_entry
def wahba_of_vectors(weights, v_I, v_B, R_BI):
    """Write the solution of Wahba's problem for (n, 3) vectors; return its uniqueness."""
    profile = diagonal((0.0, 0.0, 0.0))
    for i in range(len(weights)):
        profile = profile + outer(weights[i] * load3(v_B[i]), load3(v_I[i]))
    # only ratios matter: scale the largest entry to one, to avoid under- and overflow
    largest = 0.0
    for i in range(3):
        for j in range(3):
            largest = max(largest, abs(profile[i][j]))
    if largest > 0.0:
        profile = (1.0 / largest) * profile
    rotation, uniqueness = wahba(profile)
    store(R_BI, rotation)
    return uniqueness

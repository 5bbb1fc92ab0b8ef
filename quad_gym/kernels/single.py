"""Entries for the classes of one vehicle: scalar instances of the kernels of sensors and vehicle.

A filter instead runs the stages of flights on its own block, as scalar instances of these would
take even longer to compile.

Python calls them through `entries.py`, which has their arguments.
"""

from quad_gym.kernels import entries
from quad_gym.kernels.compiling import call_stage, entry, kernel
from quad_gym.kernels.compiling.signatures import signature_of
from quad_gym.kernels.filter.gate import forget_innovations
from quad_gym.kernels.filter.slow import begin_slow
from quad_gym.kernels.filter.starts import initialize, set_heading, start_still, wahba
from quad_gym.kernels.numbers.blocks import lanes_at, lanes_of
from quad_gym.kernels.numbers.lanes import select
from quad_gym.kernels.numbers.linalg import diagonal, keep, load3, load4, load33, outer, store
from quad_gym.kernels.obstacles import crosses, distance_from
from quad_gym.kernels.sensors import camera
from quad_gym.kernels.sensors.gnss import (
    draw_heading_error,
    drift_gnss,
    measure_gnss,
    turn_baseline,
)
from quad_gym.kernels.sensors.imu import (
    draw_imu_errors,
    drift_biases,
    err_imu,
    measure_imu,
    measure_imu_average,
    vibrate_imu,
)
from quad_gym.kernels.vehicle.air import accelerations_in_air
from quad_gym.kernels.vehicle.dynamics import accelerations, integrate, load_state
from quad_gym.records import FEATURE_BLOCKS, FLIGHT_BLOCK

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
def sense_imu(flights, params):
    """Sample the IMU of flights[0]."""
    measure_imu(flights[0], params[0], True)


@_entry
def sense_imu_average(flights, params, starts):
    """Sample the averaging IMU of flights[0] over a tick from the true state of starts[0]."""
    measure_imu_average(flights[0], params[0], load_state(starts[0]), True)


@_entry
def sense_gnss(flights, params, paired):
    """Measure flights[0] by GNSS, including the baseline if `paired`."""
    measure_gnss(flights[0], params[0], paired, True)


@_entry
def draw_sensor_errors(flights, params):
    """Draw the constant errors of the sensors of flights[0]."""
    draw_imu_errors(flights[0], params[0], True)
    draw_heading_error(flights[0], params[0], True)


@_entry
def disturb_imu(flights, params):
    """Add errors and vibration to the last IMU sample of flights[0]."""
    err_imu(flights[0], params[0], True)
    vibrate_imu(flights[0], params[0], True)


@_entry
def turn_gnss_baseline(flights, params):
    """Add the constant error to the last measured baseline of flights[0]."""
    turn_baseline(flights[0], params[0], True)


@_entry
def limit_features(flights, params, blurs, ground_hides, feature_count):
    """Blur the last image of flights[0], and drop features out of range or behind the ground."""
    camera.limit_camera(flights[0], params[0], blurs, ground_hides, feature_count, True)


@_entry
def step_gnss_drift(flights, params):
    """Advance the slow position error of flights[0] to the next measurement."""
    drift_gnss(flights[0], params[0], True, 1.0)


@_entry
def sense_features(flights, params, feature_count):
    """Measure the features that the camera of flights[0] sees."""
    flight = flights[0]
    for i in range(feature_count):
        block = FEATURE_BLOCKS + i
        (x, y, z), seen = camera.measure(flight, params[0], i)
        keep(flight.measurement[block], seen, (x, y, z))
        flight.block_valid[block] = select(seen, 1.0, 0.0)


@_entry
def step_biases(flights, params):
    """Advance the IMU biases of flights[0] by one tick."""
    drift_biases(flights[0], params[0])


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

"""Errors, delivery and gate shared by the sensors with parameters in the fields `aid_...`.

A sensor has one block of up to three numbers. It may have a slow error of three numbers, constant
in an episode, a Gauss-Markov error of one number, and constant errors of scale and alignment.
"""

from quad_gym.kernels.compiling import kernel
from quad_gym.kernels.filter.gate import add_nis, gate_numbers, mask_rejected
from quad_gym.kernels.maths.linalg import keep3, keep33
from quad_gym.kernels.maths.random import normal_pair, stream_of, uniform_pair
from quad_gym.kernels.sensors.clock import begin_clock, tick_clock
from quad_gym.kernels.sensors.latency import (
    deliver_arrived,
    exchange,
    find_arrivals,
    keep_arrived,
    stamp,
)
from quad_gym.kernels.simd.lanes import any_of, logical_not, select
from quad_gym.records import (
    AID_BLOCKS,
    AID_GROUPS,
    DRAW_AID_DRIFT,
    DRAW_AID_MATRIX,
    DRAW_AID_PHASE,
    DRAW_SLOW,
    FIRST_AID,
    Aid,
    FaultKind,
)

_LOSS = int(FaultKind[f"{Aid(0).name}_LOSS"])

for _aid in Aid:  # the faults that silence sensors are in the same order
    assert FaultKind[f"{_aid.name}_LOSS"] == _LOSS + _aid


@kernel
def begin_aid(flight, p, settings, s, mask):
    """Begin an episode of sensor s of `Aid`, in the lanes `mask`: draw its errors, set its clock.

    A warm start uses the normals of slow errors, too, see `filter/warm.py`.
    """
    stream = stream_of(flight)
    k = settings.aid_vector[s]
    if k >= 0:
        for i in range(3):
            _, n = normal_pair(stream, DRAW_SLOW + k + i)
            error = p.aid_vector_sigma[s] * n
            flight.aid_vector[s, i] = select(mask, error, flight.aid_vector[s, i])
    k = settings.aid_scalar[s]
    if k >= 0:
        _, n = normal_pair(stream, DRAW_SLOW + k)
        flight.aid_scalar[s] = select(mask, p.aid_scalar_sigma[s] * n, flight.aid_scalar[s])
    share, _ = uniform_pair(stream, DRAW_AID_PHASE + s)
    begin_clock(flight, settings, FIRST_AID + s, share, mask)


@kernel
def draw_matrix(flight, p, s, mask):
    """Draw the errors of scale and alignment of sensor s, in the lanes `mask`."""
    stream = stream_of(flight)
    a, b = normal_pair(stream, DRAW_AID_MATRIX + 5 * s)
    c, d = normal_pair(stream, DRAW_AID_MATRIX + 5 * s + 1)
    e, f = normal_pair(stream, DRAW_AID_MATRIX + 5 * s + 2)
    g, h = normal_pair(stream, DRAW_AID_MATRIX + 5 * s + 3)
    i, _ = normal_pair(stream, DRAW_AID_MATRIX + 5 * s + 4)
    z = p.aid_matrix_sigma[s]
    keep33(
        flight.aid_matrix[s],
        mask,
        ((z * a, z * b, z * c), (z * d, z * e, z * f), (z * g, z * h, z * i)),
    )


@kernel
def aid_due(flight, p, settings, s, mask, starting):
    """Lanes in which sensor s measures now; advances its clock and its Gauss-Markov error."""
    due = tick_clock(flight, settings, FIRST_AID + s, mask)
    if not starting and any_of(due):
        n, _ = normal_pair(stream_of(flight), DRAW_AID_DRIFT + s)
        error = p.aid_scalar_decay[s] * flight.aid_scalar[s] + p.aid_scalar_drive[s] * n
        flight.aid_scalar[s] = select(due, error, flight.aid_scalar[s])
    return due


@kernel
def deliver_first(flight, s, mask, values):
    """Deliver the measurement of sensor s that initializes the filter, which uses it only once."""
    keep3(flight.aid_measurement[s], mask, values)
    block = AID_BLOCKS + s
    flight.block_fresh[block] = select(mask, 1.0, flight.block_fresh[block])


@kernel
def deliver(flight, work, settings, s, mask, due, values):
    """Deliver the measurement of sensor s in the lanes `due`, now or after its latency."""
    sensor, block, measurement = FIRST_AID + s, AID_BLOCKS + s, flight.aid_measurement[s]
    if settings.faults:
        due = due & (flight.fault_active[_LOSS + s] <= 0.0)
    arrives = find_arrivals(flight, work, settings, sensor, mask)
    flight.block_valid[block] = select(mask, select(due, 1.0, 0.0), flight.block_valid[block])
    if settings.sensor_delay[sensor] == 0:
        keep3(measurement, due, values)
        flight.block_fresh[block] = select(due, 1.0, flight.block_fresh[block])
    elif any_of(due | arrives):
        keep_arrived(work, block, measurement, 3)
        keep3(measurement, due, values)
        taken = stamp(flight, settings, sensor, mask)
        exchange(flight, work, block, measurement, 3, settings.under_way[sensor], mask, taken)
        deliver_arrived(work, block, measurement, 3, mask)


@kernel
def gate_aid(flight, p, work, settings, s, k, numbers):
    """Store the innovation of sensor s, whose rows begin at k, and mask it beyond the gate."""
    block, group = AID_BLOCKS + s, AID_GROUPS + s
    valid = (work.taking > 0.0) & (flight.block_valid[block] > 0.0)
    rejected, nis = gate_numbers(
        flight, p, work, settings, k, block, group, valid, p.aid_gate[s], numbers
    )
    add_nis(work, valid & logical_not(work.again > 0.0), nis, numbers)
    mask_rejected(flight, work, settings, k, group, valid, rejected, numbers)

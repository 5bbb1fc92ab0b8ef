"""Errors, delivery and gate shared by the sensors with parameters in the fields `aid_...`.

A sensor has one block of up to three numbers. It may have Gauss-Markov errors of three numbers and
of one, and constant errors of scale and alignment.
"""

from typing import Any

from quad_gym.kernels.compiling import kernel
from quad_gym.kernels.filter.error_state import D
from quad_gym.kernels.filter.gate import gate_numbers
from quad_gym.kernels.maths.linalg import keep, load3
from quad_gym.kernels.maths.random import normal_pair, stream_of, uniform_pair
from quad_gym.kernels.sensors.clock import begin_clock, tick_clock
from quad_gym.kernels.sensors.latency import (
    deliver_arrived,
    exchange,
    find_arrivals,
    keep_arrived,
    stamp,
)
from quad_gym.kernels.sensors.stage import sensor_stage
from quad_gym.kernels.simd.lanes import any_of, select
from quad_gym.records import (
    AID_BLOCKS,
    AID_FREEDOMS,
    AID_GROUPS,
    DRAW_AID_DRIFT,
    DRAW_AID_MATRIX,
    DRAW_AID_PHASE,
    DRAW_AID_VECTOR,
    DRAW_SLOW,
    FIRST_AID,
    Aid,
    FaultKind,
    Sensor,
)

AID_LOSS = FaultKind[f"{Aid(0).name}_LOSS"].value
"""First of the faults that silence aiding sensors, which are in the same order."""

for _aid in Aid:
    assert FaultKind[f"{_aid.name}_LOSS"] == AID_LOSS + _aid


@kernel
def _begin(flight, p, settings, s, mask):
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
    stream, z = stream_of(flight), p.aid_matrix_sigma[s]
    a, b = normal_pair(stream, DRAW_AID_MATRIX + 5 * s)
    c, d = normal_pair(stream, DRAW_AID_MATRIX + 5 * s + 1)
    e, f = normal_pair(stream, DRAW_AID_MATRIX + 5 * s + 2)
    g, h = normal_pair(stream, DRAW_AID_MATRIX + 5 * s + 3)
    i, _ = normal_pair(stream, DRAW_AID_MATRIX + 5 * s + 4)
    keep(flight.aid_matrix[s], mask, z * ((a, b, c), (d, e, f), (g, h, i)))


@kernel
def _due(flight, p, settings, s, mask, starting):
    """Lanes in which sensor s measures now; advances its clock and its Gauss-Markov errors."""
    due = tick_clock(flight, settings, FIRST_AID + s, mask)
    if not starting and any_of(due):
        n, _ = normal_pair(stream_of(flight), DRAW_AID_DRIFT + s)
        error = p.aid_scalar_decay[s] * flight.aid_scalar[s] + p.aid_scalar_drive[s] * n
        flight.aid_scalar[s] = select(due, error, flight.aid_scalar[s])
        if any_of(p.aid_vector_drive[s] > 0.0):
            for i in range(3):
                n, _ = normal_pair(stream_of(flight), DRAW_AID_VECTOR + 3 * s + i)
                last = flight.aid_vector[s, i]
                error = p.aid_vector_decay[s] * last + p.aid_vector_drive[s] * n
                flight.aid_vector[s, i] = select(due, error, last)
    return due


@kernel
def _deliver(flight, work, settings, s, mask, due, values):
    """Deliver the measurement of sensor s in the lanes `due`, now or after its latency."""
    sensor, block, measurement = FIRST_AID + s, AID_BLOCKS + s, flight.aid_measurement[s]
    if settings.faults:
        due = due & (flight.fault_active[AID_LOSS + s] <= 0.0)
    arrives = find_arrivals(flight, work, settings, sensor, mask)
    flight.block_valid[block] = select(mask, select(due, 1.0, 0.0), flight.block_valid[block])
    if settings.sensor_delay[sensor] == 0:
        keep(measurement, due, values)
        flight.block_fresh[block] = select(due, 1.0, flight.block_fresh[block])
    elif any_of(due | arrives):
        keep_arrived(work, block, measurement, 3)
        keep(measurement, due, values)
        taken = stamp(flight, settings, sensor, mask)
        exchange(flight, work, block, measurement, 3, settings.under_way[sensor], mask, taken)
        deliver_arrived(work, block, measurement, 3, mask)


def aid_stage(aid: Aid, measure: Any, expect: Any, reset: Any, *others: Any) -> Any:
    """Make the stage of an aiding sensor.

    Args:
        aid: The sensor.
        measure: `(flight, p) -> numbers, within`: three numbers that it measures now, zero beyond
            its own, and the lanes in which it can measure.
        expect: `(flight, p, work, settings, k, valid)`: fill its rows from k on, in these lanes.
        reset: `(flight, p, work, settings, states, lanes, alone, nu)`: reset states to the sensor
            in `lanes`, those of the vehicle where it is `alone`, by the innovation nu.
        others: `(flight, p, mask)`, draw further constant errors of an episode, and `align` of
            `sensor_stage`; optional.
    """
    s, block, group = int(aid), AID_BLOCKS + aid, AID_GROUPS + aid
    numbers, (draw, *align) = float(AID_FREEDOMS[aid]), others or (_draw_nothing,)

    @kernel
    def begin(flight, p, settings, mask):  # type: ignore[no-untyped-def]
        _begin(flight, p, settings, s, mask)
        draw(flight, p, mask)

    @kernel
    def sample(flight, p, settings, work, stages, mask, starting):  # type: ignore[no-untyped-def]
        due = _due(flight, p, settings, s, mask, starting)
        values, within = measure(flight, p)
        if starting and settings.heading_sensor == FIRST_AID + s and settings.warm == 0:
            # it initializes the filter, which uses it only once
            keep(flight.aid_measurement[s], mask, values)
            flight.block_fresh[block] = select(mask, 1.0, flight.block_fresh[block])
        else:
            _deliver(flight, work, settings, s, mask, due & within, values)

    @kernel
    def expect_valid(flight, p, work, settings, k):  # type: ignore[no-untyped-def]
        expect(flight, p, work, settings, k, flight.block_valid[block] > 0.0)

    @kernel
    def gate(flight, p, work, settings, k):  # type: ignore[no-untyped-def]
        gate_numbers(flight, p, work, settings, k, block, group, p.aid_gate[s], numbers)

    @kernel
    def reset_states(flight, p, work, settings):  # type: ignore[no-untyped-def]
        nu, lanes, alone = load3(flight.innovation[block]), work.reset[group], work.alone[group]
        states = D + settings.slow_states
        reset(flight, p, work, settings, states, lanes > 0.0, alone > 0.0, nu)

    kernels = (begin, sample, expect_valid, gate, reset_states, *align)
    return sensor_stage(Sensor[aid.name], *kernels)


@kernel
def _draw_nothing(flight, p, mask):
    """Placeholder for sensors without further constant errors."""

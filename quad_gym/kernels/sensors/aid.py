"""Errors, delivery and gate shared by the sensors with parameters in the fields `aid_...`.

A sensor has one block of up to three numbers, or several. It may have Gauss-Markov errors of three
numbers and of one, and constant errors of scale and alignment.
"""

from typing import Any

from quad_gym.kernels.compiling import kernel
from quad_gym.kernels.filter.error_state import D
from quad_gym.kernels.maths.elementary import maximum
from quad_gym.kernels.maths.linalg import keep, load3
from quad_gym.kernels.maths.random import normal_pair, stream_of, uniform_pair
from quad_gym.kernels.sensors.latency import begin_clock, begin_sample, deliver, tick_clock
from quad_gym.kernels.sensors.stage import sensor_stage
from quad_gym.kernels.simd.lanes import any_of, select, zero_like
from quad_gym.records import (
    AID_BLOCK,
    AID_GROUPS,
    AID_MOST,
    AID_ROW,
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
    share, _ = uniform_pair(stream, DRAW_AID_PHASE[s])
    begin_clock(flight, settings, FIRST_AID + s, share, mask)


@kernel
def draw_matrix(flight, p, s, mask):
    """Draw the errors of scale and alignment of sensor s, in the lanes `mask`."""
    stream, z = stream_of(flight), p.aid_matrix_sigma[s]
    a, b = normal_pair(stream, DRAW_AID_MATRIX[s])
    c, d = normal_pair(stream, DRAW_AID_MATRIX[s] + 1)
    e, f = normal_pair(stream, DRAW_AID_MATRIX[s] + 2)
    g, h = normal_pair(stream, DRAW_AID_MATRIX[s] + 3)
    i, _ = normal_pair(stream, DRAW_AID_MATRIX[s] + 4)
    keep(flight.aid_matrix[s], mask, z * ((a, b, c), (d, e, f), (g, h, i)))


@kernel
def _due(flight, p, settings, s, mask, starting):
    """Lanes in which sensor s measures now; advances its clock and its Gauss-Markov errors."""
    due = tick_clock(flight, settings, FIRST_AID + s, mask)
    if not starting and any_of(due):
        n, _ = normal_pair(stream_of(flight), DRAW_AID_DRIFT[s])
        error = p.aid_scalar_decay[s] * flight.aid_scalar[s] + p.aid_scalar_drive[s] * n
        flight.aid_scalar[s] = select(due, error, flight.aid_scalar[s])
        if any_of(p.aid_vector_drive[s] > 0.0):
            for i in range(3):
                n, _ = normal_pair(stream_of(flight), DRAW_AID_VECTOR[s] + i)
                last = flight.aid_vector[s, i]
                error = p.aid_vector_decay[s] * last + p.aid_vector_drive[s] * n
                flight.aid_vector[s, i] = select(due, error, last)
    return due


def aid_stage(aid: Aid, measure: Any, expect: Any, reset: Any, *others: Any) -> Any:
    """Make the stage of an aiding sensor.

    Args:
        aid: The sensor.
        measure: `(flight, p, i) -> numbers, within`: three numbers that block i measures now, zero
            beyond its own, and the lanes in which it can measure.
        expect: `(flight, p, work, settings, i, k, valid)`: fill the rows of block i, from k on, in
            these lanes.
        reset: `(flight, p, work, settings, states, lanes, alone, nu)`: reset states to the sensor
            in `lanes`, those of the vehicle where it is `alone`, by the innovation nu; of several
            blocks, by the largest ones.
        others: `(flight, p, mask)`, draw further constant errors of an episode, and `align` of
            `sensor_stage`; optional.
    """
    s, group, sensor = int(aid), AID_GROUPS + aid, FIRST_AID + int(aid)
    first, row, several = AID_BLOCK[s], AID_ROW[s], AID_MOST[aid] > 1
    draw, *align = others or (_draw_nothing,)

    @kernel
    def begin(flight, p, settings, mask):  # type: ignore[no-untyped-def]
        _begin(flight, p, settings, s, mask)
        draw(flight, p, mask)

    @kernel
    def sample(flight, p, settings, work, stages, mask, starting):  # type: ignore[no-untyped-def]
        due = _due(flight, p, settings, s, mask, starting)
        if starting and settings.heading_sensor == sensor and settings.warm == 0:
            # it initializes the filter, which uses it only once
            (x, y, z), _ = measure(flight, p, 0)
            keep(flight.aid_measurement[row], mask, (x, y, z))
            flight.block_fresh[first] = select(mask, 1.0, flight.block_fresh[first])
            return
        if settings.faults:
            due = due & (flight.fault_active[AID_LOSS + s] <= 0.0)
        values = flight.aid_measurement[row : row + AID_MOST[s]]
        begin_sample(flight, work, settings, sensor, values, 3, mask)
        if any_of(due):
            for i in range(settings.sensor_blocks[sensor]):
                (x, y, z), within = measure(flight, p, i)
                taken = due & within
                keep(values[i], taken, (x, y, z))
                flight.block_valid[first + i] = select(taken, 1.0, flight.block_valid[first + i])
        deliver(flight, work, settings, sensor, values, 3, mask, due)

    @kernel
    def expect_valid(flight, p, work, settings, k):  # type: ignore[no-untyped-def]
        for i in range(settings.sensor_blocks[sensor]):
            valid = flight.block_valid[first + i] > 0.0
            if any_of(valid):
                expect(flight, p, work, settings, i, k, valid)
                k += 3

    @kernel
    def reset_states(flight, p, work, settings):  # type: ignore[no-untyped-def]
        lanes, alone, states = work.reset[group], work.alone[group], D + settings.slow_states
        nu = load3(flight.innovation[first])
        if several:
            nu = _largest(flight, first, settings.sensor_blocks[sensor])
        reset(flight, p, work, settings, states, lanes > 0.0, alone > 0.0, nu)

    return sensor_stage(Sensor[aid.name], begin, sample, expect_valid, reset_states, *align)


@kernel
def _largest(flight, first, count):
    """Magnitudes of the largest innovations among the valid blocks of a sensor."""
    zero = zero_like(flight.tick)
    largest = (zero, zero, zero)
    for block in range(first, first + count):
        nu, valid = load3(flight.innovation[block]), flight.block_valid[block] > 0.0
        size = (abs(nu[0]), abs(nu[1]), abs(nu[2]))
        largest = (
            maximum(largest[0], select(valid, size[0], zero)),
            maximum(largest[1], select(valid, size[1], zero)),
            maximum(largest[2], select(valid, size[2], zero)),
        )
    return largest


@kernel
def _draw_nothing(flight, p, mask):
    """Placeholder for sensors without further constant errors."""

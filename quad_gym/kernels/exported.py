"""Functions of a filter's library for other processors (`baselines/exporting/library.py`).

They do what `single.start_filter` and `tape.run_tape` do, one operation a call, on records.
"""

from numba import types
from numba.np.numpy_support import from_dtype

from quad_gym.kernels.compiling import entry
from quad_gym.kernels.filter.still import start_still
from quad_gym.kernels.maths.linalg import load3
from quad_gym.kernels.simd.addresses import array_at
from quad_gym.kernels.simd.blocks import lanes_of
from quad_gym.kernels.single import begin_filter
from quad_gym.kernels.stages import STAGE_TABLE
from quad_gym.kernels.tape import keep_estimate, predict_sample, update_with
from quad_gym.kernels.window import take_input
from quad_gym.records import (
    FLIGHT_BLOCK,
    MEASUREMENT,
    OPERATION,
    PARAMS_BLOCK,
    SAMPLE,
    SETTINGS,
    START,
    STEP_BLOCK,
    WORK_BLOCK,
)
from quad_gym.records.inputs import EVENT, INPUT, PENDING, WINDOW

_FLIGHT, _PARAMS, _STEPS, _SETTINGS, _WORK, _TABLE, _SAMPLE, _MEASUREMENT, _START = map(
    from_dtype,
    (
        *(FLIGHT_BLOCK, PARAMS_BLOCK, STEP_BLOCK, SETTINGS, WORK_BLOCK, STAGE_TABLE),
        *(SAMPLE, MEASUREMENT, START),
    ),
)
_WINDOW, _INPUT = map(from_dtype, (WINDOW, INPUT))
_events_at, _samples_at, _waits_at, _operations_at = map(
    array_at, (EVENT, SAMPLE, PENDING, OPERATION)
)
_NUMBERS = (_FLIGHT, _PARAMS, _PARAMS, _STEPS, _SETTINGS, _WORK, _TABLE)


@entry(signature=types.none(*_NUMBERS, _SAMPLE))
def predict(flight, params, ticks, steps, settings, work, table, sample):
    """Propagate the estimate over the time of a sample."""
    mask = lanes_of(work).mask
    predict_sample(lanes_of(flight), params, ticks, steps, settings, work, table, mask, sample)


@entry(signature=types.none(*_NUMBERS, _MEASUREMENT))
def update(flight, params, ticks, steps, settings, work, table, measurement):
    """Update the estimate with the measurements of an instant."""
    mask = lanes_of(work).mask
    update_with(lanes_of(flight), params, ticks, steps, settings, work, table, mask, measurement)


@entry(signature=types.none(_WINDOW, *[types.int64] * 4, _INPUT))
def take(window, events, samples, waits, operations, given):
    """Write the operations that process an input; the memory is at these addresses."""
    given.outcome = take_input(
        window,
        _events_at(events, window.event_room),
        _samples_at(samples, window.room[0]),
        _waits_at(waits, window.waiting_room),
        _operations_at(operations, 0),
        given,
    )


@entry(signature=types.none(_FLIGHT, _PARAMS, _SETTINGS, _WORK, _START))
def start(flight, params, settings, work, first):
    """Start the filter from its first fix."""
    begin_filter(flight, params, settings, work, load3(first.x_I))


@entry(signature=types.none(_START))
def start_level(first):
    """Compute the first estimate of a vehicle of known tilt."""
    start_still(first)


@entry(signature=types.none(_FLIGHT, types.int64))
def keep(flight, address):
    """Store the estimate in a row of numbers, see KEPT."""
    keep_estimate(lanes_of(flight), address)

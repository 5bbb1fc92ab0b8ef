"""Entries that run one stage on every block, or the scalar filter: for timing, not for flying."""

import numpy as np
from numba import types
from numba.np.numpy_support import from_dtype

from quad_gym.kernels.compiling import call_stage, entry
from quad_gym.kernels.compiling.stages import STAGE_TABLE
from quad_gym.kernels.filter.predict import predict
from quad_gym.kernels.filter.update import update
from quad_gym.kernels.simd.addresses import lanes_at
from quad_gym.kernels.simd.blocks import lanes_of
from quad_gym.records import (
    FLIGHT,
    FLIGHT_BLOCK,
    PARAMS,
    PARAMS_BLOCK,
    SETTINGS,
    WORK,
    WORK_BLOCK,
)

_flight_at = lanes_at(FLIGHT_BLOCK)


def _run_stage(address, pitch, count, number, world, model, settings, work, table, flag):
    """Run a stage once for every block.

    Args:
        address, pitch: Of the first block, as of `Call`; bytes from one block to the next.
        count: How many blocks there are.
        number: A `Stage`.
        world, model, settings, work, table: As for `fly`.
        flag: What the stage is called with.
    """
    true, believed = lanes_of(world[0]), lanes_of(model[0])
    scratch = lanes_of(work[0])
    for index in range(count):
        flight = _flight_at(address + index * pitch)
        scratch.mask = 1.0
        call_stage(table[0], number, flight, true, believed, settings[0], scratch, flag)


def _array(dtype):
    return types.Array(from_dtype(np.dtype(dtype)), 1, "C")


run_stage = entry(
    _run_stage,
    types.none(
        types.int64,
        types.int64,
        types.int64,
        types.int64,
        *map(_array, (PARAMS_BLOCK, PARAMS_BLOCK, SETTINGS, WORK_BLOCK, STAGE_TABLE)),
        types.int64,
    ),
)


def _filter_cycle_of_flights(flights, model, work, feature_count, form):
    """Update and predict the filter of every flight: the scalar instance of the same kernels."""
    for index in range(len(flights)):
        update(flights[index], model[0], work[0], feature_count, True, form)
        predict(flights[index], model[0], work[0], form)


filter_cycle_of_flights = entry(
    _filter_cycle_of_flights,
    types.none(*map(_array, (FLIGHT, PARAMS, WORK)), types.int64, types.int64),
)

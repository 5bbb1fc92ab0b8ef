"""What a task of a user's own is shown of flights, for the views of `quad_gym.tasks`."""

import numpy as np
from numba import types
from numba.np.numpy_support import from_dtype

from quad_gym.kernels.compiling import entry, kernel
from quad_gym.kernels.maths.linalg import load3, load4, load33
from quad_gym.kernels.maths.rotation import quaternion_to_dcm
from quad_gym.kernels.simd.blocks import lanes_of
from quad_gym.kernels.task.observation import previewed, put_relative
from quad_gym.kernels.task.reference import evaluate_reference
from quad_gym.records import FLIGHT_BLOCK, PARAMS_BLOCK, SETTINGS, SHOWN_SIZE, WIDTH, WORK_BLOCK


@kernel
def _put(row, k, values, count):
    """Write the first numbers of an array or a tuple; return the next place."""
    for i in range(count):
        row[k + i] = values[i]
    return k + count


@kernel
def _put_matrix(row, k, R):
    """Write a matrix row by row; return the next place."""
    for i in range(3):
        for j in range(3):
            row[k + 3 * i + j] = R[i][j]
    return k + 9


@kernel
def _show(flight, p, settings, row):
    """Write the numbers of `quad_gym.records.SHOWN`, in its order."""
    time = flight.tick * p.dt
    r_ref, v_ref, a_ref, x_ref = evaluate_reference(flight, time, settings.harmonics)
    row[0] = time
    k = _put(row, 1, load3(flight.r), 3)
    k = _put(row, k, load3(flight.v), 3)
    k = _put(row, k, load4(flight.q), 4)
    k = _put(row, k, load3(flight.w), 3)
    k = _put_matrix(row, k, quaternion_to_dcm(load4(flight.q)))
    k = _put(row, k, load3(flight.r_seen), 3)
    k = _put(row, k, load3(flight.v_seen), 3)
    k = _put_matrix(row, k, flight.R_seen)
    r, v, w = load3(flight.r_seen), load3(flight.v_seen), load3(flight.w_seen)
    k = put_relative(flight, p, settings, row, k, r, v, load33(flight.R_seen), w)
    k = _put(row, k, flight.action, 4)
    k = _put(row, k, flight.last_action, 4)
    k = _put(row, k, r_ref, 3)
    k = _put(row, k, v_ref, 3)
    k = _put(row, k, a_ref, 3)
    k = _put(row, k, x_ref, 3)
    for i in range(2):
        k = _put(row, k, previewed(flight, p, settings, i), 3)
    row[k] = flight.position_error
    row[k + 1] = flight.gate_next


def _array(kind, dimensions=1):
    return types.Array(from_dtype(np.dtype(kind)), dimensions, "C")


@entry(
    signature=types.none(
        _array(FLIGHT_BLOCK),
        _array(SETTINGS),
        _array(PARAMS_BLOCK),
        _array(WORK_BLOCK),
        _array(np.float64, 2),
    )
)
def show(blocks, settings, model, work, shown):
    """Show all flights at the present instant.

    Args:
        blocks: (n_blocks,) FLIGHT_BLOCK.
        settings: (1,) SETTINGS.
        model: (1,) PARAMS_BLOCK.
        work: (1,) WORK_BLOCK, whose field `observation` is written.
        shown: (SHOWN_SIZE, n_blocks WIDTH), written.
    """
    p, scratch = lanes_of(model[0]), lanes_of(work[0])
    for index in range(len(blocks)):
        _show(lanes_of(blocks[index]), p, settings[0], scratch.observation)
        for k in range(SHOWN_SIZE):
            for lane in range(WIDTH):
                shown[k, index * WIDTH + lane] = work[0].observation[k, lane]

"""What a task of a user's own is shown of flights, for the views of `quad_gym.tasks`."""

from numba import types

from quad_gym.kernels.compiling import entry, kernel
from quad_gym.kernels.maths.linalg import load3, load4, load33
from quad_gym.kernels.maths.rotation import quaternion_to_dcm
from quad_gym.kernels.simd.addresses import lanes_at, record_at
from quad_gym.kernels.task.observation import previewed, put_relative
from quad_gym.kernels.task.reference import evaluate_reference
from quad_gym.records import (
    FLIGHT_BLOCK,
    PARAMS_BLOCK,
    SETTINGS,
    SHOWN_SIZE,
    WIDTH,
    WORK_BLOCK,
    Call,
)

_BLOCKS, _PITCH = int(Call.BLOCKS), int(Call.PITCH)
_MODEL, _SETTINGS, _WORK = int(Call.MODEL), int(Call.SETTINGS), int(Call.WORK)
_flight_at, _params_at, _work_at = map(lanes_at, (FLIGHT_BLOCK, PARAMS_BLOCK, WORK_BLOCK))
_settings_at, _plain_work_at = record_at(SETTINGS), record_at(WORK_BLOCK)


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


_WORDS, _FLOATS = types.Array(types.int64, 1, "C"), types.Array(types.float64, 2, "C")


@entry(signature=types.none(_WORDS, _FLOATS))
def show(call, shown):
    """Show all flights of a batch at the present instant.

    Args:
        call: (len(Call),) of a thread, as for `fly`; the field `observation` of its workspace is
            written.
        shown: (SHOWN_SIZE, n_blocks WIDTH), written: the rows of `quad_gym.records.SHOWN`.
    """
    p, settings, work = _params_at(call[_MODEL]), _settings_at(call[_SETTINGS]), call[_WORK]
    row, plain = _work_at(work).observation, _plain_work_at(work).observation
    for index in range(shown.shape[1] // WIDTH):
        _show(_flight_at(call[_BLOCKS] + index * call[_PITCH]), p, settings, row)
        for k in range(SHOWN_SIZE):
            for lane in range(WIDTH):
                shown[k, index * WIDTH + lane] = plain[k, lane]

"""What a user's task is shown of flights, for the views of `quad_gym.tasks`."""

from quad_gym.kernels.compiling import kernel, stage
from quad_gym.kernels.maths.linalg import load3, load4, load33
from quad_gym.kernels.maths.rotation import quaternion_to_dcm
from quad_gym.kernels.simd.blocks import lanes_of
from quad_gym.kernels.task.observation import put_relative, reference_shown


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
    """Write the numbers of `quad_gym.records.SHOWN`, in its order, but for whole ones."""
    reference = reference_shown(flight, p, settings)
    row[0] = flight.tick * p.dt
    k = _put(row, 1, load3(flight.r), 3)
    k = _put(row, k, load3(flight.v), 3)
    k = _put(row, k, load4(flight.q), 4)
    k = _put(row, k, load3(flight.w), 3)
    k = _put_matrix(row, k, quaternion_to_dcm(load4(flight.q)))
    k = _put(row, k, load3(flight.r_seen), 3)
    k = _put(row, k, load3(flight.v_seen), 3)
    k = _put_matrix(row, k, flight.R_seen)
    r, v, w = load3(flight.r_seen), load3(flight.v_seen), load3(flight.w_seen)
    k = put_relative(reference, row, k, r, v, load33(flight.R_seen), w)
    k = _put(row, k, flight.action, 4)
    k = _put(row, k, flight.last_action, 4)
    for vector in reference:
        k = _put(row, k, vector, 3)
    row[k] = flight.position_error
    row[k + 1] = flight.gate_next


@stage
def show_stage(flight, world, model, settings, work, stages, flag):
    """Fill the workspace's observation with what is shown."""
    _show(lanes_of(flight), lanes_of(model), settings, lanes_of(work).observation)

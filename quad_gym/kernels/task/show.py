"""Numbers for the views of user-defined tasks, see `quad_gym.records.SHOWN`."""

from quad_gym.kernels.compiling import kernel, stage
from quad_gym.kernels.maths.linalg import load3, load4, load33
from quad_gym.kernels.maths.rotation import quaternion_to_dcm
from quad_gym.kernels.simd.blocks import lanes_of
from quad_gym.kernels.task.observation import put_relative, reference_shown


@kernel
def _show(flight, p, settings, row):
    """Write the fields of `SHOWN` in order."""
    reference = reference_shown(flight, p, settings)
    R_BI = quaternion_to_dcm(load4(flight.q))
    for i in range(3):
        for j in range(3):
            row[3 * i + j] = R_BI[i][j]
    r, v, w = load3(flight.r_seen), load3(flight.v_seen), load3(flight.w_seen)
    k = put_relative(reference, row, 9, r, v, load33(flight.R_seen), w)
    for vector in reference:
        for i in range(3):
            row[k + i] = vector[i]
        k += 3


@stage
def show_stage(flight, world, model, settings, work, stages, flag):
    """Write the numbers for a task's view to the workspace's observation."""
    _show(lanes_of(flight), lanes_of(model), settings, lanes_of(work).observation)

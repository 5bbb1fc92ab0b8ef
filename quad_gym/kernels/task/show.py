"""Numbers for the views of user-defined tasks, see `quad_gym.records.SHOWN`."""

from quad_gym.kernels.compiling import stage
from quad_gym.kernels.maths.linalg import load3, load4, load33, store
from quad_gym.kernels.maths.rotation import quaternion_to_dcm
from quad_gym.kernels.task.observation import put_relative, reference_shown


@stage
def show_stage(flight, world, model, settings, work, stages, flag):
    """Write the fields of `SHOWN`, in order, to the workspace's observation."""
    row, reference = work.observation, reference_shown(flight, model, settings)
    R_BI = quaternion_to_dcm(load4(flight.q))
    for i in range(3):
        store(row[3 * i :], R_BI[i])
    r, v, w = load3(flight.r_seen), load3(flight.v_seen), load3(flight.w_seen)
    k = put_relative(reference, row, 9, r, v, load33(flight.R_seen), w)
    for vector in reference:
        store(row[k:], vector)
        k += 3

"""Innovations of all blocks of a measurement: the gate of each, and the statistics of all of them.

See `measurements/gate.py` for one block. Where one kind of measurement has been rejected
`max_rejections` times in a row, the filter is more likely wrong than the sensor, see `recovery.py`.
"""

import numpy as np

from quad_gym.kernels.compiling import kernel
from quad_gym.kernels.filter.recovery import follow_ratio, forget_corrections
from quad_gym.kernels.measurements.aid import judge_aids, mark_failed_aids
from quad_gym.kernels.measurements.blocks import judge
from quad_gym.kernels.measurements.blocks import mark_failed as mark_failed_blocks
from quad_gym.kernels.simd.lanes import logical_not, select
from quad_gym.records import AID_BLOCKS, AIDS, FEATURE_BLOCKS, SENSOR_GROUPS


@kernel
def judge_innovations(flight, p, work, settings, slow, stages, first_of_aids, mask, again):
    """Keep the innovations of the present measurements and mask those beyond the gate.

    Where measurements are processed in steps, the first decides for all.

    Args:
        flight: Record; keeps innovations, NIS, decisions and counters.
        p: Parameters as the filter believes them.
        work: Workspace, with `z` the innovation and `Rz` the measurement noise alone; afterwards
            `left_out` says how many numbers were masked in each lane.
        settings: What the batch does.
        slow: The settings, where sensors have slow errors, see `slow.py`, or None.
        stages: The table of stages, which has those of aiding sensors; None without slow errors.
        first_of_aids: Row at which aiding sensors begin.
        mask: Which lanes.
        again: Which lanes take a later step of measurements that they have met before.
    """
    zero = 0.0 * p.sigma_beta
    work.taking, work.again = select(mask, 1.0, 0.0), select(again, 1.0, 0.0)
    work.judged_nis, work.judged_freedoms, work.left_out = zero, zero, zero
    if slow is not None:
        judge_aids(flight, p, work, slow, stages, first_of_aids)
    judge(flight, p, work, settings, slow, 0)
    first = mask & (work.measured > 0.0) & logical_not(again)
    follow_ratio(flight, p, work.judged_nis, work.judged_freedoms, first)


@kernel
def mark_failed(flight, p, work, settings, slow, failed):
    """Say of the blocks of an update that failed as a whole that none was taken."""
    work.taking = select(failed, 1.0, 0.0)
    mark_failed_blocks(flight, p, work, settings, slow, 0)
    if slow is not None:
        mark_failed_aids(flight, work, slow)


@kernel
def forget_innovations(flight, feature_count, mask):
    """Begin an episode without innovations, where `mask`."""
    blocks = FEATURE_BLOCKS + feature_count
    for k in range(blocks + AIDS):
        s = k if k < blocks else k - blocks + AID_BLOCKS
        flight.block_nis[s] = select(mask, np.nan, flight.block_nis[s])
        flight.gate[s] = select(mask, 0.0, flight.gate[s])
        flight.rejections[s] = select(mask, 0.0, flight.rejections[s])
        for i in range(3):
            flight.innovation[s, i] = select(mask, np.nan, flight.innovation[s, i])
            flight.innovation_sigma[s, i] = select(mask, np.nan, flight.innovation_sigma[s, i])
    forget_corrections(flight, mask)
    for group in range(SENSOR_GROUPS):
        flight.rejected_in_row[group] = select(mask, 0.0, flight.rejected_in_row[group])
        flight.reopened[group] = select(mask, 0.0, flight.reopened[group])

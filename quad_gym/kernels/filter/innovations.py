"""Innovations of all blocks of a measurement: gate and statistics.

See `gate.py` for one block. Where one group of measurements has been rejected `max_rejections`
times in a row, the filter is more likely wrong than the sensor, see `recovery.py`.
"""

import numpy as np

from quad_gym.kernels.compiling import kernel
from quad_gym.kernels.filter.measurements import call_measured
from quad_gym.kernels.filter.recovery import follow_ratio, forget_corrections
from quad_gym.kernels.simd.lanes import logical_not, select
from quad_gym.records import AID_BLOCKS, AIDS, FEATURE_BLOCKS, SENSOR_GROUPS, Act

_GATE = int(Act.GATE)


@kernel
def gate_innovations(flight, p, work, settings, stages, mask, again):
    """Store the innovations of the present measurements and mask those beyond the gate.

    Where measurements are processed in steps, the first step decides for all.

    Args:
        flight: Record; keeps innovations, NIS, decisions and counters.
        p: Parameters assumed by the filter.
        work: Workspace, with `nu` the innovation and `Rz` the measurement noise; on return,
            `left_out` is how many numbers were masked in each lane.
        settings: Configuration of the batch.
        stages: Table of stages, with the sensors' stages.
        mask: Lanes to be updated.
        again: Lanes that process these measurements in a later step.
    """
    zero = 0.0 * p.sigma_beta
    work.taking, work.again = select(mask, 1.0, 0.0), select(again, 1.0, 0.0)
    work.judged_nis, work.judged_freedoms, work.left_out = zero, zero, zero
    call_measured(flight, p, work, settings, stages, _GATE)
    first = mask & (work.measured > 0.0) & logical_not(again)
    follow_ratio(flight, p, work.judged_nis, work.judged_freedoms, first)


@kernel
def forget_innovations(flight, feature_count, mask):
    """Reset the innovations at the start of an episode, in the lanes `mask`."""
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

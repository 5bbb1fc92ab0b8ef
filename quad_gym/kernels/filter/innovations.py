"""Innovations of all blocks of a measurement: gate and statistics.

See `gate.py` for one block. Where one group of measurements has been rejected `max_rejections`
times in a row, the filter is more likely wrong than the sensor, see `recovery.py`.
"""

import numpy as np

from quad_gym.kernels.compiling import kernel
from quad_gym.kernels.filter.measurements import call_measured
from quad_gym.kernels.filter.recovery import follow_ratio, forget_corrections
from quad_gym.kernels.maths.linalg import keep
from quad_gym.kernels.simd.blocks import reset
from quad_gym.kernels.simd.lanes import logical_not, select
from quad_gym.records import AID_BLOCKS, AIDS, FEATURE_BLOCKS, Act, FilterForm

MONITORED = int(FilterForm.GATE | FilterForm.INNOVATIONS)
"""Bits of a `FilterForm` with which innovations are stored, and the filter is monitored."""


@kernel
def gate_innovations(flight, p, work, settings, stages, mask, again):
    """Store the innovations of the present measurements and mask those beyond the gate.

    Where measurements are processed in steps, the first step decides for all: `again` are the lanes
    in a later step. On return, work.left_out counts the masked numbers of each lane.
    """
    zero = 0.0 * p.sigma_beta
    work.taking, work.again = select(mask, 1.0, 0.0), select(again, 1.0, 0.0)
    work.judged_nis, work.judged_freedoms, work.left_out = zero, zero, zero
    call_measured(flight, p, work, settings, stages, Act.GATE)
    first = mask & (work.measured > 0.0) & logical_not(again)
    follow_ratio(flight, p, work.judged_nis, work.judged_freedoms, first)


@kernel
def forget_innovations(flight, feature_count, mask):
    """Reset the innovations at the start of an episode, in the lanes `mask`."""
    blocks, none = FEATURE_BLOCKS + feature_count, (np.nan, np.nan, np.nan)
    for k in range(blocks + AIDS):
        s = k if k < blocks else k - blocks + AID_BLOCKS
        flight.block_nis[s] = select(mask, np.nan, flight.block_nis[s])
        flight.gate[s] = select(mask, 0.0, flight.gate[s])
        flight.rejections[s] = select(mask, 0.0, flight.rejections[s])
        keep(flight.innovation[s], mask, none)
        keep(flight.innovation_sigma[s], mask, none)
    forget_corrections(flight, mask)
    reset(flight, mask, 0.0, "rejected_in_row reopened")

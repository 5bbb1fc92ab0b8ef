"""Innovations of all blocks of a measurement: the gate of each, and what they tell together.

See `measurements/gate.py` for one block. A feature whose predicted direction is too uncertain for a
linear model is left out, too: as a direction's error is bounded it would pass any gate, and its
update would be wrong and sure of itself. Where one kind of measurement has been rejected
`gate_patience` times in a row, the filter is likelier wrong than the sensor, see `recovery.py`.
"""

import math

import numpy as np

from quad_gym.kernels.compiling import kernel
from quad_gym.kernels.filter.recovery import (
    FITTING_FEATURES,
    LARGEST,
    camera_fits,
    follow_drift,
    follow_ratio,
)
from quad_gym.kernels.maths.elementary import clip, maximum
from quad_gym.kernels.measurements.aid import mark_failed_aids
from quad_gym.kernels.measurements.gate import (
    count_in_row,
    judge_direction,
    judge_triple,
    mark_block,
    mask_block,
)
from quad_gym.kernels.simd.lanes import any_of, logical_not, select
from quad_gym.records import (
    AID_BLOCKS,
    AIDS,
    BASELINE_BLOCK,
    FEATURE_BLOCKS,
    POSITION_BLOCK,
    SENSOR_GROUPS,
    VELOCITY_BLOCK,
    FilterForm,
)

_GATE = int(FilterForm.GATE)


@kernel
def judge_innovations(
    flight,
    p,
    work,
    feature_count,
    use_position,
    use_baseline,
    use_velocity,
    form,
    mask,
    again,
    columns,
    slow,
):
    """Keep the innovations of the present measurements and mask those beyond the gate.

    Where measurements are processed in steps, the first decides for all.

    Args:
        flight: Record; keeps innovations, NIS, decisions and counters.
        p: Parameters as the filter believes them.
        work: Workspace, with `z` the innovation and `Rz` the measurement noise alone.
        feature_count: Features in use.
        use_position, use_baseline, use_velocity: Whether any lane has them.
        form: A `FilterForm`.
        mask: Which lanes.
        again: Which lanes take a later step of measurements that they have met before.
        columns: Rows of work.A in use.
        slow: The settings, where there may be aiding sensors, or None; these have been judged
            before.

    Returns:
        How many measurements were masked in each lane.
    """
    gating = (form & _GATE) != 0
    zero = 0.0 * p.sigma_beta
    left_out, total, freedoms = zero, zero, zero
    if slow is not None:
        left_out, total, freedoms = work.left_out, work.judged_nis, work.judged_freedoms
    count, side, up = zero, zero, zero
    trusted = camera_fits(flight, p)
    k = 0
    if use_position:
        has = mask & (flight.position_valid > 0.0)
        rejected, nis = judge_triple(
            flight, p, work, k, POSITION_BLOCK, has, again, gating, columns
        )
        # a fix that is rejected while the camera fits tells of GNSS, not of the filter
        counts = select(has & logical_not(rejected & trusted), 1.0, 0.0)
        total, freedoms = total + counts * nis, freedoms + 3.0 * counts
        if gating:
            mask_block(work, k, rejected, columns)
            count_in_row(flight, POSITION_BLOCK, has, rejected, again)
            left_out = left_out + select(rejected, 3.0, 0.0)
        k += 3
    if use_baseline:
        has = mask & (flight.baseline_valid > 0.0)
        rejected, _, scaled, nis = judge_direction(
            flight, p, work, k, BASELINE_BLOCK, has, again, gating, columns, np.inf
        )
        first = has & logical_not(again)
        follow_drift(flight, BASELINE_BLOCK, first, scaled[0], scaled[1], zero)
        counts = select(has & logical_not(rejected & trusted), 1.0, 0.0)
        total, freedoms = total + counts * nis, freedoms + 2.0 * counts
        if gating:
            mask_block(work, k, rejected, columns)
            count_in_row(flight, BASELINE_BLOCK, has, rejected, again)
            left_out = left_out + select(rejected, 3.0, 0.0)
        k += 3
    if use_velocity:
        has = mask & (flight.velocity_valid > 0.0)
        rejected, nis = judge_triple(
            flight, p, work, k, VELOCITY_BLOCK, has, again, gating, columns
        )
        total, freedoms = total + nis, freedoms + select(has, 3.0, 0.0)
        if gating:
            mask_block(work, k, rejected, columns)
            count_in_row(flight, VELOCITY_BLOCK, has, rejected, again)
            left_out = left_out + select(rejected, 3.0, 0.0)
        k += 3
    seen, refused = zero, zero
    for i in range(feature_count):
        if any_of(flight.feature_valid[i] > 0.0):
            has = mask & (flight.feature_valid[i] > 0.0)
            s = FEATURE_BLOCKS + i
            rejected, unsure, scaled, nis = judge_direction(
                flight, p, work, k, s, has, again, gating, columns, p.gate_uncertainty
            )
            total = total + nis
            freedoms = freedoms + select(has & logical_not(unsure), 2.0, 0.0)
            counts = select(has & logical_not(unsure | again), 1.0, 0.0)
            count = count + counts
            side = side + counts * clip(scaled[0], -LARGEST, LARGEST)
            up = up + counts * clip(scaled[1], -LARGEST, LARGEST)
            if gating:
                mask_block(work, k, rejected | unsure, columns)
                left_out = left_out + select(rejected | unsure, 3.0, 0.0)
                seen = seen + select(has & logical_not(unsure), 1.0, 0.0)
                refused = refused + select(rejected, 1.0, 0.0)
            k += 3
    if feature_count > 0:
        root = math.sqrt(maximum(count, 1.0))
        follow_drift(flight, FEATURE_BLOCKS, count > 0.0, side / root, up / root, zero)
    if gating and feature_count > 0:
        count_in_row(flight, FEATURE_BLOCKS, seen > 0.0, refused >= seen, again)
        fits = (seen - refused >= FITTING_FEATURES) & (2.0 * refused < seen) & logical_not(again)
        flight.fit_tick = select(fits, flight.tick, flight.fit_tick)
    first = mask & logical_not(again)
    follow_ratio(flight, p, total, freedoms, first)
    return left_out


@kernel
def mark_failed(flight, feature_count, failed, slow):
    """Say of the blocks of an update that failed as a whole that none was taken."""
    mark_block(flight, POSITION_BLOCK, failed & (flight.position_valid > 0.0))
    mark_block(flight, BASELINE_BLOCK, failed & (flight.baseline_valid > 0.0))
    mark_block(flight, VELOCITY_BLOCK, failed & (flight.velocity_valid > 0.0))
    for i in range(feature_count):
        mark_block(flight, FEATURE_BLOCKS + i, failed & (flight.feature_valid[i] > 0.0))
    if slow is not None:
        mark_failed_aids(flight, slow, failed)


@kernel
def forget_innovations(flight, feature_count, mask):
    """Begin an episode without innovations, where `mask`."""
    for k in range(FEATURE_BLOCKS + feature_count + AIDS):
        s = (
            k
            if k < FEATURE_BLOCKS + feature_count
            else k - FEATURE_BLOCKS - feature_count + AID_BLOCKS
        )
        flight.block_nis[s] = select(mask, np.nan, flight.block_nis[s])
        flight.gate[s] = select(mask, 0.0, flight.gate[s])
        flight.rejections[s] = select(mask, 0.0, flight.rejections[s])
        for i in range(3):
            flight.innovation[s, i] = select(mask, np.nan, flight.innovation[s, i])
            flight.innovation_sigma[s, i] = select(mask, np.nan, flight.innovation_sigma[s, i])
    for group in range(SENSOR_GROUPS):
        flight.rejected_in_row[group] = select(mask, 0.0, flight.rejected_in_row[group])
        flight.reopened[group] = select(mask, 0.0, flight.reopened[group])

"""Updates with delayed measurements, which arrive with their time stamps.

A measurement in transit waits in a flight's record, with the sums of the IMU when it was taken
(`kernels/sensors/common.py`). When it arrives, the estimate is retrodicted to that instant over
the IMU's samples since then (`preintegration.py`), updated as usual, and carried forward again. For
the covariance, the white noise of these samples is removed on the way back and added on the way
forward, as it is independent of the measurement. That neglects the drift of the biases in the
meantime, and the information of measurements taken in between on this noise. Storing every sample
and filtering again from the time stamp would neglect nothing.

Source: Y. Bar-Shalom, H. Chen and M. Mallick, "One-step solution for the multistep out-of-sequence-
measurement problem in tracking", IEEE Trans. Aerospace and Electronic Systems 40(1), 2004.
"""

from quad_gym.kernels.compiling import Stage, call_stage, kernel
from quad_gym.kernels.filter.error_state import (
    D,
    copy_triangle,
    keep_covariance,
    take_up_corrections,
)
from quad_gym.kernels.filter.gate import MONITORED
from quad_gym.kernels.filter.measurements import (
    choose_valid,
    count_failure,
    count_measured,
    forget_corrections,
)
from quad_gym.kernels.filter.preintegration import NOISE, put_noise, take_columns, take_mean
from quad_gym.kernels.filter.slow import (
    begin_to_carry_slow,
    carry_slow,
    shift_carried_slow,
    stages_of,
)
from quad_gym.kernels.numbers.blocks import keep_fields
from quad_gym.kernels.numbers.factors import eliminate
from quad_gym.kernels.numbers.lanes import any_of, logical_not, select
from quad_gym.kernels.numbers.linalg import (
    keep,
    load3,
    load33,
    load_block,
    load_column3,
    load_symmetric,
    outer,
    store,
    store_block,
)
from quad_gym.records import SENSORS, FilterForm

_ESTIMATE = "r_hat v_hat v_corrected R_hat b_a_hat b_g_hat"
_KEPT = f"{_ESTIMATE} w_meas update_failures"


@kernel
def _keep_estimate(flight, work, slow):
    """Copy the estimate, for lanes in which nothing arrives or an update fails."""
    keep_fields(work, flight, True, _KEPT, "kept_", "")
    all_lanes = flight.tick == flight.tick
    copy_triangle(work.kept_P, flight.P, 0, D, all_lanes)
    if slow is not None:
        keep_fields(work, flight, True, "slow_hat", "kept_", "")
        copy_triangle(work.kept_P_slow, flight.P_slow, D, slow.slow_states, all_lanes)


@kernel
def _matrix_of(row, k):
    return (
        (row[k], row[k + 1], row[k + 2]),
        (row[k + 3], row[k + 4], row[k + 5]),
        (row[k + 6], row[k + 7], row[k + 8]),
    )


@kernel
def _find_stamp(flight, p, work, sensor, delay, under_way, arrived):
    """Fill work.since_* with the IMU's sums at the arrival's time stamp, or with the present ones.

    Where a measurement arrives, w_meas becomes the rates at that instant, for lever arms.
    """
    keep_fields(work, flight, True, "turn bias_gain velocity position", "since_", "imu_")
    store(work.since_level, load3(flight.level_sum))
    stamps = flight.stamps[sensor]
    for slot in range(under_way + 1):
        row, here = stamps[slot], arrived & (stamps[slot, 0] == flight.tick - delay)
        keep(work.since_turn, here, _matrix_of(row, 1))
        keep(work.since_bias_gain, here, _matrix_of(row, 16))
        keep(work.since_velocity, here, (row[10], row[11], row[12]))
        keep(work.since_position, here, (row[13], row[14], row[15]))
        keep(flight.w_meas, here, (row[25], row[26], row[27]))
        keep(work.since_level, here, (row[28], row[29], row[30]))
    work.since_time = select(arrived, delay * p.dt, 0.0)
    work.since_noise = select(arrived, 1.0, 0.0)
    C_s, B_s = load33(work.since_turn), load33(work.since_bias_gain)
    B = load33(flight.imu_bias_gain)
    store(work.since_bias_gain, C_s @ (B - B_s))


@kernel
def _add_noise(flight, p, work, noise, slow, back):
    """Fill work.P with the propagated covariance and `noise` times the noise; return the pivot.

    work.columns has the propagated covariance, its covariances with slow errors, and the noise.
    """
    M, P, states = work.columns, work.P, 15
    for i in range(0, 15, 3):
        for j in range(0, i + 3, 3):
            block = load_block(M, i, j)
            for k in range(NOISE, NOISE + 6):
                block = block + outer(noise * load_column3(M, i, k), load_column3(M, j, k))
            store_block(P, i, j, block)
    if slow is not None:
        states = 15 + slow.slow_states
        carry_slow(flight, slow, p, work, noise, back)
    return eliminate(P, work.L, states, states)


@kernel
def _load_columns(flight, work, slow):
    """Fill work.columns with the covariance of fifteen states, and theirs with slow errors."""
    M = work.columns
    for i in range(0, 15, 3):
        store_block(M, i, i, load_symmetric(flight.P, i))
        for j in range(0, i, 3):
            block = load_block(flight.P, i, j)
            store_block(M, i, j, block)
            store_block(M, j, i, block.T)
    if slow is not None:
        for i in range(0, slow.slow_states, 3):
            for j in range(0, 15, 3):
                store_block(M, j, D + i, load_block(flight.P_slow, i, j).T)


@kernel
def _transpose(M):
    """Transpose the first fifteen columns of M."""
    for i in range(0, 15, 3):
        store_block(M, i, i, load_block(M, i, i).T)
        for j in range(0, i, 3):
            lower, upper = load_block(M, i, j), load_block(M, j, i)
            store_block(M, i, j, upper.T)
            store_block(M, j, i, lower.T)


@kernel
def _carry(flight, p, work, form, back, ticks, slow):
    """Propagate the estimate to the time stamp of the arrival, or from there to the present.

    Where the noise to be removed on the way back exceeds the uncertainty, none is removed.

    Args:
        flight: Record.
        p: Parameters assumed by the filter.
        work: Workspace.
        form: Options of the filter.
        back: True to propagate back in time.
        ticks: Ticks between the time stamp and the present.
        slow: The settings, where sensors have slow errors, see `slow.py`, or None.

    Returns:
        Lanes in which the covariance stays positive definite.
    """
    if (form & FilterForm.FIRST_ESTIMATES.value) != 0:
        take_up_corrections(flight, slow, load33(flight.R_hat), flight.tick == flight.tick)
    _load_columns(flight, work, slow)
    R_s, dR, dv, dr = take_mean(flight, p, work, back)
    put_noise(p, work, R_s, dR, dv)
    for side in range(2):  # A P, then A (A P)^T; covariances with slow errors and noise once
        columns = NOISE + 6 if side == 0 else 15
        take_columns(work, columns, R_s, dR, dv, dr, back)
        if side == 0:
            _transpose(work.columns)
    noise, sign = work.since_noise, -1.0 if back else 1.0
    if slow is not None:
        begin_to_carry_slow(slow, p, work, ticks)
    good = noise > 0.0
    for _ in range(2):
        good = _add_noise(flight, p, work, sign * noise, slow, back) >= 0.0
        if not any_of(logical_not(good)):
            break
        if back:
            noise = select(good, noise, 0.0)
    work.since_noise = noise
    keep_covariance(flight, slow, work.P, good)
    if slow is not None:
        shift_carried_slow(flight, slow, work, back)
    return good


@kernel
def _restore_estimate(flight, work, settings, arrived, good, slow):
    """Restore the saved estimate, except where a measurement arrived and its update succeeded.

    Where it failed, the sums of corrections are reset, as the last correction is undone.
    """
    old = logical_not(arrived & good)
    keep_fields(flight, work, old, _ESTIMATE, "", "kept_")
    keep_fields(flight, work, True, "w_meas", "", "kept_")
    copy_triangle(flight.P, work.kept_P, 0, D, old)
    if slow is not None:
        keep_fields(flight, work, old, "slow_hat", "", "kept_")
        copy_triangle(flight.P_slow, work.kept_P_slow, D, slow.slow_states, old)
    failed = arrived & old
    if (settings.form & MONITORED) != 0 and any_of(failed):
        forget_corrections(flight, failed)
    failures = select(failed, work.kept_update_failures, flight.update_failures)
    flight.update_failures = failures
    count_failure(flight, failed)


@kernel
def update_by_sensor(flight, p, work, settings, stages, slow):
    """Update with each delayed sensor in turn, then with all prompt ones, where `work.mask`.

    Args:
        flight: Record; reads the measurements and their validity, changes the estimate.
        p: Parameters assumed by the filter.
        work: Workspace.
        settings: Delays of the sensors.
        stages: Table of stages.
        slow: The settings, where sensors have slow errors, see `slow.py`, or None.
    """
    mask = work.mask > 0.0
    keep_fields(work, flight, True, "block_valid", "kept_", "")
    for sensor in range(SENSORS + 1):
        delayed = sensor != SENSORS
        delay = choose_valid(flight, work, settings, sensor)
        count_measured(flight, work, settings)
        measured = work.measured > 0.0
        arrived = mask & measured if delayed else mask
        if not any_of(mask & measured):
            continue
        store(work.since_level, load3(flight.level_sum))
        if delayed:
            _keep_estimate(flight, work, slow)
            _find_stamp(flight, p, work, sensor, delay, settings.under_way[sensor], arrived)
        good = arrived
        for leg in range(2 if delayed else 1):  # a loop, so that `_carry` is compiled once
            if delayed:
                good = good & _carry(flight, p, work, settings.form, leg == 0, delay, slow)
            if leg == 0:
                work.mask = select(good, 1.0, 0.0)
                call_stage(stages, Stage.UPDATE, flight, p, p, settings, work, 0)
        if delayed:
            good = good & (flight.update_failures == work.kept_update_failures)
            _restore_estimate(flight, work, settings, arrived, good, slow)
    keep_fields(flight, work, True, "block_valid", "", "kept_")
    work.mask = select(mask, 1.0, 0.0)
    if settings.by_motion:
        call_stage(stages, Stage.HEADING, flight, p, p, settings, work, 0)


late_update_stage, late_update_with_slow_stage = stages_of("late_update", update_by_sensor)

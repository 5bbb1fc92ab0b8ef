"""Time stamps: what the IMU had summed up when a measurement was taken, for the way back to it."""

import numpy as np

from quad_gym.kernels.compiling import kernel
from quad_gym.kernels.maths.linalg import keep3, keep33
from quad_gym.kernels.simd.lanes import select
from quad_gym.records import DELAY_SLOTS, STAMP


@kernel
def forget_stamps(stamps, mask):
    """Begin an episode with nothing in transit, where `mask`."""
    for slot in range(DELAY_SLOTS):
        stamps[slot, 0] = select(mask, np.nan, stamps[slot, 0])


@kernel
def put_stamp(stamps, flight, taken):
    """Move the stamps of a sensor, (DELAY_SLOTS, STAMP), on and stamp the first with now."""
    for slot in range(DELAY_SLOTS - 1, 0, -1):
        for i in range(STAMP):
            stamps[slot, i] = select(taken, stamps[slot - 1, i], stamps[slot, i])
    row = stamps[0]
    row[0] = select(taken, flight.tick, row[0])
    for i in range(3):
        for j in range(3):
            k = 1 + 3 * i + j
            row[k] = select(taken, flight.imu_turn[i, j], row[k])
            row[k + 15] = select(taken, flight.imu_bias_gain[i, j], row[k + 15])
        row[10 + i] = select(taken, flight.imu_velocity[i], row[10 + i])
        row[13 + i] = select(taken, flight.imu_position[i], row[13 + i])
        row[25 + i] = select(taken, flight.w_meas[i], row[25 + i])


@kernel
def _matrix_of(row, k):
    return (
        (row[k], row[k + 1], row[k + 2]),
        (row[k + 3], row[k + 4], row[k + 5]),
        (row[k + 6], row[k + 7], row[k + 8]),
    )


@kernel
def go_to_stamp(row, flight, work, here):
    """Fill work.since_*, and the rates that a lever arm is turned with, from a stamp."""
    keep33(work.since_turn, here, _matrix_of(row, 1))
    keep33(work.since_bias_gain, here, _matrix_of(row, 16))
    keep3(work.since_velocity, here, (row[10], row[11], row[12]))
    keep3(work.since_position, here, (row[13], row[14], row[15]))
    keep3(flight.w_meas, here, (row[25], row[26], row[27]))

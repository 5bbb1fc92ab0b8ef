"""The words of a flight's record that an update of its filter reads and writes."""

import functools
from typing import Any

import numpy as np
from numpy.typing import NDArray

from quad_gym.records.flight import PARTS
from quad_gym.records.layout import FLIGHT_BLOCK, offset_of
from quad_gym.records.sizes import FIRST_BLOCK, MAX_BLOCKS, WIDTH

_OF_CORE = {"tick", "filter_status", "diverged"}
_PARTS = {"filter", "watch", "late", "slow", "aids"}
_NOT_READ = {
    *("prediction_failures", "waiting", "waiting_valid", "aid_vector", "aid_scalar", "aid_matrix"),
    *("arc",),  # set by predictions alone
    *("stamps",),  # only the stamps of arriving measurements are gathered
}
_NOT_WRITTEN = {
    *("tick", "w_meas", "w_before", "gyro", "accel"),
    *("block_valid", "gnss_position", "gnss_baseline", "gnss_velocity"),
    *("pixels", "aid_measurement"),
    *("imu_turn", "imu_velocity", "imu_position", "imu_bias_gain"),
}


def words_of_update(settings: Any, used: frozenset[str]) -> tuple[NDArray[np.uint64], int]:
    """Return the words of an update as offsets of their first lane in a block.

    Words that an update writes come first; the second value is their number. `used` names the parts
    of a flight's record that are in use.
    """
    blocks = tuple(map(int, settings["sensor_blocks"]))
    return _words(used, int(settings["feature_count"]), int(settings["slow_states"]), blocks)


@functools.cache
def _words(
    used: frozenset[str], features: int, slow: int, sensor_blocks: tuple[int, ...]
) -> tuple[NDArray[np.uint64], int]:
    written: list[NDArray[np.int64]] = []
    read: list[NDArray[np.int64]] = []
    for part, fields in PARTS:
        for name, shape, *_ in fields:
            chosen = name in _OF_CORE if part == "core" else part in _PARTS & used
            if chosen and name not in _NOT_READ:
                first = offset_of(FLIGHT_BLOCK, name) // (8 * WIDTH)
                words = first + np.arange(np.prod(shape, dtype=int)).reshape(shape)
                (read if name in _NOT_WRITTEN else written).append(
                    _in_use(name, words, features, slow, sensor_blocks)
                )
    words = np.concatenate([*written, *read])
    return WIDTH * words.astype(np.uint64), sum(map(len, written))


def _in_use(
    name: str, words: NDArray[np.int64], features: int, slow: int, sensor_blocks: tuple[int, ...]
) -> NDArray[np.int64]:
    """The words of a field that a configuration uses."""
    if name == "L":
        return words[np.tril_indices(len(words))]
    if name == "L_slow":
        return words[:slow][np.tri(slow, words.shape[1], 15, dtype=bool)]
    if name == "pixels":
        words = words[:features]
    elif name == "slow_hat":
        words = words[:slow]
    elif words.ndim > 0 and len(words) == MAX_BLOCKS:
        blocks = [
            first + k
            for first, count in zip(FIRST_BLOCK, sensor_blocks, strict=True)
            for k in range(count)
        ]
        words = words[blocks]
    return words.ravel()

"""Records in memory: of a single flight, of WIDTH flights as a block, and parts of them.

In a block of flights (`block_dtype`) every field has a trailing axis of WIDTH. The scalar form
(`scalar_dtype`) has these fields without that axis. Kernels read both by field name. The numbers in
blocks have the precision of the process, and numbers in scalar records are float64.
"""

import functools
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from quad_gym.records.flight import FLIGHT_FIELDS, PARTS, WORK_FIELDS
from quad_gym.records.params import PARAMS_FIELDS, SETTINGS_FIELDS
from quad_gym.records.sizes import (
    ALIGNED,
    FIRST_BLOCK,
    MAX_BLOCKS,
    REAL,
    REAL_BYTES,
    TERMS,
    WIDTH,
    Field,
)

# --------------------------------------------------------------------------------------------------
# Records in memory: of a single flight, and of WIDTH flights as a block.
# --------------------------------------------------------------------------------------------------


def scalar_dtype(fields: tuple[Field, ...]) -> np.dtype:
    """Data type of the record of one flight, in float64."""
    return np.dtype([(f.name, f.kind, f.shape) for f in fields], align=True)


def block_dtype(fields: tuple[Field, ...]) -> np.dtype:
    """Data type of the record of WIDTH flights: every field with a trailing axis of WIDTH."""
    kinds = {"f8": REAL}
    return np.dtype(
        [(f.name, kinds.get(f.kind, f.kind), (*f.shape, WIDTH)) for f in fields], align=True
    )


FLIGHT, FLIGHT_BLOCK = scalar_dtype(FLIGHT_FIELDS), block_dtype(FLIGHT_FIELDS)
PARAMS, PARAMS_BLOCK = scalar_dtype(PARAMS_FIELDS), block_dtype(PARAMS_FIELDS)
WORK, WORK_BLOCK = scalar_dtype(WORK_FIELDS), block_dtype(WORK_FIELDS)

SAMPLES = ("gyro", "accel", "w_meas")
ESTIMATED = ("r_hat", "v_hat", "R_hat", "b_a_hat", "b_g_hat", "w_hat")
"""Fields of flights that kernels exchange with a user's estimator: after a tick they write samples,
and read the estimate before they observe it. Flights are larger than what most ticks need."""
EXCHANGE_BLOCK = block_dtype(
    tuple(
        Field(name, (3, 3) if name == "R_hat" else (3,), "mixed", "as in a flight")
        for name in (*SAMPLES, *ESTIMATED)
    )
)
SETTINGS = scalar_dtype(SETTINGS_FIELDS)


class Room(NamedTuple):
    """The memory of a block of flights: consecutive parts of the full record."""

    dtype: np.dtype  #: data type of a block: the fields that are stored
    skipped: int  #: bytes of the full record before the first stored field

    def holds(self, name: str) -> bool:
        """Return True if a field is stored."""
        return name in (self.dtype.names or ())


def offset_of(dtype: np.dtype, name: str) -> int:
    """Bytes from the beginning of a record to a field."""
    assert dtype.fields is not None
    return int(dtype.fields[name][1])


def room_of(used: frozenset[str]) -> Room:
    """Return the smallest room that holds the core and the parts in use.

    Kernels address the fields of the full record. A block in memory is a window of it: its address
    minus the skipped bytes is the address of the full record, and kernels access no field outside
    the window.
    """
    chosen = [i for i, (name, _) in enumerate(PARTS) if name in used | {"core"}]
    first = FLIGHT_FIELDS.index(PARTS[chosen[0]][1][0])
    # words begin at a multiple of 8 bytes, which a number of float32 of one flight may not
    while offset_of(FLIGHT_BLOCK, FLIGHT_FIELDS[first].name) % 8:
        first -= 1
    fields = FLIGHT_FIELDS[first : 1 + FLIGHT_FIELDS.index(PARTS[chosen[-1]][1][-1])]
    return Room(block_dtype(fields), offset_of(FLIGHT_BLOCK, fields[0].name))


def aligned_zeros(count: int, dtype: np.dtype) -> NDArray[Any]:
    """Return `count` zeroed records at an address that is a multiple of ALIGNED."""
    raw = np.zeros(count * dtype.itemsize + ALIGNED, np.uint8)
    start = -raw.ctypes.data % ALIGNED
    return raw[start : start + count * dtype.itemsize].view(dtype)


def field_of_flights(blocks: NDArray[Any], name: str, count: int) -> NDArray[Any]:
    """Return a copy of one field of the first `count` flights, as an array (count, ...).

    Numbers of single precision are returned as float64, in which analyses compute.
    """
    values = in_double(blocks[name])
    lane = values.ndim - 1
    values = values.transpose(0, lane, *range(1, lane)).copy()
    return values.reshape(-1, *values.shape[2:])[:count]


def in_double(values: NDArray[Any]) -> NDArray[Any]:
    """Return numbers of flights as float64, and words as they are."""
    return values.astype(np.float64) if values.dtype == np.float32 else values


@functools.cache
def places_of_lanes(dtype: np.dtype) -> NDArray[np.intp]:
    """Return where a block of a type holds each flight, as indices (n, WIDTH) of 4 bytes."""
    places = []
    for name in dtype.names or ():
        field = dtype[name]
        parts = field.base.itemsize // 4
        count = field.itemsize // (field.base.itemsize * WIDTH)
        row, part, lane = np.ogrid[:count, :parts, :WIDTH]
        found = offset_of(dtype, name) // 4 + (row * WIDTH + lane) * parts + part
        places.append(found.reshape(-1, WIDTH))
    return np.concatenate(places)


def parts_of(blocks: NDArray[Any]) -> NDArray[np.uint32]:
    """Return the memory of blocks in parts of 4 bytes, (blocks, n): see `places_of_lanes`."""
    return blocks.view(np.uint32).reshape(len(blocks), -1)


def put_in_flights(blocks: NDArray[Any], name: str, values: NDArray[Any]) -> None:
    """Write one field of the first flights from an array (count, ...)."""
    target, whole, shape = blocks[name], len(values) // WIDTH, values.shape[1:]
    last, axes = whole * WIDTH, range(2, 2 + len(shape))
    target[:whole] = values[:last].reshape(whole, WIDTH, *shape).transpose(0, *axes, 1)
    if last < len(values):
        rest = values[last:]
        target[whole, ..., : len(rest)] = rest.transpose(*range(1, rest.ndim), 0)


# --------------------------------------------------------------------------------------------------
# The words of a flight's record that an update of its filter reads and writes.
# --------------------------------------------------------------------------------------------------

_OF_CORE = {"tick", "diverged"}  # and `filter_status`, which is no number and is copied by itself
_PARTS = {"filter", "watch", "late", "slow", "aids"}
_NOT_READ = {
    "prediction_failures",
    "waiting",
    "waiting_valid",
    "aid_vector",
    "aid_scalar",
    "aid_matrix",
    "arc",  # set by predictions alone
    "stamps",  # only the stamps of arriving measurements are gathered
}
_NOT_WRITTEN = {
    "tick",
    "w_meas",
    "w_before",
    "gyro",
    "accel",
    "block_valid",
    "measurement",
    "imu_turn",
    "imu_velocity",
    "imu_position",
    "imu_bias_gain",
}


def words_of_update(settings: Any, used: frozenset[str]) -> tuple[NDArray[np.uint64], int]:
    """Return the words of an update as offsets of their first lane in a block.

    Words that an update writes come first; the second value is their number. `used` names the parts
    of a flight's record that are in use.
    """
    blocks = tuple(map(int, settings["sensor_blocks"]))
    return _words(used, int(settings["slow_states"]), blocks)


@functools.cache
def _words(
    used: frozenset[str], slow: int, sensor_blocks: tuple[int, ...]
) -> tuple[NDArray[np.uint64], int]:
    written: list[NDArray[np.int64]] = []
    read: list[NDArray[np.int64]] = []
    for part, fields in PARTS:
        for name, shape, *_ in fields:
            chosen = name in _OF_CORE if part == "core" else part in _PARTS & used
            if chosen and name not in _NOT_READ:
                first = offset_of(FLIGHT_BLOCK, name) // (REAL_BYTES * WIDTH)
                words = first + np.arange(np.prod(shape, dtype=int)).reshape(shape)
                (read if name in _NOT_WRITTEN else written).append(
                    _in_use(name, words, slow, sensor_blocks)
                )
    words = np.concatenate([*written, *read])
    return WIDTH * words.astype(np.uint64), sum(map(len, written))


def _in_use(
    name: str, words: NDArray[np.int64], slow: int, sensor_blocks: tuple[int, ...]
) -> NDArray[np.int64]:
    """The words of a field that a configuration uses."""
    if name == "P":
        return words[np.tril_indices(len(words))]
    if name == "P_slow":
        return words[:slow][np.tri(slow, words.shape[1], 15, dtype=bool)]
    if name == "slow_hat":
        words = words[:slow]
    elif words.ndim > 0 and len(words) == MAX_BLOCKS:
        blocks = [
            first + k
            for first, count in zip(FIRST_BLOCK, sensor_blocks, strict=True)
            for k in range(count)
        ]
        words = words[blocks]
    return words.ravel()


# --------------------------------------------------------------------------------------------------
# Users' trajectories as records, shared by all flights of a batch.
#
# A path is a row of PATH; its segments are consecutive rows of PIECE.
# --------------------------------------------------------------------------------------------------

# fmt: off
PATH_FIELDS = (
    Field("first", (), "-", "index of the first piece", "i8"),
    Field("pieces", (), "-", "number of pieces", "i8"),
    Field("closed", (), "0 or 1", "1 if the path repeats", "i8"),
    Field("duration", (), "s", "duration of the path, or of one round"),
    Field("heading", (), "-", "0: toward the point; 2: along the velocity; 3: the yaw"),
    Field("point", (2,), "m", "point that body x faces, in I"),
    Field("begin_heading", (2,), "-", "horizontal direction of the velocity at the start, even from rest"),
    Field("end_heading", (2,), "-", "horizontal direction of the velocity at the end"),
)
PIECE_FIELDS = (
    Field("begin", (), "s", "time at which the segment begins"),
    Field("terms", (TERMS, 4), "mixed", "coefficients of x, y, z [m] and yaw [rad], the highest power first"),
)
# fmt: on

PATH, PIECE = scalar_dtype(PATH_FIELDS), scalar_dtype(PIECE_FIELDS)

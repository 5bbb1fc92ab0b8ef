"""Records in memory: a flight by itself, and WIDTH flights side by side.

In a block of flights (`block_dtype`) every field has a trailing axis of WIDTH. The scalar form
(`scalar_dtype`) has the same fields without it. Kernels read both by field name.
"""

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from quad_gym.records.flight import FLIGHT_FIELDS, PARTS
from quad_gym.records.params import PARAMS_FIELDS
from quad_gym.records.settings import SETTINGS_FIELDS
from quad_gym.records.sizes import WIDTH, Field
from quad_gym.records.work import WORK_FIELDS


def scalar_dtype(fields: tuple[Field, ...]) -> np.dtype:
    """The record of one flight."""
    return np.dtype([(f.name, f.kind, f.shape) for f in fields], align=True)


def block_dtype(fields: tuple[Field, ...]) -> np.dtype:
    """The record of WIDTH flights: every field with a trailing axis of WIDTH."""
    return np.dtype([(f.name, f.kind, (*f.shape, WIDTH)) for f in fields], align=True)


FLIGHT, FLIGHT_BLOCK = scalar_dtype(FLIGHT_FIELDS), block_dtype(FLIGHT_FIELDS)
PARAMS, PARAMS_BLOCK = scalar_dtype(PARAMS_FIELDS), block_dtype(PARAMS_FIELDS)
WORK, WORK_BLOCK = scalar_dtype(WORK_FIELDS), block_dtype(WORK_FIELDS)
SETTINGS = scalar_dtype(SETTINGS_FIELDS)


class Room(NamedTuple):
    """The memory that a block of flights takes: parts of the full record, without a gap."""

    dtype: np.dtype
    """of the blocks: the fields that there is room for"""
    skipped: int
    """bytes of the full record before the first of them"""

    def holds(self, name: str) -> bool:
        """Whether there is room for a field."""
        return name in (self.dtype.names or ())


def offset_of(dtype: np.dtype, name: str) -> int:
    """Bytes from the beginning of a record to a field."""
    assert dtype.fields is not None
    return int(dtype.fields[name][1])


def room_of(used: frozenset[str]) -> Room:
    """The least room for the core, and for the parts that are used.

    Kernels know the full record alone. A block in memory is a window of it, so that its address,
    less what the window skips, is that of the full record, of which nothing else is touched.

    Args:
        used: Names of `PARTS`.
    """
    chosen = [i for i, (name, _) in enumerate(PARTS) if name in used | {"core"}]
    fields = [field for _, part in PARTS[chosen[0] : chosen[-1] + 1] for field in part]
    return Room(block_dtype(tuple(fields)), offset_of(FLIGHT_BLOCK, fields[0].name))


def aligned_zeros(count: int, dtype: np.dtype) -> NDArray[Any]:
    """`count` zeroed records that begin on a cache line."""
    raw = np.zeros(count * dtype.itemsize + 64, np.uint8)
    start = -raw.ctypes.data % 64
    return raw[start : start + count * dtype.itemsize].view(dtype)


def field_of_flights(blocks: NDArray[Any], name: str, count: int) -> NDArray[Any]:
    """One field of the first `count` flights, as an array (count, ...): a copy."""
    values = blocks[name]
    lane = values.ndim - 1
    values = values.transpose(0, lane, *range(1, lane)).copy()
    return values.reshape(-1, *values.shape[2:])[:count]

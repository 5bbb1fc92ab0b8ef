"""Tapes: the operations of a filter on a log, as a list that compiled code runs."""

from array import array
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from quad_gym.estimation.filtering.history import InputHistory
from quad_gym.estimation.filtering.samples import Measurement
from quad_gym.records import (
    AID_BLOCK,
    AID_ROW,
    BASELINE_BLOCK,
    FEATURE_BLOCKS,
    MEASUREMENT,
    NOISE_FIELDS,
    OPERATION,
    POSITION_BLOCK,
    VELOCITY_BLOCK,
    Operation,
)

_TRIPLES = (
    ("position_G", "gnss_position", POSITION_BLOCK),
    ("baseline_G", "gnss_baseline", BASELINE_BLOCK),
    ("velocity_G", "gnss_velocity", VELOCITY_BLOCK),
)
_NOISE = (*NOISE_FIELDS, "aid_sigma")
_PREDICT, _UPDATE = int(Operation.PREDICT), int(Operation.UPDATE)

BLANK = np.zeros(1, MEASUREMENT)
"""Record of a measurement of nothing, with the noise of the parameters."""
for _name in _NOISE:
    BLANK[_name] = np.nan


@dataclass(frozen=True, eq=False)
class Tape:
    """Inputs of a filter, and the operations that process them in order."""

    samples: NDArray[Any]  #: (n,) SAMPLE
    measurements: NDArray[Any]  #: (n,) MEASUREMENT
    operations: NDArray[Any]  #: (n,) OPERATION
    slots: int = 1  #: number of copies of the filter's memory that exist at a time
    kept: int = 0  #: number of estimates to store
    reported: int = 0  #: number of updates whose innovations are stored
    first: int = 0  #: number of the first measurement in the writer

    @property
    def valid(self) -> NDArray[np.bool_]:
        """(m, MAX_BLOCKS) True where a reported update has measured a block."""
        updates = self.operations[self.operations["code"] == Operation.UPDATE]
        updates = updates[updates["target"] >= 0]
        return np.asarray(self.measurements["valid"][updates["index"]] > 0.0)

    def without_estimates(self) -> "Tape":
        """Return the tape without storing estimates."""
        others = self.operations["code"] != Operation.KEEP
        return replace(self, operations=self.operations[others], kept=0)

    def after(self, first: int) -> "Tape":
        """Return the tape without its first operations."""
        return replace(self, operations=self.operations[first:])


def write_measurement(row: Any, m: Measurement) -> None:
    """Write a measurement into a blank record."""
    valid = row["valid"]
    for name, place, block in _TRIPLES:
        values = getattr(m, name)
        if values is not None:
            valid[block], row[place] = 1.0, values
    if m.pixels is not None:
        seen = np.asarray(~np.isnan(m.pixels).any(axis=1))
        valid[FEATURE_BLOCKS : FEATURE_BLOCKS + len(seen)] = seen
        row["pixels"][: len(seen)] = np.where(seen[:, np.newaxis], m.pixels, 0.0)
    for aid, values in m.aids.items():
        count, length = values.shape
        known = ~np.isnan(values[:, 0])
        valid[AID_BLOCK[aid] : AID_BLOCK[aid] + count] = known
        place = row["aid_measurement"][AID_ROW[aid] : AID_ROW[aid] + count]
        place[:, :length] = np.where(known[:, np.newaxis], values, 0.0)
    for name, value in m.noise.items():
        if name == "aid_sigma":
            for aid, sigma in value.items():
                row[name][aid] = sigma
        else:
            row[name] = value


_AT_ONCE = 4096  #: operations of a piece of a tape


@dataclass(eq=False)
class TapeWriter:
    """Writes the operations that process inputs in the order of their arrival.

    It keeps numbers, not objects: a long log has millions of inputs. A measurement is made from the
    log again when its piece of the tape is run.
    """

    make: Callable[[int, int], Measurement]
    """returns a measurement by the numbers of its stream and row"""
    history: InputHistory
    rows: "array[int]" = field(default_factory=lambda: array("q"))
    """stream and row of each measurement"""
    _parts: list[NDArray[np.int32]] = field(default_factory=list)

    def write(self, inputs: NDArray[Any]) -> None:
        """Write the operations that process inputs (n,) INPUT."""
        for operations in self.history.take(inputs):
            self._parts.append(operations.view(np.int64).reshape(-1, 3).astype(np.int32))

    def keep(self) -> None:
        """Store the estimate at the end."""
        kept = sum(int((part[:, 0] == Operation.KEEP).sum()) for part in self._parts)
        self._parts.append(np.array([[Operation.KEEP, 0, kept]], np.int32))

    @cached_property
    def _operations(self) -> NDArray[np.int32]:
        """(n, 3) all operations."""
        return np.concatenate([np.empty((0, 3), np.int32), *self._parts])

    @cached_property
    def slots(self) -> int:
        """Number of copies that exist at a time.

        A copy overwrites the oldest one that is not restored any more.
        """
        codes, _, targets = self._operations.T
        copies = np.maximum.accumulate(np.where(codes == Operation.COPY, targets + 1, 0))
        return 1 + int((copies - targets)[codes == Operation.RESTORE].max(initial=1))

    @property
    def updates(self) -> NDArray[np.int32]:
        """(n,) numbers of the measurements in the order in which they are reported."""
        codes, indices, targets = self._operations.T
        return indices[(codes == Operation.UPDATE) & (targets >= 0)]

    def measurement(self, index: int) -> Measurement:
        """Return a measurement of the tape."""
        return self.make(*self.rows[2 * index : 2 * index + 2])

    def tape(self) -> Tape:
        """Return the tape."""
        return self._piece(0, len(self._operations))

    def pieces(self) -> Iterator[Tape]:
        """Yield the tape in pieces, each with its own inputs and numbers of results."""
        count = len(self._operations)
        for first in range(0, max(count, 1), _AT_ONCE):
            yield self._piece(first, min(first + _AT_ONCE, count))

    def _piece(self, first: int, end: int) -> Tape:
        """Return the operations from one up to another, with numbers that begin at zero."""
        numbers = self._operations[first:end].astype(np.int64)
        codes, indices, targets = numbers.T
        updates, keeps = codes == Operation.UPDATE, codes == Operation.KEEP
        copies = (codes == Operation.COPY) | (codes == Operation.RESTORE)
        targets[copies] %= self.slots
        kept = _from_zero(targets, keeps)
        reported = _from_zero(targets, updates & (targets >= 0))
        samples = _from_zero(indices, codes == Operation.PREDICT)
        measured = _from_zero(indices, updates)
        records = np.repeat(BLANK, measured[1] - measured[0])
        for row, index in zip(records, range(*measured), strict=True):
            write_measurement(row, self.measurement(index))
        return Tape(
            self.history.samples[slice(*samples)].copy(),
            records,
            numbers.view(OPERATION).ravel(),
            self.slots,
            kept[1] - kept[0],
            reported[1] - reported[0],
            measured[0],
        )


def _from_zero(numbers: NDArray[Any], chosen: NDArray[Any]) -> tuple[int, int]:
    """Subtract the least of some numbers from them; return it, and the end of their range."""
    some = numbers[chosen]
    if not len(some):
        return 0, 0
    least, end = int(some.min()), int(some.max()) + 1
    numbers[chosen] -= least
    return least, end


ONE_PREDICTION = np.array([(_PREDICT, 0, -1)], OPERATION)
ONE_UPDATE = np.array([(_UPDATE, 0, -1)], OPERATION)

"""Tapes: the operations of a filter on a log, as a list that compiled code runs."""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from quad_gym.estimation.samples import Measurement, Sample
from quad_gym.records import (
    AID_BLOCKS,
    BASELINE_BLOCK,
    FEATURE_BLOCKS,
    MEASUREMENT,
    NOISE_FIELDS,
    OPERATION,
    POSITION_BLOCK,
    SAMPLE,
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


def samples_record(samples: Sequence[Sample]) -> NDArray[Any]:
    """Return samples as records."""
    found = np.empty(len(samples), SAMPLE)
    for name in SAMPLE.names or ():
        if samples:
            found[name] = [getattr(sample, name) for sample in samples]
    return found


def measurements_record(measurements: Sequence[Measurement]) -> NDArray[Any]:
    """Return measurements as records."""
    found = np.repeat(BLANK, len(measurements))
    for row, measurement in zip(found, measurements, strict=True):
        write_measurement(row, measurement)
    return found


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
        valid[AID_BLOCKS + aid] = 1.0
        row["aid_measurement"][aid, : len(values)] = values
    for name, value in m.noise.items():
        if name == "aid_sigma":
            for aid, sigma in value.items():
                row[name][aid] = sigma
        else:
            row[name] = value


@dataclass(eq=False)
class TapeWriter:
    """Writes the operations that process inputs in the order of their arrival.

    Its methods `apply`, `copy` and `restore` are those that an `InputHistory` asks for.
    """

    samples: list[Sample] = field(default_factory=list)
    measurements: list[Measurement] = field(default_factory=list)
    operations: list[tuple[int, int, int]] = field(default_factory=list)
    awaited: Measurement | None = None  #: measurement whose next update is reported
    kept: int = 0
    reported: int = 0
    _places: dict[int, int] = field(default_factory=dict)
    _copies: int = 0
    _oldest: int = 1  #: age of the oldest copy that was restored, in copies

    def apply(self, given: Sample | Measurement) -> None:
        """Process a sample or a measurement."""
        index = self._places.get(id(given))
        if index is None:
            known: list[Any] = self.samples if isinstance(given, Sample) else self.measurements
            index = self._places[id(given)] = len(known)
            known.append(given)  # which keeps it alive, and its identity unique
        if isinstance(given, Sample):
            self.operations.append((_PREDICT, index, -1))
            return
        target = -1
        if given is self.awaited:
            self.awaited, target = None, self.reported
            self.reported += 1
        self.operations.append((_UPDATE, index, target))

    def copy(self) -> int:
        """Copy the memory; return the number of the copy."""
        self.operations.append((Operation.COPY, 0, self._copies))
        self._copies += 1
        return self._copies - 1

    def restore(self, number: int) -> None:
        """Restore a copy."""
        self._oldest = max(self._oldest, self._copies - number)
        self.operations.append((Operation.RESTORE, 0, number))

    def keep(self) -> None:
        """Store the estimate."""
        self.operations.append((Operation.KEEP, 0, self.kept))
        self.kept += 1

    def tape(self) -> Tape:
        """Return the tape; a copy overwrites the oldest one that is not restored any more."""
        operations = np.array(self.operations, np.int64).reshape(-1, 3).view(OPERATION).ravel()
        copies = (operations["code"] == Operation.COPY) | (operations["code"] == Operation.RESTORE)
        slots = self._oldest + 1
        operations["target"][copies] %= slots
        return Tape(
            samples_record(self.samples),
            measurements_record(self.measurements),
            operations,
            slots,
            self.kept,
            self.reported,
        )


ONE_PREDICTION = np.array([(_PREDICT, 0, -1)], OPERATION)
ONE_UPDATE = np.array([(_UPDATE, 0, -1)], OPERATION)

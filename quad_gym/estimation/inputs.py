"""Inputs of a filter: IMU samples and measurements, checked, kept in a window, and on tapes."""

import math
from array import array
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from quad_gym.kernels import entries
from quad_gym.params import checks as check
from quad_gym.params.sensor_table import READINGS
from quad_gym.params.suites import SensorSuite
from quad_gym.records import BLOCKS_OF, MEASUREMENT, OPERATION, SAMPLE, Operation
from quad_gym.records.inputs import EVENT, INPUT, PENDING, WINDOW

# --------------------------------------------------------------------------------------------------
# Inputs of a filter, checked: IMU samples, and measurements of one instant.
# --------------------------------------------------------------------------------------------------

Floats = NDArray[np.float64]

HEADING_ALONE = 4.0
"""Value of the noise `baseline_sigma`, above the largest one of pi, with which a filter uses only
the heading of a baseline; its noise is then the suite's [rad]."""


def known_blocks(values: Floats) -> NDArray[np.bool_]:
    """Return True for the rows of `values` (blocks, length) that were measured."""
    return np.asarray(~np.isnan(values).any(axis=1))


@dataclass(frozen=True, eq=False)
class Measurement:
    """Measurements of one instant, by the names of their readings."""

    values: dict[str, Floats] = field(default_factory=dict)
    """(blocks, length) numbers as in records, NaN: a block was not measured"""
    sigmas: dict[str, Floats] = field(default_factory=dict)
    """(1,) or (3,) standard deviations that replace the suite's"""

    @property
    def empty(self) -> bool:
        """True if nothing was measured."""
        return not self.values

    @property
    def blocks(self) -> list[int]:
        """Blocks of innovations of the measurement."""
        return [
            blocks.start + int(i)
            for name, blocks in BLOCKS_OF.items()
            if name in self.values
            for i in np.flatnonzero(known_blocks(self.values[name]))
        ]


def keyword_of(name: str) -> str:
    """Return the keyword of a reading: names of vectors in G say so."""
    return f"{name}_G" if READINGS[name].in_G else name


def checked_measurement(sensors: SensorSuite, given: Mapping[str, Any]) -> Measurement:
    """Check the arguments of `update` by their keywords; None: not measured."""
    values, sigmas = {}, {}
    for name, reading in READINGS.items():
        if (value := given.get(keyword_of(name))) is not None:
            values[name] = _checked_value(sensors, name, value)
        if (sigma := given.get(reading.sigma)) is not None:
            if name not in values:
                raise ValueError(f"{reading.sigma} must come with its measurement")
            sigmas[name] = checked_sigma(name, sigma)
    return Measurement(values, sigmas)


def require_gnss(sensors: SensorSuite, what: str) -> None:
    """Refuse an operation that requires GNSS."""
    if sensors.gnss is None:
        raise ValueError(f"the sensor suite has no GNSS to {what}")


def _checked_value(sensors: SensorSuite, name: str, value: Any) -> Floats:
    """Return a measurement (blocks, length) of a reading."""
    reading, count, keyword = READINGS[name], sensors.blocks_of(name), keyword_of(name)
    if count == 0:
        words = name.replace("gnss", "GNSS").replace("_", " ")
        raise ValueError(f"the sensor suite has no {words} to update with")
    if name == "gnss_baseline":
        return checked_baseline(sensors, value)[np.newaxis]
    several = reading.most_blocks > 1
    if not several and reading.length == 1:
        return np.array([[check.number(keyword, value)]])
    found = check.array(keyword, value, sensors.shape_of(name), allow_nan=several)
    return found.reshape(count, reading.length)


def checked_baseline(sensors: SensorSuite, gnss_baseline_G: ArrayLike) -> Floats:
    """Return a baseline (3,), scaled by a power of two: its length is not used."""
    if sensors.gnss is not None and not sensors.gnss.has_baseline:
        raise ValueError("gnss_baseline_G must be None for GNSS with one antenna")
    baseline = check.array("gnss_baseline_G", gnss_baseline_G, (3,))
    largest = np.abs(baseline).max()
    if largest == 0.0:
        raise ValueError("gnss_baseline_G must have a direction, got zeros")
    # a power of two brings it near one without rounding
    return np.ldexp(baseline, -int(np.frexp(largest)[1]))


def checked_sigma(name: str, value: Any) -> Floats:
    """Return the standard deviations of a reading, of a number or as many."""
    reading = READINGS[name]
    least = reading.least_sigma
    if np.ndim(value) == 0 or reading.sigmas == 1:
        sigma = check.positive(reading.sigma, value, least=least)
        if name == "gnss_baseline":
            sigma = min(sigma, math.pi)
        return np.full(reading.sigmas, sigma)
    sigmas = check.array(reading.sigma, value, (reading.sigmas,))
    if not (sigmas >= least).all():
        raise ValueError(f"{reading.sigma} must be at least {least:g}, got {value!r}")
    return sigmas


# --------------------------------------------------------------------------------------------------
# The window of past inputs of a filter: Python's side of `quad_gym.kernels.tape`.
# --------------------------------------------------------------------------------------------------

_EVERY = 8  #: events between two copies of the state: a copy costs about as much as an event
_ROOM = {EVENT: 256, SAMPLE: 256, PENDING: 16, OPERATION: 2048}  #: records in memory at first
_OPERATIONS = list(_ROOM).index(OPERATION)


class InputHistory:
    """The samples and measurements of a window of time, and the operations that process them.

    Args:
        window: Length of the window [s].
        longest: Longest duration of a sample [s].
        numbered: True: samples, measurements and copies are numbered in the order of their arrival;
            False: numbers of those that have left the window are used again.
    """

    def __init__(self, window: float, longest: float, numbered: bool = False) -> None:
        self.window, self._longest, self._numbered = window, longest, numbered
        self._state, self.one = np.zeros(1, WINDOW), np.zeros(1, INPUT)
        self._call: Callable[[], Any] | None = None
        self._memory = [np.zeros(count, kind) for kind, count in _ROOM.items()]
        self.begin(0.0)

    def begin(self, time: float) -> None:
        """Begin at a time [s], with no events."""
        self._state[:] = np.zeros(1, WINDOW)
        settings = {"length": self.window, "longest": self._longest, "ahead": math.inf}
        for name, value in {**settings, "copy_every": _EVERY, "time": time, "oldest": time}.items():
            self._state[name] = value
        self._limit_numbers()

    @property
    def time(self) -> float:
        """Time up to which the inputs reach [s]."""
        return float(self._state["time"][0])

    @property
    def oldest(self) -> float:
        """Earliest time stamp that can still be included [s]."""
        return float(self._state["oldest"][0])

    @property
    def samples(self) -> NDArray[Any]:
        """Samples (n,) SAMPLE, by their numbers."""
        return self._memory[1]

    def take(self, inputs: NDArray[Any]) -> Iterator[NDArray[Any]]:
        """Yield the operations (n,) OPERATION that process inputs (n,) INPUT, part by part.

        Operations are valid until the next part. After an input with an error it takes no more.
        """
        first = 0
        while first < len(inputs):
            if inputs is not self.one:
                entries.take_inputs(self._state, *self._memory, inputs[first:])
            else:
                if self._call is None:
                    self._call = entries.take_inputs.bound(self._state, *self._memory, inputs)
                self._call()
            _, _, _, operations = self._memory
            yield operations[: self._state["operations"][0]]
            taken, shortage = int(self._state["taken"][0]), int(self._state["shortage"][0])
            first += taken
            if shortage < 0 and first < len(inputs):
                return
            if shortage >= 0 and not (taken and shortage == _OPERATIONS):
                old = self._memory[shortage]
                self._memory[shortage] = np.concatenate([old, np.zeros_like(old)])
                self._call = None
                self._limit_numbers()

    def _limit_numbers(self) -> None:
        """Use numbers again as far as memory for what they refer to suffices."""
        events, samples, _, _ = map(len, self._memory)
        self._state["room"] = 0 if self._numbered else (samples, events, events)

    def __getstate__(self) -> dict[str, Any]:
        """Return the state without addresses, which another process or copy does not share."""
        return self.__dict__ | {"_call": None}


# --------------------------------------------------------------------------------------------------
# Tapes: the operations of a filter on a log, as a list that compiled code runs.
# --------------------------------------------------------------------------------------------------

_PREDICT, _UPDATE = int(Operation.PREDICT), int(Operation.UPDATE)

_GROUP = {name: group for group, name in enumerate(READINGS)}
BLANK = np.zeros(1, MEASUREMENT)
"""Record of a measurement of nothing, with the noise of the parameters."""
BLANK["sigma"] = np.nan


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
    for name, values in m.values.items():
        first, (count, length) = BLOCKS_OF[name].start, values.shape
        known = known_blocks(values)
        row["valid"][first : first + count] = known
        blocks = row["measurement"][first : first + count, :length]
        blocks[...] = np.where(known[:, np.newaxis], values, 0.0)
    for name, sigmas in m.sigmas.items():
        row["sigma"][_GROUP[name], : len(sigmas)] = sigmas


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

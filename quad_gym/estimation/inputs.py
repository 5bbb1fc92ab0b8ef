"""Inputs of a filter: IMU samples and measurements, checked, kept in a window, and on tapes."""

import math
from array import array
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, NoReturn

import numpy as np
from numpy.typing import NDArray

from quad_gym.kernels import entries
from quad_gym.params import checks as check
from quad_gym.params.sensor_table import READINGS
from quad_gym.params.suites import SensorSuite
from quad_gym.records import BLOCKS_OF, MEASUREMENT, OPERATION, SAMPLE, Operation
from quad_gym.records.inputs import EVENT, INPUT, PENDING, WINDOW, Outcome

# --------------------------------------------------------------------------------------------------
# Inputs of a filter, checked: IMU samples, and measurements of one instant.
# --------------------------------------------------------------------------------------------------

Floats = NDArray[np.float64]

HEADING_ALONE = 4.0
"""Standard deviation of a baseline, above the largest one of pi, with which a filter uses only its
heading; its noise is then the suite's [rad]."""

Measurement = NDArray[Any]
"""Measurements of one instant, (1,) MEASUREMENT."""

GROUP = {name: group for group, name in enumerate(READINGS)}
"""Numbers of the readings, as groups of the gate."""


_OK = int(Outcome.OK)
_KEYWORDS = tuple(
    (reading.keyword, reading.sigma, name, GROUP[name]) for name, reading in READINGS.items()
)
"""Keywords of a reading and of its standard deviation, its name and its number."""


def checked_measurement(sensors: SensorSuite, given: Mapping[str, Any]) -> Measurement:
    """Return the measurements given by the keywords of `update`; None: not measured."""
    found = np.zeros(1, MEASUREMENT)
    for keyword, of_sigma, name, group in _KEYWORDS:
        if (value := given.get(keyword)) is not None:
            _put(found, sensors, name, keyword, value)
        if (sigma := given.get(of_sigma)) is not None:
            count = READINGS[name].sigmas
            shape = () if count == 1 or np.ndim(sigma) == 0 else (count,)
            numbers = check.shaped(of_sigma, sigma, shape)
            # a record with 0 has none
            found["sigma"][0, group, :count] = np.where(numbers == 0.0, -1.0, numbers)
    entries.check_measurement(found)
    if found["outcome"][0] != _OK:
        _refuse(found[0], given)
    return found


def _put(
    measurement: Measurement, sensors: SensorSuite, name: str, keyword: str, value: Any
) -> None:
    """Write the value of a reading into a measurement."""
    count, first = sensors.blocks_of(name), BLOCKS_OF[name].start
    if count == 0 and np.size(value):
        words = name.replace("gnss", "GNSS").replace("_", " ")
        raise ValueError(f"{keyword} must be None: the sensor suite has no {words}")
    numbers, length = check.shaped(keyword, value, sensors.shape_of(name)), READINGS[name].length
    measurement["valid"][0, first : first + count] = 1.0
    blocks = measurement["measurement"][0, first : first + count, :length]
    blocks[...] = numbers.reshape(count, length)


def _refuse(row: Any, given: Mapping[str, Any]) -> NoReturn:
    """Raise the error of a measurement that the check refuses."""
    culprit = int(row["culprit"])
    name = list(READINGS)[culprit % len(READINGS)]
    of_sigma, reading = culprit >= len(READINGS), READINGS[name]
    keyword = reading.sigma if of_sigma else reading.keyword
    value, outcome = given[keyword], row["outcome"]
    if outcome == Outcome.CONTRADICTION:
        raise ValueError(f"{keyword} must come with its measurement, {reading.keyword}")
    if outcome == Outcome.NOT_FINITE:
        raise ValueError(f"{keyword} must be finite, got {value!r}")
    if of_sigma:
        raise ValueError(
            f"{keyword} must be at least {reading.least_sigma:g}, and at most {check.LARGEST:g}, "
            f"got {value!r}"
        )
    raise ValueError(f"{keyword} must have a direction, got zeros")


def measured_blocks(measurement: Measurement) -> list[int]:
    """Return the blocks of innovations of a measurement."""
    return [int(block) for block in np.flatnonzero(measurement["valid"][0])]


def values_of(measurement: Measurement, name: str, count: int) -> Floats:
    """Return the first blocks of a reading, (count, length); NaN: not measured."""
    blocks = slice(BLOCKS_OF[name].start, BLOCKS_OF[name].start + count)
    numbers = measurement["measurement"][0, blocks, : READINGS[name].length]
    values: Floats = np.array(numbers, np.float64)
    values[measurement["valid"][0, blocks] == 0.0] = np.nan
    return values


def sigmas_of(measurement: Measurement, name: str) -> Floats:
    """Return a measurement's own standard deviations of a reading; NaN: the suite's."""
    sigmas: Floats = measurement["sigma"][0, GROUP[name], : READINGS[name].sigmas]
    return sigmas


def require_gnss(sensors: SensorSuite, what: str) -> None:
    """Refuse an operation that requires GNSS."""
    if sensors.gnss is None:
        raise ValueError(f"the sensor suite has no GNSS to {what}")


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

NOTHING = np.zeros(1, MEASUREMENT)
"""A measurement of nothing, with the noise of the parameters."""
NOTHING["sigma"] = np.nan


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
        records = np.repeat(NOTHING, measured[1] - measured[0])
        for k, index in enumerate(range(*measured)):
            records[k : k + 1] = self.measurement(index)
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

"""Inputs of a filter: IMU samples and measurements, checked, kept in a window, and on tapes."""

import math
from array import array
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from quad_gym.kernels import entries
from quad_gym.params import checks as check
from quad_gym.params.suites import SensorSuite
from quad_gym.records import (
    AID_BLOCK,
    AID_ROW,
    BASELINE_BLOCK,
    FEATURE_BLOCKS,
    MEASUREMENT,
    NOISE_FIELDS,
    OPERATION,
    POSITION_BLOCK,
    SAMPLE,
    VELOCITY_BLOCK,
    Aid,
    Operation,
)
from quad_gym.records.inputs import EVENT, INPUT, PENDING, WINDOW

# --------------------------------------------------------------------------------------------------
# Inputs of a filter, checked: IMU samples, and measurements of one instant.
# --------------------------------------------------------------------------------------------------

Floats = NDArray[np.float64]

HEADING_ALONE = 4.0
"""Value of the noise `baseline_sigma`, above the largest one of pi, with which a filter uses only
the heading of a baseline; its noise is then the suite's [rad]."""

SIGMA_KEYWORDS = (
    "gnss_sigma",
    "baseline_sigma",
    "velocity_sigma",
    "pixel_sigma",
    *(f"{aid.name.lower()}_sigma" for aid in Aid),
)
"""Keywords of `update` for the noise of its measurements."""


@dataclass(frozen=True, eq=False)
class Measurement:
    """Measurements of one instant; None: not measured."""

    position_G: Floats | None = None  #: (3,) antenna position [m]
    baseline_G: Floats | None = None  #: (3,) baseline, scaled to a length near one [-]
    velocity_G: Floats | None = None  #: (3,) antenna velocity [m/s]
    pixels: Floats | None = None  #: (n_features, 2) image coordinates, NaN: not seen [pixels]
    aids: dict[Aid, Floats] = field(default_factory=dict)
    """(blocks, length) measurements of aiding sensors, NaN: a block was not measured"""
    noise: dict[str, Any] = field(default_factory=dict)
    """fields of the parameter record that replace the suite's for this measurement"""

    @property
    def empty(self) -> bool:
        """True if nothing was measured."""
        values = (self.position_G, self.baseline_G, self.velocity_G, self.pixels)
        return all(v is None for v in values) and not self.aids

    @property
    def blocks(self) -> list[int]:
        """Blocks of innovations of the measurement."""
        triples = enumerate((self.position_G, self.baseline_G, self.velocity_G))
        found = [POSITION_BLOCK + k for k, values in triples if values is not None]
        if self.pixels is not None:
            seen = ~np.isnan(self.pixels).any(axis=1)
            found += [FEATURE_BLOCKS + int(i) for i in np.flatnonzero(seen)]
        for aid, values in self.aids.items():
            found += [AID_BLOCK[aid] + int(i) for i in np.flatnonzero(~np.isnan(values[:, 0]))]
        return found


def checked_measurement(
    sensors: SensorSuite,
    position_G: ArrayLike | None,
    baseline_G: ArrayLike | None,
    pixels: ArrayLike | None,
    velocity_G: ArrayLike | None,
    others: dict[str, Any],
) -> Measurement:
    """Check the arguments of `update`.

    Args:
        sensors: The filter's suite.
        position_G: As in `update`.
        baseline_G: As in `update`.
        pixels: As in `update`.
        velocity_G: As in `update`.
        others: Measurements of aiding sensors by name, and noise by SIGMA_KEYWORDS.
    """
    aids = _checked_aids(sensors, others) if others else {}
    if position_G is not None or baseline_G is not None:
        require_gnss(sensors, "update")
    position = baseline = velocity = image = None
    if position_G is not None:
        position = check.array("gnss_position_G", position_G, (3,))
    if baseline_G is not None:
        baseline = checked_baseline(sensors, baseline_G)
    if pixels is not None:
        count = 0 if sensors.camera is None else len(sensors.camera.features_I)
        image = check.array("pixels", pixels, (count, 2), allow_nan=True)
    if velocity_G is not None:
        if sensors.gnss is None or sensors.gnss.velocity_sigma is None:
            raise ValueError("the sensor suite has no GNSS velocity to update with")
        velocity = check.array("gnss_velocity_G", velocity_G, (3,))
    if not others:
        return Measurement(position, baseline, velocity, image)
    measured = {
        "gnss_sigma": position is not None,
        "baseline_sigma": baseline is not None,
        "velocity_sigma": velocity is not None,
        "pixel_sigma": image is not None,
        **{f"{aid.name.lower()}_sigma": aid in aids for aid in Aid},
    }
    return Measurement(position, baseline, velocity, image, aids, _checked_noise(others, measured))


def require_gnss(sensors: SensorSuite, what: str) -> None:
    """Refuse an operation that requires GNSS."""
    if sensors.gnss is None:
        raise ValueError(f"the sensor suite has no GNSS to {what}")


def checked_baseline(sensors: SensorSuite, gnss_baseline_G: ArrayLike) -> Floats:
    """Return a baseline, scaled by a power of two: its length is not used."""
    if sensors.gnss is not None and not sensors.gnss.has_baseline:
        raise ValueError("gnss_baseline_G must be None for GNSS with one antenna")
    baseline = check.array("gnss_baseline_G", gnss_baseline_G, (3,))
    largest = np.abs(baseline).max()
    if largest == 0.0:
        raise ValueError("gnss_baseline_G must have a direction, got zeros")
    # a power of two brings it near one without rounding
    return np.ldexp(baseline, -int(np.frexp(largest)[1]))


def _checked_aids(sensors: SensorSuite, others: dict[str, Any]) -> dict[Aid, Floats]:
    """Return the measurements of aiding sensors as arrays; None: not measured."""
    names = tuple(aid.name.lower() for aid in Aid)
    check.keywords(others, names + SIGMA_KEYWORDS, "update")
    found = {}
    for name in names:
        aid, value = Aid[name.upper()], others.get(name)
        if value is None:
            continue
        if aid not in sensors.aids:
            raise ValueError(f"the sensor suite has no {name} to update with")
        params = sensors.aids[aid]
        alone, several = params.shape == (), params.most_blocks > 1
        numbers = [check.number(name, value)] if alone else value
        values = check.array(name, numbers, params.shape or (1,), allow_nan=several)
        found[aid] = values.reshape(params.blocks, params.length)
    return found


def gnss_noise(name: str, value: Any) -> Floats:
    """Return standard deviations (3,) in I [m] of a number or three."""
    if np.ndim(value) == 0:
        return np.full(3, check.positive(name, value, least=1e-9))
    sigmas = check.array(name, value, (3,))
    if not (sigmas >= 1e-9).all():
        raise ValueError(f"{name} must be at least 1e-9, got {value!r}")
    return sigmas


def _checked_noise(others: dict[str, Any], measured: dict[str, bool]) -> dict[str, Any]:
    """Return noise by fields of the parameter record."""
    noise: dict[str, Any] = {}
    for name in SIGMA_KEYWORDS:
        value = others.get(name)
        if value is None:
            continue
        if not measured[name]:
            raise ValueError(f"{name} must come with its measurement")
        if name == "gnss_sigma":
            noise["position_sigma_I"] = gnss_noise(name, value)
            continue
        sigma = check.positive(name, value, least=1e-12)
        if name == "baseline_sigma":
            noise["baseline_noise"] = noise["baseline_sigma"] = min(sigma, math.pi)
        elif name.removesuffix("_sigma").upper() in Aid.__members__:
            noise.setdefault("aid_sigma", {})[Aid[name.removesuffix("_sigma").upper()]] = sigma
        else:
            noise[name] = sigma
    return noise


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

"""The window of past inputs of a filter: Python's side of `quad_gym.kernels.window`."""

import math
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray

from quad_gym.kernels import entries
from quad_gym.records import OPERATION, SAMPLE
from quad_gym.records.inputs import EVENT, INPUT, PENDING, WINDOW

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

"""Calls of the compiled code that flies: addresses of a batch's memory, in words.

An array as an argument would take a third of a microsecond, longer than a stage runs.
"""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from quad_gym.kernels.entries import fly
from quad_gym.records import Call, Room

Word = int | NDArray[Any] | Sequence[NDArray[Any]]
"""A number, an array of which the kernel gets the address, or an array for each thread."""


class Calls:
    """The calls of all threads of a batch; they keep its memory and the `kept` arrays alive."""

    def __init__(
        self,
        blocks: NDArray[Any],
        room: Room,
        words: Mapping[Call, Word],
        kept: Sequence[NDArray[Any]],
    ) -> None:
        self._memory = (blocks, dict(words), kept)
        threads = next(len(arrays) for arrays in words.values() if isinstance(arrays, list))
        self._words = np.zeros((threads, len(Call)), np.int64)
        self._words[:, Call.BLOCKS] = address_of(blocks) - room.skipped
        self._words[:, Call.PITCH] = room.dtype.itemsize
        for word, value in words.items():
            if isinstance(value, Sequence):
                self._words[:, word] = [address_of(array) for array in value]
            else:
                self._words[:, word] = value if isinstance(value, int) else address_of(value)
        self._rows = [address_of(row) for row in self._words]

    def observe_into(self, observations: NDArray[np.float32]) -> None:
        """Set the array into which the next step writes its observations."""
        self._memory[1][Call.OBSERVATIONS] = observations
        self._words[:, Call.OBSERVATIONS] = address_of(observations)

    def show_into(self, shown: NDArray[np.float64]) -> None:
        """Set the array into which the next step or reset writes the fields that tasks read."""
        self._memory[1][Call.SHOWN] = shown
        self._words[:, Call.SHOWN] = address_of(shown)
        self._words[:, Call.SHOWN_PITCH] = shown.strides[0]

    def __call__(self, board: NDArray[np.int64], number: int, command: int, serving: bool) -> bool:
        """Fly blocks of a board, as the thread of this number; see `fly`."""
        row, posted = self._rows[number], address_of(board)
        return bool(fly(row, posted, board.size, number, command, serving))


def address_of(array: NDArray[Any]) -> int:
    """Return the address of an array's memory.

    `array.__array_interface__` would write out the data type, which takes 0.3 ms for a record.
    """
    return array.ctypes.data

"""State variables that a task keeps for each flight."""

from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from quad_gym.records import WIDTH

_KINDS = {"b": np.bool_, "i": np.int64, "u": np.int64, "f": np.float64}


class State:
    """Named arrays (n, ...), one row per flight, which have the same values in each new episode."""

    __slots__ = ("_arrays", "_start")
    _arrays: dict[str, NDArray[Any]]
    _start: dict[str, NDArray[Any]]

    def __init__(self, count: int, start: Mapping[str, ArrayLike]) -> None:
        arrays: dict[str, NDArray[Any]] = {}
        first: dict[str, NDArray[Any]] = {}
        for name, value in start.items():
            if not isinstance(name, str) or not name.isidentifier() or name.startswith("_"):
                raise ValueError(
                    f"names in state must be identifiers without leading underscore, got {name!r}"
                )
            values = np.asarray(value)
            if values.dtype.kind not in _KINDS:
                raise ValueError(f"state must hold numbers, got {value!r} for {name!r}")
            first[name] = values.astype(_KINDS[values.dtype.kind])
            arrays[name] = np.empty((count, *values.shape), first[name].dtype)
            arrays[name][:] = first[name]
        super().__setattr__("_arrays", arrays)
        super().__setattr__("_start", first)
        self.lock(True)

    def __getattr__(self, name: str) -> NDArray[Any]:
        if name[0] == "_" or name not in self._arrays:
            raise AttributeError(f"the task declares no state {name!r}: add it to `state`")
        return self._arrays[name]

    def __setattr__(self, name: str, value: Any) -> None:
        self.__getattr__(name)[:] = value

    def __dir__(self) -> list[str]:
        return [*super().__dir__(), *self._arrays]  # for "did you mean" suggestions

    def __iter__(self) -> Iterator[str]:
        return iter(self._arrays)

    def __len__(self) -> int:
        return len(self._arrays)

    def __getstate__(self) -> Any:
        return self._arrays, self._start

    def __setstate__(self, state: Any) -> None:
        # pickle restores larger arrays as views of its bytes, which cannot be made writable again
        super().__setattr__("_arrays", {name: array.copy() for name, array in state[0].items()})
        super().__setattr__("_start", state[1])
        self.lock(True)

    def lock(self, locked: bool) -> None:
        """Make all arrays read-only, or writable."""
        for array in self._arrays.values():
            array.flags.writeable = not locked

    def begin(self, chosen: NDArray[np.bool_]) -> None:
        """Set the rows of flights that begin an episode to the initial values."""
        self.lock(False)
        for name, array in self._arrays.items():
            array[chosen] = self._start[name]
        self.lock(True)

    def copies(self) -> dict[str, NDArray[Any]]:
        """Copies of all arrays, by name."""
        return {name: array.copy() for name, array in self._arrays.items()}

    def bring_back(self, copies: Mapping[str, NDArray[Any]], chosen: NDArray[np.bool_]) -> None:
        """Restore the rows of chosen flights from copies."""
        self.lock(False)
        for name, array in self._arrays.items():
            array[chosen] = copies[name][chosen]
        self.lock(True)

    def dtype(self) -> np.dtype[Any]:
        """Data type for the state of a block of flights in snapshots."""
        return np.dtype(
            [(name, a.dtype, (WIDTH, *a.shape[1:])) for name, a in self._arrays.items()]
        )

    def write_to(self, blocks: NDArray[Any]) -> None:
        """Copy the state into the blocks of a snapshot, of type `dtype`."""
        for name, array in self._arrays.items():
            flat = np.zeros((len(blocks) * WIDTH, *array.shape[1:]), array.dtype)
            flat[: len(array)] = array
            blocks[name] = flat.reshape(blocks[name].shape)

    def read_from(self, blocks: NDArray[Any]) -> None:
        """Copy the state from the blocks of a snapshot."""
        self.lock(False)
        for name, array in self._arrays.items():
            array[:] = blocks[name].reshape(-1, *array.shape[1:])[: len(array)]
        self.lock(True)

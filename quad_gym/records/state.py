"""State variables that a task or an estimator of a user keeps for each flight."""

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from quad_gym.records.sizes import WIDTH

_KINDS = {"b": np.bool_, "i": np.int64, "u": np.int64, "f": np.float64}


class State:
    """Named arrays (n, ...), one row per flight, which have the same values in each new episode."""

    __slots__ = ("_first", "_rows")
    _first: NDArray[Any]
    _rows: NDArray[Any]

    def __init__(self, count: int, start: Mapping[str, ArrayLike]) -> None:
        first: dict[str, NDArray[Any]] = {}
        for name, value in start.items():
            if not isinstance(name, str) or not name.isidentifier() or name.startswith("_"):
                raise ValueError(
                    f"names in state must be identifiers without leading underscore, got {name!r}"
                )
            values = np.asarray(value)
            if values.dtype.kind not in _KINDS:
                raise ValueError(f"state must contain numbers, got {value!r} for {name!r}")
            first[name] = values.astype(_KINDS[values.dtype.kind])
        row = np.zeros(1, [(name, value.dtype, value.shape) for name, value in first.items()])
        for name, value in first.items():
            row[name] = value
        self.__setstate__((row, np.repeat(row, count)))

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the variables."""
        return self._rows.dtype.names or ()

    def __getattr__(self, name: str) -> NDArray[Any]:
        if name[0] == "_" or name not in self.names:
            raise AttributeError(f"its class declares no state {name!r}: add it to `state`")
        return self._rows[name]

    def __setattr__(self, name: str, value: Any) -> None:
        self.__getattr__(name)[:] = value

    def __dir__(self) -> list[str]:
        return [*super().__dir__(), *self.names]  # for "did you mean" suggestions

    def __getstate__(self) -> Any:
        return self._first, self._rows

    def __setstate__(self, state: Any) -> None:
        object.__setattr__(self, "_first", state[0])
        object.__setattr__(self, "_rows", state[1].copy())  # pickle's own may be read-only forever
        self.lock(True)

    def lock(self, locked: bool) -> None:
        """Make all arrays read-only, or writable."""
        self._rows.flags.writeable = not locked

    def begin(self, chosen: NDArray[np.bool_]) -> None:
        """Set the rows of flights that begin an episode to the initial values."""
        self.put(self._first, chosen)

    def rows(self) -> NDArray[Any]:
        """Copy of all variables: one record (n,)."""
        return self._rows.copy()

    def put(self, rows: NDArray[Any], chosen: NDArray[np.bool_]) -> None:
        """Replace the rows of chosen flights by others, as `rows` returns them."""
        self.lock(False)
        self._rows[chosen] = rows
        self.lock(True)

    def kept_with(self, flights: NDArray[Any]) -> NDArray[Any]:
        """Join a snapshot of flights with this state, if there is any."""
        if not self.names:
            return flights
        kept = np.zeros(len(flights), self._kind_with(flights.dtype))
        kept["flights"] = flights
        kept["state"][np.divmod(np.arange(len(self._rows)), WIDTH)] = self._rows
        return kept

    def flights_of(
        self, snapshot: NDArray[Any], flights: np.dtype[Any], owner: str
    ) -> NDArray[Any]:
        """Return the flights of a snapshot that `kept_with` has joined with a state like this one.

        `flights` is their data type, `owner` the task or estimator that needs the state.
        """
        if not self.names:
            return snapshot
        if getattr(snapshot, "dtype", None) != self._kind_with(flights):
            raise ValueError(f"snapshot must be one of a batch with {owner}")
        return np.asarray(snapshot["flights"])

    def restore(self, snapshot: NDArray[Any]) -> None:
        """Restore the state that `kept_with` has joined with flights."""
        if self.names:
            places = np.divmod(np.arange(len(self._rows)), WIDTH)
            self.put(snapshot["state"][places], np.ones(len(self._rows), bool))

    def _kind_with(self, flights: np.dtype[Any]) -> np.dtype[Any]:
        """Data type of flights with this state."""
        return np.dtype([("flights", flights), ("state", self._rows.dtype, (WIDTH,))])

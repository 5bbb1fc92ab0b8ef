"""Observations of a task: joined with the built-in observation, checked and clipped."""

from collections.abc import Mapping, Sequence
from operator import attrgetter
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from quad_gym.tasks import answers
from quad_gym.tasks.task import TaskError, label

if TYPE_CHECKING:
    from quad_gym.tasks.batch import TaskBatch

Singles = NDArray[np.float32]

_ARRAYS, _SHAPE = {np.ndarray}, attrgetter("shape")

_SQUARABLE = 1e15
"""Magnitude up to which a sum of squares does not overflow in single precision."""


class Part(NamedTuple):
    """Size and bounds of one array that `observe` returns."""

    size: int
    low: float
    high: float


class Joiner:
    """Assembly of observations: built-in values that are kept, the task's, and privileged ones.

    Args:
        count: Number of flights.
        parts: Arrays that `observe` returns, by name.
        shipped: Size of the built-in observation.
        split: Index in the built-in observation at which the task's values are inserted.
        kept: Indices before `split` that are kept; None: all.
    """

    def __init__(
        self,
        count: int,
        parts: Mapping[str, Part],
        shipped: int,
        split: int,
        kept: Sequence[int] | None,
    ) -> None:
        self._sizes = {name: part.size for name, part in parts.items()}
        self._names = tuple(parts)
        self._shapes = [(count, part.size) for part in parts.values()]
        self._split, self._rest = split, shipped - split
        self._kept: slice | NDArray[np.intp] = slice(0, split)
        if kept is not None and len(kept) < split:
            self._kept = np.array(kept, np.intp)
        self._begin = split if kept is None else len(kept)
        self.size = self._begin + sum(self._sizes.values()) + self._rest
        """Size of an observation."""
        bounds = [(part.low, part.high) for part in parts.values() for _ in range(part.size)]
        self._low, self._high = np.array(bounds, np.float32).reshape(-1, 2).T.copy()
        self._least = self._low.max(initial=-_SQUARABLE)
        self._most = self._high.min(initial=_SQUARABLE)
        self._surely_within = 0.99 * float(max(min(-self._least, self._most), 0.0)) ** 2

    def join(self, flights: "TaskBatch", value: Any, shipped: Singles) -> Singles:
        """Assemble the observations of the environment.

        Args:
            flights: Flights of the task.
            value: Return value of `observe`.
            shipped: Built-in observations, (n, k).

        Raises:
            TaskError: If the return value is invalid.
        """
        if not self._is_as_at_first(value):
            value = self._checked(flights, value)
        parts = list(value.values())
        if self._begin:
            parts.insert(0, shipped[:, self._kept])
        if self._rest:
            parts.append(shipped[:, self._split :])
        try:
            joined = np.concatenate(parts, axis=1, dtype=np.float32, casting="same_kind")
        except TypeError:
            self._checked(flights, value)  # raises an error that names the array
            raise
        flat = joined.ravel(order="K")  # in memory order, without a copy
        if not flat.dot(flat) <= self._surely_within:  # also for NaN
            self._hold(flights, joined[:, self._begin : self.size - self._rest], value)
        return joined

    def _is_as_at_first(self, value: Any) -> bool:
        """True if `observe` has returned arrays with the same names and shapes as at first."""
        if type(value) is not dict or tuple(value) != self._names:
            return False
        parts = value.values()
        return set(map(type, parts)) == _ARRAYS and list(map(_SHAPE, parts)) == self._shapes

    def _checked(self, flights: "TaskBatch", value: Any) -> dict[str, NDArray[Any]]:
        """Check the return value of `observe`; return (n, k) arrays in the observation's order."""
        found = answers.parts(flights.own_task, value, flights.count)
        sizes = {name: part.shape[1] for name, part in found.items()}
        if sizes != self._sizes:
            raise TaskError(
                f"{label(flights.own_task)}.observe must always return the same sizes, "
                f"{self._sizes}, got {sizes}"
            )
        return {name: found[name] for name in self._sizes}

    def _hold(self, flights: "TaskBatch", ours: Singles, own: Mapping[str, Any]) -> None:
        """Clip the task's part of observations to its bounds.

        Raises:
            TaskError: If it is not finite although the state of the flight is. For flights whose
                state is not finite, it is replaced by finite numbers.
        """
        if ours.min() >= self._least and ours.max() <= self._most:
            return  # clipping is slow
        if not np.isfinite(ours).all():
            for name, values in own.items():
                sound = np.isfinite(values).all(axis=1)
                if not sound.all():
                    sound |= ~flights.finite(~sound)
                    answers.require(sound, flights.own_task, "observe", values, f"finite {name!r}")
            np.nan_to_num(ours, copy=False)
        np.clip(ours, self._low, self._high, out=ours)

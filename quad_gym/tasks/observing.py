"""Observations of a task: joined with the built-in observation, checked and clipped."""

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from quad_gym.tasks import answers
from quad_gym.tasks.memory import ReadableBatch
from quad_gym.tasks.task import BOUND, Task, TaskError, label

Singles = NDArray[np.float32]


class Part(NamedTuple):
    """Size and bounds of one array that `observe` returns."""

    size: int
    low: float
    high: float


class Joiner:
    """Assembly of observations: built-in values that are kept, the task's, and privileged ones.

    The task's values are inserted at index `split` of the built-in observation, of whose indices
    before it the `kept` remain (None: all).
    """

    def __init__(
        self,
        count: int,
        parts: Mapping[str, Part],
        builtin: int,
        split: int,
        kept: Sequence[int] | None,
    ) -> None:
        self._count = count
        self._sizes = {name: part.size for name, part in parts.items()}
        self._kept: slice | Sequence[int] = slice(0, split)
        if kept is not None and len(kept) < split:
            self._kept = kept
        self._split = split
        begin = split if kept is None else len(kept)
        bounds = [(part.low, part.high) for part in parts.values() for _ in range(part.size)]
        self._own = slice(begin, begin + len(bounds))
        self._low, self._high = np.array(bounds, np.float32).reshape(-1, 2).T.copy()
        self._least, self._most = self._low.max(initial=-BOUND), self._high.min(initial=BOUND)
        self.size = self._own.stop + builtin - split
        """Size of an observation."""

    def join(self, flights: ReadableBatch, task: Task, value: Any, builtin: Singles) -> Singles:
        """Assemble observations from the return value of `observe` and the built-in ones, (n, k).

        Sizes must be as in the first call, and values finite, except for flights whose state is
        not finite: finite numbers replace theirs.
        """
        parts = answers.parts(task, value, self._count)
        sizes = {name: part.shape[1] for name, part in parts.items()}
        if sizes != self._sizes:
            raise TaskError(
                f"{label(task)}.observe must always return the same sizes, "
                f"{self._sizes}, got {sizes}"
            )
        own = [parts[name] for name in self._sizes]
        joined = np.concatenate(
            [builtin[:, self._kept], *own, builtin[:, self._split :]], axis=1, dtype=np.float32
        )
        ours = joined[:, self._own]
        if ours.min(initial=0.0) >= self._least and ours.max(initial=0.0) <= self._most:
            return joined  # almost always; clipping takes longer
        if not np.isfinite(ours).all():
            for name, values in parts.items():
                wrong = ~np.isfinite(values).all(axis=1)
                wrong[wrong] = flights.finite(np.flatnonzero(wrong))
                answers.require(~wrong, task, "observe", values, f"finite {name!r}")
            np.nan_to_num(ours, copy=False)
        np.clip(ours, self._low, self._high, out=ours)
        return joined

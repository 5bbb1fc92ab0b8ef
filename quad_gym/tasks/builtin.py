"""Built-in reward and endings of a step, as a group of a view."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from quad_gym.tasks.lazy import Attribute, Group, Lazy, frozen

Floats = NDArray[np.float64]
Truths = NDArray[np.bool_]

_JUDGED = ("reward", "terminated", "truncated", "ending")


class Builtin(Group):
    """Reward and endings of the built-in task; zero where an episode has begun since."""

    __slots__ = ("_begun",)

    def __init__(self, flights: Any, kept: list[Attribute]) -> None:
        super().__init__(flights, kept)
        self._begun: Truths | None = None

    def _result(self, name: str) -> Floats:
        found: Floats = self._flights.result(name)
        return found if self._begun is None else np.where(self._begun, 0.0, found)

    @Lazy
    def reward(self) -> Floats:
        """Built-in reward per step, (n,), regardless of `reward_per`."""
        reward, scale = self._result("reward"), self._flights.reward_scale
        return reward if scale == 1.0 else reward / scale

    @Lazy
    def terminated(self) -> Truths:
        """True where the vehicle has crashed or passed the last gate, (n,)."""
        return self._result("terminated") > 0.0

    @Lazy
    def truncated(self) -> Truths:
        """True at the time limit or after a failure of the filter, (n,).

        With `truncate_when_diverged` also where the filter has diverged. It may be True together
        with `terminated`.
        """
        return self._result("truncated") > 0.0

    @Lazy
    def ending(self) -> NDArray[np.int64]:
        """Reason of the ending, (n,), see `quad_gym.records.Ending`."""
        return self._result("ending").astype(np.int64)

    def read(self) -> None:
        """Compute all arrays, before the task's results overwrite their sources."""
        for name in _JUDGED:
            getattr(self, name)

    def step_over(self) -> None:
        """Drop the arrays of the last step."""
        self.forget()
        if self._begun is not None:
            self._begun = None

    def begin(self, chosen: Truths) -> None:
        """Set the rows of flights that have begun an episode since to zero."""
        self._begun = chosen if self._begun is None else self._begun | chosen
        for name, value in self.__dict__.items():
            self.__dict__[name] = frozen(np.where(chosen, value.dtype.type(0), value))

"""`LaidTask`: a user's task laid over the task of an id, whose methods stay where it has none."""

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from functools import reduce
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from quad_gym.records import Ending
from quad_gym.tasks import answers
from quad_gym.tasks.fields import field
from quad_gym.tasks.groups import BuiltinView
from quad_gym.tasks.task import Task, label

if TYPE_CHECKING:
    from quad_gym.params.sensors import SensorSuite
    from quad_gym.params.world import WorldParams
    from quad_gym.tasks.random import FlightRandom
    from quad_gym.tasks.view import View

Floats = NDArray[np.float64]
Truths = NDArray[np.bool_]


class LaidTask(Task):
    """A task over the task of an environment, as `LookAround` is the task of its id.

    Reward, endings and observation are those of `over` where it overrides them, otherwise those of
    `base`. `reset` and `update` of both are called, first of `base`, so that `over` reads a
    complete state. In methods of `over`, `view.builtin` has reward and endings of `base`, and its
    observation is appended to that of `base`, as to any built-in observation.

    Args:
        over: The user's task.
        base: The task of the environment.

    Raises:
        ValueError: If both have a variable of the same name in `state`.
    """

    def __init__(self, over: Task, base: Task) -> None:
        self.over, self.base = over, base
        both = sorted(set(over.state) & set(base.state))
        if both:
            raise ValueError(
                f"state of {label(over)} must not have {both[0]!r}, which the environment's task "
                f"{label(base)} has: choose another name, or derive from {label(base)}"
            )
        self.state: Mapping[str, ArrayLike] = {**base.state, **over.state}
        self._label = label(over)
        self.replaces_observation, self.keeps = base.replaces_observation, base.keeps
        self.privileged = over.privileged or base.privileged
        replaces = over.has("observe") and over.replaces_observation
        if replaces:
            kept = [n for n in over.keeps if not base.replaces_observation or n in base.keeps]
            self.replaces_observation, self.keeps = True, tuple(kept)
        self._of_base = frozenset(over.keeps) if replaces else None
        self.observes = {
            **{name: spec for name, spec in base.observes.items() if self._keeps_part(name)},
            **(over.observes if over.has("observe") else {}),
        }

    def has(self, method: str) -> bool:
        """Return True if one of both tasks overrides a method."""
        return self.over.has(method) or self.base.has(method)

    def _require(self, sensors: "SensorSuite", world: "WorldParams") -> None:
        self.base._require(sensors, world)
        self.over._require(sensors, world)

    def reset(self, view: "View", rng: "FlightRandom") -> Mapping[str, ArrayLike] | None:
        """Begin episodes in both tasks; start values of `over` have precedence."""
        start = self.base.reset(view, rng)
        with self._over(view):
            again = self.over.reset(view, rng)
        return again if start is None else start if again is None else {**start, **again}

    def update(self, view: "View", rng: "FlightRandom") -> None:
        """Change the state of both tasks."""
        self.base.update(view, rng)
        with self._over(view):
            self.over.update(view, rng)

    def reward(self, view: "View") -> Floats | dict[str, Floats]:
        """Return the reward, (n,), or its terms."""
        return self._asked("reward", view)

    def terminated(self, view: "View") -> Truths:
        """Return True for episodes that end by a crash or at the goal, (n,)."""
        return self._asked("terminated", view)

    def truncated(self, view: "View") -> Truths:
        """Return True for episodes that are cut short, (n,)."""
        return self._asked("truncated", view)

    def observe(self, view: "View") -> dict[str, NDArray[Any]]:
        """Return the parts of the observation by name: of `base`, then of `over`."""
        parts: dict[str, NDArray[Any]] = {}
        if self.base.has("observe"):
            named = answers.parts(self.base, self.base.observe(view), view.count)
            parts = {name: part for name, part in named.items() if self._keeps_part(name)}
        if self.over.has("observe"):
            with self._over(view):
                own = answers.parts(self.over, self.over.observe(view), view.count)
            both = sorted(set(own) & set(parts))
            if both:
                raise ValueError(
                    f"observe must not return {both[0]!r}, a name of a part of {label(self.base)}"
                )
            parts |= own
        return parts

    def _keeps_part(self, name: str) -> bool:
        """Return True if a part of the observation of `base` is observed."""
        return self._of_base is None or name in self._of_base

    def _asked(self, method: str, view: "View") -> Any:
        if not self.over.has(method):
            return getattr(self.base, method)(view)
        with self._over(view):
            return getattr(self.over, method)(view)

    @contextmanager
    def _over(self, view: "View") -> Iterator[None]:
        """Show reward and endings of `base` as the built-in ones."""
        builtin = view._builtin
        view._builtin = _BaseView(view, self.base, builtin)
        try:
            yield
        finally:
            view._builtin = builtin


class _BaseView(BuiltinView):
    """Reward and endings of a task in Python, computed when they are read."""

    __slots__ = ("_base", "_beneath", "_view")

    def __init__(self, view: "View", base: Task, beneath: BuiltinView) -> None:
        super().__init__(view._flights)
        self._view, self._base, self._beneath = view, base, beneath

    @contextmanager
    def _beneath_it(self) -> Iterator["View"]:
        """View in which the built-in reward and endings are again those beneath the task."""
        view = self._view
        view._builtin = self._beneath
        try:
            yield view
        finally:
            view._builtin = self

    @field("(n,)", "-", "-", "reward of the environment's task, per step")
    def reward(self) -> Floats:
        with self._beneath_it() as view:
            terms = answers.reward_terms(self._base, view)
        return np.where(self._flights.began, 0.0, reduce(np.add, terms.values()))

    @field("(n,) bool", "-", "-", "True where the environment's task terminates the episode")
    def terminated(self) -> Truths:
        with self._beneath_it() as view:
            return answers.truths(self._base, "terminated", view) & ~self._flights.began

    @field("(n,) bool", "-", "-", "True where the environment's task cuts the episode short")
    def truncated(self) -> Truths:
        with self._beneath_it() as view:
            return answers.truths(self._base, "truncated", view) & ~self._flights.began

    @field("(n,) int", "-", "-", "reason of the ending, see `quad_gym.records.Ending`")
    def ending(self) -> NDArray[np.int64]:
        over, why = self.terminated | self.truncated, self._beneath.ending
        return np.where(over, np.where(why > 0, why, int(Ending.TASK)), 0)

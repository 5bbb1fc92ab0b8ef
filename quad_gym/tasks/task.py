"""`Task`: a user's reward, endings, observation and reset, in place of the built-in ones."""

import difflib
import importlib
import os
import sys
import warnings
from collections.abc import Callable, Collection, Mapping
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

if TYPE_CHECKING:
    from quad_gym.params.sensors import SensorSuite
    from quad_gym.params.world import WorldParams
    from quad_gym.tasks.draws import FlightRandom
    from quad_gym.tasks.view import View

METHODS = ("reset", "update", "reward", "terminated", "truncated", "observe")
"""What a task can have, in the order in which a step calls them."""

BOUND = 1e6
"""Numbers that `observe` returns are held within this, unless `observes` says otherwise."""


class TaskError(RuntimeError):
    """A task's method failed, or returned something else than it has to."""


class HiddenTruthError(RuntimeError):
    """`observe` asked for what the controller cannot know."""


class ObservationSpec(NamedTuple):
    """What the table of observations says of a part that `observe` returns."""

    unit: str = "-"
    frame: str = "-"
    """I: inertial, B: body, "-": none"""
    low: float = -BOUND
    high: float = BOUND
    """bounds that it is held within"""


class Task:
    """Your own reward, endings, observation and reset; the id's task does what it leaves out.

    Each method is called once in a control step, for all flights at once, with a `View` whose arrays
    have one row per flight. `gymnasium.make(id, task=Mine())`, `make_vec` and `make_sb3_vec_env`
    fly the same flights with it, bit for bit as far as its methods treat every row alike.

    | method | returns |
    |---|---|
    | `reset(view, rng)` | None, or start values by name; rows of flights that begin an episode count |
    | `update(view, rng)` | None; called first in a step, to change `view.state` |
    | `reward(view)` | (n,) float: of the step; `reward_per="second"` multiplies it by the control period |
    | `terminated(view)` | (n,) bool: the episode is over by a crash, or at the goal |
    | `truncated(view)` | (n,) bool: it is cut short |
    | `observe(view)` | (n,) or (n, k) float, or such arrays by name |

    In the step that begins an episode (Gymnasium's next-step autoreset) reward and endings of that
    flight do not count. A flight whose state is no longer finite ends in any case. Where a step
    ends an episode and begins the next one, `observe` is called for both.

    Class attributes, all optional:

    - `state`: what the task keeps for each flight: values at the start of an episode, by name. Shape
      and type follow from them: {"target": np.zeros(3), "laps": 0, "caught": False}. Methods read
      `view.state.target`, (n, 3); `reset` and `update` may change it.
    - `observes`: unit, frame and bounds of what `observe` returns, by name.
    - `replaces_observation`: whether that takes the place of the shipped observation; else it
      follows it.
    - `keeps`: names of parts of the shipped observation that stay where it is replaced, as far as
      there are such, and come first.
    - `privileged`: whether `observe` may read the truth.
    """

    state: Mapping[str, ArrayLike] = {}
    observes: Mapping[str, ObservationSpec] = {}
    replaces_observation: bool = False
    keeps: Collection[str] = ()
    privileged: bool = False

    def __init_subclass__(cls) -> None:
        """Warn of methods whose names are nearly those of a task: nobody would call them."""
        super().__init_subclass__()
        for name, value in vars(cls).items():
            near = difflib.get_close_matches(name, METHODS, 1, cutoff=0.8)
            if callable(value) and near and name not in METHODS and not hasattr(Task, name):
                warnings.warn(
                    f"{cls.__name__}.{name} is not called; did you mean {near[0]}?", stacklevel=2
                )

    @staticmethod
    def of(
        *,
        state: Mapping[str, ArrayLike] | None = None,
        observes: Mapping[str, ObservationSpec] | None = None,
        replaces_observation: bool = False,
        keeps: Collection[str] = (),
        privileged: bool = False,
        **methods: Callable[..., Any],
    ) -> "Task":
        """A task made of plain functions, called as the methods are: `Task.of(reward=f)`.

        Args:
            state: As the class attribute.
            observes: Likewise.
            replaces_observation: Likewise.
            keeps: Likewise.
            privileged: Likewise.
            methods: Functions by the names of the methods.

        Raises:
            TypeError: If there is no such method, or one cannot be called.
        """
        for name, function in methods.items():
            if name not in METHODS:
                raise TypeError(f"a task has no {name}; it has {', '.join(METHODS)}")
            if not callable(function):
                raise TypeError(f"{name} must be a function, got {function!r}")
        task = Task()
        task.state, task.observes = dict(state or {}), dict(observes or {})
        task.replaces_observation, task.privileged = replaces_observation, privileged
        task.keeps = tuple(keeps)
        vars(task).update(methods)
        return task

    def reset(self, view: "View", rng: "FlightRandom") -> Mapping[str, ArrayLike] | None:
        """Begin episodes: set `view.state`, choose starts. The view shows the episodes that begin.

        Args:
            view: All flights; `view.is_first` says which begin. What is written to the rows of the
                others does not count.
            rng: Draws for each flight from its own stream.

        Returns:
            None, or any of "position" (n, 3) in I [m], "velocity" (n, 3) in I [m/s] and "yaw" (n,)
            [rad] to start with. What a caller's reset asks for comes first.
        """
        return None

    def update(self, view: "View", rng: "FlightRandom") -> None:
        """Change `view.state` after a step has been flown, before anything else is asked."""

    def reward(self, view: "View") -> NDArray[np.float64]:
        """(n,) the reward of the step that has been flown."""
        return view.builtin.reward  # type: ignore[no-any-return]

    def terminated(self, view: "View") -> NDArray[np.bool_]:
        """(n,) whether a crash, or the goal, ends the episode."""
        return view.builtin.terminated  # type: ignore[no-any-return]

    def truncated(self, view: "View") -> NDArray[np.bool_]:
        """(n,) whether something else ends it, such as the time limit; both where both do."""
        return view.builtin.truncated  # type: ignore[no-any-return]

    def observe(self, view: "View") -> Any:
        """(n,) or (n, k) numbers, or such arrays by name."""
        return {}

    def _require(self, sensors: "SensorSuite", world: "WorldParams") -> None:
        """Refuse, by a ValueError, sensors or a world that a built-in task cannot be flown with."""

    def has(self, method: str) -> bool:
        """Whether it has a method of its own."""
        return method in vars(self) or getattr(type(self), method) is not getattr(Task, method)


def resolve_task(given: Any) -> Task:
    """The task that the keyword `task` means.

    Args:
        given: A `Task`; a class of them, made without arguments; or "module:name" of either, which
            is looked for in the working directory, too.

    Raises:
        ValueError: If it is none of these, or its attributes are invalid.
    """
    found = _named(given) if isinstance(given, str) else given
    if isinstance(found, type) and issubclass(found, Task):
        found = found()
    if not isinstance(found, Task):
        raise ValueError(f'task must be a quad_gym.Task, or its "module:name", got {given!r}')
    for name in ("replaces_observation", "privileged"):
        if not isinstance(getattr(found, name), bool):
            raise ValueError(f"{name} of {label(found)} must be True or False")
    if isinstance(found.keeps, str) or not all(isinstance(name, str) for name in found.keeps):
        raise ValueError(f"keeps of {label(found)} must hold names, got {found.keeps!r}")
    for name, part in found.observes.items():
        if not isinstance(part, ObservationSpec) or not part.low < part.high:
            raise ValueError(
                f"observes of {label(found)} must hold ObservationSpec with low < high, got {part!r} "
                f"for {name!r}"
            )
    return found


def _named(name: str) -> Any:
    """What "module:name" names.

    Raises:
        ValueError: If there is no such module, or nothing of that name in it.
    """
    module, colon, attribute = name.partition(":")
    if not (colon and module and attribute):
        raise ValueError(f'task must be "module:name" of a quad_gym.Task, got {name!r}')
    here = os.getcwd()
    added = here not in sys.path and "" not in sys.path
    if added:  # as a console command has not
        sys.path.insert(0, here)
    try:
        return getattr(importlib.import_module(module), attribute)
    except (ImportError, AttributeError) as error:
        raise ValueError(f"task must name a quad_gym.Task, got {name!r}: {error}") from None
    finally:
        if added:
            sys.path.remove(here)


def label(task: Task) -> str:
    """What to call a task in messages."""
    return type(task).__name__

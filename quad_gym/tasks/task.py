"""`Task`: the interface of user-defined tasks, and their random numbers."""

import difflib
import math
import warnings
from collections.abc import Callable, Collection, Mapping
from typing import TYPE_CHECKING, Any, NamedTuple, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from quad_gym.params import checks as check

if TYPE_CHECKING:
    from quad_gym.params.suites import SensorSuite
    from quad_gym.params.world import WorldParams
    from quad_gym.tasks.view import View


# --------------------------------------------------------------------------------------------------
# Random numbers for tasks: one stream per flight, independent of the other flights.
#
# Threefry-2x64 with 13 rounds, as in `quad_gym.kernels.numbers.random`, on NumPy arrays of keys.
# The key is the key of the flight, modified so that tasks and kernels never share a draw; the
# counter consists of the instant and the number of the draw.
# --------------------------------------------------------------------------------------------------

Words = NDArray[np.uint64]

_PARITY = np.uint64(0x1BD11BDAA9FC1A22)
_ROTATIONS = ((16, 42, 12, 31), (16, 32, 24, 21), (16, 42, 12, 31), (16,))
_OURS = np.uint64(0x9E3779B97F4A7C15)
"""Constant that makes the keys of tasks differ from the keys of the kernels."""


def threefry(key0: Words, key1: Words, counter0: Words, counter1: Words) -> tuple[Words, Words]:
    """Generate two random words from a two-word key and counter (J. Salmon et al., SC 2011)."""
    keys = (key0, key1, key0 ^ key1 ^ _PARITY)
    a, b = counter0 + key0, counter1 + key1
    for group, rotations in enumerate(_ROTATIONS):
        if group:
            a = a + keys[group % 3]
            b = b + keys[(group + 1) % 3] + np.uint64(group)
        for places in rotations:
            a = a + b
            b = ((b << np.uint64(places)) | (b >> np.uint64(64 - places))) ^ a
    return a, b


class FlightRandom:
    """Random number generator with a separate stream for each flight.

    Its methods correspond to NumPy's generator. Row i of every result is drawn from the stream of
    flight i at its present instant, so the numbers of a flight do not depend on the batch size.
    Each method of a task, by its number, draws other numbers.
    """

    def __init__(self, keys: Words, instants: Words, method: int) -> None:
        self._key0, self._key1 = keys[:, 0] ^ _OURS, keys[:, 1]
        self._instants = instants
        self._next = method << 32

    def random(self, size: int | tuple[int, ...] | None = None) -> NDArray[np.float64]:
        """Draw uniform numbers in [0, 1).

        Args:
            size: Shape, whose first axis must have the length n; None: (n,).

        Raises:
            ValueError: If the first axis has another length.
        """
        count = len(self._instants)
        size = count if size is None else size
        shape = (int(size),) if isinstance(size, int | np.integer) else tuple(size)
        if not shape or shape[0] != count:
            raise ValueError(f"size must begin with the number of flights, {count}, got {size}")
        columns = math.prod(shape[1:])
        draws = np.arange(self._next, self._next + columns, dtype=np.uint64)
        self._next += columns
        a, _ = threefry(
            self._key0[:, np.newaxis],
            self._key1[:, np.newaxis],
            self._instants[:, np.newaxis],
            draws[np.newaxis],
        )
        return np.ascontiguousarray((a >> np.uint64(11)) * 2.0**-53).reshape(shape)

    def uniform(
        self, low: ArrayLike = 0.0, high: ArrayLike = 1.0, size: int | tuple[int, ...] | None = None
    ) -> NDArray[np.float64]:
        """Draw uniform numbers in [low, high); see `random` for `size`."""
        floor = np.asarray(low, np.float64)
        return np.asarray(floor + (np.asarray(high, np.float64) - floor) * self.random(size))

    def normal(
        self,
        loc: ArrayLike = 0.0,
        scale: ArrayLike = 1.0,
        size: int | tuple[int, ...] | None = None,
    ) -> NDArray[np.float64]:
        """Draw normal numbers with mean `loc` and standard deviation `scale`, as `random` does."""
        radius = np.sqrt(-2.0 * np.log(1.0 - self.random(size)))
        mean, sigma = np.asarray(loc, np.float64), np.asarray(scale, np.float64)
        return np.asarray(mean + sigma * (radius * np.cos(2.0 * np.pi * self.random(size))))

    def integers(
        self, low: int, high: int | None = None, size: int | tuple[int, ...] | None = None
    ) -> NDArray[np.int64]:
        """Draw integers in [low, high), or in [0, low) without `high`; see `random` for `size`."""
        first, end = (0, low) if high is None else (low, high)
        if end <= first:
            raise ValueError(f"high must be greater than low, got {low} and {high}")
        return np.floor(first + (end - first) * self.random(size)).astype(np.int64)

    def __getattr__(self, name: str) -> Any:
        raise AttributeError(
            f"the generator of a task has random, uniform, normal and integers, not {name}"
        )


# --------------------------------------------------------------------------------------------------
# `Task`: reward, endings, observation and reset defined by a user instead of the built-in ones.
# --------------------------------------------------------------------------------------------------

METHODS = ("reset", "update", "reward", "terminated", "truncated", "observe")
"""Methods that a task may define, in the order in which a step calls them."""

BOUND = 1e6
"""Default bound on the magnitude of values returned by `observe`; larger values are clipped."""


class TaskError(RuntimeError):
    """Error raised when a method of a task fails or returns an invalid value."""


class ObservationSpec(NamedTuple):
    """Unit, frame and bounds of an array that `observe` returns."""

    unit: str = "-"  #: unit as listed in the table of observations; "-": dimensionless
    frame: str = "-"  #: Frame of the components. I: inertial, B: body, "-": none
    low: float = -BOUND  #: lower bound; smaller values are clipped
    high: float = BOUND  #: upper bound; larger values are clipped


class Task:
    """Your own reward, endings, observation and reset of an environment.

    Methods that you do not override keep the behavior of the environment's task, which may be a
    class such as `LookAround`. Each method is called once per control step for all flights, with a
    `View` whose arrays have one row per flight. `gymnasium.make(id, task=Mine())`, `make_vec` and `make_sb3_vec_env` produce bitwise
    identical flights, provided that the methods compute each row independently of the others.

    | method | returns |
    |---|---|
    | `reset(view, rng)` | None, or start values by name; only rows of flights that begin an episode are used |
    | `update(view, rng)` | None; called first in a step, to change `view.state` |
    | `reward(view)` | (n,) float: reward of the step, or a dictionary of its terms, whose sum it is; `reward_per="second"` multiplies it by the control period |
    | `terminated(view)` | (n,) bool: True ends the episode by a crash or at the goal |
    | `truncated(view)` | (n,) bool: True cuts the episode short |
    | `observe(view)` | (n,) or (n, k) float, or a dictionary of such arrays |

    In the step that begins an episode (Gymnasium's next-step autoreset), reward and endings of that
    flight are ignored. A flight whose state is no longer finite always ends. If one step ends an
    episode and begins the next one, `observe` is called for both.

    Class attributes, all optional:

    - `state`: variables that the task keeps for each flight: initial values by name, which define
      shape and type: {"target": np.zeros(3), "laps": 0, "caught": False}. Methods read
      `view.state.target`, (n, 3); `reset` and `update` may change it.
    - `observes`: unit, frame and bounds of the arrays that `observe` returns, by name.
    - `replaces_observation`: True if the output of `observe` replaces the built-in observation;
      False (default) appends it.
    - `keeps`: names of parts of the built-in observation to keep if it is replaced. They come
      first; names of parts that the observation does not have are ignored.
    - `privileged`: True if `observe` may read the true state.
    """

    state: Mapping[str, ArrayLike] = {}
    observes: Mapping[str, ObservationSpec] = {}
    replaces_observation: bool = False
    keeps: Collection[str] = ()
    privileged: bool = False

    def __init_subclass__(cls) -> None:
        """Warn about misspelled method names, which would never be called."""
        super().__init_subclass__()
        for name, value in vars(cls).items():
            near = difflib.get_close_matches(name, METHODS, 1, cutoff=0.8)
            if callable(value) and near and name not in METHODS and not hasattr(Task, name):
                warnings.warn(
                    f"{cls.__name__}.{name} is not called; did you mean {near[0]}?", stacklevel=2
                )

    @classmethod
    def of(
        cls,
        *,
        state: Mapping[str, ArrayLike] | None = None,
        observes: Mapping[str, ObservationSpec] | None = None,
        replaces_observation: bool | None = None,
        keeps: Collection[str] | None = None,
        privileged: bool | None = None,
        **methods: Callable[..., Any],
    ) -> Self:
        """Make a task of plain functions, with the arguments of the methods: `Task.of(reward=f)`.

        Other arguments are the attributes of the class. `methods` are `reset`, `update`, `reward`,
        `terminated`, `truncated` and `observe`. Called on a subclass, as `LookAround.of(reward=f)`,
        it makes an instance of that class, which keeps what is not given; variables of `state` are
        added to those of the class, and so are parts of `observes`, unless `observe` is given.

        Raises:
            TypeError: If a name is not a method of `Task`, or a value is not callable.
        """
        for name, function in methods.items():
            if name not in METHODS:
                raise TypeError(f"a task has no {name}; it has {', '.join(METHODS)}")
            if not callable(function):
                raise TypeError(f"{name} must be a function, got {function!r}")
        task = cls()
        if state is not None:
            task.state = {**task.state, **state}
        if observes is not None or "observe" in methods:
            kept = {} if "observe" in methods else task.observes
            task.observes = {**kept, **(observes or {})}
        if replaces_observation is not None:
            task.replaces_observation = replaces_observation
        if keeps is not None:
            task.keeps = tuple(keeps)
        if privileged is not None:
            task.privileged = privileged
        vars(task).update(methods)
        return task

    def reset(self, view: "View", rng: "FlightRandom") -> Mapping[str, ArrayLike] | None:
        """Begin episodes: set `view.state`, choose starts. The view shows the new episodes.

        Args:
            view: All flights; `view.is_first` is True for flights that begin an episode. Values
                written to other rows are discarded.
            rng: Random numbers, drawn for each flight from its own stream.

        Returns:
            None, or any of the start values "position" (n, 3) in I [m], "velocity" (n, 3) in I
            [m/s] and "yaw" (n,) [rad]. Values passed to the environment's `reset` take precedence.
        """
        return None

    def update(self, view: "View", rng: "FlightRandom") -> None:
        """Change `view.state` after a step, before reward, endings and observation are computed."""

    def reward(self, view: "View") -> "NDArray[np.float64] | dict[str, NDArray[np.float64]]":
        """Return the reward of the last step, (n,), or its terms by name, (n,) each."""
        return view.builtin.reward

    def terminated(self, view: "View") -> NDArray[np.bool_]:
        """Return True for episodes that end by a crash or at the goal, (n,)."""
        return view.builtin.terminated

    def truncated(self, view: "View") -> NDArray[np.bool_]:
        """Return True for episodes that are cut short, such as by the time limit, (n,).

        Both `terminated` and `truncated` may be True in the same step.
        """
        return view.builtin.truncated

    def observe(self, view: "View") -> Any:
        """Return the task's observation: numbers (n,) or (n, k), or a dictionary of such arrays."""
        return {}

    def _require(self, sensors: "SensorSuite", world: "WorldParams") -> None:
        """Raise a ValueError for sensors or a world that a built-in task cannot use."""

    def has(self, method: str) -> bool:
        """Return True if the task overrides a method."""
        return method in vars(self) or getattr(type(self), method) is not getattr(Task, method)


def resolve_task(given: Any) -> Task:
    """Task specified by the keyword `task`.

    Args:
        given: A `Task`; a subclass of `Task`, which is instantiated without arguments; or
            "module:name" of either. Modules in the working directory are found, too.

    Raises:
        ValueError: If it is none of these, or its attributes are invalid.
    """
    found = check.own("task", given, Task)
    for name in ("replaces_observation", "privileged"):
        if not isinstance(getattr(found, name), bool):
            raise ValueError(
                f"{name} of {label(found)} must be True or False, got {getattr(found, name)!r}"
            )
    if isinstance(found.keeps, str) or not all(isinstance(name, str) for name in found.keeps):
        raise ValueError(f"keeps of {label(found)} must contain names, got {found.keeps!r}")
    for name, part in found.observes.items():
        if not isinstance(part, ObservationSpec) or not part.low < part.high:
            raise ValueError(
                f"observes of {label(found)} must map names to ObservationSpec with low < high, "
                f"got {part!r} for {name!r}"
            )
    return found


def label(task: Task) -> str:
    """Name of a task in messages."""
    return str(getattr(task, "_label", type(task).__name__))

"""`TaskBatch`: flights with the rewards, endings, observations and starts of a user's task."""

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import replace
from functools import reduce
from typing import TYPE_CHECKING, Any, NamedTuple, NoReturn

import numpy as np
from numpy.typing import ArrayLike, NDArray

from quad_gym.batch.memory import State
from quad_gym.batch.starts import checked_mask, checked_start
from quad_gym.configuration import FlightConfiguration
from quad_gym.params import checks as check
from quad_gym.params.checks import did_you_mean
from quad_gym.params.task import TaskParams
from quad_gym.params.world import WorldParams
from quad_gym.records import RESULTS, Autoreset, Ending, Result
from quad_gym.tasks.task import (
    BOUND,
    METHODS,
    FlightRandom,
    Task,
    TaskError,
    label,
    resolve_task,
)
from quad_gym.tasks.view import VIEW_FIELDS, BuiltinView, Group, ReadableBatch, View, field

if TYPE_CHECKING:
    from quad_gym.params.suites import SensorSuite


# --------------------------------------------------------------------------------------------------
# Checks of the return values of a task's methods; errors name the method and the flights.
# --------------------------------------------------------------------------------------------------

Floats = NDArray[np.float64]
Truths = NDArray[np.bool_]

LONE = "observed"
"""Name in the table of observations for an array that `observe` returns without a name."""

Start = dict[str, Any]

_SHAPES: dict[str, tuple[int, ...]] = {"position": (3,), "velocity": (3,), "yaw": ()}
"""Start values that `reset` may return, with the shapes of their rows."""


def ask(task: Task, method: str, *arguments: Any) -> Any:
    """Call a task's method; an exception that it raises becomes the cause of a TaskError."""
    try:
        return getattr(task, method)(*arguments)
    except Exception as error:
        raise TaskError(
            f"{label(task)}.{method} failed, for all flights: {type(error).__name__}: {error}"
            + _meant(error)
        ) from error


def _meant(error: Exception) -> str:
    """Suggestion of an attribute's name, for the end of a message about one that is missing."""
    if not isinstance(error, AttributeError) or error.name is None:
        return ""
    if not isinstance(error.obj, Group | State):
        return ""  # attributes of users' objects may have side effects
    if isinstance(error.obj, Group):  # in another group?
        for field in VIEW_FIELDS:
            if field.name.rpartition(".")[2] == error.name:
                return f"; did you mean view.{field.name}?"
    return did_you_mean(error.name, [name for name in dir(error.obj) if name[0] != "_"])


def numbers(task: Task, method: str, value: Any, name: str = "") -> NDArray[Any]:
    """Convert a return value to an array of numbers."""
    try:
        found = np.asarray(value)
    except (TypeError, ValueError):
        found = np.array(None)
    if found.dtype.kind not in "fiub":
        _refuse(task, method, f"numbers{_of(name)}", _short(value))
    return found


def reward_terms(task: Task, view: View) -> dict[str, Floats]:
    """Terms of a task's reward, (n,) each, which may still be NaN or infinite."""
    value = ask(task, "reward", view)
    if not isinstance(value, Mapping):
        return {"reward": _reward(task, value, view.count)}
    if not value:
        _refuse(task, "reward", "at least one term", "none")
    return {str(name): _reward(task, term, view.count, str(name)) for name, term in value.items()}


def _reward(task: Task, value: Any, count: int, name: str = "") -> Floats:
    """Reward, or its term with this name, (n,)."""
    found = numbers(task, "reward", value, name)
    if found.shape != (count,):
        must = f"shape ({count},), one number per flight{_of(name)}"
        _refuse(task, "reward", must, found.shape)
    return found.astype(np.float64)


def truths(task: Task, method: str, view: View) -> Truths:
    """Boolean values that a method returns, (n,)."""
    found = numbers(task, method, ask(task, method, view))
    if found.dtype.kind != "b" or found.shape != (view.count,):
        must = f"booleans of shape ({view.count},)"
        _refuse(task, method, must, f"{found.dtype} of {found.shape}")
    return found


def parts_of(task: Task, value: Any, count: int) -> dict[str, NDArray[Any]]:
    """Convert the return value of `observe` to (n, k) arrays by name, in its order."""
    named = value if isinstance(value, Mapping) else {LONE: value}
    found = {}
    for name, part in named.items():
        array = numbers(task, "observe", part, str(name))
        if array.ndim not in (1, 2) or len(array) != count:
            must = f"shape ({count},) or ({count}, k){_of(str(name))}"
            _refuse(task, "observe", must, array.shape)
        found[str(name)] = array[:, np.newaxis] if array.ndim == 1 else array
    return found


def starts(
    task: Task,
    returned: Any,
    chosen: NDArray[np.bool_],
    given: Start,
    params: TaskParams,
    world: WorldParams,
) -> Start:
    """Combine start values that `reset` of a task returns with `given` ones, which take precedence.

    Rows of flights that are not `chosen` (n,) to begin an episode are ignored.
    """
    if not isinstance(returned, Mapping) or not set(returned) <= set(_SHAPES):
        raise TaskError(
            f"{label(task)}.reset must return None or a dictionary with any of "
            f"{', '.join(_SHAPES)}; got {returned!r}"
        )
    count, found = len(chosen), {name: given.get(name) for name in _SHAPES}
    for name, value in returned.items():
        values = numbers(task, "reset", value, name)
        shape = (count, *_SHAPES[name])
        if values.shape not in (shape, _SHAPES[name]):
            _refuse(task, "reset", f"shape {shape} for {name!r}", values.shape)
        rows = np.zeros(shape)
        rows[chosen] = np.broadcast_to(values, shape)[chosen]
        sound = np.asarray(np.isfinite(rows).reshape(count, -1).all(axis=1))
        require(sound, task, "reset", rows, f"finite numbers for {name!r}")
        if given.get(name) is None:
            found[name] = rows
    try:
        checked_start(count, **found, task=params, world=world, chosen=chosen)
    except ValueError as error:
        raise TaskError(f"{label(task)}.reset returned an invalid start: {error}") from None
    return found


def require(sound: Truths, task: Task, method: str, values: NDArray[Any], required: str) -> None:
    """Reject values (n, ...) of flights that are not sound, (n,)."""
    wrong = np.flatnonzero(~sound)
    if wrong.size:
        got = f"{_short(values[wrong[0]])} for {flights_named(wrong)}"
        _refuse(task, method, required, got)


def flights_named(flights: NDArray[np.intp]) -> str:
    """List flights by number, at most five."""
    first = ", ".join(str(i) for i in flights[:5])
    more = f" and {len(flights) - 5} more" if len(flights) > 5 else ""
    return f"flight {first}" if len(flights) == 1 else f"flights {first}{more}"


def _refuse(task: Task, method: str, must: str, got: Any) -> NoReturn:
    """Raise a TaskError for what a method has returned."""
    raise TaskError(f"{label(task)}.{method} must return {must}, got {got}")


def _of(name: str) -> str:
    return f" for {name!r}" if name and name != LONE else ""


def _short(value: Any) -> str:
    text = repr(value)
    return text if len(text) <= 60 else f"{text[:57]}..."


# --------------------------------------------------------------------------------------------------
# Observations of a task: joined with the built-in observation, checked and clipped.
# --------------------------------------------------------------------------------------------------

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
        parts = parts_of(task, value, self._count)
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
                require(~wrong, task, "observe", values, f"finite {name!r}")
            np.nan_to_num(ours, copy=False)
        np.clip(ours, self._low, self._high, out=ours)
        return joined


# --------------------------------------------------------------------------------------------------
# `LaidTask`: a user's task laid over the task of an id, whose methods stay where it has none.
# --------------------------------------------------------------------------------------------------


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
            named = parts_of(self.base, self.base.observe(view), view.count)
            parts = {name: part for name, part in named.items() if self._keeps_part(name)}
        if self.over.has("observe"):
            with self._over(view):
                own = parts_of(self.over, self.over.observe(view), view.count)
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
            terms = reward_terms(self._base, view)
        return np.where(self._flights.began, 0.0, reduce(np.add, terms.values()))

    @field("(n,) bool", "-", "-", "True where the environment's task terminates the episode")
    def terminated(self) -> Truths:
        with self._beneath_it() as view:
            return truths(self._base, "terminated", view) & ~self._flights.began

    @field("(n,) bool", "-", "-", "True where the environment's task cuts the episode short")
    def truncated(self) -> Truths:
        with self._beneath_it() as view:
            return truths(self._base, "truncated", view) & ~self._flights.began

    @field("(n,) int", "-", "-", "reason of the ending, see `quad_gym.records.Ending`")
    def ending(self) -> NDArray[np.int64]:
        over, why = self.terminated | self.truncated, self._beneath.ending
        return np.where(over, np.where(why > 0, why, int(Ending.TASK)), 0)


def laid_over(tasks: Sequence[Any]) -> Task:
    """Make one task of several, of which each is laid over the one before it.

    A task that derives from the class of the one before it takes its place.
    """
    found, *others = [resolve_task(given) for given in tasks]
    for over in others:
        base = type(found.over if isinstance(found, LaidTask) else found)
        if base is not Task and isinstance(over, base):
            found = LaidTask(over, found.base) if isinstance(found, LaidTask) else over
        else:
            found = LaidTask(over, found)
    return found


# --------------------------------------------------------------------------------------------------
# `TaskBatch`: flights with the rewards, endings, observations and starts of a user's task.
# --------------------------------------------------------------------------------------------------

LARGEST_REWARD = 1e30
"""Larger rewards are errors; learning algorithms hold rewards in single precision."""
_RESET_DRAWS, _UPDATE_DRAWS = 1, 2


class TaskBatch(ReadableBatch):
    """Flights of one configuration with a user-defined task.

    The kernels simulate, evaluate and observe as usual; the task's methods then replace their part
    of the results. Episodes begin in the kernel with next-step autoreset, and by masked resets
    otherwise, so that the flights' random streams continue as without a task.

    `parts` are the arrays that `observe` returns, inserted at index `split` of the built-in
    observation, of which the indices `kept` are kept (None: all).
    """

    def __init__(
        self,
        c: FlightConfiguration,
        *,
        own_task: Task,
        parts: Mapping[str, Part] | None = None,
        split: int = 0,
        kept: Sequence[int] | None = None,
    ) -> None:
        self.made = c, {"own_task": own_task, "parts": parts, "split": split, "kept": kept}
        self._in_kernel = c.autoreset is Autoreset.NEXT_STEP
        mode = Autoreset.NEXT_STEP if self._in_kernel else Autoreset.DISABLED
        super().__init__(replace(c, autoreset=mode), split)
        self.own_task = own_task
        self.methods = frozenset(method for method in METHODS if own_task.has(method))
        self._same_step = c.autoreset is Autoreset.SAME_STEP
        self._joiner: Joiner | None = None
        if parts is not None and "observe" in self.methods:
            self._joiner = Joiner(self.count, parts, self._low.size, split, kept)
        self._state = State(self.count, own_task.state)
        self._failed: Truths = np.zeros(self.count, bool)
        self._terms: Mapping[str, Floats] = {}
        self._rewarded: Truths = np.zeros(self.count, bool)
        self._all, self._returns = np.arange(self.count), np.zeros(self.count)
        size = self._joiner.size if self._joiner else self._low.size
        # the kernels do not write it: they begin episodes only at the start of a step
        self.final_observations = np.zeros((self.count, size), np.float32)
        self._begun_again = False
        self._view: View | None = None

    # ---- flying -------------------------------------------------------------------------------

    def reset(
        self,
        *,
        seeds: Sequence[int | None] | None = None,
        keys: ArrayLike | None = None,
        mask: ArrayLike | None = None,
        position: ArrayLike | None = None,
        velocity: ArrayLike | None = None,
        yaw: ArrayLike | None = None,
    ) -> Singles:
        """Begin new episodes; see `FlightBatch.reset`. After a TaskError, they must begin again."""
        given: Start = {"position": position, "velocity": velocity, "yaw": yaw}
        chosen = checked_mask(self.count, mask)
        builtin = super().reset(seeds=seeds, keys=keys, mask=mask, **given)
        self._failed |= chosen
        observations = self._observed(self._begin(chosen, given, builtin))
        self._failed &= ~chosen
        return observations

    def step(self, actions: NDArray[Any] | None = None) -> Singles:
        """Fly one control period; see `FlightBatch.step`.

        After a TaskError, the vehicles have moved, but the step has no results; all flights must be
        reset.
        """
        if self._failed.any():
            raise check.NotResetError(
                f"call reset() before step(): a method of {label(self.own_task)} has failed for "
                f"{flights_named(np.flatnonzero(self._failed))}"
            )
        self.view.forget()
        builtin = super().step(actions)
        self._failed[:] = True
        observations = self._after_step(builtin)
        self._failed[:] = False
        return observations

    def _after_step(self, builtin: Singles) -> Singles:
        """Call the task's methods after a step; return the observations."""
        steps = self._results[Result.EPISODE_STEPS, : self.count]
        self.began = steps == 0.0 if self._in_kernel else np.zeros(self.count, bool)
        self._begun_again = False
        if self.began.any():
            builtin = self._begin(self.began, {}, builtin)
        if "update" in self.methods:
            with self._writing(~self.began, _UPDATE_DRAWS) as rng:
                ask(self.own_task, "update", self.view, rng)
        terms: dict[str, Floats] = {}
        if "reward" in self.methods:
            terms = reward_terms(self.own_task, self.view)
        terminated, truncated = self._asked_truths("terminated"), self._asked_truths("truncated")
        observations = self._observed(builtin)
        if terms:
            self._write_rewards(terms)
        over = self._write_endings(terminated, truncated)
        self._write_remaining()
        if self._same_step and over.any():
            self._keep_innovations()
            self.final_observations[over] = observations[over]
            builtin = self._begin(over, {}, super().reset(mask=over))
            observations[over] = self._observed(builtin)[over]
        return observations

    # ---- episodes that begin ------------------------------------------------------------------

    def _begin(self, chosen: Truths, given: Start, builtin: Singles) -> Singles:
        """Call `reset` of the task for episodes begun by the kernels; return the observations."""
        self.began = chosen
        self.judged[:, chosen] = self._returns[chosen] = 0.0
        self._state.begin(chosen)
        self.view.forget()
        if "reset" not in self.methods:
            return builtin
        with self._writing(chosen, _RESET_DRAWS) as rng:
            start = ask(self.own_task, "reset", self.view, rng)
        if start is not None:
            builtin = self._begin_again(
                chosen, starts(self.own_task, start, chosen, given, self.task, self.world)
            )
        return builtin

    def _begin_again(self, chosen: Truths, start: Start) -> Singles:
        """Begin the same episodes, with the same draws, at other start values."""
        again = np.flatnonzero(chosen)
        instants, episodes = self.record("instant", again), self.record("episode", again)
        self.write(again, instant=instants - np.uint64(1), episode=episodes - 1.0)
        builtin = super().reset(mask=chosen, **start)
        self._begun_again = True
        self.view.forget()
        return builtin

    # ---- rewards and endings ------------------------------------------------------------------

    def _asked_truths(self, method: str) -> Truths | None:
        """Return value of `terminated` or `truncated`; None: the built-in endings stay."""
        if method not in self.methods:
            return None
        return truths(self.own_task, method, self.view)

    def _write_rewards(self, terms: Mapping[str, Floats]) -> None:
        """Write rewards; flights that begin, or whose state is not finite, have none."""
        rewards = reduce(np.add, terms.values())
        sound = np.abs(rewards) <= LARGEST_REWARD  # NaN is not
        if not sound.all():
            failed = ~sound & ~self.began
            failed[failed] = self.finite(np.flatnonzero(failed))
            require(~failed, self.own_task, "reward", rewards, "finite rewards")
        self._terms, self._rewarded = terms, sound & ~self.began
        reward = np.where(self._rewarded, self.reward_scale * rewards, 0.0)
        self._returns += reward
        self._write(self._all, reward=reward, episode_return=self._returns)

    def reward_terms(self) -> dict[str, Floats]:
        """Return the terms of the last step's reward, (count,) each; their sum is the reward.

        A reward that the task returns as one array is one term, "reward".
        """
        if "reward" not in self.methods:
            return super().reward_terms()
        return {
            name: np.where(self._rewarded, self.reward_scale * term, 0.0)
            for name, term in self._terms.items()
        }

    def _write_endings(self, terminated: Truths | None, truncated: Truths | None) -> Truths:
        """Write endings and their reasons; return True for flights that have ended."""
        crashed, cut = self.judged[1] > 0.0, self.judged[2] > 0.0
        ends, truncates = crashed if terminated is None else terminated, cut
        if terminated is not None and (crashed & ~terminated).any():  # a flight that is not finite
            ends = terminated | crashed & ~self.finite(self._all)  # cannot go on
        if truncated is not None:
            truncates = truncated
        ends, truncates = ends & ~self.began, truncates & ~self.began
        over = ends | truncates
        changed = np.flatnonzero(over | crashed | cut)
        if changed.size:
            lost = (self.result("filter_diverged") > 0.0) & self.task.truncate_when_diverged
            why = np.where(lost, Ending.FILTER_DIVERGED, Ending.TIME_LIMIT)
            why = np.where(self.result("filter_status") > 0.0, Ending.FILTER_FAILED, why)
            why = np.where(truncates & cut, why, Ending.TASK)
            why = np.where(ends, np.where(crashed, self.judged[3], Ending.TASK), why)
            self._write(
                changed,
                terminated=ends[changed],
                truncated=truncates[changed],
                ending=(over * why)[changed],
                needs_reset=over[changed],
            )
        return over

    def _write(self, flights: NDArray[np.intp], **values: NDArray[Any]) -> None:
        """Write values of some flights to records, and to results that have their names."""
        self.write(flights, **values)
        for name, value in values.items():
            if name in RESULTS:
                self._results[RESULTS.index(name), : self.count][flights] = value

    def _write_remaining(self) -> None:
        """Write gates passed, and the starts of episodes that `reset` has changed."""
        if "gates_passed" in self._state.names:
            passed = np.where(self.began, 0.0, self._state.gates_passed)
            self._results[Result.GATES_PASSED, : self.count] = passed
            self.write(self._all, gate_next=passed)
        if self._begun_again:
            for name in ("position_error", "estimation_error", "filter_status"):
                row = self._results[Result[name.upper()], : self.count]
                row[self.began] = self.record(name)[self.began]

    # ---- observing ----------------------------------------------------------------------------

    def ask_parts(self) -> dict[str, NDArray[Any]]:
        """Arrays that `observe` returns at the present instant, (count, k) each."""
        return parts_of(self.own_task, self._asked_to_observe(), self.count)

    def _asked_to_observe(self) -> Any:
        view = self.view
        view.hide(not self.own_task.privileged)
        try:
            return ask(self.own_task, "observe", view)
        finally:
            view.hide(False)

    def _observed(self, builtin: Singles) -> Singles:
        """Observations of the environment."""
        if self._joiner is None:
            return builtin
        return self._joiner.join(self, self.own_task, self._asked_to_observe(), builtin)

    # ---- keeping ------------------------------------------------------------------------------

    @property
    def view(self) -> View:
        """View of the flights for the task's methods."""
        if self._view is None:
            self._view = View(self, self._state)
        return self._view

    def snapshot(self) -> NDArray[Any]:
        """Copy all flights and the task's state, for `restore`."""
        return self._state.kept_with(super().snapshot())

    def restore(self, snapshot: NDArray[Any]) -> None:
        """Restore all flights from a snapshot of this batch, or of another one of equal size."""
        kind = super().snapshot().dtype
        super().restore(self._state.flights_of(snapshot, kind, label(self.own_task)))
        self._state.restore(snapshot)
        self._returns = self.record("episode_return")
        self.began = self.record("tick") == 0.0
        self._failed[:] = False
        self.view.forget()

    def __getstate__(self) -> dict[str, Any]:
        """Everything but the threads and the view, which a copy creates itself."""
        return super().__getstate__() | {"_view": None}

    # ---- calling the task ---------------------------------------------------------------------

    @contextmanager
    def _writing(self, chosen: Truths, draws: int) -> Iterator[FlightRandom]:
        """Allow a method to change the task's state, but only of chosen flights."""
        kept = self._state.rows()
        self._state.lock(False)
        try:
            yield FlightRandom(self.record("key"), self.record("instant"), draws)
        finally:
            self._state.put(kept[~chosen], ~chosen)

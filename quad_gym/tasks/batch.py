"""`TaskBatch`: flights that a task of a user's own judges, observes and begins."""

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from quad_gym.batch.flight_batch import FlightBatch
from quad_gym.batch.starts import checked_mask, checked_start
from quad_gym.params import checks as check
from quad_gym.records import WIDTH, Autoreset, Ending, Result
from quad_gym.tasks import answers
from quad_gym.tasks.draws import FlightRandom
from quad_gym.tasks.state import State
from quad_gym.tasks.task import Task, TaskError, label
from quad_gym.tasks.view import View

Floats = NDArray[np.float64]
Truths = NDArray[np.bool_]
Start = dict[str, ArrayLike | None]

_RESET_DRAWS, _UPDATE_DRAWS = 1, 2
_TASK = float(Ending.TASK)
_STARTS = {"position": (3,), "velocity": (3,), "yaw": ()}
"""What `reset` may return, with the shapes of its rows."""


class Before(NamedTuple):
    """What flights were like before a step."""

    position_error: Floats
    gates_passed: Floats


class Part(NamedTuple):
    """One part of what `observe` returns."""

    size: int
    low: float
    high: float


class TaskBatch(FlightBatch):
    """Flights of one configuration under a task of a user's own.

    The kernels fly, judge and observe as ever; then the task's methods replace what they replace.
    Episodes begin in the kernel where it flies by the next-step mode, and by masked resets
    otherwise, so that the flights' random streams go on as without a task.

    Args:
        count: Number of flights.
        custom: The task.
        parts: What its `observe` returns, by name; None: it is not asked.
        split: Where that stands in an observation: after so many shipped numbers.
        autoreset: When a flight whose episode is over begins the next one.
        keywords: Those of `FlightBatch`.

    Raises:
        ValueError: If an argument is invalid.
    """

    def __init__(
        self,
        count: int,
        *,
        custom: Task,
        parts: Mapping[str, Part] | None = None,
        split: int = 0,
        autoreset: Autoreset = Autoreset.DISABLED,
        **keywords: Any,
    ) -> None:
        in_kernel = autoreset == Autoreset.NEXT_STEP
        super().__init__(
            count,
            autoreset=Autoreset.NEXT_STEP if in_kernel else Autoreset.DISABLED,
            **keywords,
        )
        self.custom, self.mode = custom, Autoreset(autoreset)
        self._parts, self._split = dict(parts or {}), split
        self._observes = parts is not None and custom.has("observe")
        self._kept = slice(split, split) if custom.replaces_observation else slice(0, split)
        self.period = 1.0 / self.clocks.control_rate
        self.reward_scale = self.period if self.task.reward_per == "second" else 1.0
        self.harmonics = int(self._settings["harmonics"][0])
        camera = self.sensors.camera
        self.features = np.array([] if camera is None else camera.features_I).reshape(-1, 3)
        self.features.flags.writeable = False
        self._state = State(self.count, custom.state)
        self._unjudged = np.zeros(self.count, bool)
        self.began = np.zeros(self.count, bool)
        self.before = Before(np.zeros(self.count), np.zeros(self.count))
        self._finals = np.zeros(self._composed(self._observations).shape, np.float32)
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
    ) -> NDArray[np.float32]:
        """Begin new episodes; see `FlightBatch.reset`.

        Raises:
            ValueError: If the arguments do not fit the number of flights; nothing has changed then.
            TaskError: If a method of the task fails; the flights need another reset then.
        """
        given: Start = {"position": position, "velocity": velocity, "yaw": yaw}
        chosen = checked_mask(self.count, mask)
        observations = super().reset(seeds=seeds, keys=keys, mask=mask, **given)
        with self._judging(chosen):
            return self._observed(self._begin(chosen, given, observations))

    def step(self, actions: NDArray[Any] | None = None) -> NDArray[np.float32]:
        """Fly one control period; see `FlightBatch.step`.

        Raises:
            ValueError: If flights have never been reset; it is a RuntimeError, too.
            TaskError: If a method of the task fails. The step has been flown then, but nothing
                says what came of it: all flights need a reset.
        """
        if self._unjudged.any():
            raise check.NotResetError(
                f"call reset() before step(): a method of {label(self.custom)} has failed for "
                f"{answers.flights_named(np.flatnonzero(self._unjudged))}"
            )
        if not self._begun:
            self._require_begun()
        self.before = Before(self.columns("position_error"), self.columns("gate_next"))
        returns = self.columns("episode_return")
        in_kernel = self.mode == Autoreset.NEXT_STEP
        self.began = self.columns("needs_reset") > 0.0 if in_kernel else np.zeros(self.count, bool)
        shipped = super().step(actions)
        with self._judging(np.ones(self.count, bool)):
            view = self.view
            view.step_over()
            if self.began.any():
                shipped = self._begin(self.began, {}, shipped)
                self._describe_start(self.began)
            if self.custom.has("update"):
                with self._writing(~self.began, _UPDATE_DRAWS) as rng:
                    answers.ask(self.custom, "update", view, rng)
            over = self._judge(returns)
            observations = self._observed(shipped)
            if self.mode == Autoreset.SAME_STEP and over.any():
                self._begin_next(over, observations)
            return observations

    def _begin_next(self, over: Truths, observations: NDArray[np.float32]) -> None:
        """Begin the next episodes in the step that ended the last ones."""
        self._finals[over] = observations[over]
        shipped = self._begin(over, {}, super().reset(mask=over))
        observations[over] = self._observed(shipped)[over]

    def _begin(
        self, chosen: Truths, given: Start, shipped: NDArray[np.float32]
    ) -> NDArray[np.float32]:
        """Ask the task about episodes that the kernels have begun; return what these observe."""
        self.began = chosen
        self._state.begin(chosen)
        view = self.view
        view.begin(chosen)
        if not self.custom.has("reset"):
            return shipped
        with self._writing(chosen, _RESET_DRAWS) as rng:
            start = answers.ask(self.custom, "reset", view, rng)
        if start is not None:
            shipped = self._start_again(chosen, self._checked_start(start, chosen, given))
            view.forget()
        return shipped

    def _start_again(self, chosen: Truths, start: Start) -> NDArray[np.float32]:
        """Begin the same episodes once more, at other places: their draws are the same."""
        lanes = np.zeros(len(self._blocks) * WIDTH, bool)
        lanes[: self.count] = chosen
        again = lanes.reshape(-1, WIDTH)
        self._blocks["instant"][again] -= np.uint64(1)
        self._blocks["episode"][again] -= 1.0
        return super().reset(mask=chosen, **start)

    def _checked_start(self, start: Any, chosen: Truths, given: Start) -> Start:
        """Start values of a task's reset, beside those that a caller has given."""
        task = self.custom
        if not isinstance(start, Mapping) or not set(start) <= set(_STARTS):
            raise TaskError(
                f"{label(task)}.reset must return None or start values by name, of "
                f"{', '.join(_STARTS)}; got {start!r}"
            )
        found = dict(given)
        for name, value in start.items():
            values = answers.numbers(task, "reset", value, name)
            shape = (self.count, *_STARTS[name])
            if values.shape not in (shape, _STARTS[name]):
                raise TaskError(
                    f"{label(task)}.reset must return shape {shape} for {name!r}, "
                    f"got {values.shape}"
                )
            rows = np.zeros(shape)
            rows[chosen] = np.broadcast_to(values, shape)[chosen]
            sound = np.isfinite(rows).reshape(self.count, -1).all(axis=1)
            answers.require(sound, task, "reset", rows, f"finite numbers for {name!r}")
            if given.get(name) is None:
                found[name] = rows
        try:
            checked_start(self.count, **found, task=self.task)
        except ValueError as error:
            raise TaskError(f"{label(task)}.reset returned a wrong start: {error}") from None
        return found

    # ---- judging ------------------------------------------------------------------------------

    def _judge(self, returns: Floats) -> Truths:
        """Ask for reward and endings, write what is the task's own, and return who is over."""
        task, view, flew = self.custom, self.view, ~self.began
        written: dict[Result, Floats] = {}
        if task.has("reward"):
            reward = answers.reward(task, answers.ask(task, "reward", view), self.count)
            sound = np.abs(reward) <= answers.LARGEST_REWARD
            if not sound.all():  # nobody is asked about a flight that is no more
                sound |= self.began | ~self._finite(~sound)
                answers.require(sound, task, "reward", reward, "finite rewards")
                reward = np.where(np.isfinite(reward), reward, 0.0)
            reward = np.where(flew, reward * self.reward_scale, 0.0)
            written[Result.REWARD] = reward
            written[Result.EPISODE_RETURN] = np.where(flew, returns + reward, 0.0)
        if task.has("terminated") or task.has("truncated"):
            written |= self._endings(flew)
        if self._observes and task.privileged:
            view.own_shipped.read()
        for result, values in written.items():
            self._results[result, : self.count] = values
            self.write(result.name.lower(), values)
        over = self.result("terminated") + self.result("truncated") > 0.0
        if Result.TERMINATED in written:
            self.write("needs_reset", over)
        return over

    def _endings(self, flew: Truths) -> dict[Result, Floats]:
        """Who is terminated and truncated, and why."""
        task, view = self.custom, self.view
        asked = {}
        for method in ("terminated", "truncated"):
            if task.has(method):
                value = answers.ask(task, method, view)
                asked[method] = answers.truths(task, method, value, self.count)
        shipped = view.own_shipped
        terminated = asked.get("terminated", shipped.terminated)
        spared = shipped.terminated & ~terminated
        if spared.any():
            terminated = terminated | (spared & ~self._finite(spared))
        terminated = terminated & flew
        truncated = asked.get("truncated", shipped.truncated) & flew & ~terminated
        ending = np.where(shipped.terminated & terminated, shipped.ending, _TASK)
        # why it would have been truncated: the judge says so only of what has not terminated
        limit = self.result("episode_steps") >= (self.max_steps or np.inf)
        cut = np.where(limit, float(Ending.TIME_LIMIT), _TASK)
        if self.task.end_when_lost:
            cut = np.where(self.result("filter_lost") > 0.0, float(Ending.FILTER_LOST), cut)
        failed = self.result("filter_status") > 0.0
        cut = np.where(failed, float(Ending.FILTER_FAILED), cut)
        ending = np.where(truncated, np.where(shipped.truncated, cut, _TASK), ending)
        return {
            Result.TERMINATED: terminated.astype(np.float64),
            Result.TRUNCATED: truncated.astype(np.float64),
            Result.ENDING: np.where(terminated | truncated, ending, 0.0),
        }

    def _finite(self, chosen: Truths) -> Truths:
        """(n,) whether the true state of flights is finite; looked at where `chosen`."""
        finite = np.ones(self.count, bool)
        flights = np.flatnonzero(chosen)
        state = np.concatenate([self.read(name, flights) for name in ("r", "v", "q", "w")], axis=1)
        finite[flights] = np.isfinite(state).all(axis=1)
        return finite

    def _describe_start(self, began: Truths) -> None:
        """Let the results speak of the start, where a step has begun an episode."""
        for result in ("position_error", "estimation_error", "filter_status"):
            row = self._results[Result[result.upper()], : self.count]
            row[began] = self.columns(result)[began]

    # ---- observing ----------------------------------------------------------------------------

    @property
    def final_observations(self) -> NDArray[np.float32]:
        """(count, n_observation) float32, where one episode has ended and the next begun."""
        return self._finals

    @final_observations.setter
    def final_observations(self, value: NDArray[np.float32]) -> None:
        self._kernel_finals = value

    def shipped_observation(self) -> NDArray[np.float32]:
        """(count, k) what the kernels observe, less its privileged part."""
        return self._observations[:, : self._split]

    def ask_parts(self) -> dict[str, NDArray[Any]]:
        """What `observe` returns at the present instant, (count, k) each."""
        self.view.hide(not self.custom.privileged)
        try:
            value = answers.ask(self.custom, "observe", self.view)
        finally:
            self.view.hide(False)
        return answers.parts(self.custom, value, self.count)

    def _observed(self, shipped: NDArray[np.float32]) -> NDArray[np.float32]:
        """The observations that the environment shows."""
        if not self._observes:
            return self._composed(shipped)
        found = self.ask_parts()
        sizes = {name: part.shape[1] for name, part in found.items()}
        declared = {name: part.size for name, part in self._parts.items()}
        if sizes != declared:
            raise TaskError(
                f"{label(self.custom)}.observe must always return the same, {declared} numbers of "
                f"each flight, got {sizes}"
            )
        columns = []
        for name, part in self._parts.items():
            values = found[name]
            if not np.isfinite(values).all():
                sound = np.isfinite(values).all(axis=1)
                sound |= ~self._finite(~sound)
                answers.require(sound, self.custom, "observe", values, f"finite {name!r}")
                values = np.nan_to_num(values, nan=part.low)
            columns.append(np.clip(values, part.low, part.high))
        return self._composed(shipped, columns)

    def _composed(
        self, shipped: NDArray[np.float32], own: Sequence[NDArray[Any]] = ()
    ) -> NDArray[np.float32]:
        """Shipped numbers, the task's, and the shipped privileged ones."""
        if not self._parts:
            return shipped
        if not own:
            own = [np.zeros((self.count, part.size)) for part in self._parts.values()]
        kept, rest = shipped[:, self._kept], shipped[:, self._split :]
        return np.concatenate([kept, *own, rest], axis=1, dtype=np.float32, casting="same_kind")

    # ---- what a view reads --------------------------------------------------------------------

    @property
    def view(self) -> View:
        """What the task sees of the flights."""
        if self._view is None:
            self._view = View(self, self._state)
        return self._view

    def columns(self, name: str) -> NDArray[Any]:
        """A field of the flights as a new array (..., n)."""
        if name not in (self._blocks.dtype.fields or {}):
            return np.ascontiguousarray(np.moveaxis(self.read(name), 0, -1))
        values = self._blocks[name]
        last = values.ndim - 1
        values = values.transpose(*range(1, last), 0, last).copy()
        return values.reshape(*values.shape[:-2], -1)[..., : self.count]

    def rows(self, name: str) -> NDArray[Any]:
        """A field of the flights as a new array (n, ...); matrices are contiguous."""
        values = self.columns(name)
        if values.ndim == 2:
            return values.T
        return np.ascontiguousarray(np.moveaxis(values, -1, 0))

    def write(self, name: str, values: NDArray[Any]) -> None:
        """Write a field of all flights, (n,)."""
        lanes = self._blocks[name].flatten()
        lanes[: self.count] = values
        self._blocks[name] = lanes.reshape(-1, WIDTH)

    def gates(self) -> Floats:
        """(n, gates, 3) of a course in I [m]."""
        return self.rows("gates")[:, : self.task.gate_count]

    def nominal(self) -> dict[str, Any]:
        """Numbers of the nominal sensors."""
        names = ("camera", "R_CB", "focal_length", "half_image", "R_IG")
        return {name: self._world[name][0, ..., 0] for name in names}

    # ---- keeping ------------------------------------------------------------------------------

    def snapshot(self) -> NDArray[Any]:
        """A copy of all flights and of what the task keeps; `restore` brings them back."""
        flights = super().snapshot()
        if not len(self._state):
            return flights
        kept = np.zeros(len(flights), [("flights", flights.dtype), ("state", self._state.dtype())])
        kept["flights"] = flights
        self._state.write_to(kept["state"])
        return kept

    def restore(self, snapshot: NDArray[Any]) -> None:
        """Bring all flights back to a snapshot of this batch, or of one of the same size.

        Raises:
            ValueError: If the snapshot is of another size, kind or task.
        """
        flights = snapshot
        if len(self._state):
            names = getattr(getattr(snapshot, "dtype", None), "names", None)
            if names != ("flights", "state") or snapshot["state"].dtype != self._state.dtype():
                raise ValueError(f"snapshot must be that of a batch with {label(self.custom)}")
            flights = snapshot["flights"]
        super().restore(flights)
        if len(self._state):
            self._state.read_from(snapshot["state"])
        self._unjudged[:] = False
        self._view = None

    def __getstate__(self) -> dict[str, Any]:
        """All but the threads and the view, which a copy makes anew."""
        return super().__getstate__() | {"_view": None}

    # ---- calling the task ---------------------------------------------------------------------

    @contextmanager
    def _judging(self, flights: Truths) -> Iterator[None]:
        """Let flights need a reset if something fails on the way."""
        self._unjudged |= flights
        yield
        self._unjudged &= ~flights

    @contextmanager
    def _writing(self, chosen: Truths, draws: int) -> Iterator[FlightRandom]:
        """Let a method change the task's state, of some flights alone."""
        instants = self.columns("instant")
        rng = FlightRandom(self.rows("key"), instants, draws)
        kept = {} if chosen.all() else self._state.copies()
        self._state.lock(False)
        try:
            yield rng
        finally:
            self._state.lock(True)
            if kept:
                self._state.bring_back(kept, ~chosen)

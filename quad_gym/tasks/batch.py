"""`TaskBatch`: flights with the rewards, endings, observations and starts of a user's task."""

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from functools import reduce
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from quad_gym.batch.calls import Calls, address_of
from quad_gym.batch.starts import checked_mask
from quad_gym.kernels.task.settle import LARGEST_REWARD, Verdict, settle
from quad_gym.params import checks as check
from quad_gym.records import WIDTH, Autoreset, Result
from quad_gym.tasks import answers
from quad_gym.tasks.draws import FlightRandom
from quad_gym.tasks.memory import COMPARED_ERROR, COMPARED_GATES, ReadableBatch
from quad_gym.tasks.observing import Joiner, Part
from quad_gym.tasks.starts import Start, starts
from quad_gym.tasks.state import State
from quad_gym.tasks.task import METHODS, Task, label
from quad_gym.tasks.view import View

Floats = NDArray[np.float64]
Singles = NDArray[np.float32]
Truths = NDArray[np.bool_]

_RESET_DRAWS, _UPDATE_DRAWS = 1, 2


class TaskBatch(ReadableBatch):
    """Flights of one configuration with a user-defined task.

    The kernels simulate, evaluate and observe as usual; the task's methods then replace their part
    of the results. Episodes begin in the kernel with next-step autoreset, and by masked resets
    otherwise, so that the flights' random streams continue as without a task.

    Args:
        count: Number of flights.
        own_task: User-defined task.
        parts: Arrays that its `observe` returns, by name; None: `observe` is not called.
        split: Index in the built-in observation at which these are inserted.
        kept: Indices of the built-in observation that are kept; None: all.
        autoreset: Mode that determines when the next episode begins after one has ended.
        keywords: Keywords of `FlightBatch`.

    Raises:
        ValueError: If an argument is invalid.
    """

    def __init__(
        self,
        count: int,
        *,
        own_task: Task,
        parts: Mapping[str, Part] | None = None,
        split: int = 0,
        kept: Sequence[int] | None = None,
        autoreset: Autoreset = Autoreset.DISABLED,
        **keywords: Any,
    ) -> None:
        self._in_kernel = autoreset == Autoreset.NEXT_STEP
        mode = Autoreset.NEXT_STEP if self._in_kernel else Autoreset.DISABLED
        super().__init__(count, autoreset=mode, **keywords)
        self.own_task = own_task
        self.methods = frozenset(method for method in METHODS if own_task.has(method))
        self._same_step = autoreset == Autoreset.SAME_STEP
        self._split, self._joiner = split, None
        if parts is not None and "observe" in self.methods:
            self._joiner = Joiner(self.count, parts, self._low.size, split, kept)
        self.period = 1.0 / self.clocks.control_rate
        self.reward_scale = self.period if self.task.reward_per == "second" else 1.0
        self._state = State(self.count, own_task.state)
        self._counts_gates = "gates_passed" in own_task.state
        self._failed: Truths | None = None  # None: no flight has failed
        self._began_in_step: Truths = np.zeros(self.count, bool)
        self.began: Truths = self._began_in_step
        self.began_some = False
        self._rewards, self._returns = np.zeros(self.count), np.zeros(self.count)
        self._terms: dict[str, NDArray[Any]] = {}
        self._terminated: Truths = np.zeros(self.count, bool)
        self._truncated: Truths = np.zeros(self.count, bool)
        self._before = np.zeros_like(self.compared_shown)
        size = self._joiner.size if self._joiner else self._low.size
        self._finals = np.zeros((self.count, size), np.float32)
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
        """Begin new episodes; see `FlightBatch.reset`.

        Raises:
            ValueError: If the arguments do not fit the number of flights; nothing is changed.
            TaskError: If a method of the task fails; the flights must be reset again.
        """
        given: Start = {"position": position, "velocity": velocity, "yaw": yaw}
        chosen = checked_mask(self.count, mask)
        shipped = super().reset(seeds=seeds, keys=keys, mask=mask, **given)
        nobody = np.zeros(self.count, bool)
        others = nobody if self._failed is None else self._failed & ~chosen
        self._note_failed(others)
        try:
            return self._observed(self._begin(chosen, given, shipped))
        except BaseException:
            self._note_failed(others | chosen)
            raise

    def step(self, actions: NDArray[Any] | None = None) -> Singles:
        """Fly one control period; see `FlightBatch.step`.

        Raises:
            ValueError: If flights have never been reset; it is also a RuntimeError.
            TaskError: If a method of the task fails. The vehicles have moved, but the step has no
                results; all flights must be reset.
        """
        if self._failed is not None:
            raise check.NotResetError(
                f"call reset() before step(): a method of {label(self.own_task)} has failed for "
                f"{answers.flights_named(np.flatnonzero(self._failed))}"
            )
        if not self._begun:
            self._require_begun()
        self._remember()
        self.view.step_over()
        shipped = super().step(actions)
        try:
            return self._after_step(shipped)
        except BaseException:
            self._note_failed(np.ones(self.count, bool))
            raise

    def _note_failed(self, flights: Truths) -> None:
        """Mark flights for which a method has failed; they need a reset before the next step."""
        self._failed = flights if flights.any() else None

    def _remember(self) -> None:
        """Store the quantities that the next step is compared with."""
        self._before[:] = self.compared_shown
        if self._counts_gates:
            self._before[COMPARED_GATES] = self.columns("gate_next")

    @property
    def error_before(self) -> Floats:
        """Distance from the reference before the step, (n,) [m]."""
        return self._before[COMPARED_ERROR]

    @property
    def gates_before(self) -> Floats:
        """Number of gates passed before the step, (n,)."""
        return self._before[COMPARED_GATES]

    def _after_step(self, shipped: Singles) -> Singles:
        """Call the task's methods after a step; return the observations."""
        self.began, self.began_some = self._began_in_step, False
        self._begun_again = False
        if self._in_kernel:
            np.logical_not(self.time_shown, out=self._began_in_step)
            # bytes of booleans are 0 or 1; any() takes ten times longer for few flights
            self.began_some = 1 in self._began_in_step.tobytes()
        if self.began_some:
            shipped = self._begin(self._began_in_step, {}, shipped)
        if "update" in self.methods:
            with self._writing(~self.began, _UPDATE_DRAWS) as rng:
                answers.ask(self.own_task, "update", self.view, rng)
        self._judge()
        observations = self._observed(shipped)
        if self._joiner and self.own_task.privileged:
            self.view.builtin.read()
        ended = self._settle()
        if ended and self._same_step:
            over = self._flights_over()
            self._keep_innovations()
            self._finals[over] = observations[over]
            shipped = self._begin(over, {}, super().reset(mask=over))
            observations[over] = self._observed(shipped)[over]
        return observations

    # ---- episodes that begin ------------------------------------------------------------------

    def _begin(self, chosen: Truths, given: Start, shipped: Singles) -> Singles:
        """Call `reset` of the task for episodes begun by the kernels; return the observations."""
        self.began, self.began_some = chosen, True
        self._state.begin(chosen)
        self._returns[chosen] = 0.0
        self.view.begin(chosen)
        if "reset" not in self.methods:
            return shipped
        with self._writing(chosen, _RESET_DRAWS) as rng:
            start = answers.ask(self.own_task, "reset", self.view, rng)
        if start is not None:
            shipped = self._begin_again(
                chosen, starts(self.own_task, start, chosen, given, self.task, self.world)
            )
        return shipped

    def _begin_again(self, chosen: Truths, start: Start) -> Singles:
        """Begin the same episodes, with the same draws, at other start values."""
        lanes = np.zeros(len(self._blocks) * WIDTH, bool)
        lanes[: self.count] = chosen
        again = lanes.reshape(-1, WIDTH)
        self._blocks["instant"][again] -= np.uint64(1)
        self._blocks["episode"][again] -= 1.0
        shipped = super().reset(mask=chosen, **start)
        self._begun_again = True
        self.view.forget()
        return shipped

    # ---- rewards and endings ------------------------------------------------------------------

    def _judge(self) -> None:
        """Call `reward`, `terminated` and `truncated`, and store their results."""
        own_task, view, methods, count = self.own_task, self.view, self.methods, self.count
        if "reward" in methods:
            self._terms = answers.reward_terms(own_task, view, count)
            self._rewards[:] = reduce(np.add, self._terms.values())
        if "terminated" in methods:
            self._terminated[:] = answers.truths(own_task, "terminated", view, count)
        if "truncated" in methods:
            self._truncated[:] = answers.truths(own_task, "truncated", view, count)

    def _settle(self) -> int:
        """Write reward and endings of the task to results and records; return the flights ended."""
        ended: int = settle(self._calls.words, self._verdict, self.reward_scale)
        if ended < 0:
            sound = np.abs(self._rewards) <= LARGEST_REWARD
            answers.require(sound, self.own_task, "reward", self._rewards, "finite rewards")
        if self._counts_gates:
            passed = np.where(self.began, 0.0, self._state.gates_passed)
            self._results[Result.GATES_PASSED, : self.count] = passed
            self.write("gate_next", passed)
        if self._begun_again:
            for name in ("position_error", "estimation_error", "filter_status"):
                row = self._results[Result[name.upper()], : self.count]
                row[self.began] = self.columns(name)[self.began]
        return ended

    def _calls_of_threads(self) -> Calls:
        """Arguments of the compiled code, `settle` included."""
        self._verdict = np.zeros(len(Verdict), np.int64)
        for word, method, said in (
            (Verdict.REWARDS, "reward", self._rewards),
            (Verdict.TERMINATED, "terminated", self._terminated),
            (Verdict.TRUNCATED, "truncated", self._truncated),
        ):
            if method in self.methods:
                self._verdict[word] = address_of(said)
        self._verdict[Verdict.RETURNS] = address_of(self._returns)
        self._verdict[Verdict.BEGAN] = address_of(self._began_in_step)
        return super()._calls_of_threads()

    def reward_terms(self) -> dict[str, Floats]:
        """Return the terms of the last step's reward, (count,) each; their sum is the reward.

        A reward that the task returns as one array is one term, "reward".
        """
        if "reward" not in self.methods:
            return super().reward_terms()
        total = reduce(np.add, self._terms.values(), np.zeros(self.count))
        none = self._began_in_step | ~(np.abs(total) <= LARGEST_REWARD)
        return {
            name: np.where(none, 0.0, self.reward_scale * values)
            for name, values in self._terms.items()
        }

    # ---- observing ----------------------------------------------------------------------------

    @property
    def final_observations(self) -> Singles:
        """Last observations of episodes that ended in this step, (count, n_observation) float32."""
        return self._finals

    @final_observations.setter
    def final_observations(self, value: Singles) -> None:
        """Ignore the kernels' array: they begin episodes only at the start of a step."""

    def builtin_observation(self) -> Singles:
        """Built-in observation without its privileged part, (count, k)."""
        return self._observations[:, : self._split]

    def ask_parts(self) -> dict[str, NDArray[Any]]:
        """Arrays that `observe` returns at the present instant, (count, k) each."""
        return answers.parts(self.own_task, self._asked_to_observe(), self.count)

    def _asked_to_observe(self) -> Any:
        view = self.view
        view.hide(not self.own_task.privileged)
        try:
            return answers.ask(self.own_task, "observe", view)
        finally:
            view.hide(False)

    def _observed(self, shipped: Singles) -> Singles:
        """Observations of the environment."""
        if self._joiner is None:
            return shipped
        return self._joiner.join(self, self._asked_to_observe(), shipped)

    # ---- keeping ------------------------------------------------------------------------------

    @property
    def view(self) -> View:
        """View of the flights for the task's methods."""
        if self._view is None:
            self._view = View(self, self._state)
        return self._view

    def snapshot(self) -> NDArray[Any]:
        """Copy all flights and the task's state, for `restore`."""
        flights = super().snapshot()
        if not len(self._state):
            return flights
        kept = np.zeros(len(flights), [("flights", flights.dtype), ("state", self._state.dtype())])
        kept["flights"] = flights
        self._state.write_to(kept["state"])
        return kept

    def restore(self, snapshot: NDArray[Any]) -> None:
        """Restore all flights from a snapshot of this batch, or of another one of equal size.

        Raises:
            ValueError: If the snapshot has another size, kind or task.
        """
        flights = snapshot
        if len(self._state):
            kind = getattr(snapshot, "dtype", None)
            if getattr(kind, "names", None) != ("flights", "state") or (
                snapshot["state"].dtype != self._state.dtype()
            ):
                raise ValueError(f"snapshot must be one of a batch with {label(self.own_task)}")
            flights = snapshot["flights"]
        super().restore(flights)
        if len(self._state):
            self._state.read_from(snapshot["state"])
        self._returns[:] = self.columns("episode_return")
        self.began = self.time_shown == 0.0
        self.began_some = bool(np.count_nonzero(self.began))
        self._remember()  # the step before is unknown: no progress, no gate passed
        self._failed = None
        self.view.step_over()

    def __getstate__(self) -> dict[str, Any]:
        """Everything but the threads and the view, which a copy creates itself."""
        return super().__getstate__() | {"_view": None}

    # ---- calling the task ---------------------------------------------------------------------

    @contextmanager
    def _writing(self, chosen: Truths, draws: int) -> Iterator[FlightRandom]:
        """Allow a method to change the task's state, but only of chosen flights."""
        kept = {} if np.count_nonzero(chosen) == self.count else self._state.copies()
        self._state.lock(False)
        try:
            yield FlightRandom(self.rows("key"), self.columns("instant"), draws)
        finally:
            self._state.lock(True)
            if kept:
                self._state.bring_back(kept, ~chosen)

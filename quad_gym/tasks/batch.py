"""`TaskBatch`: flights with the rewards, endings, observations and starts of a user's task."""

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import replace
from functools import reduce
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from quad_gym.batch.resets import checked_mask
from quad_gym.packing.configuration import FlightConfiguration
from quad_gym.params import checks as check
from quad_gym.records import RESULTS, Autoreset, Ending, Result
from quad_gym.records.state import State
from quad_gym.tasks import answers
from quad_gym.tasks.answers import Start
from quad_gym.tasks.memory import ReadableBatch
from quad_gym.tasks.observing import Joiner, Part
from quad_gym.tasks.random import FlightRandom
from quad_gym.tasks.task import METHODS, Task, label
from quad_gym.tasks.view import View

Floats = NDArray[np.float64]
Singles = NDArray[np.float32]
Truths = NDArray[np.bool_]

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
                f"{answers.flights_named(np.flatnonzero(self._failed))}"
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
                answers.ask(self.own_task, "update", self.view, rng)
        terms: dict[str, Floats] = {}
        if "reward" in self.methods:
            terms = answers.reward_terms(self.own_task, self.view)
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
            start = answers.ask(self.own_task, "reset", self.view, rng)
        if start is not None:
            builtin = self._begin_again(
                chosen, answers.starts(self.own_task, start, chosen, given, self.task, self.world)
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
        return answers.truths(self.own_task, method, self.view)

    def _write_rewards(self, terms: Mapping[str, Floats]) -> None:
        """Write rewards; flights that begin, or whose state is not finite, have none."""
        rewards = reduce(np.add, terms.values())
        sound = np.abs(rewards) <= LARGEST_REWARD  # NaN is not
        if not sound.all():
            failed = ~sound & ~self.began
            failed[failed] = self.finite(np.flatnonzero(failed))
            answers.require(~failed, self.own_task, "reward", rewards, "finite rewards")
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
        return answers.parts(self.own_task, self._asked_to_observe(), self.count)

    def _asked_to_observe(self) -> Any:
        view = self.view
        view.hide(not self.own_task.privileged)
        try:
            return answers.ask(self.own_task, "observe", view)
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

"""What is kept of a run, with either engine: evaluations and the best policy, on Ctrl-C, too."""

import csv
import io
import os
import signal
import threading
import time
from abc import ABC, abstractmethod
from pathlib import Path
from types import FrameType, TracebackType
from typing import Any, Self

import gymnasium

from baselines.plans import Plan
from baselines.seeds import first_seed
from quad_gym.evaluation import Policy, roll_out

EVALUATIONS = "evaluations.csv"
STATE = "training_state.pickle"
"""Within the file of the last policy, where those who load the policy pass over it."""
_COLUMNS = (
    "steps",
    "training_seconds",
    "mean_error",
    "late_error",
    "crash_rate",
    "return",
    "gates_passed",
    "training_return",
)


SUFFIXES = {"sb3": ".zip", "compiled": ".npz"}
"""Of files of policies, by engine."""


class RunError(ValueError):
    """A folder does not hold the run that it should."""


def last_file(plan: Plan, folder: Path) -> Path:
    """Where the policy of the last evaluation is kept, and what resuming needs."""
    return folder / f"last{SUFFIXES[plan.engine]}"


def best_file(plan: Plan, folder: Path) -> Path:
    """Where the policy of the best evaluation is kept."""
    return folder / f"best{SUFFIXES[plan.engine]}"


def has_checkpoint(folder: Path) -> bool:
    """Whether a run can be resumed from the folder."""
    kept = any((folder / f"last{suffix}").exists() for suffix in SUFFIXES.values())
    return kept and (folder / "training.json").exists()


def score(summary: dict[str, float], duration: float) -> float:
    """What makes an evaluation the best: few crashes and small errors, or many gates and soon.

    Of a task with a reward of its own: the largest return.
    """
    if summary["own_reward"] > 0.0:
        return summary["return"]
    if summary["gates_total"] > 0.0:
        return summary["gates_passed"] - summary["crash_rate"] - summary["seconds"] / duration
    return -summary["mean_error"] - 10.0 * summary["crash_rate"]


class RunKeeper(ABC):
    """Evaluates the policy now and then, and keeps what a run leaves behind.

    All is done between a rollout and the next, where nothing is half done. A checkpoint is written
    under another name and then moved to its place, so a kill at any moment leaves the one before.

    Args:
        plan: What is trained.
        folder: Where the run is kept.
        judge: Flights to evaluate on.
        quiet: Whether to leave out the progress bar.
    """

    def __init__(
        self,
        plan: Plan,
        folder: Path,
        judge: gymnasium.vector.VectorEnv[Any, Any, Any],
        *,
        quiet: bool = False,
    ) -> None:
        super().__init__()
        self._plan, self._folder, self._judge, self._quiet = plan, folder, judge, quiet
        self._interval = plan.recipe.steps / plan.evaluations
        self._first_seed = first_seed("validation", plan.seed, plan.episodes)
        self.steps, self.seconds, self.finished = 0, 0.0, False
        self.rows: list[dict[str, float]] = []
        self.best: dict[str, float] = {}
        self.last: dict[str, float] = {}
        self._since: float | None = None
        self._stop = False
        self._handlers: dict[int, Any] = {}
        self._bar: Any = None

    # ---- what depends on the engine -------------------------------------------------------------

    @abstractmethod
    def _training_return(self, model: Any) -> float:
        """Mean return of the latest episodes of the training."""

    @abstractmethod
    def _save(self, model: Any, *, best: bool) -> None:
        """Write the best policy where this is it, and then the last checkpoint.

        In this order: a run that dies in between makes the same best policy again.
        """

    # ---- between rollouts -----------------------------------------------------------------------

    def begin(self, steps: int) -> None:
        """Start clock and bar of a training that has done `steps` steps; all is compiled now."""
        if not self._quiet:
            from tqdm.auto import tqdm

            total = self._plan.recipe.steps
            self._bar = tqdm(total=total, initial=steps, unit=" steps", unit_scale=True)
        self.steps, self._since = steps, time.perf_counter()

    def watch(self, model: Policy, steps: int) -> None:
        """Evaluate and keep a policy where it is due; to be called before every rollout."""
        if self._bar is not None:
            self._bar.update(steps - self._bar.n)
        due = steps // self._interval > self.steps // self._interval
        self.steps = steps
        if due or self._stop or not self.rows:
            self._keep(model)

    @property
    def stopping(self) -> bool:
        """Whether the run has been asked to end."""
        return self._stop

    # ---- the beginning and the end --------------------------------------------------------------

    def __enter__(self) -> Self:
        """Take over Ctrl-C and the request to terminate."""
        if threading.current_thread() is threading.main_thread():  # else they are not ours to take
            for number in (signal.SIGINT, signal.SIGTERM):
                self._handlers[number] = signal.signal(number, self._interrupt)
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        """Give the signals back."""
        while self._handlers:
            signal.signal(*self._handlers.popitem())
        if self._bar is not None:
            self._bar.close()

    def _interrupt(self, number: int, frame: FrameType | None) -> None:
        """The first signal ends the run with the rollout's present step; a second one, at once."""
        if self._stop:
            raise KeyboardInterrupt
        self._stop = True

    def finish(self, model: Policy, steps: int) -> None:
        """Keep the policy that the last step has made, if the run came to its end."""
        if self._bar is not None:
            self._bar.update(steps - self._bar.n)
        self.finished = steps >= self._plan.recipe.steps
        if self.finished and self.steps < steps:
            self.steps = steps
            self._keep(model)

    # ---- keeping --------------------------------------------------------------------------------

    def _keep(self, model: Policy) -> None:
        """Evaluate, and write a checkpoint."""
        now = time.perf_counter()
        self.seconds += now - (now if self._since is None else self._since)
        episodes = roll_out(model, self._judge, seed=self._first_seed)
        known = episodes.summary() | {
            "steps": float(self.steps),
            "training_seconds": self.seconds,
            "training_return": self._training_return(model),
        }
        row = {name: known[name] for name in _COLUMNS}
        self.rows.append(row)
        batch = self._judge.unwrapped.flights.batch  # type: ignore[attr-defined]
        summary = {
            **row,
            "own_reward": float("reward" in getattr(batch, "methods", ())),
            "gates_total": float(batch.task.gate_count * (batch.task.kind == "waypoints")),
            "seconds": float(episodes.lengths.mean() / batch.clocks.control_rate),
        }
        self.last = row | {"score": score(summary, batch.task.duration or 1.0)}
        is_best = not self.best or self.last["score"] > self.best["score"]
        self.best = self.last if is_best else self.best
        self._save(model, best=is_best)
        self._write_rows()
        if self._bar is not None:
            self._bar.set_postfix_str(f"error {row['mean_error']:.3f} m")
        self._since = time.perf_counter()

    def state(self) -> dict[str, Any]:
        """What the next process has to know to go on."""
        return {name: getattr(self, name) for name in ("rows", "best", "last", "seconds")}

    def restore(self, state: dict[str, Any], steps: int) -> None:
        """Know again what `state` gave when `steps` steps were done."""
        for name, value in state.items():
            setattr(self, name, value)
        self.steps = steps

    def _write_rows(self) -> None:
        text = io.StringIO()
        writer = csv.DictWriter(text, _COLUMNS, lineterminator="\n")
        writer.writeheader()
        writer.writerows(self.rows)
        replace_file(self._folder / EVALUATIONS, text.getvalue().encode())


def replace_file(file: Path, content: bytes) -> None:
    """Write a file so that at any moment there is the old or the new one, whole."""
    part = file.with_name(file.name + ".part")
    with part.open("wb") as stream:
        stream.write(content)
        stream.flush()
        os.fsync(stream.fileno())
    part.replace(file)

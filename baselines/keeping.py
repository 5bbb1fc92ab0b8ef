"""Evaluations, checkpoints and lock of a run, for both engines; on Ctrl-C, too."""

import csv
import io
import os
import pickle
import signal
import socket
import threading
import time
import zipfile
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import gymnasium
from filelock import FileLock, Timeout
from tqdm.auto import tqdm

from baselines.recipes import Plan, first_seed
from quad_gym.evaluation import Policy, roll_out

EVALUATIONS = "evaluations.csv"
STATE = "training_state.pickle"
"""Name of the state within the file of the last policy; loading the policy ignores it."""
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
SUFFIXES = {"sb3": ".zip", "compiled": ".npz"}  #: extensions of policy files, by engine


class RunError(ValueError):
    """Error raised when a folder does not contain the expected run."""


def last_file(plan: Plan, folder: Path) -> Path:
    """File of the policy of the last checkpoint, with the state for resuming."""
    return folder / f"last{SUFFIXES[plan.engine]}"


def best_file(plan: Plan, folder: Path) -> Path:
    """File of the policy of the best evaluation."""
    return folder / f"best{SUFFIXES[plan.engine]}"


def has_checkpoint(folder: Path) -> bool:
    """True if a run can be resumed from the folder."""
    kept = any((folder / f"last{suffix}").exists() for suffix in SUFFIXES.values())
    return kept and (folder / "training.json").exists()


@contextmanager
def reading_checkpoint(folder: Path) -> Iterator[None]:
    """Context that reads a checkpoint, in which errors become a `RunError` that says what to do."""
    try:
        yield
    except (zipfile.BadZipFile, pickle.UnpicklingError, EOFError) as error:
        raise RunError(f"the checkpoint in {folder} is damaged: {error}") from None
    except (ImportError, AttributeError, LookupError, TypeError, ValueError) as error:
        raise RunError(
            f"the training in {folder} must be resumed with the version of quad_gym, the packages, "
            "the precision and the number of lanes that stopped it, or begun in another folder; "
            f"its best policy can be used in any case ({type(error).__name__}: {error})"
        ) from None


def score(summary: dict[str, float], duration: float) -> float:
    """Score by which the best evaluation is selected.

    Small errors and few crashes; on a course, many gates in a short time and few crashes; for a
    task that defines its own reward, the return.
    """
    if summary["own_reward"] > 0.0:
        return summary["return"]
    if summary["gates_total"] > 0.0:
        return summary["gates_passed"] - summary["crash_rate"] - summary["seconds"] / duration
    return -summary["mean_error"] - 10.0 * summary["crash_rate"]


class RunKeeper(ABC):
    """Evaluations of the policy during a run by an environment, `judge`, and files of the run.

    Evaluations and checkpoints are made between two rollouts. A checkpoint is written under another
    name and then renamed, so that the previous one survives an interruption at any time.
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
        self._bar: Any = tqdm(disable=True)  # until the run begins

    # ---- specific to the engine -----------------------------------------------------------------

    @abstractmethod
    def _training_return(self, model: Any) -> float:
        """Mean return of the latest episodes of the training."""

    @abstractmethod
    def _save(self, model: Any, *, best: bool) -> None:
        """Write the best policy, if this is the best, and then the last checkpoint.

        The order matters: a run that is killed in between finds the same best policy again.
        """

    # ---- between rollouts -----------------------------------------------------------------------

    def begin(self, steps: int) -> None:
        """Start the clock and the progress bar at a number of steps, after compilation."""
        look: dict[str, Any] = {"unit": " steps", "unit_scale": True, "disable": self._quiet}
        self._bar = tqdm(total=self._plan.recipe.steps, initial=steps, **look)
        self.steps, self._since = steps, time.perf_counter()

    def watch(self, model: Policy, steps: int) -> None:
        """Evaluate and store the policy if this is due; to be called before every rollout."""
        self._bar.update(steps - self._bar.n)
        due = steps // self._interval > self.steps // self._interval
        self.steps = steps
        if due or not self.rows:
            self._keep(model)
        elif self._stop:  # without an evaluation, which could change the best policy
            self._count_seconds()
            self._save(model, best=False)

    @property
    def stopping(self) -> bool:
        """True if the run has been requested to stop."""
        return self._stop

    # ---- the beginning and the end --------------------------------------------------------------

    @contextmanager
    def running(self) -> Iterator[None]:
        """Context of a run, in which SIGINT and SIGTERM stop it."""
        with signals_to(self._interrupt):
            try:
                yield
            finally:
                self._bar.close()

    def _interrupt(self, number: int) -> None:
        """Stop the run after the present step; after a second signal, immediately."""
        if self._stop:
            raise KeyboardInterrupt
        self._stop = True

    def finish(self, model: Policy, steps: int) -> None:
        """Store the policy after the last step, if the run is complete."""
        self._bar.update(steps - self._bar.n)
        self.finished = steps >= self._plan.recipe.steps
        if self.finished and self.steps < steps:
            self.steps = steps
            self._keep(model)

    # ---- checkpoints ----------------------------------------------------------------------------

    def _keep(self, model: Policy) -> None:
        """Evaluate, and write a checkpoint."""
        self._count_seconds()
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
        text = io.StringIO()
        writer = csv.DictWriter(text, _COLUMNS, lineterminator="\n")
        writer.writeheader()
        writer.writerows(self.rows)
        replace_file(self._folder / EVALUATIONS, text.getvalue().encode())
        self._bar.set_postfix_str(f"error {row['mean_error']:.3f} m")
        self._since = time.perf_counter()

    def _count_seconds(self) -> None:
        """Add the time since the last checkpoint to the time of the training."""
        now = time.perf_counter()
        self.seconds += now - (now if self._since is None else self._since)

    def state(self) -> dict[str, Any]:
        """State from which the next process resumes."""
        return {name: getattr(self, name) for name in ("rows", "best", "last", "seconds")}

    def restore(self, state: dict[str, Any], steps: int) -> None:
        """Restore a `state` that was taken after `steps` steps."""
        for name, value in state.items():
            setattr(self, name, value)
        self.steps = steps


@contextmanager
def signals_to(handle: Callable[[int], Any]) -> Iterator[None]:
    """Context in which SIGINT and SIGTERM only call a function with their number."""
    before: dict[int, Any] = {}
    if threading.current_thread() is threading.main_thread():  # Python allows no other thread
        for number in (signal.SIGINT, signal.SIGTERM):
            before[number] = signal.signal(number, lambda number, _: handle(number))
    try:
        yield
    finally:
        for given, handler in before.items():
            signal.signal(given, handler)


def replace_file(file: Path, content: bytes) -> None:
    """Write a file atomically: at any time it is either the old or the new one."""
    part = file.with_name(file.name + ".part")
    with part.open("wb") as stream:
        stream.write(content)
        stream.flush()
        os.fsync(stream.fileno())
    for wait in (0.01, 0.1, 1.0):  # Windows refuses while another process reads the file
        with suppress(PermissionError):
            part.replace(file)
            return
        time.sleep(wait)
    part.replace(file)


# ---- locks ---------------------------------------------------------------------------------------
# The operating system releases a lock when the process ends for any reason. Locks also work between
# machines on a shared file system that supports them (NFS, or Lustre mounted with `flock`).

LOCK = "training.lock"  #: name of the lock file in the folder

HOLDER = "training.process"  #: name of the file with the process that has or had the lock

PATIENCE = 0.5  #: time to wait for a lock [s]; checking for a lock takes it briefly


class BusyError(RunError):
    """Error raised when another process trains in the folder."""


@contextmanager
def locked(folder: Path) -> Iterator[None]:
    """Lock the existing folder of a run, or raise a `BusyError` if another process has the lock."""
    lock = FileLock(folder / LOCK, timeout=PATIENCE)
    try:
        lock.acquire()
    except Timeout:
        raise BusyError(f"folder {folder} is in use by {holder(folder)}") from None
    try:
        with suppress(OSError):  # a full disk
            (folder / HOLDER).write_text(f"process {os.getpid()} on {socket.gethostname()}\n")
        yield
    finally:
        lock.release()


def is_locked(folder: Path) -> bool:
    """True if a process trains in the folder now."""
    if not (folder / LOCK).exists():  # never begun
        return False
    try:
        with FileLock(folder / LOCK, timeout=0.0):
            return False
    except Timeout:
        return True


def holder(folder: Path) -> str:
    """Process that has the lock of a folder, or had it last."""
    try:
        return (folder / HOLDER).read_text(encoding="utf-8").strip() or "another process"
    except OSError:
        return "another process"

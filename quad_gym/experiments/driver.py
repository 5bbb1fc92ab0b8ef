"""Driver of trainings: starts them, notices how each ends, and restarts those that died."""

import sys
import time
from collections import Counter, deque
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any

from tqdm import tqdm

from baselines.keeping import holder, is_locked, signals_to
from quad_gym.experiments.experiment import Training
from quad_gym.experiments.processes import Ended, Job

PAUSE = 0.1  #: time between looks at the jobs [s]

REFRESH = 1.0  #: time between updates of the progress bar [s]

RETRIES = 2  #: default number of restarts of a training that died

INTERRUPTED = 130  #: exit code of an experiment that was stopped


def train_all(
    trainings: Sequence[Training],
    folder: Path,
    jobs: int,
    *,
    retries: int = RETRIES,
    hidden: bool | None = None,
) -> "Driver":
    """Complete trainings in processes, with their output in `folder`, and show the progress.

    `jobs` limits the number of parallel trainings; a training that died is restarted `retries`
    times; the bar is hidden by default (None) if stderr is no terminal. Returns the driver, with
    the failures.
    """
    total = sum(training.plan.recipe.steps for training in trainings)
    with tqdm(total=total, desc="training", unit=" steps", unit_scale=True, disable=hidden) as bar:
        driver = Driver(trainings, partial(Job, folder / "logs"), jobs, retries, bar)
        driver.run()
    return driver


def stopped() -> int:
    """Print how to continue an experiment that was stopped; returns its exit code."""
    print("\nStopped. Start the same command again to continue.", file=sys.stderr)
    return INTERRUPTED


class Driver:
    """Driver of trainings until each is finished or has failed; see `train_all`."""

    def __init__(
        self,
        trainings: Sequence[Training],
        start: Callable[[Training], Job],
        jobs: int,
        retries: int,
        bar: Any,
    ) -> None:
        self.failed: dict[Training, str] = {}
        self.stopped = False
        self._trainings, self._begin, self._bar = trainings, start, bar
        self._jobs, self._retries = jobs, retries
        self._waiting = deque(training for training in trainings if not training.finished)
        self._running: dict[Training, Job] = {}
        self._elsewhere: dict[Training, str] = {}
        self._deaths: Counter[Training] = Counter()
        self._steps = {training: training.plan.recipe.steps for training in trainings}
        self._steps |= {training: training.steps_done() for training in self._waiting}
        self._shown = 0.0

    def run(self) -> None:
        """Train, until all trainings are completed or SIGINT or SIGTERM has stopped them."""
        forwarded = 0
        signals: list[int] = []
        with signals_to(signals.append):
            try:
                while self._running or self._waiting:
                    self.stopped = bool(signals)
                    for training, job in list(self._running.items()):
                        if (ended := job.ended()) is not None:
                            del self._running[training]
                            self._settle(training, ended)
                    if self.stopped:
                        self._waiting.clear()
                    self._start()
                    if len(signals) > forwarded:
                        forwarded = len(signals)
                        self._stop()
                    self._show()
                    if self._running or self._waiting:
                        time.sleep(PAUSE)
            finally:
                self._stop()

    def exit_code(self) -> int:
        """Print the failures and how to continue; returns the exit code."""
        if self.failed:
            print(f"{len(self.failed)} failed; start the same command again to retry them:")
        for training, reason in self.failed.items():
            print(f"  {training.folder}: {reason}")
        return stopped() if self.stopped else int(bool(self.failed))

    def _stop(self) -> None:
        """Ask all trainings to stop; one that is asked twice stops without a checkpoint."""
        for job in self._running.values():
            job.stop()

    def _settle(self, training: Training, ended: Ended) -> None:
        if ended.kind == "finished":
            self._finish(training)
        elif self.stopped:
            return
        elif ended.kind == "busy":
            self._waiting.append(training)
        elif ended.kind == "failed":
            self._fail(training, ended.text)
        elif self._deaths[training] == self._retries:
            self._fail(training, f"died {self._retries + 1} times, lastly: {ended.text}")
        else:
            self._deaths[training] += 1
            self._waiting.append(training)
            self._bar.write(
                f"{training.name}: died ({ended.text}); restarts from its checkpoint "
                f"({self._deaths[training]} of {self._retries})"
            )

    def _finish(self, training: Training) -> None:
        self._steps[training] = training.plan.recipe.steps
        done = len(self._trainings) - len(self._waiting) - len(self._running) - len(self.failed)
        self._bar.write(progress(done, self._trainings, training))

    def _fail(self, training: Training, reason: str) -> None:
        self.failed[training] = reason
        self._bar.write(f"{training.name}: {reason}")

    def _start(self) -> None:
        self._elsewhere.clear()
        for _ in range(len(self._waiting)):
            if len(self._running) >= self._jobs:
                return
            training = self._waiting.popleft()
            try:
                if is_locked(training.folder):
                    self._elsewhere[training] = holder(training.folder)
                    self._waiting.append(training)
                elif training.finished:  # by another process
                    self._finish(training)
                else:
                    self._running[training] = self._begin(training)
            except (OSError, ValueError) as error:  # no process, a full disk, another training
                self._fail(training, str(error))

    def _show(self) -> None:
        now = time.monotonic()
        if now < self._shown + REFRESH and (self._running or self._waiting):
            return
        self._shown = now
        for training in (*self._running, *self._elsewhere):
            self._steps[training] = training.steps_done()
        left = len(self._running) + len(self._waiting)
        words = [f"{len(self._trainings) - left - len(self.failed)}/{len(self._trainings)} done"]
        words += [f"{len(self.failed)} failed"] if self.failed else []
        words += [f"running {training.name}" for training in list(self._running)[:2]]
        words += [f"{training.name}: {where}" for training, where in self._elsewhere.items()][:1]
        self._bar.n = min(sum(self._steps.values()), self._bar.total)
        self._bar.set_postfix_str("; ".join(words))


def progress(done: int, trainings: Sequence[Training], latest: Training) -> str:
    """Describe the latest training that is finished."""
    seconds = latest.record().get("training_seconds", 0.0)
    return f"[{done}/{len(trainings)}] {latest.name}: {seconds:.0f} s"

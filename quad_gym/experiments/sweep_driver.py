"""Starts the trainings of a sweep, notices how each ends, and restarts those that died."""

import signal
import time
from collections import Counter, deque
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any

from baselines.locks import holder, is_locked
from quad_gym.experiments.sweep_executors import Ended, Executor, Job
from quad_gym.experiments.sweep_plan import Training
from quad_gym.experiments.sweep_table import steps_done

REFRESH = 1.0
"""Between renewals of the progress line [s]."""


@dataclass
class Signals:
    """How often Ctrl-C or a request to terminate has come."""

    count: int = 0

    @classmethod
    @contextmanager
    def counted(cls) -> Iterator["Signals"]:
        """Take them over for a while."""
        found = cls()

        def count(number: int, frame: Any) -> None:
            found.count += 1

        numbers = (signal.SIGINT, signal.SIGTERM)
        before = [signal.signal(number, count) for number in numbers]
        try:
            yield found
        finally:
            for number, handler in zip(numbers, before, strict=True):
                signal.signal(number, handler)


@dataclass
class Driver:
    """Runs trainings until every one is finished or has failed.

    Args:
        trainings: What is to be trained.
        executor: What starts them.
        jobs: How many at a time; None: all.
        retries: How often a training that died is started again.
        say: Prints a line.
        bar: A progress bar of tqdm over environment steps.
    """

    trainings: Sequence[Training]
    executor: Executor
    jobs: int | None
    retries: int
    say: Callable[[str], None]
    bar: Any
    failed: dict[str, str] = field(default_factory=dict)
    """why, by name"""

    def __post_init__(self) -> None:
        self._waiting = deque(t for t in self.trainings if not t.finished)
        self._running: dict[str, tuple[Training, Job]] = {}
        self._elsewhere: dict[str, str] = {}
        self._died: Counter[str] = Counter()
        left = {t.name for t in self._waiting}
        self._steps = {
            t.name: steps_done(t.folder) if t.name in left else t.plan.recipe.steps
            for t in self.trainings
        }
        self._shown = 0.0

    def run(self) -> bool:
        """Train.

        Returns:
            Whether it came to the end; else it was asked to end, and all trainings have.
        """
        told = 0
        with Signals.counted() as signals:
            try:
                while self._running or self._waiting:
                    self._collect(stopping=signals.count > 0)
                    if signals.count == 0:
                        self._start()
                    else:
                        self._waiting.clear()
                    if signals.count > told:
                        self._end(at_once=told > 0)
                        told = signals.count
                    self._show()
                    if self._running or self._waiting:
                        time.sleep(self.executor.pause)
            finally:
                self._end(at_once=False)
        return told == 0

    def _end(self, *, at_once: bool) -> None:
        for _, job in self._running.values():
            if at_once:
                job.kill()
            else:
                job.stop()

    def _collect(self, *, stopping: bool) -> None:
        for name, (training, job) in list(self._running.items()):
            ended = job.ended()
            if ended is not None:
                del self._running[name]
                self._settle(training, ended, stopping=stopping)

    def _settle(self, training: Training, ended: Ended, *, stopping: bool) -> None:
        name = training.name
        if ended.kind == "finished":
            self._steps[name] = training.plan.recipe.steps
        elif stopping:
            return
        elif ended.kind == "busy":
            self._waiting.append(training)
        elif ended.kind == "failed":
            self._fail(training, ended.text)
        else:
            self._died[name] += 1
            if self._died[name] > self.retries:
                self._fail(training, f"died {self._died[name]} times, lastly: {ended.text}")
                return
            self._waiting.append(training)
            self.say(
                f"{name}: died ({ended.text}); starts again from its checkpoint "
                f"({self._died[name]} of {self.retries})"
            )

    def _fail(self, training: Training, why: str) -> None:
        self.failed[training.name] = why
        self.say(f"{training.name}: {why}")

    def _start(self) -> None:
        self._elsewhere.clear()
        for _ in range(len(self._waiting)):
            if self.jobs is not None and len(self._running) >= self.jobs:
                return
            training = self._waiting.popleft()
            if is_locked(training.folder):
                self._elsewhere[training.name] = holder(training.folder)
                self._waiting.append(training)
                continue
            try:
                if training.finished:  # by another sweep
                    self._steps[training.name] = training.plan.recipe.steps
                else:
                    self._running[training.name] = (training, self.executor.start(training))
            except (OSError, ValueError) as error:  # no process, a full disk, another training
                self._fail(training, str(error))

    def _show(self) -> None:
        now = time.monotonic()
        if now < self._shown + REFRESH and (self._running or self._waiting):
            return
        self._shown = now
        for training in self.trainings:
            if training.name in self._running or training.name in self._elsewhere:
                self._steps[training.name] = steps_done(training.folder)
        total = len(self.trainings)
        left = len(self._running) + len(self._waiting)
        words = [f"{total - left - len(self.failed)}/{total} done, {left} left"]
        words += [f"{len(self.failed)} failed"] if self.failed else []
        names = [*self._running, *(f"{n} ({who})" for n, who in self._elsewhere.items())]
        words += [
            "running " + ", ".join(names[:2]) + (f", {len(names) - 2} more" * (len(names) > 2))
        ]
        self.bar.n = min(sum(self._steps.values()), self.bar.total)
        self.bar.set_postfix_str("; ".join(words if names else words[:-1]))

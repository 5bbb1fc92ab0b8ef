"""Trainings in processes of this machine: their progress, and how each has ended."""

import multiprocessing
import os
import sys
import time
import traceback
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from tqdm import tqdm

from baselines.keeping import signals_to
from baselines.plans import Plan
from baselines.training import train
from quad_gym.experiments.experiment import Training

PAUSE = 0.1  #: time between looks at the processes [s]

REFRESH = 1.0  #: time between updates of the progress bar [s]

INTERRUPTED = 130  #: exit code of an experiment that was stopped


@dataclass
class Completion:
    """Trainings that failed, with reasons, and whether a signal stopped the others."""

    failed: dict[Training, str] = field(default_factory=dict)
    stopped: bool = False

    def exit_code(self) -> int:
        """Print the failures and how to continue; returns the exit code."""
        if self.failed:
            print(f"{len(self.failed)} failed; start the same command again to retry them:")
        for training, reason in self.failed.items():
            print(f"  {training.folder}: {reason}")
        return stopped() if self.stopped else int(bool(self.failed))


def stopped() -> int:
    """Print how to continue an experiment that was stopped; returns its exit code."""
    print("\nStopped. Start the same command again to continue.", file=sys.stderr)
    return INTERRUPTED


def train_all(
    trainings: Sequence[Training], folder: Path, jobs: int, *, hidden: bool | None = None
) -> Completion:
    """Complete the unfinished trainings, `jobs` at a time, and show the progress.

    A training that fails or dies does not affect the others. SIGINT or SIGTERM stops all of them
    after their present step, and a second signal immediately. The output of each is in the folder
    `logs`. The bar is hidden by default (None) if stderr is no terminal.
    """
    waiting = [training for training in trainings if not training.record()]
    running: dict[Training, _Job] = {}
    outcome, signals, forwarded, shown = Completion(), list[int](), 0, 0.0
    steps = {training: training.plan.recipe.steps for training in trainings}
    steps |= dict.fromkeys(waiting, 0)
    total = sum(training.plan.recipe.steps for training in trainings)
    look: dict[str, Any] = {"unit": " steps", "unit_scale": True, "disable": hidden}
    with signals_to(signals.append), tqdm(total=total, desc="training", **look) as bar:
        while running or waiting:
            if len(signals) > forwarded:
                forwarded, outcome.stopped, waiting = len(signals), True, []
                for job in running.values():
                    job.process.terminate()
            for training in [t for t, job in running.items() if job.process.exitcode is not None]:
                problem = running.pop(training).ending()
                if problem and outcome.stopped:
                    continue
                if problem:
                    outcome.failed[training] = problem
                steps[training] = training.plan.recipe.steps
                done = len(trainings) - len(waiting) - len(running)
                bar.write(progress(done, trainings, training, problem))
            while waiting and len(running) < jobs:
                training = waiting.pop(0)
                running[training] = _Job(training, folder / "logs")
            if time.monotonic() > shown + REFRESH:
                shown = time.monotonic()
                steps |= {training: training.steps_done() for training in running}
                bar.n = min(sum(steps.values()), total)
                bar.set_postfix_str(", ".join(training.name for training in list(running)[:2]))
            time.sleep(PAUSE)
    return outcome


def progress(done: int, trainings: Sequence[Training], latest: Training, problem: str = "") -> str:
    """Describe the latest training that has ended."""
    seconds = latest.record().get("training_seconds", 0.0)
    return f"[{done}/{len(trainings)}] {latest.name}: {problem or f'{seconds:.0f} s'}"


class _Job:
    """Training in a process."""

    def __init__(self, training: Training, logs: Path) -> None:
        logs.mkdir(parents=True, exist_ok=True)
        self._log = logs / f"{training.name.replace('/', ',')}.txt"
        context = multiprocessing.get_context("spawn")  # compiled kernels and torch fork badly
        self._answer, sender = context.Pipe(duplex=False)
        given = (training.plan, training.folder, sender, self._log)
        self.process = context.Process(target=_work, args=given, daemon=True)
        self.process.start()
        sender.close()

    def ending(self) -> str:
        """Return why the ended process has not finished the training; empty if it has."""
        with suppress(OSError):
            if self._log.stat().st_size == 0:
                self._log.unlink()
        with suppress(EOFError, OSError):
            return str(self._answer.recv())
        code = self.process.exitcode or 0
        return f"died: signal {-code}" if code < 0 else f"died: exit code {code}"


def _work(plan: Plan, folder: Path, sender: Any, log: Path) -> None:
    """Train in a folder; runs in a separate process."""
    if hasattr(os, "setsid"):  # Ctrl-C is for the driver alone, which asks each training to stop
        os.setsid()
    with suppress(OSError):  # no log on a full disk
        file = os.open(log, os.O_WRONLY | os.O_CREAT | os.O_APPEND, 0o666)
        os.dup2(file, 1)
        os.dup2(file, 2)
        os.close(file)
    try:
        finished = train(plan, folder, tensorboard=False, quiet=True).finished
        problem = "" if finished else "asked to stop"
    except Exception as error:  # any error of a user's task or of a file system
        with suppress(OSError):
            traceback.print_exc()
        problem = f"{type(error).__name__}: {error}"
    with suppress(OSError):  # the driver may be gone
        sender.send(problem)

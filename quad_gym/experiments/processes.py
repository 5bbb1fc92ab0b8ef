"""Trainings as processes of this machine, which report when they have ended, and how."""

import multiprocessing
import os
import traceback
from contextlib import suppress
from pathlib import Path
from typing import Any, NamedTuple

from baselines.keeping import BusyError
from baselines.plans import Plan
from baselines.training import train
from quad_gym.experiments.experiment import Training


class Ended(NamedTuple):
    """Ending of a job."""

    kind: str
    """One of finished; busy: another process trains in the folder; failed: the training raised an
    error; stopped: it was asked to stop; died"""
    text: str = ""  #: reason


def work(plan: Plan, folder: Path) -> Ended:
    """Train in a folder, from its checkpoint if it has one; runs in a separate process."""
    try:
        done = train(plan, folder, resume=True, tensorboard=False, quiet=True)
    except BusyError as error:
        return Ended("busy", str(error))
    except Exception as error:  # any error of a user's task or of a file system
        with suppress(OSError):
            traceback.print_exc()
        return Ended("failed", f"{type(error).__name__}: {error}")
    return Ended("finished" if done.finished else "stopped", "asked to stop")


class Job:
    """Process of this machine, which survives an experiment that is killed."""

    def __init__(self, logs: Path, training: Training) -> None:
        logs.mkdir(parents=True, exist_ok=True)
        self._log = logs / f"{training.name.replace('/', ',')}.txt"
        context = multiprocessing.get_context("spawn")  # compiled kernels and torch fork badly
        self._answer, sender = context.Pipe(duplex=False)
        self._process = context.Process(
            target=_in_process, args=(training.plan, training.folder, sender, self._log)
        )
        self._process.start()
        sender.close()

    def ended(self) -> Ended | None:
        """Return how it ended; None while it runs."""
        code = self._process.exitcode
        if code is None:
            return None
        with suppress(OSError):
            if self._log.stat().st_size == 0:
                self._log.unlink()
        with suppress(EOFError, OSError):
            if self._answer.poll():
                return Ended(*self._answer.recv())
        return Ended("died", f"signal {-code}" if code < 0 else f"exit code {code}")

    def stop(self) -> None:
        """Ask it to write a checkpoint and stop; the second time, to stop at once."""
        self._process.terminate()


def _in_process(plan: Plan, folder: Path, sender: Any, log: Path) -> None:
    if hasattr(os, "setsid"):  # Ctrl-C is for the driver alone, which asks each training to stop
        os.setsid()
    with suppress(OSError):  # no log on a full disk
        file = os.open(log, os.O_WRONLY | os.O_CREAT | os.O_APPEND, 0o666)
        os.dup2(file, 1)
        os.dup2(file, 2)
        os.close(file)
    ended = work(plan, folder)
    with suppress(OSError):  # the driver may be gone
        sender.send(tuple(ended))

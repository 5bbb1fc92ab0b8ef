"""Where the trainings of a sweep run: processes of this machine, Slurm through submitit, Ray.

All run the same function, `work`, which locks the folder, trains, and returns in one word how it
ended. Each executor starts jobs, which know whether they have ended, for whatever reason.
"""

import importlib
import multiprocessing
import os
import traceback
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any, NamedTuple, Protocol

from baselines.locks import BusyError
from baselines.plans import Plan
from baselines.training import train
from quad_gym.experiments.sweep_plan import Training

EXECUTORS = ("local", "slurm", "ray")

_DAY = 24 * 60  # minutes


class Ended(NamedTuple):
    """How a job has ended."""

    kind: str
    """finished, busy (another process trains in the folder), failed (the training raised), stopped
    (it was asked to end) or died"""
    text: str = ""
    """why"""


class Job(Protocol):
    """A training that was started."""

    def ended(self) -> Ended | None:
        """How it has ended; None while it runs, or waits for a machine."""

    def stop(self) -> None:
        """Ask it to write a checkpoint and end."""

    def kill(self) -> None:
        """End it at once."""


class Executor(Protocol):
    """Starts trainings."""

    pause: float
    """between looks at its jobs [s]"""

    def start(self, training: Training) -> Job:
        """Start a training, or go on with it."""


def work(plan: Plan, folder: Path) -> Ended:
    """Train in a folder, from its checkpoint if it has one; in a process of its own."""
    try:
        done = train(plan, folder, resume=True, tensorboard=False, quiet=True)
    except BusyError as error:
        return Ended("busy", str(error))
    except Exception as error:  # whatever a user's task or a file system may raise
        with suppress(OSError):
            traceback.print_exc()
        return Ended("failed", f"{type(error).__name__}: {error}")
    return Ended("finished" if done.finished else "stopped", "asked to end")


def make_executor(
    name: str, folder: Path, threads: int, options: Mapping[str, Any], cores: int
) -> tuple[Executor, int | None]:
    """An executor, and how many trainings it runs at a time; None: as many as it likes.

    Args:
        name: One of EXECUTORS.
        folder: Of the sweep, for what jobs print.
        threads: Of each training.
        options: Of the executor.
        cores: Of this machine.

    Raises:
        ValueError: If an option is invalid.
        ImportError: If a package is missing.
    """
    if name == "slurm":
        return SubmititExecutor(folder / "logs", threads, options), None
    if name == "ray":
        return RayExecutor(threads, options), None
    if options:
        raise ValueError(f"--options are of slurm and ray, got {', '.join(options)} for local")
    return LocalExecutor(folder / "logs"), max(1, cores // threads)


def _optional(package: str) -> Any:
    try:
        return importlib.import_module(package)
    except ImportError as error:
        raise ImportError(
            f'this executor needs {package}: pip install "quad-gym[sweep]" ({error})'
        ) from None


# ---- processes of this machine -------------------------------------------------------------------


class LocalExecutor:
    """A process per training, which outlives a sweep that is killed."""

    pause = 0.1

    def __init__(self, logs: Path) -> None:
        self._logs = logs

    def start(self, training: Training) -> Job:
        """Start a training, or go on with it."""
        self._logs.mkdir(parents=True, exist_ok=True)
        log = self._logs / f"{training.name.replace('/', ',')}.txt"
        return _LocalJob(training, log)


class _LocalJob:
    def __init__(self, training: Training, log: Path) -> None:
        context = multiprocessing.get_context("spawn")  # compiled kernels and torch fork badly
        self._log = log
        self._answer, sender = context.Pipe(duplex=False)
        self._process = context.Process(
            target=_in_process, args=(training.plan, training.folder, sender, log)
        )
        self._process.start()
        sender.close()

    def ended(self) -> Ended | None:
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
        self._process.terminate()

    def kill(self) -> None:
        self._process.kill()


def _in_process(plan: Plan, folder: Path, sender: Any, log: Path) -> None:
    os.setsid()  # Ctrl-C is for the sweep alone, which then asks each training to end
    with suppress(OSError):  # no log on a full disk
        file = os.open(log, os.O_WRONLY | os.O_CREAT | os.O_APPEND, 0o666)
        os.dup2(file, 1)
        os.dup2(file, 2)
        os.close(file)
    ended = work(plan, folder)
    with suppress(OSError):  # the sweep may be gone
        sender.send(tuple(ended))


# ---- Slurm ---------------------------------------------------------------------------------------


class SubmititExecutor:
    """A job of Slurm per training; with the option cluster=local, a process of this machine."""

    pause = 1.0

    def __init__(self, logs: Path, threads: int, options: Mapping[str, Any]) -> None:
        submitit = _optional("submitit")
        given = {"timeout_min": _DAY, "cpus_per_task": threads, "name": "quad-gym", **options}
        cluster = given.pop("cluster", "slurm")
        try:
            self._executor = submitit.AutoExecutor(folder=logs.absolute(), cluster=cluster)
            self._executor.update_parameters(**given)
        except (NameError, RuntimeError, TypeError, ValueError) as error:  # as submitit has them
            raise ValueError(f"--options do not fit submitit: {error}") from None

    def start(self, training: Training) -> Job:
        """Submit a training."""
        return _SubmititJob(self._executor.submit(work, training.plan, training.folder.absolute()))


class _SubmititJob:
    def __init__(self, job: Any) -> None:
        self._job = job

    def ended(self) -> Ended | None:
        if not self._job.done():
            return None
        error = self._job.exception()
        if error is None:
            return Ended(*self._job.result())
        lines = str(error).strip().splitlines() or [""]
        return Ended("died", f"job {self._job.job_id}: {lines[0]}")

    def stop(self) -> None:
        self._job.cancel(check=False)

    kill = stop


# ---- Ray -----------------------------------------------------------------------------------------


class RayExecutor:
    """A task of Ray per training, on any node; the folder lies where all nodes see it."""

    pause = 0.5

    def __init__(self, threads: int, options: Mapping[str, Any]) -> None:
        self._ray = _optional("ray")
        try:
            self._ray.init(**{"log_to_driver": False, "logging_level": "warning", **options})
        except (TypeError, ConnectionError, RuntimeError) as error:
            raise ValueError(f"--options do not fit Ray: {error}") from None
        self._work = self._ray.remote(num_cpus=threads, max_retries=0)(work)

    def start(self, training: Training) -> Job:
        """Hand a training over to Ray."""
        return _RayJob(self._ray, self._work.remote(training.plan, training.folder.absolute()))


class _RayJob:
    def __init__(self, ray: Any, task: Any) -> None:
        self._ray, self._task = ray, task

    def ended(self) -> Ended | None:
        ready, _ = self._ray.wait([self._task], timeout=0)
        if not ready:
            return None
        try:
            return Ended(*self._ray.get(self._task))
        except self._ray.exceptions.RayError as error:  # worker or node lost
            lines = str(error).strip().splitlines() or [type(error).__name__]
            return Ended("died", lines[0])

    def stop(self) -> None:
        self._ray.cancel(self._task)  # as Ctrl-C in its process

    def kill(self) -> None:
        self._ray.cancel(self._task, force=True)

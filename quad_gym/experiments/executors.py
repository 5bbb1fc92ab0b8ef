"""Executors of trainings: processes of this machine, Slurm through submitit, Ray.

All run the same function, `work`, which trains in a folder and returns how the training ended. A
job reports when it has ended, for whatever reason.
"""

import multiprocessing
import os
import traceback
from collections.abc import Callable, Mapping
from contextlib import suppress
from functools import partial
from pathlib import Path
from types import MappingProxyType
from typing import Any, NamedTuple, Protocol

from baselines.keeping import BusyError
from baselines.plans import Plan
from baselines.training import train
from quad_gym.experiments.experiment import Training
from quad_gym.params import checks as check

_DAY = 24 * 60  #: minutes


class Ended(NamedTuple):
    """Ending of a job."""

    kind: str
    """One of finished; busy: another process trains in the folder; failed: the training raised an
    error; stopped: it was asked to stop; died"""
    text: str = ""  #: reason


class Job(Protocol):
    """Training that was started."""

    def ended(self) -> Ended | None:
        """Ending of the job; None while it runs, or waits for a machine."""

    def stop(self) -> None:
        """Ask the training to write a checkpoint and stop; the second time, to stop at once."""


Executor = Callable[[Training], Job]  #: function that starts or resumes a training


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


def make_executor(
    name: str, folder: Path, threads: int = 1, options: Mapping[str, Any] = MappingProxyType({})
) -> Executor:
    """Make an executor: "local", "slurm" or "ray", with options of submitit or Ray."""
    if name == "slurm":
        return _submitit(folder / "logs", threads, options)
    if name == "ray":
        return _ray(threads, options)
    if options:
        raise ValueError(f"--options are of slurm and ray, got {', '.join(options)} for local")
    return partial(_LocalJob, folder / "logs")


# ---- processes of this machine -------------------------------------------------------------------


class _LocalJob:
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


# ---- Slurm and Ray -------------------------------------------------------------------------------


class _RemoteJob:
    """Job on another machine, with the functions of its library."""

    def __init__(self, done: Callable[[], Any], result: Callable[[], Any], stop: Any) -> None:
        self._done, self._result, self.stop = done, result, stop

    def ended(self) -> Ended | None:
        if not self._done():
            return None
        try:
            return Ended(*self._result())
        except Exception as error:  # job, worker or node lost
            return Ended("died", (str(error).strip() or type(error).__name__).splitlines()[0])


def _submitit(logs: Path, threads: int, options: Mapping[str, Any]) -> Executor:
    """Executor with one Slurm job per training; with cluster=local, processes of this machine."""
    submitit = check.package("submitit", "this executor", "sweep")
    given = {"timeout_min": _DAY, "cpus_per_task": threads, "name": "quad-gym", **options}
    cluster = given.pop("cluster", "slurm")
    try:
        executor = submitit.AutoExecutor(folder=logs.absolute(), cluster=cluster)
        executor.update_parameters(**given)
    except (NameError, RuntimeError, TypeError, ValueError) as error:  # as submitit has them
        raise ValueError(f"--options do not fit submitit: {error}") from None

    def start(training: Training) -> Job:
        job = executor.submit(work, training.plan, training.folder.absolute())
        return _RemoteJob(job.done, job.result, partial(job.cancel, check=False))

    return start


def _ray(threads: int, options: Mapping[str, Any]) -> Executor:
    """Executor with one Ray task per training; all nodes need the folder under the same path."""
    ray = check.package("ray", "this executor", "sweep")
    try:
        ray.init(**{"log_to_driver": False, "logging_level": "warning", **options})
    except (TypeError, ConnectionError, RuntimeError) as error:
        raise ValueError(f"--options do not fit Ray: {error}") from None
    remote = ray.remote(num_cpus=threads, max_retries=0)(work)

    def start(training: Training) -> Job:
        task = remote.remote(training.plan, training.folder.absolute())
        done, result = lambda: ray.wait([task], timeout=0)[0], partial(ray.get, task)
        return _RemoteJob(done, result, partial(ray.cancel, task))  # KeyboardInterrupt in work

    return start

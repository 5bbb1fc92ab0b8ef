"""Experiments: cases and seeds, their trainings, the driver of these, and test flights."""

import csv
import multiprocessing
import os
import sys
import time
import traceback
from abc import ABC, abstractmethod
from collections import Counter, deque
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import cached_property, partial
from itertools import islice
from pathlib import Path
from typing import Any, NamedTuple, Protocol

import gymnasium
import numpy as np
from numpy.typing import NDArray
from tqdm import tqdm

from baselines.keeping import EVALUATIONS, BusyError, best_file, holder, is_locked, signals_to
from baselines.policies import load_policy
from baselines.recipes import Plan
from baselines.training import require_model, run_in, train
from quad_gym import Flight, FlightRecorder
from quad_gym.analysis.recording import Tracer
from quad_gym.envs.config import with_effect
from quad_gym.evaluation import Episodes, Policy, roll_out, steps_of

# --------------------------------------------------------------------------------------------------
# Flights of policies in test episodes.
# --------------------------------------------------------------------------------------------------

Floats = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Flown:
    """Test episodes of one policy."""

    episodes: Episodes
    recorded: Mapping[str, Any]
    """Results of the recorder by name, with "time" (t,) [s]"""


@dataclass(frozen=True, kw_only=True)
class Trial:
    """Test episodes that policies fly: environment, seeds, and recorded quantities."""

    env_id: str
    keywords: Mapping[str, Any]
    """Keywords of the environment; those without effect are ignored"""
    policy: str
    """Name of the case whose policies fly, or of a fixed policy (`load_policy`)"""
    episodes: int
    first_episode: int
    """Seed of the first episode; episode i has this seed + i"""
    threads: int | None = None

    def make(self, count: int) -> Any:
        """Make the environment with a number of flights."""
        return gymnasium.make_vec(
            self.env_id, num_envs=count, threads=self.threads, **with_effect(self.keywords)
        )

    @cached_property
    def env(self) -> Any:
        """Environment of all episodes."""
        return self.make(self.episodes)

    def flown(self, policy: str) -> Flown:
        """Fly a policy, by name or file."""
        return fly(self.load(policy), self.env, self.first_episode, self.recorder())

    def recorder(self) -> "Recorder":
        """Make the recorder of the episodes."""
        return PathRecorder()

    def load(self, policy: str) -> Policy:
        """Load a policy by name or file."""
        return load_policy(policy, self.env)


def fly(policy: Policy, env: Any, seed: int, recorder: "Recorder | None" = None) -> Flown:
    """Fly one episode in every flight of a vector environment; episode i has seed + i."""
    recorder = recorder or PathRecorder()
    episodes = roll_out(policy, env, seed=seed, watch=recorder.add)
    return Flown(episodes, recorder.recorded())


class Recorder(Protocol):
    """Recorder of test episodes."""

    def add(self, step: int, batch: Any, flying: NDArray[np.bool_]) -> None:
        """Record an instant; see `quad_gym.evaluation.Watch`."""

    def recorded(self) -> dict[str, Any]:
        """Return its results by name."""


class PathRecorder(Tracer):
    """Recorder of the first path, and of errors: "percentiles" (3, t) [m], "not_crashed" (t,)."""

    def recorded(self) -> dict[str, Any]:
        """Return path and errors by name."""
        errors = {"percentiles": self.percentiles, "not_crashed": self.not_crashed}
        return {"time": self.time, "path": self.trace(), **errors}


def flight_of_episode(
    policy: Policy, env: Any, seed: int, episode: int, steps: int, about: Mapping[str, Any]
) -> Flight:
    """Fly the episodes of `fly` once more, for the `steps` steps of one, and return this one.

    In a smaller batch, the matrix products of a policy would round differently, and a flight that
    diverges could end elsewhere.
    """
    recorder = FlightRecorder(env.unwrapped.flights.batch, episode, about=dict(about))
    for _ in islice(steps_of(policy, env, seed), steps + 1):  # the first one is the start
        recorder.keep()
    return recorder.flight


# --------------------------------------------------------------------------------------------------
# Experiments: cases and seeds, their trainings, and the test flights of the policies.
# --------------------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class Training:
    """Training of one case with one seed."""

    case: str
    """Name of the case, and of its folder below `runs`"""
    plan: Plan
    folder: Path

    @property
    def name(self) -> str:
        """Name of the training in messages."""
        return f"{self.case}/seed_{self.plan.seed}"

    def record(self) -> dict[str, Any]:
        """Contents of `training.json`; empty before the first checkpoint."""
        return run_in(self.folder, self.plan, resume=True) or {}

    @property
    def finished(self) -> bool:
        """True if all steps are completed."""
        return bool(self.record().get("finished"))

    @property
    def best(self) -> str:
        """File of the policy of the best evaluation."""
        return str(best_file(self.plan, self.folder))

    def curve(self, score: str) -> tuple[Floats, Floats]:
        """Steps and scores of the evaluations so far, (k,) each."""
        rows = [(row["steps"], row[score]) for row in read_evaluations(self.folder)]
        steps, scores = np.array(rows).reshape(-1, 2).T
        return steps, scores

    def steps_done(self) -> int:
        """Number of steps at the last evaluation."""
        return int(max(self.curve("steps")[0], default=0))


def read_evaluations(folder: Path) -> list[dict[str, float]]:
    """Evaluations of the training in a folder so far."""
    file = folder / EVALUATIONS
    lines = file.read_text(encoding="utf-8").splitlines() if file.exists() else []
    return [{name: float(x) for name, x in row.items()} for row in csv.DictReader(lines)]


def make_trainings(cases: Mapping[str, Plan], seeds: Sequence[int], folder: Path) -> list[Training]:
    """Trainings of all cases with all seeds; the first seed of every case is first."""
    return [
        Training(case, plan.replace(seed=seed), folder / "runs" / case / f"seed_{seed}")
        for seed in seeds
        for case, plan in cases.items()
    ]


def check_trainings(trainings: Iterable[Training]) -> None:
    """Check all folders, and make model and environment of each unfinished case once."""
    for training in {each.case: each for each in trainings if not each.finished}.values():
        try:
            require_model(training.plan)
            training.plan.make_judge().close()
        except (TypeError, ValueError) as error:
            raise ValueError(f"{training.case}: {error}") from None


@dataclass(frozen=True, eq=False, kw_only=True)
class Experiment(ABC):
    """Cases that are trained with several seeds, and trials in which the policies fly."""

    env_id: str
    seeds: tuple[int, ...]
    episodes: int
    """Number of test episodes"""
    first_episode: int
    """Seed of the first test episode"""
    environment: Mapping[str, Any]
    """Keywords of the environment in training and test"""
    folder: Path
    threads: int | None = None

    @abstractmethod
    def cases(self) -> dict[str, Plan]:
        """Plans of the trainings by name of the case, with any seed."""

    @abstractmethod
    def trials(self) -> dict[str, Trial]:
        """Test flights by name."""

    def trial(
        self, keywords: Mapping[str, Any], policy: str, kind: type[Trial] = Trial, **more: Any
    ) -> Trial:
        """Test flights with keywords of the environment; see `kind` for the other arguments."""
        names = ("env_id", "episodes", "first_episode", "threads")
        shared: dict[str, Any] = {name: getattr(self, name) for name in names}
        keywords = {**self.environment, **keywords}
        return kind(keywords=keywords, policy=policy, **shared, **more)

    @cached_property
    def trainings(self) -> list[Training]:
        """Trainings, the first seed of every case first."""
        return make_trainings(self.cases(), self.seeds, self.folder)

    def trainings_of(self, case: str) -> list[Training]:
        """Trainings of a case, in the order of the seeds."""
        return [training for training in self.trainings if training.case == case]

    def check(self) -> None:
        """Check all plans, folders and environments; raises the errors of `check_trainings`."""
        check_trainings(self.trainings)
        for trial in self.trials().values():
            trial.make(1).close()

    def policies(self, trial: Trial) -> list[str]:
        """Policies that fly a trial: one per seed, or a fixed one."""
        return [training.best for training in self.trainings_of(trial.policy)] or [trial.policy]

    def fly(self) -> dict[str, list[Flown]]:
        """Fly all policies; returns the flights of each policy, by name of the trial."""
        flown = {}
        for name, trial in tqdm(self.trials().items(), desc="evaluating", unit=" runs"):
            flown[name] = [trial.flown(policy) for policy in self.policies(trial)]
        return flown


# --------------------------------------------------------------------------------------------------
# Trainings as processes of this machine, which report when they have ended, and how.
# --------------------------------------------------------------------------------------------------


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


# --------------------------------------------------------------------------------------------------
# Driver of trainings: starts them, notices how each ends, and restarts those that died.
# --------------------------------------------------------------------------------------------------

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

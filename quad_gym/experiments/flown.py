"""Flights of policies in test episodes, stored in files so that each policy is flown only once."""

import hashlib
import json
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, Protocol

import gymnasium
import numpy as np
from numpy.typing import NDArray

from baselines.policies import load_policy
from quad_gym import Flight, FlightRecorder
from quad_gym.analysis.plots import Trace
from quad_gym.analysis.recording import Tracer
from quad_gym.analysis.reports import as_json
from quad_gym.envs.effects import with_effect
from quad_gym.evaluation import Episodes, Policy, roll_out
from quad_gym.kernels.digest import flights_digest
from quad_gym.params.suites import contents_of_suite_files

Floats = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Flown:
    """Test episodes of one policy."""

    episodes: Episodes
    recorded: Mapping[str, Floats]
    """Arrays of the recorder by name, with "time" (t,) [s]"""

    def save(self, file: Path) -> None:
        """Write a file atomically."""
        file.parent.mkdir(parents=True, exist_ok=True)
        part = file.with_suffix(".part.npz")
        arrays: dict[str, Any] = {f"episodes.{k}": v for k, v in self.episodes._asdict().items()}
        arrays["episodes.ending"] = self.episodes.ending.astype(str)
        np.savez_compressed(part, **{**arrays, **self.recorded})
        part.replace(file)

    @classmethod
    def load(cls, file: Path) -> "Flown":
        """Read a file written by `save`."""
        with np.load(file) as stored:
            episodes = Episodes(*(stored[f"episodes.{name}"] for name in Episodes._fields))
            names = [name for name in stored if not name.startswith("episodes.")]
            return cls(episodes, {name: stored[name] for name in names})


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

    def digest(self, policy: str) -> str:
        """Digest of everything that affects the flights of a policy."""
        file = Path(policy)
        trained = hashlib.sha256(file.read_bytes()).hexdigest() if file.is_file() else policy
        suites = contents_of_suite_files(self.keywords.get("sensors"))
        about = as_json(self) | {"policy": trained, "threads": None}
        given = [about, flights_digest(), *as_json(suites).values()]
        return hashlib.sha256(json.dumps(given, sort_keys=True).encode()).hexdigest()[:12]

    def flown(self, policy: str, folder: Path) -> Flown:
        """Flights of a policy, by name or file; read from their file in a folder if it exists."""
        file = folder / f"{self.digest(policy)}.npz"
        if not file.exists():
            fly(self.load(policy), self.env, self.first_episode, self.recorder()).save(file)
        return Flown.load(file)

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
    return Flown(episodes, recorder.arrays())


class Recorder(Protocol):
    """Recorder of test episodes."""

    def add(self, step: int, batch: Any, flying: NDArray[np.bool_]) -> None:
        """Record an instant; see `quad_gym.evaluation.Watch`."""

    def arrays(self) -> dict[str, Floats]:
        """Recorded arrays by name."""


class PathRecorder(Tracer):
    """Recorder of the first path, and of errors: "percentiles" (3, t) [m], "not_crashed" (t,)."""

    def arrays(self) -> dict[str, Floats]:
        """Recorded arrays; the path is in those named "path.FIELD", see `path_of`."""
        path = {f"path.{name}": values for name, values in vars(self.trace()).items()}
        errors = {"percentiles": self.percentiles, "not_crashed": self.not_crashed}
        return {"time": self.time, **errors, **path}


def flight_of_episode(
    policy: Policy, env: Any, seed: int, episode: int, about: Mapping[str, Any] | None = None
) -> tuple[Flight, Episodes]:
    """Fly the episodes of `fly` once more, and return one of them as a flight, and all results.

    In a smaller batch, the matrix products of a policy would round differently, and a flight that
    diverges could end elsewhere.
    """
    recorder = FlightRecorder(env.unwrapped.flights.batch, episode, about=dict(about or {}))
    flying = True

    def keep(step: int, batch: Any, which: NDArray[np.bool_]) -> None:
        nonlocal flying
        if flying:  # including the instant at which it ends
            recorder.keep()
        flying = bool(which[episode])

    episodes = roll_out(policy, env, seed=seed, watch=keep)
    return recorder.flight, episodes


def path_of(flown: Flown) -> Trace:
    """First episode, recorded by `PathRecorder`."""
    return Trace(**{name: flown.recorded[f"path.{name}"] for name in Trace.__dataclass_fields__})

"""Flights of policies in test episodes."""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from itertools import islice
from typing import Any, Protocol

import gymnasium
import numpy as np
from numpy.typing import NDArray

from baselines.policies import load_policy
from quad_gym import Flight, FlightRecorder
from quad_gym.analysis.recording import Tracer
from quad_gym.envs.config import with_effect
from quad_gym.evaluation import Episodes, Policy, roll_out, steps_of

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

"""Flights of policies in test episodes, stored in files so that each policy is flown only once."""

import hashlib
import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

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

MARKERS = 2  #: number of features that determine position and heading if the vertical is known

TRACED = 12  #: number of episodes whose traces are stored


@dataclass(frozen=True, eq=False)
class Flown:
    """Test episodes of one policy."""

    episodes: Episodes
    recorded: Mapping[str, Floats]
    """Arrays of `PathRecorder` or `ViewRecorder` by name, with "time" (t,) [s]"""

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
    traced: tuple[str, ...] = ()
    """Names from `TRACES`; empty: errors and the path of the first episode are recorded"""
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
        about = [self.env_id, self.keywords, self.episodes, self.first_episode, self.traced]
        given = as_json([*about, trained, flights_digest(), *suites.values()])
        return hashlib.sha256(json.dumps(given, sort_keys=True).encode()).hexdigest()[:12]

    def flown(self, policy: str, folder: Path) -> Flown:
        """Flights of a policy, by name or file; read from their file in a folder if it exists."""
        file = folder / f"{self.digest(policy)}.npz"
        if not file.exists():
            fly(self.load(policy), self.env, self.first_episode, self.traced).save(file)
        return Flown.load(file)

    def load(self, policy: str) -> Policy:
        """Load a policy by name or file."""
        return load_policy(policy, self.env)


def fly(policy: Policy, env: Any, seed: int, traced: Sequence[str] = ()) -> Flown:
    """Fly one episode in every flight of a vector environment; episode i has seed + i.

    Traces named in `traced`, of `TRACES`, need a task with a `View`; without, see `PathRecorder`.
    """
    recorder = ViewRecorder(traced) if traced else PathRecorder()
    episodes = roll_out(policy, env, seed=seed, watch=recorder.add)
    return Flown(episodes, recorder.arrays())


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


class ViewRecorder:
    """Recorder of "in_view" and "mean_speed", (e,), and of `TRACES` (t, k) of k episodes by name.

    `in_view` is the share of time in which the camera faces at least `MARKERS` features,
    `mean_speed` the mean true speed [m/s]. Traces are NaN after the end of an episode.
    """

    def __init__(self, traced: Sequence[str]) -> None:
        self._traced = traced
        self._seen = self._steps = self._distance = np.zeros(0)
        self._rows: list[list[Any]] = []

    def add(self, step: int, batch: Any, flying: NDArray[np.bool_]) -> None:
        """Record an instant; see `quad_gym.evaluation.Watch`."""
        view = batch.view
        if step == 0:
            self._seen, self._steps, self._distance = np.zeros((3, view.count))
        if view.features.shape[1]:
            self._seen += (view.truth.features_in_view.sum(axis=1) >= MARKERS) & flying
        self._distance += np.where(flying, np.linalg.norm(view.velocity, axis=1), 0.0)
        self._steps += flying
        k = min(TRACED, view.count)
        row = [TRACES[name](view, slice(k)).astype(np.float64) for name in self._traced]
        for values in row:
            values[~flying[:k]] = np.nan
        self._rows.append([view.period * step, *row])

    def arrays(self) -> dict[str, Floats]:
        """Recorded arrays."""
        time, *columns = (np.array(column) for column in zip(*self._rows, strict=True))
        return {
            "time": time,
            "in_view": self._seen / self._steps,
            "mean_speed": self._distance / self._steps,
            **dict(zip(self._traced, columns, strict=True)),
        }


def _sigma(view: Any, k: slice) -> Floats:
    try:
        return np.asarray(view.estimate.position_sigma[k].max(axis=1))
    except ValueError:  # no filter runs on the truth
        return np.zeros(len(view.position[k]))


def _outage(view: Any, k: slice) -> Floats:
    failing = view.truth.faults.get("gnss_outage")  # no GNSS runs on the truth
    return np.zeros(len(view.position[k])) if failing is None else failing[k].astype(np.float64)


TRACES: Mapping[str, Callable[[Any, slice], Floats]] = {
    "off_wall": lambda view, k: _angle(
        view.features[k].mean(axis=1) - view.position[k], view.truth.forward[k]
    ),
    "off_reward": lambda view, k: _angle(view.reference_heading[k], view.truth.forward[k]),
    "sigma": _sigma,
    "estimation_error": lambda view, k: view.estimation_error[k].copy(),
    "position_error": lambda view, k: view.position_error[k].copy(),
    "speed": lambda view, k: np.linalg.norm(view.velocity[k], axis=1),
    "outage": _outage,
}
"""Traces by name: horizontal angle of body x from the direction of the features, and from the
desired heading, positive to the left [rad]; largest standard deviation of the position according to
the filter, estimation error and tracking error of the position [m]; true speed [m/s]; 1 while GNSS
fails."""


def _angle(start: Floats, end: Floats) -> Floats:
    """Horizontal angle from one direction to another, in (-pi, pi] [rad]."""
    cross = start[:, 0] * end[:, 1] - start[:, 1] * end[:, 0]
    return np.asarray(np.arctan2(cross, start[:, 0] * end[:, 0] + start[:, 1] * end[:, 1]))

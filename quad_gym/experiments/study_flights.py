"""Results of flying a policy in a study: numbers of every episode, and a few in full."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from quad_gym.evaluation import Policy, roll_out

Floats = NDArray[np.float64]

MARKERS = 2
"""So many features fix position and heading of a vehicle that knows its vertical."""

TRACED = 12
"""How many episodes are kept in full."""

_TRACE = "trace_"
"""Before the names of traces in files."""


@dataclass(frozen=True, eq=False)
class Flown:
    """The test episodes of one policy; (e,) numbers, and instants (t, TRACED) of the first ones."""

    returns: Floats
    """sum of rewards"""
    crashed: NDArray[np.bool_]
    """whether it crashed"""
    error: Floats
    """true position error, mean over the episode [m]"""
    late_error: Floats
    """the same over the second half of the time limit; NaN where it ended before [m]"""
    in_view: Floats
    """share of time in which the camera faces at least MARKERS features"""
    gates: NDArray[np.int64]
    """gates, or gaps, passed"""
    speed: Floats
    """true speed, mean over the episode [m/s]"""
    time: Floats
    """(t,) [s]"""
    traces: Mapping[str, Floats]
    """(t, k) by the names of TRACES"""

    def save(self, file: Path) -> None:
        """Write it, whole or not at all."""
        file.parent.mkdir(parents=True, exist_ok=True)
        part = file.with_suffix(".part.npz")
        numbers: dict[str, Any] = {
            f.name: getattr(self, f.name) for f in fields(self) if f.name != "traces"
        }
        numbers |= {_TRACE + name: values for name, values in self.traces.items()}
        np.savez_compressed(part, **numbers)
        part.replace(file)

    @classmethod
    def load(cls, file: Path) -> "Flown":
        """Read what `save` wrote."""
        with np.load(file) as stored:
            names = [f.name for f in fields(cls) if f.name != "traces"]
            traces = {k.removeprefix(_TRACE): stored[k] for k in stored if k.startswith(_TRACE)}
            return cls(**{name: stored[name] for name in names}, traces=traces)


class _Watch:
    """Looks at the flights after every step."""

    def __init__(self, traced: Sequence[str]) -> None:
        self.traced = traced
        self.seen = self.steps = self.distance = np.zeros(0)
        self.rows: list[list[Any]] = []

    def add(self, step: int, batch: Any, flying: NDArray[np.bool_]) -> None:
        """Take notice of an instant; see `quad_gym.evaluation.Watch`."""
        view = batch.view
        if step == 0:
            self.seen, self.steps, self.distance = (np.zeros(view.count) for _ in range(3))
        if view.features.shape[1]:
            self.seen += (view.truth.features_in_view.sum(axis=1) >= MARKERS) & flying
        self.distance += np.where(flying, np.linalg.norm(view.velocity, axis=1), 0.0)
        self.steps += flying
        k = min(TRACED, view.count)
        row = [TRACES[name](view, slice(k)).astype(np.float64) for name in self.traced]
        self.rows.append([np.full(1, view.period * step), *row])
        for values in row:
            values[~flying[:k]] = np.nan


def _off_wall(view: Any, k: slice) -> Floats:
    return _angle(view.features[k].mean(axis=1) - view.position[k], view.truth.forward[k])


def _sigma(view: Any, k: slice) -> Floats:
    try:
        return np.asarray(view.estimate.position_sigma[k].max(axis=1))
    except ValueError:  # on the truth no filter runs
        return np.zeros(len(view.position[k]))


def _outage(view: Any, k: slice) -> Floats:
    failing = view.truth.faults.get("gnss_outage")  # on the truth no GNSS runs
    return np.zeros(len(view.position[k])) if failing is None else failing[k].astype(np.float64)


TRACES: Mapping[str, Callable[[Any, slice], Floats]] = {
    "off_wall": _off_wall,
    "off_reward": lambda view, k: _angle(view.reference_heading[k], view.truth.forward[k]),
    "sigma": _sigma,
    "estimation_error": lambda view, k: view.estimation_error[k].copy(),
    "position_error": lambda view, k: view.position_error[k].copy(),
    "speed": lambda view, k: np.linalg.norm(view.velocity[k], axis=1),
    "outage": _outage,
}
"""What can be kept of every instant: angle of body x from the direction of the features and from
the wanted heading, to the left, in the plane [rad]; largest standard deviation of the position that
the filter states, error of the estimate, of the position [m]; true speed [m/s]; whether GNSS fails.
"""


def _angle(start: Floats, end: Floats) -> Floats:
    """(n,) from one direction to another in the plane, to the left, in (-pi, pi] [rad]."""
    cross = start[:, 0] * end[:, 1] - start[:, 1] * end[:, 0]
    return np.asarray(np.arctan2(cross, start[:, 0] * end[:, 0] + start[:, 1] * end[:, 1]))


def fly(policy: Policy, env: Any, seed: int, traced: Sequence[str] = ()) -> Flown:
    """Fly one episode in every flight of an environment with a `Task`; episode i has seed + i."""
    watch = _Watch(traced)
    episodes = roll_out(policy, env, seed=seed, watch=watch.add)
    time, *columns = (np.array(column) for column in zip(*watch.rows, strict=True))
    return Flown(
        episodes.returns,
        episodes.crashed,
        episodes.mean_error,
        episodes.late_error,
        watch.seen / watch.steps,
        episodes.gates_passed,
        watch.distance / watch.steps,
        time[:, 0],
        dict(zip(traced, columns, strict=True)),
    )

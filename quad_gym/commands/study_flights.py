"""Results of flying a policy in a study: numbers of every episode, and a few in full."""

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
    time: Floats
    """(t,) [s]"""
    off_wall: Floats
    """(t, k) angle of body x from the direction of the features, to the left, in the plane [rad]"""
    off_reward: Floats
    """(t, k) likewise from the wanted heading [rad]"""
    sigma: Floats
    """(t, k) largest standard deviation of the position that the filter states [m]"""
    estimation_error: Floats
    """(t, k) [m]"""
    position_error: Floats
    """(t, k) [m]"""

    def succeeded(self, within: float) -> NDArray[np.bool_]:
        """(e,) whether it flew to the end, in the second half with a mean error below `within`."""
        return ~self.crashed & (np.nan_to_num(self.late_error, nan=np.inf) < within)

    def save(self, file: Path) -> None:
        """Write it, whole or not at all."""
        file.parent.mkdir(parents=True, exist_ok=True)
        part = file.with_suffix(".part.npz")
        np.savez_compressed(part, **{f.name: getattr(self, f.name) for f in fields(self)})
        part.replace(file)

    @classmethod
    def load(cls, file: Path) -> "Flown":
        """Read what `save` wrote."""
        with np.load(file) as stored:
            return cls(**{f.name: stored[f.name] for f in fields(cls)})


class _Watch:
    """Looks at the flights after every step."""

    def __init__(self) -> None:
        self.seen = self.steps = np.zeros(0)
        self.rows: list[list[Any]] = []

    def add(self, step: int, batch: Any, flying: NDArray[np.bool_]) -> None:
        """Take notice of an instant; see `quad_gym.evaluation.Watch`."""
        view = batch.view
        if step == 0:
            self.seen, self.steps = np.zeros(view.count), np.zeros(view.count)
        in_view = view.truth.features_in_view.sum(axis=1) >= MARKERS
        self.seen += in_view & flying
        self.steps += flying
        k = min(TRACED, view.count)
        forward, to_wall = (
            view.truth.forward[:k],
            view.features[:k].mean(axis=1) - view.position[:k],
        )
        row = [
            _angle(to_wall, forward),
            _angle(view.reference_heading[:k], forward),
            view.estimate.position_sigma[:k].max(axis=1),
            view.estimation_error[:k].copy(),
            view.position_error[:k].copy(),
        ]
        self.rows.append([np.full(1, view.period * step), *row])
        for values in row:
            values[~flying[:k]] = np.nan


def _angle(start: Floats, end: Floats) -> Floats:
    """(n,) from one direction to another in the plane, to the left, in (-pi, pi] [rad]."""
    cross = start[:, 0] * end[:, 1] - start[:, 1] * end[:, 0]
    return np.asarray(np.arctan2(cross, start[:, 0] * end[:, 0] + start[:, 1] * end[:, 1]))


def fly(policy: Policy, env: Any, seed: int) -> Flown:
    """Fly one episode in every flight of an environment with a `Task`; episode i has seed + i."""
    watch = _Watch()
    episodes = roll_out(policy, env, seed=seed, watch=watch.add)
    time, *columns = (np.array(column) for column in zip(*watch.rows, strict=True))
    return Flown(
        episodes.returns,
        episodes.crashed,
        episodes.mean_error,
        episodes.late_error,
        watch.seen / watch.steps,
        time[:, 0],
        *columns,
    )

"""Traces of the first test episodes of a study."""

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from quad_gym.experiments import Floats

MARKERS = 2  #: number of features that determine position and heading if the vertical is known

TRACED = 50  #: number of episodes whose traces are stored


class ViewRecorder:
    """Recorder of "in_view" and "mean_speed", (e,), and of `TRACES` (t, k) of k episodes by name.

    `in_view` is the share of time in which the camera faces at least `MARKERS` features,
    `mean_speed` the mean true speed [m/s]. Traces are NaN after the end of an episode.
    """

    def __init__(self, traced: Sequence[str]) -> None:
        self._traced = traced
        self._seen = self._steps = self._distance = np.zeros(0)
        self._rows: list[list[Any]] = []

    def add(self, step: int, batch: Any, flying: Any) -> None:
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

    def recorded(self) -> dict[str, Any]:
        """Return shares of time, speeds and traces by name."""
        time, *columns = (np.array(column) for column in zip(*self._rows, strict=True))
        return {
            "time": time,
            "in_view": self._seen / self._steps,
            "mean_speed": self._distance / self._steps,
            **dict(zip(self._traced, columns, strict=True)),
        }


class SpeedRecorder:
    """Recorder of "mean_speed", (e,) [m/s], for tasks without a view; "in_view" is NaN."""

    def __init__(self) -> None:
        self._distance = self._steps = np.zeros(0)

    def add(self, step: int, batch: Any, flying: Any) -> None:
        """Record an instant; see `quad_gym.evaluation.Watch`."""
        if step == 0:
            self._distance, self._steps = np.zeros((2, len(flying)))
        speed = np.linalg.norm(batch.read("velocity"), axis=1)
        self._distance += np.where(flying, speed, 0.0)
        self._steps += flying

    def recorded(self) -> dict[str, Any]:
        """Return the speeds by name."""
        return {
            "mean_speed": self._distance / self._steps,
            "in_view": np.full(len(self._steps), np.nan),
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

"""Validation of a suite with a part of a log that was not used to find its numbers."""

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from quad_gym.estimation.fits import Fit, fit_of
from quad_gym.estimation.logs import Log
from quad_gym.estimation.replaying import replay
from quad_gym.estimation.results import Replay, by_sensor
from quad_gym.params.sensors import SensorSuite

_PERIOD, _GAP = 5, 1
"""Fixes are left out for a second in every five [s], in five replays that leave out each second."""


@dataclass(frozen=True, eq=False)
class Validation:
    """Consistency of a filter on a part of a log."""

    sensors: dict[str, Fit]
    held_out_error: tuple[float, float] | None
    """root mean square difference of the prediction from the first fix after gaps: horizontal, and
    vertical [m]; None: no fixes"""
    held_out_nis: float | None  #: mean NIS of these fixes over three
    held_out_ratios: tuple[float, float, float] | None
    """mean squared difference over its variance: east, north, up; 1 for a consistent filter"""
    diverged: float  #: share of the samples at which the filter counts as diverged
    problems: tuple[str, ...]  #: sentences of the replay, see `Replay.problems`
    replay: Replay


def validate(
    log: Log, suite: SensorSuite, start: Mapping[str, Any] | None, split: float
) -> Validation:
    """Replay a log, and compare the part after a time with the predictions of the filter."""
    result = replay(log, sensors=suite, start=start, reported_noise=False)
    sensors = {}
    for name, m in by_sensor(result.measured).items():
        if fit := fit_of(m, m.time > split):
            sensors[name] = fit
    diverged = float(np.mean(result.diverged[result.time > split]))
    held_out = _held_out(log, suite, start, split)
    return Validation(sensors, *held_out, diverged, result.problems, result)


def _held_out(
    log: Log, suite: SensorSuite, start: Mapping[str, Any] | None, split: float
) -> tuple[Any, Any, Any]:
    """Return errors, mean NIS and ratios of the first fixes after a second without."""
    gnss = log.gnss
    if gnss is None or suite.gnss is None or len(gnss) < 3:
        return None, None, None
    errors, sigmas, nis = [], [], []
    period = float(np.median(np.diff(gnss.time)))
    for first in range(0, _PERIOD, _GAP):
        since = gnss.time - split - first
        kept = np.flatnonzero((since < 0.0) | (since % _PERIOD >= _GAP))
        skipped = np.diff(kept, prepend=kept[:1]) > 1
        gaps = np.diff(gnss.time[kept], prepend=gnss.time[kept[:1]])
        skipped &= gaps <= _GAP + 2.0 * period  # longer ones are outages of the log
        some = replace(log, gnss=gnss.rows(kept))
        result = replay(some, sensors=suite, start=start, reported_noise=False)
        fixes = result.measured.get("gnss_position")
        if fixes is None:
            return None, None, None
        after = np.isin(fixes.received, gnss.received[kept[skipped]]) & np.isfinite(fixes.nis)
        errors.append(fixes.innovation[after])
        sigmas.append(fixes.sigma[after])
        nis.append(fixes.nis[after])
    error, sigma = np.concatenate(errors), np.concatenate(sigmas)
    if not len(error):
        return None, None, None
    squares = (error**2).mean(axis=0)
    level, up = math.sqrt(squares[0] + squares[1]), math.sqrt(squares[2])
    ratios = tuple(((error / sigma) ** 2).mean(axis=0).tolist())
    return (level, up), float(np.concatenate(nis).mean() / 3.0), ratios

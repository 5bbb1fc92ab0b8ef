"""Validation of a suite with a part of a log that was not used to find its numbers."""

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np

from quad_gym.estimation.calibrating.likelihood import SETTLING
from quad_gym.estimation.logs import Floats, Log
from quad_gym.estimation.replaying.findings import Finding, Severity
from quad_gym.estimation.replaying.fits import Fit, fit_of
from quad_gym.estimation.replaying.replay import replay
from quad_gym.estimation.replaying.results import Replay, by_sensor
from quad_gym.estimation.replaying.verdict import in_one_line
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
    findings: tuple[Finding, ...]  #: of the replay
    replay: Replay  #: of several logs, of the first one

    @property
    def problems(self) -> tuple[str, ...]:
        """Sentences with which the suite does not describe the log."""
        return tuple(str(f) for f in self.findings if f.severity == Severity.LOST)

    @property
    def verdict(self) -> str:
        """The verdict in a line."""
        return in_one_line(self.findings, self.sensors)


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
    held_out = _held_out(left_out(log, suite, start, split))
    return Validation(sensors, *held_out, diverged, result.findings, result)


def pooled(validations: Mapping[str, Validation]) -> Validation:
    """Return one validation of several logs, by name: means over measurements and over logs."""
    if len(validations) == 1:
        return next(iter(validations.values()))
    each = list(validations.values())
    sensors = {}
    for name in dict.fromkeys(name for v in each for name in v.sensors):
        fits = [v.sensors[name] for v in each if name in v.sensors]
        counts = [fit.measurements for fit in fits]
        mean, median, rejected = (
            float(np.average([getattr(fit, field) for fit in fits], weights=counts))
            for field in ("mean_nis", "median_nis", "rejected")
        )
        worst = max((fit.correlation for fit in fits), key=abs)
        sensors[name] = Fit(sum(counts), fits[0].freedoms, mean, median, rejected, worst)
    held = [v for v in each if v.held_out_error is not None]
    errors = np.array([v.held_out_error for v in held])
    level, up = np.sqrt((errors**2).mean(axis=0)).tolist() if held else (0.0, 0.0)
    each_ratios = np.array([v.held_out_ratios for v in held], float)
    ratios = each_ratios.mean(axis=0).tolist() if held else None
    findings = [
        replace(f, text=f"{f.text} ({name})") for name, v in validations.items() for f in v.findings
    ]
    findings.sort(key=lambda finding: -finding.severity)
    return Validation(
        sensors,
        (level, up) if held else None,
        float(np.mean([v.held_out_nis for v in held])) if held else None,
        None if ratios is None else tuple(ratios),
        float(np.mean([v.diverged for v in each])),
        tuple(findings),
        each[0].replay,
    )


class LeftOut(NamedTuple):
    """First fixes after a second without, predicted by the filter."""

    received: Floats  #: times of arrival, (n,) [s]
    error: Floats  #: measurement minus prediction, (n, 3) in I [m]
    sigma: Floats  #: its predicted standard deviations, (n, 3) [m]
    nis: Floats  #: (n,)


def left_out(
    log: Log, suite: SensorSuite, start: Mapping[str, Any] | None, split: float = -math.inf
) -> LeftOut | None:
    """Return the first fixes after each second without, later than a time; None: no fixes."""
    gnss = log.gnss
    if gnss is None or suite.gnss is None or len(gnss) < 3:
        return None
    parts = []
    period = float(np.median(np.diff(gnss.time)))
    begin = max(split, float(gnss.time[0]) + SETTLING)  # the start needs all fixes
    for first in range(0, _PERIOD, _GAP):
        since = gnss.time - begin - first
        kept = np.flatnonzero((since < 0.0) | (since % _PERIOD >= _GAP))
        skipped = np.diff(kept, prepend=kept[:1]) > 1
        gaps = np.diff(gnss.time[kept], prepend=gnss.time[kept[:1]])
        skipped &= gaps <= _GAP + 2.0 * period  # longer ones are outages of the log
        some = replace(log, gnss=gnss.rows(kept))
        result = replay(some, sensors=suite, start=start, reported_noise=False)
        fixes = result.measured.get("gnss_position")
        if fixes is None:
            return None
        after = np.isin(fixes.received, gnss.received[kept[skipped]]) & np.isfinite(fixes.nis)
        columns = fixes.received, fixes.innovation, fixes.sigma, fixes.nis
        parts.append([column[after] for column in columns])
    found = LeftOut(*(np.concatenate(some) for some in zip(*parts, strict=True)))
    return found if len(found.nis) else None


def _held_out(found: LeftOut | None) -> tuple[Any, Any, Any]:
    """Return errors, mean NIS and ratios of fixes that were left out."""
    if found is None:
        return None, None, None
    squares = (found.error**2).mean(axis=0)
    level, up = math.sqrt(squares[0] + squares[1]), math.sqrt(squares[2])
    ratios = tuple(((found.error / found.sigma) ** 2).mean(axis=0).tolist())
    return (level, up), float(found.nis.mean() / 3.0), ratios

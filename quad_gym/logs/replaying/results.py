"""Results of a replay: estimates, innovations, their statistics, findings and problems."""

import bisect
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from enum import IntEnum
from typing import Any, NamedTuple, TypeVar

import numpy as np

from quad_gym.estimation.filters import Results
from quad_gym.logs.formats import Floats
from quad_gym.params.sensor_table import READINGS
from quad_gym.params.suites import SensorSuite
from quad_gym.records import (
    FREEDOMS,
    GROUP_BLOCK,
    FilterStatus,
    GateDecision,
)
from quad_gym.rotations import dcm_to_quaternion

# --------------------------------------------------------------------------------------------------
# Findings: sentences about the use of an estimate, by quantity and severity.
# --------------------------------------------------------------------------------------------------

QUANTITIES = ("position", "height", "attitude", "heading")

ADVICE = (
    "Check the units, axes and time stamps of the log, or use a suite with the noise, delays and "
    "mounting of these sensors: `quad-gym calibrate LOG` finds noise, delays and lever arms."
)


class Severity(IntEnum):
    """Weight of a finding."""

    NOTE = 0  #: information
    UNCERTAIN = 1  #: errors of the quantity are larger than its standard deviation
    LOST = 2  #: the quantity cannot be used, or the suite does not describe the log


@dataclass(frozen=True, kw_only=True)
class Finding:
    """A sentence of the verdict."""

    quantity: str  #: "position", "height", "attitude", "heading"; or "log", for its units and axes
    severity: Severity
    text: str

    def __str__(self) -> str:
        return self.text if self.quantity == "log" else f"{self.quantity}: {self.text}"


def by_quantity(findings: Sequence[Finding]) -> list[str]:
    """Return a paragraph on each quantity: its findings, or "usable".

    A single finding is in the first line, and several are a list below it.
    """
    lines = [f"log: {f.text}" for f in findings if f.quantity == "log"]
    for quantity in QUANTITIES:
        some = [f for f in findings if f.quantity == quantity]
        worst = max((f.severity for f in some), default=Severity.NOTE)
        words = ("usable", "uncertain", "not usable")[worst]
        between = "\n  - " if len(some) > 1 else "; "
        lines.append(between.join([f"{quantity}: {words}", *(f.text for f in some)]))
    return lines


# --------------------------------------------------------------------------------------------------
# Results of a replay: estimates, innovations and problems; smoothed estimates.
# --------------------------------------------------------------------------------------------------

SIGMAS = tuple(
    f"{word}_sigma_{axis}"
    for word in ("position", "velocity", "attitude", "accel_bias", "gyro_bias")
    for axis in "xyz"
)
"""Columns of the standard deviations of estimates."""

COLUMNS = (
    "time",
    *(
        f"{name}_{axis}"
        for name in ("position", "velocity", "quaternion", "accel_bias", "gyro_bias")
        for axis in ("wxyz" if name == "quaternion" else "xyz")
    ),
    *SIGMAS,
)
"""Columns of estimates in a table."""


@dataclass(frozen=True, eq=False)
class InnovationSeries:
    """Innovations of one kind of measurement in a replay."""

    time: Floats  #: (m,) time stamps [s]
    received: Floats  #: (m,) times of arrival [s]
    innovation: Floats
    """(m, d) innovations; of positions and velocities in I, of directions across the predicted
    one"""
    sigma: Floats  #: (m, d) standard deviations of the innovations, as predicted by the filter
    nis: Floats
    """(m,) normalized innovations squared; chi-square with d degrees of freedom for a consistent
    filter"""
    gate: Floats  #: (m,) gate decisions, see `quad_gym.records.GateDecision`

    @property
    def gated(self) -> Any:
        """Measurements (m,) that were left out: rejected, or with a too uncertain prediction."""
        return self.rejected | (self.gate == GateDecision.UNSURE)

    @property
    def rejected(self) -> Any:
        """Measurements (m,) with innovations beyond the gate."""
        return self.gate == GateDecision.REJECTED


@dataclass(frozen=True, eq=False)
class Estimates:
    """Estimates for a log, at samples of its IMU."""

    sensors: SensorSuite
    """sensor suite that the filter assumed; `gnss.reference_antenna_G` is the origin of I"""
    time: Floats  #: (n,) times of the samples [s]
    position: Floats  #: (n, 3) position in I [m]
    velocity: Floats  #: (n, 3) velocity in I [m/s]
    quaternion: Floats
    """(n, 4) attitude: unit quaternions (w, x, y, z), body to inertial, without changes of sign"""
    accel_bias: Floats  #: (n, 3) accelerometer bias in B [m/s^2]
    gyro_bias: Floats  #: (n, 3) gyro bias in B [rad/s]
    sigma: Floats
    """(n, 15) standard deviations of position, velocity, error angles, accelerometer and gyro
    bias"""
    status: FilterStatus
    """numerical failures; 0 does not imply that the suite fits the log, see `Replay.problems`"""
    sources: Mapping[str, Any] = field(default_factory=dict, kw_only=True)
    """sources in the log, see `Log.sources`"""
    notes: tuple[str, ...] = field(default=(), kw_only=True)
    """sentences on the choice of sources and on dropped rows"""

    def __len__(self) -> int:
        return len(self.time)

    def columns(self) -> dict[str, Floats]:
        """Return the estimates as a table: columns of one number each, by name."""
        kinematics = self.time, self.position, self.velocity, self.quaternion
        table = np.column_stack([*kinematics, self.accel_bias, self.gyro_bias, self.sigma])
        return dict(zip(COLUMNS, table.T, strict=True))


@dataclass(frozen=True, eq=False)
class Replay(Estimates):
    """Filter output for a log, at each IMU sample since the start of the filter.

    Each row holds the estimate at the arrival of the next sample: measurements contribute from
    their arrival on, not from their time stamps on.
    """

    estimator: str
    """kind of the filter: "ukf" or "ekf\", or the class of an own one"""
    heading_known: Any
    """(n,) True where the heading was known, from a measurement or from the motion"""
    diverged: Any  #: (n,) True where the innovations showed that the filter had diverged
    heading_apart: Any
    """(n,) heading by motion, from IMU and GNSS velocities alone, minus the heading of the filter
    [rad]; 0 without GNSS velocities"""
    motion_sigma: Any
    """(n,) standard deviation of the heading by motion [rad]; infinite without GNSS velocities"""
    compass_out: Any
    """(n,) True where the magnetometer was left out, because it contradicted the motion"""
    measured: dict[str, InnovationSeries]
    """innovations by measurement: "gnss_position", "gnss_baseline", "gnss_velocity", "feature_0",
    ..., "barometer" and "magnetometer\""""
    late: dict[str, Floats]
    """ages at their arrival [s] of the measurements that were older than the window, and were left
    out, by sensor"""
    unused: tuple[str, ...]  #: sensors of the log that the suite does not use
    findings: tuple[Finding, ...] = ()
    """the verdict: units and axes of the log, and the quantities that were estimated, the worst
    first"""
    verdict: str = ""
    """the verdict in a line, such as "usable: NIS per degree of freedom 0.6 to 1.3\""""

    @property
    def problems(self) -> tuple[str, ...]:
        """Sentences of the findings that a replay must not have; empty: no problem was found."""
        return tuple(str(f) for f in self.findings if f.severity == Severity.LOST)

    @property
    def too_late(self) -> int:
        """Number of measurements that were older than the window, and were left out."""
        return sum(map(len, self.late.values()))

    def columns(self) -> dict[str, Floats]:
        """Return the estimates as a table: columns of one number each, by name."""
        return super().columns() | {"diverged": self.diverged.astype(np.float64)}

    def summary(self) -> dict[str, Any]:
        """Return counts and mean NIS per measurement, the verdict, and all sentences."""
        kinds = {}
        for name, m in self.measured.items():
            known, freedoms = m.nis[np.isfinite(m.nis)], m.innovation.shape[1]
            mean = float(known.mean()) if len(known) else math.nan
            kinds[name] = {
                "count": len(m.time),
                "gated": int(m.gated.sum()),
                "degrees_of_freedom": freedoms,
                "mean_nis": mean,
                "nis_per_degree_of_freedom": mean / freedoms,
            }
        return {
            "duration": float(self.time[-1] - self.time[0]),
            "imu_samples": len(self.time),
            "measurements": kinds,
            "too_late": self.too_late,
            "unused": self.unused,
            "status": self.status.name or "",
            "diverged": float(np.mean(self.diverged)),
            "verdict": self.verdict,
            "problems": self.problems,
            "findings": [
                {"quantity": f.quantity, "severity": f.severity.name.lower(), "text": f.text}
                for f in self.findings
            ],
            "heading_known": bool(self.heading_known[-1]),
            "sources": self.sources,
            "notes": self.notes,
        }


@dataclass(frozen=True, eq=False)
class Smoothed(Estimates):
    """Smoothed trajectory of a log, at each IMU sample since the heading is known."""

    covariance: Floats
    """(n, 15, 15) of position, velocity, error angles, accelerometer and gyro bias"""
    difference: Floats
    """(n, 15) filtered minus smoothed estimates, divided by the square root of the difference of
    their variances; NaN where this is less than a millionth of the filter's, as at the end"""

    def consistency(self, limit: float = 3.0) -> dict[str, float]:
        """Return McReynolds' test of consistency: shares of large differences, by state.

        The covariance of (filtered - smoothed) is the difference of their covariances if the suite
        describes the sensors, whatever the motion: no reference trajectory is necessary. Then a
        share of 0.0027 is beyond 3 standard deviations on average; as differences are correlated
        over time, single flights scatter about it. A much larger share shows a process model or
        noise that does not describe the log.

        Args:
            limit: Limit in standard deviations.

        Returns:
            Shares by the names of the columns of standard deviations; NaN where nothing was tested.
        """
        large, tested = np.abs(self.difference) > limit, np.isfinite(self.difference)
        with np.errstate(invalid="ignore"):
            shares = large.sum(axis=0) / tested.sum(axis=0)
        names = [name.replace("_sigma", "") for name in SIGMAS]
        return dict(zip(names, shares.tolist(), strict=True))


def by_sensor(measured: Mapping[str, InnovationSeries]) -> dict[str, InnovationSeries]:
    """Return the innovations of a replay by sensor, with all blocks of a sensor together."""
    found = dict(measured)
    for reading in (reading for reading in READINGS.values() if reading.most_blocks > 1):
        names = {reading.name_of(k) for k in range(reading.most_blocks)}
        if parts := [found.pop(name) for name in measured if name in names]:
            found[reading.together] = stacked(parts)
    return found


def rejected_for_their_size(m: InnovationSeries, probability: float) -> InnovationSeries:
    """Return innovations of which those within the gate do not count as rejected.

    A filter also leaves out measurements of a sensor on probation, whatever they are.

    Args:
        m: The innovations.
        probability: False-alarm probability of the gate.
    """
    from scipy.stats import chi2

    limit = chi2.isf(probability, m.innovation.shape[1])
    within = m.rejected & (m.nis < limit)
    return replace(m, gate=np.where(within, float(GateDecision.UNSURE), m.gate))


_Found = TypeVar("_Found", bound=Estimates)


def joined(parts: Sequence[_Found]) -> _Found:
    """Return the estimates for the parts of a log as of one log."""
    first = parts[0]
    if len(parts) == 1:
        return first
    changes: dict[str, Any] = {"status": first.status}
    for each in parts[1:]:
        changes["status"] |= each.status
    for name in (f.name for f in fields(first)):
        values = [getattr(part, name) for part in parts]
        if isinstance(values[0], np.ndarray):
            changes[name] = np.concatenate(values)
        elif name == "measured":
            changes[name] = _joined_innovations(values)
        elif name == "late":
            names = dict.fromkeys(sensor for late in values for sensor in late)
            changes[name] = {n: np.concatenate([v[n] for v in values if n in v]) for n in names}
    return replace(first, **changes)


def _joined_innovations(
    parts: Sequence[Mapping[str, InnovationSeries]],
) -> dict[str, InnovationSeries]:
    """Return the innovations of all parts by kind of measurement."""
    names = dict.fromkeys(name for part in parts for name in part)
    return {name: stacked([part[name] for part in parts if name in part]) for name in names}


def stacked(parts: Sequence[InnovationSeries]) -> InnovationSeries:
    """Return innovations in the order of time."""
    order = np.argsort(np.concatenate([m.time for m in parts]), kind="stable")
    columns = [f.name for f in fields(InnovationSeries)]
    return InnovationSeries(
        *(np.concatenate([getattr(m, name) for m in parts])[order] for name in columns)
    )


# --------------------------------------------------------------------------------------------------
# Statistics of the innovations of a sensor.
#
# NIS is the normalized innovation squared, over its degrees of freedom: 1 on average for a
# consistent filter. Means include the measurements that the gate has rejected; otherwise a filter
# that rejects all that contradicts it would look consistent.
# --------------------------------------------------------------------------------------------------

AT_LIMIT = 0.05
"""Probability with which a test rejects what is at the limit of the test; a consistent filter is
far from the limits."""
MIN_COUNT = 50  #: number of innovations that shows their correlation


class Fit(NamedTuple):
    """Innovations of a sensor compared with the filter's predictions."""

    measurements: int
    freedoms: int
    mean_nis: float  #: mean NIS per degree of freedom; 1 for a consistent filter
    median_nis: float
    """median NIS over the median of chi-square; 1 for a consistent filter, and hardly changed by
    outliers"""
    rejected: float  #: share of the measurements that the gate rejects
    correlation: float
    """correlation of successive innovations, the largest of all axes; 0 for a consistent filter"""


def fit_of(measured: InnovationSeries, rows: Any = slice(None)) -> Fit | None:
    """Return the statistics of some innovations; None: fewer than three are known."""
    from scipy.stats import chi2

    known = np.isfinite(measured.nis)[rows]
    nis, d = measured.nis[rows][known], measured.innovation.shape[1]
    if len(nis) < 3:
        return None
    rho = correlations((measured.innovation / measured.sigma)[rows][known])
    return Fit(
        len(nis),
        d,
        float(nis.mean() / d),
        float(np.median(nis) / chi2.median(d)),
        float(measured.rejected[rows][known].mean()),
        float(rho[np.argmax(np.abs(rho))]),
    )


def correlations(scaled: Floats) -> Floats:
    """Return the correlation of successive innovations (n, axes) by axis; 0 where all are zero."""
    products, squares = (scaled[:-1] * scaled[1:]).mean(axis=0), (scaled**2).mean(axis=0)
    return np.divide(products, squares, out=np.zeros_like(products), where=squares > 0.0)


def correlation_time(values: Floats) -> float:
    """Return the integrated autocorrelation time of numbers, in samples; 1 if they are white.

    The sum ends with the first correlation that white noise would also have, to three standard
    deviations.
    """
    centered, least = values - values.mean(), max(0.05, 3.0 / math.sqrt(len(values)))
    variance, tau = float((centered**2).mean()), 1.0
    if variance == 0.0:
        return tau
    for lag in range(1, len(values) // 4):
        rho = float((centered[:-lag] * centered[lag:]).mean()) / variance
        if rho < least:
            break
        tau += 2.0 * rho
    return tau


def exceeds(hits: Any, share: float) -> bool:
    """Return True if more than a share of the cases (n,) is certainly True.

    The test is binomial (Clopper and Pearson), with as many independent cases as the
    autocorrelation leaves, and rejects a share at the limit with the probability `AT_LIMIT`.
    """
    from scipy.stats import beta

    hits = np.asarray(hits, np.float64)
    count = len(hits) / correlation_time(hits) if len(hits) else 0.0
    true = float(hits.mean()) * count if count else 0.0
    return true > 0.0 and bool(beta.ppf(AT_LIMIT, true, count - true + 1.0) > share)


def larger(nis: Floats, freedoms: int, ratio: float) -> bool:
    """Return True if the innovations' variance certainly exceeds its prediction by a ratio.

    The median decides, so that outliers do not.
    """
    from scipy.stats import chi2

    return exceeds(nis > ratio * chi2.median(freedoms), 0.5)


def runs_beyond_chance(rejected: Any, probability: float) -> list[tuple[int, int]]:
    """Return first and last rows of the runs of rejections (n,) that chance does not explain.

    Chance has independent outliers that are as frequent as the rejections outside of the run, and
    at least 1 %, and explains a run unless its probability is smaller than the given one.
    """
    edges = np.flatnonzero(np.diff(np.concatenate([[0], np.asarray(rejected, int), [0]])))
    count, total = len(rejected), int(np.sum(rejected))
    found = []
    for begin, end in zip(edges[::2].tolist(), edges[1::2].tolist(), strict=True):
        length = end - begin
        share = max((total - length) / max(count - length, 1), 0.01)
        if count * share**length < probability:
            found.append((begin, end - 1))
    return found


# --------------------------------------------------------------------------------------------------
# Results of a replay from the pieces of its tape: estimates, and innovations by measurement.
# --------------------------------------------------------------------------------------------------


def collected(
    pieces: Iterable[Results], blocks: Iterable[int], count: int, stamps: Floats
) -> tuple[dict[str, Any], dict[int, InnovationSeries]]:
    """Return columns of `Replay` by name, and innovations by block.

    Args:
        pieces: Results of all pieces of a tape.
        blocks: Blocks of innovations, in the order of the results.
        count: Number of estimates.
        stamps: Times of measurement and arrival (m, 2) of the updates.
    """
    columns: dict[str, Any] = {}
    rows: dict[int, list[Floats]] = {block: [] for block in blocks}
    first = updates = 0
    for kept, reported, valid in pieces:
        for name, values in _columns_of(kept).items():
            if name not in columns:
                columns[name] = np.empty((count, *values.shape[1:]), values.dtype)
            columns[name][first : first + len(kept)] = values
        first += len(kept)
        times = stamps[updates : updates + len(valid)]
        updates += len(valid)
        for row, (block, found) in enumerate(rows.items()):
            have = valid[:, block]
            if have.any():
                found.append(np.column_stack([times[have], reported[have, row]]))
    measured = {
        block: _measured(np.concatenate(found), FREEDOMS[block])
        for block, found in rows.items()
        if found
    }
    return columns, measured


def state_columns(rows: Floats) -> tuple[dict[str, Floats], Floats]:
    """Return fields of `Replay` from rows of r, v, R_BI, b_a, b_g, and the rest of the rows."""
    r, v, R, b_a, b_g, rest = np.split(rows, np.cumsum((3, 3, 9, 3, 3)), axis=1)
    state = {
        "position": r,
        "velocity": v,
        "quaternion": dcm_to_quaternion(R.reshape(-1, 3, 3)),
        "accel_bias": b_a,
        "gyro_bias": b_g,
    }
    return state, rest


def _columns_of(kept: Floats) -> dict[str, Any]:
    """Return fields of `Replay` from stored estimates."""
    columns, rest = state_columns(kept)
    variances, state = np.split(rest, (15,), axis=1)
    return {
        **columns,
        "sigma": np.sqrt(variances),
        "heading_known": (state[:, 5] > 0.0) & (state[:, 4] <= 0.0),
        "diverged": state[:, 0] > 0.0,
        "heading_apart": 2.0 * np.arcsin(np.clip(0.5 * state[:, 1], -1.0, 1.0)),
        "motion_sigma": np.where(state[:, 2] > 0.0, state[:, 2], np.inf),
        "compass_out": state[:, 3] > 0.0,
    }


def _measured(table: Floats, d: int) -> InnovationSeries:
    """Return innovations from rows of two times and REPORTED numbers."""
    values = table[:, 2:]
    if d == 2 and (values[:, 4] > math.pi).all():
        d = 1  # headings alone: nothing was measured upward
    return InnovationSeries(
        table[:, 0],
        table[:, 1],
        values[:, :d],
        values[:, 3 : 3 + d],
        values[:, 6],
        values[:, 7],
    )


def name_of(block: int) -> str:
    """Return the name of a block of innovations."""
    group = bisect.bisect(GROUP_BLOCK, block) - 1
    reading = tuple(READINGS.values())[group]
    return reading.name_of(block - GROUP_BLOCK[group])

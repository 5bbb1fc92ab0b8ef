"""Results of a replay: estimates, innovations and problems; smoothed estimates."""

import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from typing import Any, TypeVar

import numpy as np

from quad_gym.estimation.logs import Floats
from quad_gym.estimation.replaying.findings import Finding, Severity
from quad_gym.params.aid_table import AID_PARAMS
from quad_gym.params.sensors import SensorSuite
from quad_gym.records import FilterStatus, GateDecision

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
class Measured:
    """Innovations of one kind of measurement."""

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
    measured: dict[str, Measured]
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


def by_sensor(measured: Mapping[str, Measured]) -> dict[str, Measured]:
    """Return the innovations of a replay by sensor, with all blocks of a sensor together."""
    found = dict(measured)
    several = {name: name for name, kind in AID_PARAMS.items() if kind.most_blocks > 1}
    for word, together in {"feature": "features", **several}.items():
        names = [name for name in measured if re.fullmatch(rf"{word}_\d+", name)]
        if names:
            found[together] = stacked([found.pop(name) for name in names])
    return found


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


def _joined_innovations(parts: Sequence[Mapping[str, Measured]]) -> dict[str, Measured]:
    """Return the innovations of all parts by kind of measurement."""
    names = dict.fromkeys(name for part in parts for name in part)
    return {name: stacked([part[name] for part in parts if name in part]) for name in names}


def stacked(parts: Sequence[Measured]) -> Measured:
    """Return innovations in the order of time."""
    order = np.argsort(np.concatenate([m.time for m in parts]), kind="stable")
    columns = [f.name for f in fields(Measured)]
    return Measured(*(np.concatenate([getattr(m, name) for m in parts])[order] for name in columns))

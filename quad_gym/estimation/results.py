"""Results of a replay: estimates, innovations and problems."""

import math
from collections.abc import Mapping
from dataclasses import dataclass, fields
from typing import Any

import numpy as np

from quad_gym.estimation.logs import Floats
from quad_gym.params.sensors import SensorSuite
from quad_gym.records import FilterStatus, GateDecision


@dataclass(frozen=True, eq=False)
class Measured:
    """Innovations of one kind of measurement."""

    time: Floats
    """(m,) time stamps [s]"""
    received: Floats
    """(m,) when they arrived [s]"""
    innovation: Floats
    """(m, d); of positions and velocities in I, of directions across the predicted one"""
    sigma: Floats
    """(m, d) what the filter expected of them"""
    nis: Floats
    """(m,) normalized squares, chi-square with d degrees of freedom in a filter that is right"""
    gate: Floats
    """(m,) what became of them, see `quad_gym.records.GateDecision`"""

    @property
    def gated(self) -> Any:
        """(m,) whether they were left out, beyond the gate or as the estimate was too uncertain."""
        return self.rejected | (self.gate == GateDecision.UNSURE)

    @property
    def rejected(self) -> Any:
        """(m,) True where they were beyond the gate."""
        return self.gate == GateDecision.REJECTED


@dataclass(frozen=True, eq=False)
class Replay:
    """What a filter has made of a log, at each sample of the IMU since its start.

    Each row holds what was known when the next sample came: measurements count from when they had
    arrived, not from their time stamps on.
    """

    estimator: str
    """"ukf" or "ekf\""""
    sensors: SensorSuite
    """what the filter believed in; `gnss.reference_antenna_G` is the origin of I"""
    time: Floats
    """(n,) of the samples [s]"""
    position: Floats
    """(n, 3) in I [m]"""
    velocity: Floats
    """(n, 3) in I [m/s]"""
    quaternion: Floats
    """(n, 4) unit quaternions (w, x, y, z), body to inertial"""
    accel_bias: Floats
    """(n, 3) in B [m/s^2]"""
    gyro_bias: Floats
    """(n, 3) in B [rad/s]"""
    sigma: Floats
    """(n, 15) standard deviations of the errors: position, velocity, error angles, biases"""
    heading_known: Any
    """(n,) whether the motion, or something else, had told the heading"""
    diverged: Any
    """(n,) True where the innovations showed that the estimate was wrong: the filter diverged"""
    status: FilterStatus
    """failures of its arithmetic; 0 does not mean that the suite fits the log, see `problems`"""
    measured: dict[str, Measured]
    """by "gnss_position", "gnss_baseline", "gnss_velocity", "feature_0", ..., "barometer" and
    "magnetometer\""""
    too_late: int
    """measurements older than the window when they arrived, and so left out"""
    unused: tuple[str, ...]
    """sensors of the log that the suite does not have"""
    problems: tuple[str, ...] = ()
    """sentences on implausible units and axes of the log, on a filter that diverged or failed, and
    on sensors that the suite does not describe, with likely causes; empty: none was found"""

    def __len__(self) -> int:
        return len(self.time)

    def columns(self) -> dict[str, Floats]:
        """The estimates as a table: columns of one number each, by name."""
        table = {"time": self.time}
        names = {
            "position": self.position,
            "velocity": self.velocity,
            "quaternion": self.quaternion,
            "accel_bias": self.accel_bias,
            "gyro_bias": self.gyro_bias,
        }
        for name, values in names.items():
            axes = "wxyz" if values.shape[1] == 4 else "xyz"
            table.update({f"{name}_{axis}": values[:, i] for i, axis in enumerate(axes)})
        words = ("position", "velocity", "attitude", "accel_bias", "gyro_bias")
        for k in range(15):
            table[f"{words[k // 3]}_sigma_{'xyz'[k % 3]}"] = self.sigma[:, k]
        table["diverged"] = self.diverged.astype(np.float64)
        return table

    def summary(self) -> dict[str, Any]:
        """Counts and mean NIS of each measurement, share of samples diverged, and `problems`."""
        kinds = {}
        for name, m in self.measured.items():
            used = np.isfinite(m.nis)
            kinds[name] = {
                "count": len(m.time),
                "gated": int(m.gated.sum()),
                "degrees_of_freedom": m.innovation.shape[1],
                "mean_nis": float(m.nis[used].mean()) if used.any() else math.nan,
            }
        return {
            "duration": float(self.time[-1] - self.time[0]),
            "imu_samples": len(self.time),
            "measurements": kinds,
            "too_late": self.too_late,
            "unused": self.unused,
            "status": self.status.name or "",
            "diverged": float(np.mean(self.diverged)),
            "problems": self.problems,
            "heading_known": bool(self.heading_known[-1]),
        }


def by_sensor(measured: Mapping[str, Measured]) -> dict[str, Measured]:
    """The innovations of a replay by sensor, all features together as "features"."""
    found = {name: m for name, m in measured.items() if not name.startswith("feature_")}
    features = [m for name, m in measured.items() if name.startswith("feature_")]
    if features:
        names = [field.name for field in fields(Measured)]
        parts = (np.concatenate([getattr(m, name) for m in features]) for name in names)
        found["features"] = Measured(*parts)
    return found

"""What a filter computed from a log: estimates and innovations."""

import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from quad_gym.estimation.logs import Floats
from quad_gym.params.sensors import SensorSuite
from quad_gym.records import FilterStatus, Gate


@dataclass(frozen=True, eq=False)
class Measured:
    """The innovations of one kind of measurement."""

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
    """(m,) what became of them, see `quad_gym.records.Gate`"""

    @property
    def gated(self) -> Any:
        """(m,) whether they were left out, beyond the gate or as the estimate was too uncertain."""
        return (self.gate == Gate.REJECTED) | (self.gate == Gate.UNSURE)


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
    attitude: Floats
    """(n, 4) unit quaternions (w, x, y, z), body to inertial"""
    accel_bias: Floats
    """(n, 3) in B [m/s^2]"""
    gyro_bias: Floats
    """(n, 3) in B [rad/s]"""
    sigma: Floats
    """(n, 15) standard deviations of the errors: position, velocity, error angles, biases"""
    heading_known: Any
    """(n,) whether the motion, or something else, had told the heading"""
    status: FilterStatus
    """what has gone wrong"""
    measured: dict[str, Measured]
    """by "gnss_position", "gnss_baseline", "gnss_velocity", "feature_0", ..., "barometer" and
    "magnetometer\""""
    too_late: int
    """measurements older than the window when they arrived, and so left out"""
    unused: tuple[str, ...]
    """what the log has and the suite has not"""

    def __len__(self) -> int:
        return len(self.time)

    def columns(self) -> dict[str, Floats]:
        """The estimates as a table: columns of one number each, by name."""
        table = {"time": self.time}
        names = {
            "position": self.position,
            "velocity": self.velocity,
            "attitude": self.attitude,
            "accel_bias": self.accel_bias,
            "gyro_bias": self.gyro_bias,
        }
        for name, values in names.items():
            axes = "wxyz" if values.shape[1] == 4 else "xyz"
            table.update({f"{name}_{axis}": values[:, i] for i, axis in enumerate(axes)})
        words = ("position", "velocity", "attitude", "accel_bias", "gyro_bias")
        for k in range(15):
            table[f"{words[k // 3]}_sigma_{'xyz'[k % 3]}"] = self.sigma[:, k]
        return table

    def summary(self) -> dict[str, Any]:
        """How many of each measurement there were, were left out, and how large they were."""
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
            "heading_known": bool(self.heading_known[-1]),
        }

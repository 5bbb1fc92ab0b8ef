"""Logs: what sensors measured in a flight, and the columns of tables that hold it.

A table has a row per sample or measurement, or several in one row where they have the same time
stamp. What a row does not hold is NaN, or empty in a file. Rows are in the order in which they
arrived, unless a column `received` tells when they did: a row whose `time` is earlier than that of
the IMU sample above it has come late.
"""

from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]


class LogColumn(NamedTuple):
    """Columns of a log, one for each number of a quantity."""

    names: tuple[str, ...]
    unit: str
    frame: str
    meaning: str


def _xyz(name: str) -> tuple[str, ...]:
    return tuple(f"{name}_{axis}" for axis in "xyz")


def _enu(name: str) -> tuple[str, ...]:
    return tuple(f"{name}_{axis}" for axis in ("east", "north", "up"))


# fmt: off
LOG_COLUMNS = {
    "time": LogColumn(("time",), "s", "-", "when it was measured; of a mean, the end of its time"),
    "received": LogColumn(("received",), "s", "-", "when it arrived; else rows stand so"),
    "gyro": LogColumn(_xyz("gyro"), "rad/s", "B", "angular rate"),
    "accel": LogColumn(_xyz("accel"), "m/s^2", "B", "specific force, about +9.8 upward at rest"),
    "gnss": LogColumn(_xyz("gnss"), "m", "ECEF", "primary antenna, from the center of the Earth"),
    "gnss_lla": LogColumn(("gnss_lat", "gnss_lon", "gnss_alt"), "deg, m", "WGS-84", "the same"),
    "gnss_enu": LogColumn(_enu("gnss"), "m", "I", "the same from the origin"),
    "gnss_sigma": LogColumn(_enu("gnss_sigma"), "m", "I", "its deviations as reported"),
    "gnss_velocity": LogColumn(_xyz("gnss_velocity"), "m/s", "ECEF", "of the antenna"),
    "gnss_velocity_enu": LogColumn(_enu("gnss_velocity"), "m/s", "I", "the same"),
    "gnss_velocity_sigma": LogColumn(("gnss_velocity_sigma",), "m/s", "-", "per axis"),
    "gnss_baseline": LogColumn(_xyz("gnss_baseline"), "m", "ECEF", "primary to secondary antenna"),
    "gnss_baseline_enu": LogColumn(_enu("gnss_baseline"), "m", "I", "the same"),
    "barometer": LogColumn(("barometer",), "m", "I", "height by static pressure"),
    "magnetometer": LogColumn(_xyz("magnetometer"), "T", "B", "magnetic field"),
}
# fmt: on
"""Columns of a table, by the names under which a dictionary may hold their numbers together.

Those of the camera, `pixel_0_u`, `pixel_0_v`, `pixel_1_u` and so on [pixels from the image's
center], or together `pixels` (n, features, 2), are not among them."""


@dataclass(frozen=True, eq=False)
class Stream:
    """What one sensor measured."""

    time: Floats
    """(n,) time stamps [s]"""
    received: Floats
    """(n,) when it arrived [s]"""
    values: dict[str, Floats]
    """(n, ...) by name"""

    def __len__(self) -> int:
        return len(self.time)


@dataclass(frozen=True, eq=False)
class Log:
    """What sensors measured in a flight, each at its own times.

    Bodies are as in this package: x forward, y left, z up; I is east, north, up.
    """

    imu: Stream
    """gyro and accel, (n, 3) each"""
    gnss: Stream | None = None
    """position_G (n, 3) from the center of the Earth, or position_I from the origin; velocity_G or
    velocity_I; baseline_G or baseline_I; position_sigma_I (n, 3); velocity_sigma (n,)"""
    camera: Stream | None = None
    """pixels (n, features, 2)"""
    barometer: Stream | None = None
    """barometer (n,)"""
    magnetometer: Stream | None = None
    """magnetometer (n, 3)"""
    barometer_from_start: bool = False
    """whether heights by pressure count from another level, so that only their changes tell"""
    about: dict[str, Any] = field(default_factory=dict)
    """what else is worth knowing, such as where it comes from"""

    def __post_init__(self) -> None:
        if len(self.imu) < 2:
            raise ValueError(f"a log must have at least two IMU samples, got {len(self.imu)}")
        steps = np.diff(self.imu.time)
        if not (steps > 0.0).all():
            k = int(np.flatnonzero(~(steps > 0.0))[0])
            raise ValueError(
                "time of IMU samples must increase, got "
                f"{self.imu.time[k + 1]:.6f} s after {self.imu.time[k]:.6f} s (sample {k + 1})"
            )
        for stream in self.streams.values():
            if not (np.isfinite(stream.time).all() and np.isfinite(stream.received).all()):
                raise ValueError("time and received must be finite where something was measured")

    @property
    def streams(self) -> dict[str, Stream]:
        """Those of all sensors that measured something, by name."""
        names = ("imu", "gnss", "camera", "barometer", "magnetometer")
        found = {name: getattr(self, name) for name in names}
        return {name: s for name, s in found.items() if s is not None and len(s)}

    def origin(self, near_G: Floats | None, within: float = 1e5) -> Floats | None:
        """The origin of I in ECEF: `near_G` if the first fix is close to it, else that fix.

        None, and so `near_G`, where no position counts from the center of the Earth.
        """
        if self.gnss is None or "position_G" not in self.gnss.values:
            return None
        fixes = self.gnss.values["position_G"]
        known = fixes[np.isfinite(fixes).all(axis=1)]
        if not len(known):
            return None
        if near_G is not None and np.linalg.norm(known[0] - near_G) < within:
            return near_G
        return known[0].copy()  # type: ignore[no-any-return]

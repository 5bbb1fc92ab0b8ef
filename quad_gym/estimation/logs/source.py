"""The common form of all formats: stamped samples by sensor and instance, as a file has them.

A reader of a format only translates its file to sources. All further steps are common
to all formats: `clocks.py` cleans times, `selection.py` selects among the sources of a sensor,
`quantities.py` compares sensors with each other, and `reading.py` puts the steps together.
"""

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from quad_gym.estimation.logs.log import Floats, Stream
from quad_gym.params.aid_table import AID_PARAMS

SENSORS = (
    *("imu", "gyro", "accel", "gnss", "gnss_velocity", *AID_PARAMS),
    *("attitude", "camera", "motors", "battery"),
)
"""Sensors that a source may have; `gyro` and `accel` are the halves of an IMU, `gnss_velocity` has
velocities apart from positions."""

COMMANDS = ("motors", "battery")
"""Sources that are no measurements of the motion."""

TO_FLU = np.array([1.0, -1.0, -1.0])
"""Vectors of a body with x forward, y right, z down as forward, left, up, and the reverse."""


@dataclass(frozen=True, eq=False, kw_only=True)
class LogSource:
    """Samples of one sensor, in the order of the file, with all its defects."""

    sensor: str  #: one of SENSORS
    topic: str  #: topic, message or columns in the file
    instance: int = 0  #: number of the sensor among several
    time: Floats  #: (n,) time stamps [s]; NaN: none
    received: Floats | None = None  #: (n,) times of arrival by the recorder's clock [s]
    row: Any = None  #: (n,) rows of a table whose order is the order of arrival
    values: dict[str, Floats]  #: measurements (n, ...) by name, as in `Stream`; NaN: not measured
    tier: int = 0  #: 0: made for the autopilot's filter, or raw; greater: a substitute
    rank: float = 0.0  #: preference of the autopilot; greater is preferred
    because: str = ""  #: reason of the preference, such as "CAL_MAG1_PRIO 75"
    dropped: Mapping[str, int] = field(default_factory=dict)  #: numbers of rows left out, by reason

    def __len__(self) -> int:
        return len(self.time)

    @property
    def name(self) -> str:
        """Name of the source in sentences."""
        return f"{self.topic} {self.instance}" if self.instance else self.topic

    def keep(self, chosen: Any, reason: str) -> "LogSource":
        """Return the source with some of its rows, and count the others."""
        count = len(self) - int(np.count_nonzero(chosen))
        if not count:
            return self
        arrays: dict[str, Any] = {"time": self.time[chosen]}
        for name in ("received", "row"):
            value = getattr(self, name)
            arrays[name] = None if value is None else value[chosen]
        arrays["values"] = {name: value[chosen] for name, value in self.values.items()}
        dropped = {**self.dropped, reason: self.dropped.get(reason, 0) + count}
        return replace(self, **arrays, dropped=dropped)

    def stream(self) -> Stream:
        """Return the measurements without their origin."""
        received = self.time if self.received is None else np.maximum(self.received, self.time)
        return Stream(self.time, received, self.values)


@dataclass(eq=False)
class RawLog:
    """Contents of a file: the sources of all sensors, and sentences about them."""

    file: str
    sources: Sequence[LogSource]
    barometer_from_start: bool = False
    """True: heights from pressure refer to another level than positions"""
    notes: list[str] = field(default_factory=list)  #: sentences on choices and dropped rows
    problems: list[str] = field(default_factory=list)  #: sentences on wrong quantities

    @property
    def where(self) -> str:
        """Name of the file at the beginning of an error; empty: there is none."""
        return f"{self.file}: " if self.file else ""


def stack(topic: Mapping[str, Any], names: Sequence[str]) -> Floats:
    """Return (n, len(names)) columns of a topic side by side; NaN for a missing one."""
    count = len(next(iter(topic.values())))
    columns = [np.asarray(topic.get(n, np.full(count, np.nan)), np.float64) for n in names]
    return np.column_stack(columns)


def positive(values: Floats) -> Floats:
    """Return valid standard deviations; NaN for the rest, as receivers write 0 for unknown."""
    return np.where(np.isfinite(values) & (values > 0.0), values, np.nan)


@contextmanager
def reading(path: Path | str, kind: str, logs: str, library: str, extra: str) -> Iterator[Path]:
    """Name file and library in errors of a library that reads a log.

    Raises:
        ImportError: If the library is not installed.
        ValueError: If it cannot read the file.
        OSError: If there is no such file.
    """
    file = Path(path)
    try:
        yield file
    except ImportError:
        install = f"install it with pip install 'quad-gym[{extra}]'"
        raise ImportError(f"{logs} need {library}: {install}") from None
    except Exception as error:  # a library raises what it meets in a damaged file
        if not file.exists():
            raise FileNotFoundError(f"there is no file {file}") from None
        raise ValueError(f"{file.name} must be {kind}: {error}") from None

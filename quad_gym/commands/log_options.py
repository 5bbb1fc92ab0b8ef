"""Options and sentences of commands that read logs."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal, cast

from tyro.conf import Positional, arg

from quad_gym.commands.options import Keywords

if TYPE_CHECKING:
    from quad_gym.estimation import Reading

MISFIT = 1  #: exit code if a suite does not describe a log, or the filter diverged or failed

LogFile = Positional[
    Annotated[
        Path,
        arg(
            metavar="LOG",
            help="table (.csv, .csv.gz), log of PX4 (.ulg) or ArduPilot (.bin), bag, EuRoC folder",
        ),
    ]
]
LogFiles = Positional[
    Annotated[
        tuple[Path, ...],
        arg(
            metavar="LOG [LOG ...]",
            help="logs in the formats of quad-gym replay",
            help_behavior_hint="(required)",
        ),
    ]
]


@dataclass(frozen=True, kw_only=True)
class ReadingArgs:
    """Options of commands that read logs."""

    body: Literal["flu", "frd"] = "flu"
    """axes of IMU and magnetometer in a table: forward, left, up; or forward, right, down"""
    instance: Keywords = field(default_factory=dict)
    """sensors to use where the log has several, such as magnetometer=1; defaults to those that
    the autopilot used or prefers, else those with the most valid data"""
    topic: Keywords = field(default_factory=dict)
    """topics of a ROS bag to use, such as imu=/mavros/imu/data_raw"""
    columns: Path | None = None
    """file (.toml) that maps the columns of a table to those of docs/logs.md"""
    from_: Annotated[float | None, arg(name="from")] = None
    """time at which to begin, in the log's clock [s]"""
    until: float | None = None
    """time at which to end [s]"""

    def reading(self) -> "Reading":
        """Return the options as keywords of `read_log`."""
        names = ("body", "instance", "topic", "columns", "from_", "until")
        return cast("Reading", {name: getattr(self, name) for name in names})

    def words(self) -> list[str]:
        """Return the options as words of a command line, as far as they are not the defaults."""
        found = ["--body", self.body] if self.body != "flu" else []
        for name in ("instance", "topic"):
            if pairs := getattr(self, name):
                found += [f"--{name}", *(f"{key}={value}" for key, value in pairs.items())]
        for name in ("columns", "from_", "until"):
            if (value := getattr(self, name)) is not None:
                found += [f"--{name.rstrip('_')}", str(value)]
        return found


def told(notes: Sequence[str]) -> str:
    """Format sentences on what was taken of a log and left out, a line each."""
    return "\n".join(f"{capital(note)}." for note in notes)


def capital(text: str) -> str:
    """Return a text with a capital first letter."""
    return f"{text[0].upper()}{text[1:]}"
